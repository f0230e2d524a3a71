"""`velfield export` on a run: figures at any size, STAC assets that exist, every format on S3."""

import json
import re
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pyogrio
import pytest
import s3fs

from schemas.export import EXPORT_FORMATS, ExportOptions
from schemas.georeference import FlightStart
from tests.exports.test_exports import UTM
from velfield.errors import InputError
from velfield.exports.export import export_module, export_run
from velfield.run.run import Run, open_run
from velfield.run.s3 import S3_OPTIONS


@pytest.fixture
def run(whole: Path) -> Run:
    return open_run(whole)


@pytest.mark.parametrize("name", ["direction", "speed"])
def test_a_figure_has_the_requested_width(name: str, run: Run, tmp_path: Path) -> None:
    shapes = {}
    for width in (None, 400, 1600):
        options = ExportOptions(width_px=width, unit="mph")
        shapes[width] = cv2.imread(str(export_run(run, name, tmp_path / f"{width}.png", options))).shape
    grid = run.grid
    for width, shape in shapes.items():
        expected = grid.width_px if width is None else width
        assert shape[0] == pytest.approx(expected * grid.height_px / grid.width_px, abs=1)
        assert expected < shape[1] < 1.6 * expected + 200  # the legend beside it
    with pytest.raises(InputError, match="at most"):
        export_run(run, name, tmp_path / "huge.png", ExportOptions(width_px=500_000))


def test_a_stac_item_lists_files_that_exist(run: Run, tmp_path: Path) -> None:
    run = georeferenced(run)
    start = datetime(2024, 5, 1, 12, tzinfo=UTC)
    path = export_run(run, "stac", tmp_path / "deep" / "item.json", ExportOptions(start=start))
    item = json.loads(path.read_text())
    assert item["properties"]["start_datetime"] == "2024-05-01T12:00:00Z"
    assert {"field", "direction", "speed"} <= set(item["assets"])
    assert [a["href"] for a in item["assets"].values() if not (path.parent / a["href"]).exists()] == []


