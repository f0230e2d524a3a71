"""Tables of a run folder: parts are concatenated with their types; a second name of a file has its bytes."""

import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from schemas.tables import TRACKLET_COLUMNS
from velfield.run import tables
from velfield.run.layout import to_path
from velfield.run.tables import (
    conform,
    empty_table,
    link_file,
    link_files,
    read_arrays,
    read_tables,
    write_arrays,
    write_table,
)

COLUMNS = {"frame": "int32", "x_px": "float64"}


def part(*frames: int) -> pd.DataFrame:
    return pd.DataFrame({"x_px": np.array(frames) / 3, "frame": np.array(frames, np.int64), "beside": "of no use"})


def test_a_table_has_the_columns_it_must_have_in_their_order_and_types() -> None:
    table = conform(part(3, 4), COLUMNS)
    assert table.dtypes.astype(str).to_dict() == COLUMNS
    assert list(table) == list(COLUMNS)
    with pytest.raises(KeyError):
        conform(part(3).drop(columns="x_px"), COLUMNS)


def test_parts_are_put_together_in_order_and_empty_ones_change_no_type(tmp_path: Path) -> None:
    parts = [part(3, 4), empty_table(COLUMNS), part(1)]
    paths = [tmp_path / f"{k}.parquet" for k in range(3)]
    for path, table in zip(paths, parts, strict=True):
        write_table(path, table, COLUMNS)
    whole = read_tables(paths, COLUMNS)
    assert whole["frame"].tolist() == [3, 4, 1]
    assert whole["x_px"].tolist() == [1.0, 4 / 3, 1 / 3]
    assert whole.dtypes.astype(str).to_dict() == COLUMNS
    assert whole.index.tolist() == [0, 1, 2]
    assert list(read_tables(paths, COLUMNS, only=("x_px",))) == ["x_px"]


@pytest.mark.parametrize("count", [0, 2])
def test_a_table_without_rows_has_its_types(count: int, tmp_path: Path) -> None:
    paths = [tmp_path / f"{k}.parquet" for k in range(count)]
    for path in paths:
        write_table(path, empty_table(TRACKLET_COLUMNS), TRACKLET_COLUMNS)
    assert read_tables(paths, TRACKLET_COLUMNS).dtypes.astype(str).to_dict() == TRACKLET_COLUMNS


def test_patches_come_back_by_name(tmp_path: Path) -> None:
    patches = {"small": np.arange(24, dtype=np.uint8).reshape(2, 3, 4), "none": np.empty((0, 8, 16), np.uint8)}
    write_arrays(tmp_path / "p.npz", patches)
    read = read_arrays(tmp_path / "p.npz")
    assert read.keys() == patches.keys()
    assert all(np.array_equal(read[name], values) for name, values in patches.items())
    some = read_arrays(tmp_path / "p.npz", only=["none"])
    assert some.keys() == {"none"}
    assert some["none"].shape == (0, 8, 16)
    assert list(tmp_path.glob("*.partial")) == []


def test_arrays_in_parts_are_written_as_numpy_writes_them_whole(tmp_path: Path) -> None:
    whole = {"crops": np.arange(60, dtype=np.uint8).reshape(5, 3, 4), "xy": np.arange(8.0).reshape(2, 4).T}
    whole |= {"scale": np.array(0.5), "none": np.empty((0, 2))}
    crops = [whole["crops"][:0], whole["crops"][:2], whole["crops"][2:]]
    write_arrays(tmp_path / "parts.npz", whole | {"crops": crops, "xy": np.ascontiguousarray(whole["xy"])})
    np.savez(tmp_path / "whole.npz", allow_pickle=False, **(whole | {"xy": np.ascontiguousarray(whole["xy"])}))
    assert (tmp_path / "parts.npz").read_bytes() == (tmp_path / "whole.npz").read_bytes()
    write_arrays(tmp_path / "columns.npz", {"xy": whole["xy"]})
    np.testing.assert_array_equal(read_arrays(tmp_path / "columns.npz")["xy"], whole["xy"])


def test_a_second_name_has_the_same_bytes_and_does_not_follow_a_replacement(tmp_path: Path) -> None:
    source, target = tmp_path / "a.bin", tmp_path / "deep/b.bin"
    source.write_bytes(b"one")
    assert link_file(source, target) == target
    assert os.path.samefile(source, target)
    tables.write_atomically(source, b"two")
    assert target.read_bytes() == b"one"
    link_files([(source, target)])
    assert target.read_bytes() == b"two"


def test_on_another_disk_the_bytes_are_copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(os, "link", refuse)
    (tmp_path / "a.bin").write_bytes(b"one")
    link_files([(tmp_path / "a.bin", tmp_path / "b.bin")])
    assert (tmp_path / "b.bin").read_bytes() == b"one"
    assert not os.path.samefile(tmp_path / "a.bin", tmp_path / "b.bin")


@pytest.mark.parametrize("direction", ["up", "down"])
def test_between_a_disk_and_s3_the_bytes_are_copied(direction: str, s3: None, tmp_path: Path) -> None:
    here = tmp_path / "a.bin"
    remote = to_path(f"s3://flights/tables/{tmp_path.name}/a.bin")
    source, target = (here, remote) if direction == "up" else (remote, here)
    source.write_bytes(b"one")
    link_files([(source, target)])
    assert target.read_bytes() == b"one"
