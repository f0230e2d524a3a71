"""Tracks of other programs: each format read with its axes, units and times, and what is refused."""

import warnings
from functools import cache
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
    degrees,
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
            "frames": FramesConfig(fps=options.get("fps")),
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


@cache
def queues(unit_m: float, vehicles: int = 12) -> pd.DataFrame:
    """Vehicles that come at 12 m/s, stand 7 m behind the one before, and drive on, all at 1.5 m/s2; x in a unit."""
    parts = []
    for k in range(vehicles):
        time_s, place, arrives, departs = np.arange(0, 80, 0.4), 150.0 - 7.0 * k, 25.0 + 1.5 * k, 48 + 1.5 * k
        to_go, gone = (np.clip(span, 0, None) for span in (arrives - time_s, time_s - departs))
        braking, speeding = (
            0.75 * np.minimum(span, 8) ** 2 + 12 * np.clip(span - 8, 0, None) for span in (to_go, gone)
        )
        x = place - braking + speeding
        there = (x > 0) & (x < 330)
        parts.append(pd.DataFrame({"id": k, "time_s": time_s[there], "x_m": x[there] / unit_m, "y_m": 5.0 / unit_m}))
    return pd.concat(parts)


@pytest.mark.parametrize(("unit_m", "warned"), [(1.0, 0), (0.3048, 2), (3.2808, 2)])
def test_gaps_and_accelerations_show_a_wrong_unit(unit_m: float, warned: int, tmp_path: Path) -> None:
    """Speeds alone would be those of a motorway, or of a street."""
    queues(unit_m).to_csv(tmp_path / "t.csv", index=False)
    notes = load(tmp_path / "t.csv", {}).notes
    found = [note for note in notes if note.startswith("warning")]
    assert len(found) == warned, notes
    assert all("--unit" in note for note in found)


def table_by_rule(number: int) -> tuple[str, bytes, dict[str, object], float]:
    """A table of `queues` with unit, axis, times, names, separator, encoding, line ends and order by lot: its name,
    bytes and options, and metres for one of what it says are metres; 1: it says the truth."""
    lot = np.random.default_rng(number)

    def one(*choices: object) -> str:
        return str(choices[lot.integers(len(choices))])

    table, unit, axis, said_unit = queues(1.0), one("m", "ft", "px"), one("up", "down"), one("name", "option")
    wrong = unit != "px" and lot.random() < 0.25
    x, y = table["x_m"], 60.0 + np.sin(table["x_m"] / 50) * (1 if axis == "down" else -1)
    called = {"m": "ft", "ft": "m"}[unit] if wrong else unit
    per_m = {"m": 1.0, "ft": 1 / 0.3048, "px": 5.0}[unit]
    suffix = f"_{called}" if said_unit == "name" else ""
    options: dict[str, object] = {} if said_unit == "name" else {"unit": called}
    if not (called == "m" and suffix) and called != "px":
        options["y_axis"] = axis
    if (called == "m" and suffix) or called == "px":  # y points down by that name
        y = 60.0 + np.sin(table["x_m"] / 50)
    options |= {"gsd_m": 0.2} if unit == "px" else {}
    time_s = table["time_s"]
    stamps = {
        "time_s": lambda: time_s,
        "timestamp_ms": lambda: (time_s * 1000).round().astype("int64"),
        "time": lambda: (pd.Timestamp("2025-06-01T12:00:00Z") + pd.to_timedelta(time_s, unit="s")).astype(str),
        "unixtime": lambda: (1.75e12 + time_s * 1000).round().astype("int64"),
    }
    time_name = one(*stamps)
    made = pd.DataFrame({one("track_id", "Vehicle ID", "ID", "objectId"): table["id"], time_name: stamps[time_name]()})
    made[f"x{suffix}"], made[f"y{suffix}"] = x * per_m, y * per_m
    if lot.random() < 0.3:
        moved = table.groupby("id")[["x_m", "time_s"]].diff().bfill()
        name, factor = [("speed_mps", 1.0), ("speed [km/h]", 3.6), ("speed", 3.6), ("Speed (mph)", 1 / 0.44704)][
            number % 4
        ]
        made[name] = moved["x_m"] / moved["time_s"] * factor
    if lot.random() < 0.5:
        made = made.sample(frac=1.0, random_state=number)
    separator, encoding, end = (
        one(",", ";", "\t", "|", ";,"),
        one("utf-8", "utf-8-sig", "utf-16"),
        one("\n", "\r\n", "\r"),
    )
    text = made.to_csv(
        index=False, sep=separator[0], decimal="," if separator == ";," else ".", lineterminator=end, quoting=number % 2
    )
    factor = 1.0 if not wrong else {"m": 0.3048, "ft": 1 / 0.3048}[unit]
    return (
        f"{number}: {unit} called {called} by {said_unit}, {axis}, {time_name}",
        text.encode(encoding),
        options,
        factor,
    )


def outcome(path: Path, options: dict[str, object]) -> tuple[LoadedTracks | None, str]:
    """What was loaded, and the warnings; or nothing, and the refusal."""
    try:
        loaded = load(path, options)
    except InputError as error:
        return None, str(error)
    return loaded, " ".join(note for note in loaded.notes if note.startswith("warning"))


