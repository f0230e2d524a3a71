"""`velfield export` on a run: figures at any size, a STAC item whose assets are where it says."""

import json
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest

from schemas.summary import RunSummary
from tests.exports.test_exports import UTM
from velfield.errors import InputError
from velfield.exports.export import FORMATS, ExportOptions, export_run
from velfield.run.run import Run, open_run


@pytest.fixture
def run(whole: tuple[Path, RunSummary]) -> Run:
    return open_run(whole[0])


@pytest.mark.parametrize("name", ["direction", "speed"])
def test_a_figure_has_the_width_that_was_asked_for(name: str, run: Run, tmp_path: Path) -> None:
    shapes = {}
    for width in (None, 400, 1600):
        options = ExportOptions(width_px=width, unit="mph")
        shapes[width] = cv2.imread(str(export_run(run, name, tmp_path / f"{width}.png", options))).shape
    grid = run.grid
    for width, shape in shapes.items():
        wanted = grid.width_px if width is None else width
        assert shape[0] == pytest.approx(wanted * grid.height_px / grid.width_px, abs=1)
        assert wanted < shape[1] < 1.6 * wanted + 200  # the legend beside it
    with pytest.raises(InputError, match="at most"):
        export_run(run, name, tmp_path / "huge.png", ExportOptions(width_px=500_000))


def test_a_stac_item_names_what_is_there(run: Run, tmp_path: Path) -> None:
    placed = run.grid.model_copy(update={"crs_wkt": UTM.to_wkt(), "affine": (0.23, 0.0, 7e5, 0.0, -0.23, 3.5e6)})
    run.__dict__["grid"] = placed  # as a run on a base image with coordinates would have it
    start = datetime(2024, 5, 1, 12, tzinfo=UTC)
    path = export_run(run, "stac", tmp_path / "deep" / "item.json", ExportOptions(start=start))
    item = json.loads(path.read_text())
    assert item["properties"]["start_datetime"] == "2024-05-01T12:00:00Z"
    assert {"field", "direction", "speed"} <= set(item["assets"])
    assert [a["href"] for a in item["assets"].values() if not (path.parent / a["href"]).exists()] == []


def test_stac_wants_to_know_when(run: Run, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--start"):
        export_run(run, "stac", tmp_path / "item.json")


def test_the_command_knows_the_formats_that_there_are() -> None:
    from typing import get_args

    from flows.commands.export import Format

    assert set(get_args(Format)) == set(FORMATS)


def test_the_certificates_are_kept_and_shown(run: Run) -> None:
    errors = run.registration.column("error_px")
    assert errors.shape == (run.frames.count, 6, 8)
    assert 0 < float(np.nanmedian(errors)) < 1
    assert (run.layout.maps / "registration.png").exists()
    assert (run.layout.maps / "lens.png").exists() == (not run.maps.lens.is_identity)
    assert "How well frames lie on the map" in run.layout.report.read_text()