def test_stac_names_all_that_is_missing_at_once(run: Run, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no start and no place on Earth, .* --start .* and .* `velfield geor"):
        export_run(run, "stac", tmp_path / "item.json")
    start = ExportOptions(start=datetime(2024, 5, 1, tzinfo=UTC))
    with pytest.raises(InputError, match=r"found no place on Earth, .*; put the map there"):
        export_run(run, "stac", tmp_path / "item.json", start)
    with pytest.raises(InputError, match=r"found no start, expected .*; give --start"):
        export_run(georeferenced(run), "stac", tmp_path / "item.json")


@pytest.mark.parametrize(
    ("is_utc", "shown", "stated"), [(True, "UTC", "x.mp4$"), (False, "by the camera", "taken as UTC$")]
)
def test_the_date_that_the_camera_wrote_is_used(
    is_utc: bool, shown: str, stated: str, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded = FlightStart(clock_s=datetime(2024, 5, 1, 12, tzinfo=UTC).timestamp(), source="x.mp4", is_utc=is_utc)
    monkeypatch.setattr(Run, "start", recorded)
    item = json.loads(export_run(georeferenced(run), "stac", tmp_path / "item.json").read_text())["properties"]
    assert item["start_datetime"] == "2024-05-01T12:00:00Z"
    assert re.search(stated, item["velfield:start_source"])
    poster = export_run(run, "poster", tmp_path / "sheet.svg", ExportOptions(width_px=200)).read_text()
    assert f"2024-05-01 12:00 {shown}" in poster
    given = ExportOptions(start=datetime(2025, 6, 1, tzinfo=UTC))
    item = json.loads(export_run(georeferenced(run), "stac", tmp_path / "item.json", given).read_text())["properties"]
    assert item["start_datetime"] == "2025-06-01T00:00:00Z"
    assert "velfield:start_source" not in item


def test_each_format_is_described_and_a_module() -> None:
    modules = [export_module(name) for name in EXPORT_FORMATS]
    assert len({one.FILE_NAME for one in modules}) == len(modules)
    assert [one for one in modules if not (hasattr(one, "encode") or hasattr(one, "write"))] == []


@pytest.mark.parametrize("name", ["shapefile", "export", "georeference"])
def test_a_format_that_is_none_is_refused_with_those_that_are(name: str) -> None:
    with pytest.raises(InputError, match=f"--format {name}: not known; expected one of cog, geoparquet"):
        export_module(name)


def georeferenced(run: Run) -> Run:
    """As a run on a base image with coordinates would be."""
    grid = run.grid.model_copy(update={"crs_wkt": UTM.to_wkt(), "affine": (0.23, 0.0, 7e5, 0.0, -0.23, 3.5e6)})
    run.__dict__["grid"] = grid
    return run


@pytest.fixture(scope="module")
def remote_root(s3: None, whole: Path) -> str:
    """The run's folder on S3."""
    s3fs.S3FileSystem(**S3_OPTIONS).put(str(whole), "flights/exports/whole", recursive=True)
    return "s3://flights/exports/whole"


NOT_FOUND = {
    "turning_counts": "no junction",
    "utdf": "no intersection",
    "signal_events": "no signal was found",
}
"""What so short a flight has none of: see test_traffic_formats.py."""


@pytest.mark.parametrize("name", sorted(EXPORT_FORMATS))
def test_each_format_is_the_same_from_and_to_s3(name: str, run: Run, remote_root: str, tmp_path: Path) -> None:
    options = ExportOptions(width_px=300, start=datetime(2024, 5, 1, 12, tzinfo=UTC))
    remote = georeferenced(open_run(remote_root))
    if name in NOT_FOUND:
        with pytest.raises(InputError, match=NOT_FOUND[name]):
            export_run(remote, name, options=options)
        return
    path = export_run(remote, name, options=options)
    assert str(path) == f"{remote_root}/exports/{export_module(name).FILE_NAME}"
    local = export_run(georeferenced(run), name, tmp_path / "whole" / "exports" / path.name, options)
    if name == "gpkg":  # it holds the time of its writing
        (tmp_path / "remote.gpkg").write_bytes(path.read_bytes())
        tables = [pyogrio.read_arrow(file)[1] for file in (local, tmp_path / "remote.gpkg")]
        assert tables[0].num_rows == len(run.tracklets())
        assert tables[0].equals(tables[1])
    elif name == "stac":
        items = [json.loads(file.read_bytes()) for file in (local, path)]
        assert items[1]["assets"]["field"]["href"] == "../field.zarr"
        assert items[0].pop("assets").keys() == items[1].pop("assets").keys()
        assert items[0] == items[1]
    else:
        assert local.read_bytes() == path.read_bytes()


def test_a_stac_item_elsewhere_names_files_by_their_whole_address(remote_root: str, tmp_path: Path) -> None:
    run = georeferenced(open_run(remote_root))
    path = export_run(run, "stac", tmp_path / "item.json", ExportOptions(start=datetime(2024, 5, 1, tzinfo=UTC)))
    assert json.loads(path.read_text())["assets"]["field"]["href"] == f"{remote_root}/field.zarr"


def test_an_export_that_fails_leaves_nothing_behind(run: Run, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not georeferenced"):
        export_run(run, "arrows", tmp_path / "arrows.geojson")
    assert list(tmp_path.iterdir()) == []


def test_the_certificates_are_kept_and_shown(run: Run) -> None:
    errors = run.registration.column("error_px")
    assert errors.shape == (run.frames.count, 6, 8)
    assert 0 < float(np.nanmedian(errors)) < 1
    assert (run.layout.maps / "registration.png").exists()
    assert (run.layout.maps / "lens.png").exists() == (not run.frame_transforms.lens.is_identity)
    assert "Registration error" in run.layout.report.read_text()


def test_a_file_where_a_folder_is_expected_is_one_line(run: Run, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file is a file, expected a folder"):
        export_run(run, "geoparquet", tmp_path / "file" / "out.parquet")
