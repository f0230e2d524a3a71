"""Tracks of other programs: each format read with its axes, units and times, and what is refused."""

import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from schemas.flight import FlightConfig, FramesConfig
from tests.track_files import (
    FORMATS,
    SPEED_M_PER_S,
    VEHICLES,
    Variant,
    ambiguous,
    csv_text,
    geotrax,
    ind,
    parquet_bytes,
    variants,
    vehicles,
    write_format,
)
from velfield.errors import InputError
from velfield.pipeline.given_tracks.load import LoadedTracks, load_tracks


def load(path: Path, options: dict[str, object]) -> LoadedTracks:
    config = FlightConfig.model_validate(
        {
            "gsd_m": options.get("gsd_m"),
            "position_unit": options.get("unit"),
            "position_y_axis": options.get("y_axis"),
            "frames": FramesConfig(fps=options.get("fps")),  # type: ignore[arg-type]
        }
    )
    return load_tracks(path, config)


def assert_left_turn_at_36_km_h(loaded: LoadedTracks, *, duration_s: float | None = None) -> None:
    """Eight vehicles from the west to the north, the image's y downwards, at 10 m/s."""
    table = loaded.table
    assert table["track_id"].nunique() == VEHICLES
    first, last = (table.groupby("track_id")[["x_px", "y_px"]].nth(k).to_numpy() * loaded.gsd_m for k in (0, -1))
    assert np.allclose(last - first, [70.0, -68.0], atol=1.0)
    steps = table.groupby("track_id")[["x_px", "y_px", "time_s"]].diff().dropna()
    speed = np.hypot(steps["x_px"], steps["y_px"]) * loaded.gsd_m / steps["time_s"]
    assert np.median(speed) == pytest.approx(SPEED_M_PER_S, rel=0.02)
    if duration_s is not None:
        assert table["time_s"].max() == pytest.approx(duration_s, abs=0.01)


@pytest.mark.parametrize("name", FORMATS)
def test_each_format_is_read_with_its_axes_units_and_times(name: str, tmp_path: Path) -> None:
    path, options = write_format(name, tmp_path)
    loaded = load(path, options)
    assert_left_turn_at_36_km_h(loaded, duration_s=vehicles()["t"].max())
    assert name.split(" in ")[0] in loaded.notes[0]


@pytest.mark.parametrize("variant", list(variants()), ids=lambda variant: variant.name)
def test_tables_by_rule_are_read_as_meant(variant: Variant, tmp_path: Path) -> None:
    path = tmp_path / variant.file_name
    path.write_bytes(variant.data)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = load(path, variant.options)
    assert_left_turn_at_36_km_h(loaded, duration_s=vehicles()["t"].max())


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("variant", list(ambiguous()), ids=lambda variant: variant.name)
def test_what_can_be_read_in_two_ways_is_one_line(variant: Variant, tmp_path: Path) -> None:
    path = tmp_path / variant.file_name
    path.write_bytes(variant.data)
    with pytest.raises(InputError) as error:
        load(path, variant.options)
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)


def test_degrees_place_the_map(tmp_path: Path) -> None:
    path, _ = write_format("pNEUMA", tmp_path)
    loaded = load(path, {})
    assert "UTM zone 33N" in str(loaded.crs_wkt)
    assert loaded.affine is not None
    assert loaded.affine[4] == -loaded.gsd_m


def test_latitudes_of_the_file_decide_where_y_points(tmp_path: Path) -> None:
    table = geotrax(vehicles())
    (tmp_path / "t.csv").write_text(csv_text(table.assign(Local_Y=-table["Local_Y"])))
    loaded = load(tmp_path / "t.csv", {})
    assert_left_turn_at_36_km_h(loaded)
    assert any("Local_Y points down, by the file's latitudes" in note for note in loaded.notes)


def test_pixels_of_a_format_that_has_metres_too(tmp_path: Path) -> None:
    path, _ = write_format("geo-trax", tmp_path)
    assert_left_turn_at_36_km_h(load(path, {"unit": "px", "gsd_m": 1 / 33.3}))


def test_two_recordings_in_one_table_are_twice_as_many_vehicles(tmp_path: Path) -> None:
    table = ind(vehicles())
    (tmp_path / "t.csv").write_text(
        csv_text(pd.concat([table, table.assign(recordingId=1, yCenter=table["yCenter"] - 9)]))
    )
    loaded = load(tmp_path / "t.csv", {"fps": 5.0})
    assert loaded.table["track_id"].nunique() == 2 * VEHICLES
    assert any("2 recordings (recordingId)" in note for note in loaded.notes)


def test_frame_rate_of_the_recording_lies_beside_it(tmp_path: Path) -> None:
    (tmp_path / "07_tracks.csv").write_text(csv_text(ind(vehicles())))
    (tmp_path / "07_recordingMeta.csv").write_text("recordingId,locationId,frameRate\n7,1,5\n")
    assert_left_turn_at_36_km_h(load(tmp_path / "07_tracks.csv", {}))


def test_names_that_come_back_are_other_vehicles(tmp_path: Path) -> None:
    table = ind(vehicles())
    (tmp_path / "t.csv").write_text(csv_text(pd.concat([table, table.assign(frame=table["frame"] + 100_000)])))
    loaded = load(tmp_path / "t.csv", {"fps": 5.0})
    assert loaded.table["track_id"].nunique() == 2 * VEHICLES
    assert any("come back" in note for note in loaded.notes)


def test_rows_twice_are_left_out_with_a_word(tmp_path: Path) -> None:
    table = ind(vehicles())
    (tmp_path / "t.csv").write_text(csv_text(pd.concat([table, table])))
    loaded = load(tmp_path / "t.csv", {"fps": 5.0})
    assert_left_turn_at_36_km_h(loaded)
    assert any(f"{len(table)} rows" in note for note in loaded.notes)


def test_parquet_with_times_of_its_own_kind(tmp_path: Path) -> None:
    t = vehicles()
    stamps = pd.Timestamp("2025-10-26T00:59:30Z") + pd.to_timedelta(t["t"], unit="s")
    table = pd.DataFrame({"id": t["id"], "time": stamps, "x_m": t["east"], "y_m": 90 - t["north"]})
    (tmp_path / "t.parquet").write_bytes(parquet_bytes(table))
    assert_left_turn_at_36_km_h(load(tmp_path / "t.parquet", {}), duration_s=t["t"].max())
