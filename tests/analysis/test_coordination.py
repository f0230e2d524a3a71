"""Queues in red and offsets of constructed signals; points of the fundamental diagram."""

from dataclasses import replace

import numpy as np
import pytest

from tests.analysis.test_traffic_analysis import CYCLE_S, crossroads, gather
from velfield.analysis.lanes.model import LaneSamples
from velfield.analysis.signals.coordination import find_offsets, queue_growth
from velfield.analysis.signals.cycles import JunctionSignal
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.pipeline.analysis.flow_tables import diagram_table, growth_table, offset_table


@pytest.fixture(scope="module")
def analysis() -> TrafficAnalysis:
    return TrafficAnalysis(gather(crossroads()))


@pytest.fixture(scope="module")
def pair() -> TrafficAnalysis:
    """Two such crossroads, the second 300 m to the east and 12 s later."""
    tracks = crossroads()
    shifted = [(times + 12.0, xy + np.array([300.0, 0.0])) for times, xy in tracks]
    return TrafficAnalysis(gather([*tracks, *shifted]))


def signal_of_crossroads(analysis: TrafficAnalysis) -> JunctionSignal:
    (signal,) = [s for s in analysis.signals.values() if s.signalised]
    return signal


def test_a_queue_grows_in_red_as_vehicles_come(analysis: TrafficAnalysis) -> None:
    signal = signal_of_crossroads(analysis)
    growth = queue_growth(signal)
    lanes = {g.lane for g in growth}
    assert lanes
    for lane in lanes:
        rows = [g for g in growth if g.lane == lane]
        assert [g.after_red_s for g in rows[:-1]] == pytest.approx(10.0 * np.arange(len(rows) - 1))
        assert rows[-2].after_red_s < rows[-1].after_red_s < CYCLE_S
        counts = [g.vehicles.value for g in rows if g.vehicles]
        assert len(counts) == len(rows)
        assert counts == sorted(counts)
        assert counts[0] < 1.0
        assert 3.0 <= counts[-1] <= 4.1  # four arrive before each green
        lengths = [g.length_m.value for g in rows if g.length_m]
        assert lengths[-1] == pytest.approx(3 * 7 + 4.5, abs=8.0)


def test_the_offset_of_two_signals_on_one_road(pair: TrafficAnalysis) -> None:
    offsets, reason = find_offsets(pair.signals, pair.lanes, pair.trajectories.observed_s)
    assert reason == ""
    # to the east alone: nobody drives the other way, and the roads to the south are beside each other
    (only,) = offsets
    assert only.distance_m == pytest.approx(300.0, abs=5.0)
    assert (only.offset_s.value + 20) % CYCLE_S - 20 == pytest.approx(12.0, abs=1.0)
    assert only.offset_s.low < only.offset_s.value < only.offset_s.high
    assert len(offset_table(pair).rows) == 1


def two_clips(*, seen_in_both: bool) -> TrafficAnalysis:
    """The pair in two clips, the second 1013 s later, no whole number of cycles. Most starts of the first junction are
    in the first clip, those of the second in the second; all, unless they are seen in both."""
    tracks = []
    for times, xy in crossroads():
        for shift_m, shift_s, main in ((0.0, 0.0, 0), (300.0, 12.0, 1)):
            at = times + shift_s
            for clip, rows in enumerate((at < 250.0, at >= 250.0)):
                seen = clip == main or (seen_in_both and (at[0] if clip == 0 else 500.0 - at[0]) > 80.0)
                if rows.sum() > 2 and seen:
                    tracks.append((at[rows] + 1013.0 * clip, xy[rows] + np.array([shift_m, 0.0])))
    return TrafficAnalysis(replace(gather(tracks), gaps_s=np.array([[250.0, 1263.0]])))


def test_the_offset_is_that_of_greens_in_one_clip() -> None:
    analysis = two_clips(seen_in_both=True)
    (only,) = find_offsets(analysis.signals, analysis.lanes, analysis.trajectories.observed_s)[0]
    assert (only.offset_s.value + 20) % CYCLE_S - 20 == pytest.approx(12.0, abs=1.0)


def test_no_clip_that_shows_both_signals_gives_no_offset() -> None:
    analysis = two_clips(seen_in_both=False)
    assert sum(bool(signal.signalised) for signal in analysis.signals.values()) == 2
    offsets, reason = find_offsets(analysis.signals, analysis.lanes, analysis.trajectories.observed_s)
    assert (offsets, reason) == ([], "None: no clip shows the greens of both of two successive junctions.")


def test_no_coordination_is_reported_as_such(analysis: TrafficAnalysis, pair: TrafficAnalysis) -> None:
    assert find_offsets(analysis.signals, analysis.lanes, analysis.trajectories.observed_s) == (
        [],
        "No offsets: 1 junction with a signal of a fixed cycle.",
    )
    assert offset_table(analysis).note.startswith("No offsets")
    first, second = (n for n, s in pair.signals.items() if s.signalised)
    cycle = pair.signals[second].cycle_s
    other = dict(pair.signals) | {second: replace(pair.signals[second], cycle_s=cycle.in_units(1.5))}
    offsets, reason = find_offsets(other, pair.lanes, pair.trajectories.observed_s)
    assert offsets == []
    assert reason == "None: the signals have cycles of their own, 40, 60 s."
    assert first != second


def test_points_of_the_diagram_obey_its_equation(analysis: TrafficAnalysis) -> None:
    table = diagram_table(analysis)
    assert len(table.rows) > 10
    for row in table.rows:
        density, flow, speed = (float(row.cells[n]) for n in ("density", "flow", "speed"))
        assert flow == pytest.approx(density * speed, rel=0.02)
        assert int(row.cells["vehicles"]) >= 5
    assert len(growth_table(analysis).rows) == len(queue_growth(signal_of_crossroads(analysis)))


def test_a_lane_on_which_no_vehicle_has_two_samples_has_no_point(analysis: TrafficAnalysis) -> None:
    samples = analysis.lanes.samples
    _, once = np.unique(samples.lane * len(analysis.trajectories) + samples.track, return_index=True)
    single = LaneSamples(*(getattr(samples, name)[once] for name in LaneSamples.__dataclass_fields__))
    assert diagram_table(analysis).rows
    short = TrafficAnalysis(analysis.trajectories)
    vars(short)["lanes"] = replace(analysis.lanes, samples=single)
    assert diagram_table(short).rows == ()