@pytest.mark.filterwarnings("error")
def test_two_hundred_tables_by_rule_are_right_or_not_without_a_word(tmp_path: Path) -> None:
    truth = queues(1.0).groupby("id")["x_m"].agg(lambda x: x.iloc[-1] - x.iloc[0]).to_numpy()
    right = 0
    for number in range(200):
        name, data, options, factor = table_by_rule(number)
        (tmp_path / "t.csv").write_bytes(data)
        loaded, said = outcome(tmp_path / "t.csv", options)
        assert "\n" not in said, name
        assert bool(said) == (factor != 1.0), f"{name}: {said}"
        if said or loaded is None:
            continue
        xy = loaded.xy_m - loaded.xy_m.min(axis=0)
        names = loaded.names.reindex(loaded.table["track_id"]).to_numpy()
        found = pd.Series(xy[:, 0]).groupby(names).agg(lambda x: x.iloc[-1] - x.iloc[0])
        assert sorted(found) == pytest.approx(sorted(truth), abs=1.0), name
        assert np.corrcoef(np.sin(xy[:, 0] / 50), xy[:, 1])[0, 1] > 0.98, name  # y down
        right += 1
    assert 120 < right < 180


@pytest.mark.parametrize(
    ("names", "north_deg"),
    [(("utm_x", "utm_y"), 90.0), (("easting", "northing"), 90.0), (("lon", "lat"), 88.73), (("x_m", "y_m"), None)],
)
def test_north_is_known_of_degrees_and_of_coordinates_to_the_east_and_north(
    tmp_path: Path, names: tuple[str, str], north_deg: float | None
) -> None:
    """In the UTM zone of 15 degrees true north is 1.27 degrees to the right of the grid's at 13.4 degrees east."""
    t = vehicles()
    x, y = degrees(t) if names[0] == "lon" else (t["east"] + 400000, t["north"] + 5800000)
    table = pd.DataFrame({"track_id": t["id"], "time_s": t["t"], names[0]: x, names[1]: y})
    table.to_csv(tmp_path / "tracks.csv", index=False)
    found = load(tmp_path / "tracks.csv", {}).north_rad
    assert (found is None) == (north_deg is None)
    if found is not None and north_deg is not None:
        assert -np.degrees(found) == pytest.approx(north_deg, abs=0.1)


def test_columns_without_a_number_or_a_length_are_named(tmp_path: Path) -> None:
    t = vehicles()
    table = pd.DataFrame({"track_id": t["id"], "time_s": t["t"], "utm_x": t["east"], "utm_y": t["north"]})
    table.assign(length_m=-4.5).to_csv(tmp_path / "short.csv", index=False)
    found = load(tmp_path / "short.csv", {})
    assert "length_m holds no length of 0.3 to 40 m: it is left out" in found.notes
    assert "length_m" not in found.table
    table.assign(utm_x=np.nan).to_csv(tmp_path / "empty.csv", index=False)
    with pytest.raises(InputError, match="found no number in columns utm_x and utm_y"):
        load(tmp_path / "empty.csv", {})


@pytest.mark.parametrize(("unit", "metres"), [("mm", 0.001), ("cm", 0.01), ("ft", 0.3048)])
def test_a_unit_read_as_metres_is_named_by_the_speeds(tmp_path: Path, unit: str, metres: float) -> None:
    """Twelve vehicles at 60 km/h, and at 110 km/h, of which metres are plausible."""
    rows = [(k, 3.0 * k + t, 60 / 3.6 * t, 4.0 * (k % 2)) for k in range(12) for t in np.arange(0, 12, 0.2)]
    table = pd.DataFrame(rows, columns=["id", "time_s", "x", "y"])
    path = tmp_path / "t.csv"
    table.assign(x=table["x"] / metres, y=table["y"] / metres).to_csv(path, index=False)
    loaded, said = outcome(path, {"unit": "m", "y_axis": "up"})
    assert f"--unit {unit} makes it 60 km/h" in said
    assert (loaded is not None) == (unit == "ft")  # 197 km/h may be real
    loaded, said = outcome(path, {"unit": unit, "y_axis": "up"})
    assert loaded is not None
    assert said == ""
    table.assign(x=table["x"] * 110 / 60).to_csv(path, index=False)
    assert outcome(path, {"unit": "m", "y_axis": "up"})[1] == ""


@pytest.mark.parametrize("by_time", [False, True])
def test_rows_that_descend_in_time_are_reported(tmp_path: Path, by_time: bool) -> None:
    t = vehicles()
    table = pd.DataFrame({"track_id": t["id"], "time_s": t["t"], "x_m": t["east"], "y_m": t["north"]})
    table = table.sort_values("time_s") if by_time else table
    back = table.assign(time_s=table["time_s"].max() - table["time_s"])
    for one, reported in ((table, False), (back, True), (table.sample(frac=1.0, random_state=1), False)):
        one.to_csv(tmp_path / "t.csv", index=False)
        found = [note for note in load(tmp_path / "t.csv", {}).notes if "descending order of time" in note]
        assert [note.startswith("warning: the rows of 8 of 8 tracks") for note in found] == [True] * reported


@pytest.mark.parametrize(("y_axis", "way"), [(None, 1.0), ("down", 1.0), ("up", -1.0)])
def test_metres_of_no_format_point_down_or_as_is_said(tmp_path: Path, y_axis: str | None, way: float) -> None:
    rows = [(k, 0.2 * t, 10.0 * k, 2.0 * t) for k in range(4) for t in range(30)]
    pd.DataFrame(rows, columns=["id", "time_s", "x_m", "y_m"]).to_csv(tmp_path / "t.csv", index=False)
    loaded = load(tmp_path / "t.csv", {"y_axis": y_axis})
    one = loaded.table.query("track_id == track_id.min()").sort_values("time_s")
    assert (one["y_px"].iloc[-1] - one["y_px"].iloc[0]) * loaded.gsd_m == pytest.approx(way * 58.0, abs=1.0)
    assert ("taken so; --y-axis up where it points up" in " ".join(loaded.notes)) == (y_axis is None)
