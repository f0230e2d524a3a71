"""Files that engineers pass on: turning counts as a workbook, moving features, each read back by another reader."""

import io
import re
import struct
import zipfile
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pandas as pd
import pytest

from tests.analysis.test_traffic_analysis import analysis, in_two_clips
from tests.field_runs import field_run, tracklets_along
from tests.turning_crossroads import apart_deg, sides, turning_crossroads
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.errors import InputError
from velfield.exports.export import export_run
from velfield.exports.junctions.signal_events import event_archive
from velfield.exports.junctions.turning_counts import junction_rows, peak_hour_factor, turning_workbook
from velfield.exports.junctions.utdf import utdf
from velfield.exports.tracks import ssam

__all__ = ["analysis"]


def test_counts_are_those_of_the_crossroads(analysis: TrafficAnalysis) -> None:
    found = next(m for m in analysis.movements if m.junction.kind == "intersection")
    rows = {str(row[0]): row for row in junction_rows(analysis, found)}
    head = rows["From the start, min"]
    counted = dict(zip(head[1:], rows["Counted"][1:], strict=True))
    assert counted == {"EB R": 12, "EB T": 48, "SB T": 48, "All": 108}
    total = counted["All"] + rows["Inferred of cut tracks"][-1]
    assert total == pytest.approx(sum(m.seen + m.inferred for m in found.movements), abs=0.2)
    assert "an hour is needed" in rows["Peak-hour factor"][1]
    assert set(rows["Heavy vehicles, %"][1:]) == {"not known"}


def test_the_peak_hour_is_the_busiest_one() -> None:
    assert peak_hour_factor(np.array([1, 1, 10, 10, 10, 20])) == pytest.approx(50 / 80)
    assert peak_hour_factor(np.array([5, 5, 5])) is None
    assert peak_hour_factor(np.zeros(4, np.int64)) is None


def test_the_workbook_holds_the_counts(analysis: TrafficAnalysis) -> None:
    data = turning_workbook(analysis)
    with zipfile.ZipFile(io.BytesIO(data)) as book:
        names = re.findall(r'sheet name="([^"]+)"', book.read("xl/workbook.xml").decode())
        words = [e.text for e in ET.fromstring(book.read("xl/sharedStrings.xml")).iter() if e.tag.endswith("}t")]
        numbers = re.findall(r"<v>([\d.]+)</v>", book.read("xl/worksheets/sheet1.xml").decode())
    assert all(name.startswith("junction ") for name in names)
    assert {"EB T", "EB R", "SB T"} <= set(words)
    assert "108" in numbers


def test_no_junction_is_one_line() -> None:
    from tests.analysis.test_traffic_analysis import drive, gather

    alone = TrafficAnalysis(gather([drive(np.array([[0.0, 10.0], [100.0, 10.0]]), 0.0)]))
    with pytest.raises(InputError, match="no junction with movements"):
        turning_workbook(alone)


@pytest.mark.filterwarnings("ignore:The inplace keyword", "ignore:Time zone information dropped")  # of the reader
def test_moving_pandas_reads_the_trajectories(tmp_path: Path) -> None:
    movingpandas = pytest.importorskip("movingpandas")
    rng = np.random.default_rng(0)
    paths = [np.column_stack([np.arange(0, 390, 6.0), 50 + rng.normal(0, 0.1, 65)]) for _ in range(3)]
    run = field_run(tmp_path / "run", tracklets_along(paths), shape=(100, 400), gsd_m=0.25)
    file = export_run(run, "moving_features", tmp_path / "t.json")
    read = movingpandas.read_mf_json(str(file), traj_id_property="track_id")
    trajectories = run.analysis.trajectories
    assert len(read.trajectories) == len(trajectories) == 3
    rows = next(iter(trajectories))
    first = read.trajectories[0]
    assert len(first.df) == rows.stop - rows.start
    length = np.hypot(*np.diff(trajectories.xy_m[rows], axis=0).T).sum()
    steps = np.diff(np.array([(point.x, point.y) for point in first.df.geometry]), axis=0)
    assert np.hypot(*steps.T).sum() == pytest.approx(length, rel=0.02)
    assert first.get_duration().total_seconds() == pytest.approx(np.ptp(trajectories.time_s[rows]), abs=0.01)


def utdf_sections(text: str) -> dict[str, pd.DataFrame]:
    """The tables of a UTDF file, by section, each as its own header names it."""
    parts = re.split(r"^\[(\w+)\]\n", text, flags=re.MULTILINE)[1:]
    tables = zip(parts[::2], parts[1::2], strict=True)
    return {name: pd.read_csv(io.StringIO(body), skiprows=1, skip_blank_lines=True) for name, body in tables}


