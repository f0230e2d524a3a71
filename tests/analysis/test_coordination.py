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
    offsets, reason = find_offsets(pair.signals, pair.lanes)
    assert reason == ""
    # to the east alone: nobody drives the other way, and the roads to the south are beside each other
    (only,) = offsets
    assert only.distance_m == pytest.approx(300.0, abs=5.0)
    assert (only.offset_s.value + 20) % CYCLE_S - 20 == pytest.approx(12.0, abs=1.0)
    assert only.offset_s.low < only.offset_s.value < only.offset_s.high
    assert len(offset_table(pair).rows) == 1


def test_no_coordination_is_reported_as_such(analysis: TrafficAnalysis, pair: TrafficAnalysis) -> None:
    assert find_offsets(analysis.signals, analysis.lanes) == (
        [],
        "No offsets: 1 junction with a signal of a fixed cycle.",
    )
    assert offset_table(analysis).note.startswith("No offsets")
    first, second = (n for n, s in pair.signals.items() if s.signalised)
    cycle = pair.signals[second].cycle_s
    assert cycle is not None
    other = dict(pair.signals) | {second: replace(pair.signals[second], cycle_s=cycle.in_units(1.5))}
    offsets, reason = find_offsets(other, pair.lanes)
    assert offsets == []
    assert reason == "None: the signals have cycles of their own, 40, 60 s."
    assert first != second


def test_points_of_the_diagram_obey_its_equation(analysis: TrafficAnalysis) -> None:
    table = diagram_table(analysis)
    assert len(table.rows) > 10
    for row in table.rows:
        density, flow, speed = (float(row.cells[n]) for n in ("density", "flow", "speed"))
        assert flow == pytest.approx(density * speed, rel=0.02)
        assert int(row.cells["vehicles"]) >= 3
    assert len(growth_table(analysis).rows) == len(queue_growth(signal_of_crossroads(analysis)))


def test_a_lane_on_which_no_vehicle_has_two_samples_has_no_point(analysis: TrafficAnalysis) -> None:
    samples = analysis.lanes.samples
    _, once = np.unique(samples.lane * len(analysis.trajectories) + samples.track, return_index=True)
    single = LaneSamples(*(getattr(samples, name)[once] for name in LaneSamples.__dataclass_fields__))
    assert diagram_table(analysis).rows
    short = TrafficAnalysis(analysis.trajectories)
    vars(short)["lanes"] = replace(analysis.lanes, samples=single)
    assert diagram_table(short).rows == ()
