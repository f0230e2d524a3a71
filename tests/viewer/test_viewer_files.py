"""Content of a run folder for its page: tiles of the base image, the list of layers, the report as a file."""

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from schemas.view import ViewRecord
from tests.browser import NEEDS_PAGE
from tests.small_flight import job, process
from velfield import open_run
from velfield.exports.export import export_run
from velfield.pipeline.compare import compare_runs
from velfield.pipeline.stages import report as report_step
from velfield.run.layout import RunLayout
from velfield.run.stores import FieldStore
from velfield.viewer.layers import view_layers
from velfield.viewer.pyramid import OVERLAP_PX, TILE_PX, pyramid_levels, pyramid_tiles


def test_tiles_make_up_the_image_at_every_level() -> None:
    y, x = np.mgrid[:900, :1300]
    grey = (127 + 60 * np.sin(x / 40) + 50 * np.cos(y / 55)).astype(np.uint8)
    tiles = {
        name: cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) for name, data in pyramid_tiles(grey)
    }
    assert pyramid_levels(*grey.shape) == 3
    own = {name: tile[:TILE_PX, :TILE_PX] for name, tile in tiles.items()}
    whole = np.vstack([np.hstack([own[f"0/{row}-{column}.jpg"] for column in range(3)]) for row in range(2)])
    assert np.abs(whole.astype(int) - grey).max() < 12
    assert tiles["2/0-0.jpg"].shape == (225, 325)
    assert max(max(tile.shape) for tile in tiles.values()) <= TILE_PX + OVERLAP_PX
    assert np.abs(tiles["0/0-0.jpg"][:, TILE_PX].astype(int) - grey[: TILE_PX + 1, TILE_PX]).max() < 12


def test_layers_follow_the_store() -> None:
    values = np.array([[np.nan, 1.0, 2.0, 3.0]])
    attributes = {
        "modal_vx": {"units": "px s-1"},
        "modal_vy": {"units": "px s-1"},
        "velocity_variance_sum": {},
        "speed_change": {"units": "px s-1", "long_name": "change of the median speed"},
        "headway": {"units": "s", "long_name": "time between vehicles"},
    }
    layers = {layer.name: layer for layer in view_layers(attributes, lambda _: values)}
    assert list(layers) == ["direction", "speed", "speed_change", "headway"]
    assert layers["speed_change"].kind == "change"
    assert layers["headway"].title == "Time between vehicles"
    assert layers["speed_change"].description.startswith("Change of the median speed. The later field minus")
    assert layers["headway"].colour_max == pytest.approx(2.96)


def test_an_interval_and_one_false_track_do_not_set_the_scale_of_speeds() -> None:
    speeds = np.linspace(5.0, 20.0, 400)[None]
    false_track = np.where(np.arange(400) == 7, 300.0, speeds)
    stored = {"modal_vx": false_track, "modal_vy": 0 * speeds, "speed_p50_ci90_upper": 3 * speeds}
    attributes = {name: {"units": "px s-1"} for name in stored}
    layers = {layer.name: layer for layer in view_layers(attributes, stored.__getitem__)}
    assert layers["speed"].colour_max == pytest.approx(20, rel=0.01)
    assert layers["speed_p50_ci90_upper"].colour_max == layers["speed"].colour_max
    assert (layers["speed"].data_max, layers["speed_p50_ci90_upper"].data_max) == (300, 60)


def test_the_record_lists_what_is_stored(whole: Path) -> None:
    layout = RunLayout(whole)
    record = ViewRecord.model_validate_json(layout.view_record.read_bytes())
    run = open_run(whole)
    assert (record.height_px, record.width_px) == run.field.shape
    assert record.gsd_m == 0.23
    assert run.record.config.field.lane_width_m / 4 / 0.23 == pytest.approx(record.segments.band_radius_px)
    assert record.segments.tracks == len(np.unique(run.segments()["track"]))
    store = FieldStore(layout.field)
    assert all(layer.description for layer in record.layers)
    for layer in record.layers:
        if len(layer.arrays) == 1:  # in the store's own words
            assert layer.description.lower().startswith(store.layer_attributes(layer.arrays[0])["long_name"].lower())
    for name, array in record.arrays.items():
        chunks = layout.root / array.store / name / "c"
        listed = set(zip(array.stored[::2], array.stored[1::2], strict=True))
        tail = ("0", "0") if name == "velocity_histogram" else ()
        assert all((chunks / str(row) / str(column)).joinpath(*tail).is_file() for row, column in listed)
        assert len(listed) == len(list(chunks.glob("*/*")))


def test_what_compare_left_is_shown(whole: Path, tmp_path: Path) -> None:
    root = tmp_path / "run"
    shutil.copytree(whole, root, ignore=shutil.ignore_patterns("raw"))
    compare_runs(whole, root, tmp_path / "comparison")
    record = ViewRecord.model_validate_json(RunLayout(root).view_record.read_bytes())
    changes = [layer for layer in record.layers if layer.kind == "change"]
    assert [layer.name for layer in changes] == ["direction_change", "speed_change", "volume_change"]
    assert changes[1].title == "Change of speed since whole"
    assert changes[1].units == "px s-1"
    assert record.arrays["speed_change"].store == "view/change.zarr"
    assert (root / record.arrays["speed_change"].store / "speed_change" / "zarr.json").is_file()


def test_the_report_goes_by_mail(whole: Path, tmp_path: Path) -> None:
    page = export_run(open_run(whole), "report", tmp_path / "report.html").read_text()
    assert page.count("data:image/jpeg;base64,") >= 2
    assert "clockwise from the top of the image" in (whole / "index.html").read_text()
    assert not re.findall(r'(?:src|href)="(?!data:)', page)
    assert "<script" not in page
    assert "Direction of travel" in page


def test_without_a_built_page_the_report_stands_alone_and_it_is_said(
    copy: Path, flight: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from flows.console import Console

    warnings: list[str] = []
    monkeypatch.setattr(Console, "warn", lambda self, text: warnings.append(text))
    monkeypatch.setattr(report_step, "page_is_built", lambda: False)
    process(job(flight, copy))
    assert any("make page" in line for line in warnings)
    page = (copy / "index.html").read_text()
    assert "<script" not in page
    assert "Direction of travel" in page


@NEEDS_PAGE
def test_the_page_holds_its_licences_and_no_address_elsewhere(whole: Path) -> None:
    licences = (whole / "view" / "LICENSES.txt").read_text()
    for package in ("leaflet", "zarrita", "zstddec"):
        assert f"{package} " in licences
    assert "Redistribution" in licences
    page = re.sub(r"<script>.*?</script>", "", (whole / "index.html").read_text(), flags=re.DOTALL)
    assert not re.findall(r'(?:src|href)="(?:https?:)?//', page)