def test_utdf_holds_volumes_lanes_and_phases(analysis: TrafficAnalysis) -> None:
    """The crossroads: 48 straight on and 12 to the right from the west, 48 from the north, a cycle of 40 s."""
    sections = utdf_sections(utdf(analysis, height_m=100.0))
    assert set(sections) == {"Network", "Nodes", "Links", "Lanes", "Timeplans", "Phases"}
    found = next(m for m in analysis.movements if m.junction.kind == "intersection")
    number = found.junction.number + 1
    lanes = sections["Lanes"].query("INTID == @number").set_index("RECORDNAME")
    hours = analysis.trajectories.duration_s / 3600
    assert lanes.loc["Volume", ["EBT", "EBR", "SBT"]].astype(float).to_numpy() * hours == pytest.approx(
        [48, 12, 48], abs=1
    )
    # the lane from the west goes straight on and to the right
    assert lanes.loc["Lanes", ["EBT", "EBR", "SBT"]].astype(int).tolist() == [1, 0, 1]
    assert lanes.loc["Shared", ["EBT", "SBT"]].astype(int).tolist() == [2, 0]
    phase = lanes.loc["Phase1", ["EBT", "SBT"]].astype(int)
    assert sorted(phase) == [1, 2]
    plan = sections["Timeplans"].query("INTID == @number").set_index("RECORDNAME")["DATA"].astype(float)
    assert plan["Cycle Length"] == pytest.approx(40.0, abs=0.2)
    phases = sections["Phases"].query("INTID == @number").set_index("RECORDNAME")
    apart = (phases.loc["Start", f"D{phase['SBT']}"] - phases.loc["Start", f"D{phase['EBT']}"]) % plan["Cycle Length"]
    signal = analysis.signals[found.junction.number]
    greens = {s.stream.approach.lane: s.green_phase_s.value for s in signal.streams}
    lane = {g.lane: found.gates.arms[g.arm].name for g in found.gates.gates if g.inwards}
    west, north = (next(green for k, green in greens.items() if lane.get(k) == arm) for arm in "WN")
    assert apart == pytest.approx((north - west) % plan["Cycle Length"], abs=0.2)
    nodes = sections["Nodes"].set_index("INTID")
    assert nodes.loc[number, "TYPE"] == 0
    assert nodes.loc[int(lanes.loc["Up Node", "SBT"]), "Y"] > nodes.loc[number, "Y"]  # y is up


@pytest.mark.parametrize("turned_deg", [0.0, 20.0])
def test_utdf_puts_arms_where_their_roads_lead(turned_deg: float) -> None:
    """From the junction to the gates of the arm N, 7 m away, it is 41 degrees beside the road."""
    nodes = utdf_sections(utdf(turning_crossroads(turned_deg), height_m=400.0))["Nodes"].set_index("DESCRIPTION")
    x, y = nodes.loc["junction 0", ["X", "Y"]].astype(float)
    for arm, road_deg in zip("ESWN", sides(turned_deg), strict=True):
        end_x, end_y = nodes.loc[f"arm {arm}", ["X", "Y"]].astype(float)
        assert apart_deg(np.arctan2(y - end_y, end_x - x), road_deg) < 6  # the middle of two lanes may lie beside
        assert 95 < np.hypot(end_x - x, end_y - y) < 115


def test_utdf_ends_greens_where_the_cycle_does_in_a_flight_of_two_clips() -> None:
    """Most starts of queues are in the second clip, against which the signal is late in the first."""
    late = in_two_clips(1013.0, 0.0, 180.0, 500.0)
    (signal,) = (s for s in late.signals.values() if s.signalised)
    rows = utdf_sections(utdf(late, height_m=100.0))["Phases"].query("INTID == @signal.junction + 1")
    phases = rows.set_index("RECORDNAME")
    for k, lanes in enumerate(signal.phases, start=1):
        (stream,) = (s for s in signal.streams if s.stream.approach.lane in lanes)
        green = (stream.red_phase_s.value - stream.green_phase_s.value) % signal.cycle_s.value
        assert 10.0 < green < 20.0
        assert phases.loc["MaxGreen", f"D{k}"] == pytest.approx(green, abs=0.06)
        end = (phases.loc["End", f"D{k}"] - phases.loc["Start", f"D{k}"]) % signal.cycle_s.value
        assert end == pytest.approx(green, abs=0.11)


