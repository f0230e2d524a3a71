"""Differences that `tests.faults.determinism` reports, and their sizes."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import zarr

from tests.faults.determinism import TOLERANCE, largest_difference


def test_tables_differ_by_their_numbers_or_without_bound(tmp_path: Path) -> None:
    table = pd.DataFrame({"frame": [1, 2], "x_px": [0.5, np.nan], "class": ["car", "van"]})
    table.to_parquet(tmp_path / "a.parquet")
    table.assign(x_px=[0.5 + 1e-3, np.nan]).to_parquet(tmp_path / "b.parquet")
    table.assign(**{"class": ["car", "bus"]}).to_parquet(tmp_path / "c.parquet")
    table.iloc[:1].to_parquet(tmp_path / "d.parquet")
    assert largest_difference(tmp_path / "a.parquet", tmp_path / "b.parquet") == pytest.approx(1e-3)
    assert largest_difference(tmp_path / "a.parquet", tmp_path / "c.parquet") == np.inf
    assert largest_difference(tmp_path / "a.parquet", tmp_path / "d.parquet") == np.inf
    assert largest_difference(tmp_path / "a.parquet", tmp_path / "none.parquet") == np.inf


def test_records_differ_by_their_numbers_or_without_bound(tmp_path: Path) -> None:
    record = {"error_px": 0.25, "points": [[1.0, 2.0]], "base_source": "given", "n": 3}
    for name, change in (("a", {}), ("b", {"points": [[1.0, 2.0 + 1e-9]]}), ("c", {"n": 4}), ("d", {"new": 1.0})):
        (tmp_path / f"{name}.json").write_text(json.dumps(record | change))
    assert 0 < largest_difference(tmp_path / "a.json", tmp_path / "b.json") < TOLERANCE
    assert largest_difference(tmp_path / "a.json", tmp_path / "c.json") == np.inf
    assert largest_difference(tmp_path / "a.json", tmp_path / "d.json") == np.inf


def test_a_chunk_differs_by_the_numbers_of_its_array(tmp_path: Path) -> None:
    for name, value in (("a", 1.0), ("b", 1.0 + 2.0**-20)):
        array = zarr.create_array(tmp_path / name / "x", shape=(4, 2), chunks=(2, 2), dtype="float32")
        array[...] = value
    assert largest_difference(tmp_path / "a/x/c/0/0", tmp_path / "b/x/c/0/0") == 2.0**-20