def unpack_events(data: bytes) -> tuple[pd.DataFrame, pd.DataFrame]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        events, detectors = (pd.read_csv(io.BytesIO(archive.read(f"{n}.csv"))) for n in ("events", "detectors"))
    events["TimeStamp"] = pd.to_datetime(events["TimeStamp"])
    return events, detectors


def test_signal_events_are_those_of_the_signal(analysis: TrafficAnalysis) -> None:
    start = datetime(2026, 5, 4, 7, 30, tzinfo=UTC)
    events, detectors = unpack_events(event_archive(analysis, start))
    green = events.query("EventId == 1 and Parameter == 1")["TimeStamp"]
    assert green.diff().dropna().dt.total_seconds().to_numpy() == pytest.approx(40.0, abs=0.2)
    assert (events["TimeStamp"].diff().dropna() >= pd.Timedelta(0)).all()
    on, off = (events.query(f"EventId == {kind}").groupby("Parameter").size() for kind in (82, 81))
    assert on.equals(off)
    assert on.sum() == sum(len(s.stream.cross_time_s) for signal in analysis.signals.values() for s in signal.streams)
    assert set(detectors["Parameter"]) == set(on.index)
    # nobody crosses from the onset of red to that of green
    reds = events.query("EventId == 10 and Parameter == 1")["TimeStamp"]
    of_phase = events["Parameter"].isin(detectors.query("Phase == 1")["Parameter"])
    crossed = events[(events["EventId"] == 82) & of_phase]["TimeStamp"]
    for red in reds:
        until = green[green > red].min()
        assert not crossed.between(red + pd.Timedelta(seconds=1), until).any()


def ssam_vehicles(data: bytes) -> Iterator[tuple[float, tuple[float, ...]]]:
    """Time and fields of each vehicle record, read by the format's own words: little-endian, without padding."""
    assert struct.unpack_from("<Bcf", data) == (0, b"L", pytest.approx(1.04))
    kind, metric, scale, *bounds = struct.unpack_from("<BBf4i", data, 6)
    assert (kind, metric, scale, bounds[:2]) == (1, 1, 1.0, [0, 0])
    at, time_s = 28, -1.0
    while at < len(data):
        if data[at] == 2:
            time_s, at = struct.unpack_from("<f", data, at + 1)[0], at + 5
        else:
            assert data[at] == 3
            fields = struct.unpack_from("<iiB8f", data, at + 1)
            at += 42
            yield time_s, fields
    assert at == len(data)


def test_ssam_has_bumpers_up_the_map(tmp_path: Path) -> None:
    paths = [np.column_stack([np.arange(0, 390, 6.0), np.full(65, 50.0)]) for _ in range(3)]
    run = field_run(tmp_path / "run", tracklets_along(paths), shape=(100, 400), gsd_m=0.25)
    vehicles = list(ssam_vehicles(export_run(run, "ssam", tmp_path / "t.trj").read_bytes()))
    trajectories = run.analysis.trajectories
    assert len(vehicles) == len(trajectories.time_s)
    assert {fields[0] for _, fields in vehicles} == {1, 2, 3}
    times = np.array([time for time, fields in vehicles if fields[0] == 1])
    assert (np.diff(times) > 0).all()
    for _, (_, _, _, front_x, front_y, rear_x, rear_y, length, width, speed, acceleration) in vehicles:
        assert front_x - rear_x == pytest.approx(length) == 4.5
        assert front_y == pytest.approx(rear_y, abs=0.2)
        assert front_y == pytest.approx(25 - 50 * 0.25, abs=0.5)
        assert (width, speed) == (pytest.approx(1.8), pytest.approx(7.5, abs=1.0))
        assert abs(acceleration) < 3


def test_ssam_keeps_the_way_of_a_vehicle_that_stands() -> None:
    speed = np.array([0.0, 5.0, 0.0, 0.0])
    zero = np.zeros(4)
    table = pd.DataFrame(
        {"track_id": 7, "frame": range(4), "time_s": 0.2 * np.arange(4), "x_m": 10.0, "y_m": 10.0, "lane": 0}
        | {"vx_m_per_s": zero, "vy_m_per_s": -speed, "ax_m_per_s2": zero, "ay_m_per_s2": zero}
        | {"speed_m_per_s": speed, "length_m": np.nan, "width_m": np.nan}
    )
    for _, fields in ssam_vehicles(ssam.ssam_records(table, np.array([100.0, 50.0]))):
        assert fields[4] - fields[6] == pytest.approx(-4.5)
