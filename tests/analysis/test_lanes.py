"""Lanes of constructed tracks: an avenue of two lanes, a side street that leaves and one that joins it, a circle."""

import numpy as np
import pytest

from schemas.arrays import FloatArray
from tests.field_runs import tracklets_along
from velfield.analysis.lanes.find import find_lanes, project
from velfield.analysis.lanes.junctions import buffered_hull, inside_hull
from velfield.analysis.lanes.model import LaneGraph
from velfield.analysis.movements.gates import find_gates
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.analysis.trajectories import Trajectories, from_tracklets

GSD_M = 0.25


def arc(centre: tuple[float, float], radius: float, start_deg: float, end_deg: float) -> FloatArray:
    angle = np.radians(np.linspace(start_deg, end_deg, 60))
    return np.array(centre) + radius * np.column_stack([np.cos(angle), np.sin(angle)])


def driven(corners: FloatArray, *, speed_m_per_s: float = 10.0) -> FloatArray:
    """Positions (n, 2), px, every 0.2 s along a path in metres."""
    along = np.concatenate([[0.0], np.hypot(*np.diff(corners, axis=0).T).cumsum()])
    s = np.arange(0.0, along[-1], speed_m_per_s / 5)
    return np.column_stack([np.interp(s, along, corners[:, k]) for k in (0, 1)]) / GSD_M


def graph_of(paths: list[FloatArray], *, sd_m: float = 0.2) -> LaneGraph:
    return find_lanes(tracks_of(paths, sd_m=sd_m))


def tracks_of(paths: list[FloatArray], *, sd_m: float = 0.2) -> Trajectories:
    rng = np.random.default_rng(5)
    noisy = [path + rng.normal(0, sd_m / GSD_M, (1, 2)) + rng.normal(0, 0.05 / GSD_M, path.shape) for path in paths]
    return from_tracklets(tracklets_along(noisy), GSD_M)


AVENUE = np.array([[0.0, 50.0], [150.0, 50.0]])
BESIDE = AVENUE - np.array([0.0, 3.5])
OPPOSITE = AVENUE[::-1] + np.array([0.0, 3.5])
LEAVES = np.concatenate([[[0.0, 46.5], [60.0, 46.5]], arc((60.0, 36.5), 10.0, 90, 0), [[70.0, 0.0]]])


@pytest.fixture(scope="module")
def avenue() -> LaneGraph:
    paths = [AVENUE] * 8 + [BESIDE] * 8 + [OPPOSITE] * 8 + [LEAVES] * 5
    return graph_of([driven(path) for path in paths])


def test_centre_lines_are_where_vehicles_drive(avenue: LaneGraph) -> None:
    errors = [
        np.abs(project(lane.xy_m, truth)[1]).max()
        for truth in (AVENUE, BESIDE, OPPOSITE)
        for lane in avenue
        if abs(np.median(lane.xy_m[:, 1]) - truth[0, 1]) < 1 and lane.length_m > 20
    ]
    assert len(errors) == 4  # the lane that the street leaves is two lanes
    assert max(errors) < 0.35


def test_the_graph_has_the_turn_and_nothing_else(avenue: LaneGraph) -> None:
    assert len(avenue) == 5
    assert sorted(c.turn for c in avenue.connections) == ["left", "straight"]
    left = next(c for c in avenue.connections if c.turn == "left")
    assert left.tracks == 5
    assert left.share == pytest.approx(5 / 13)
    assert len(avenue.entries) == 3
    assert len(avenue.exits) == 4


STREET = np.array([[80.0, 0.0], [80.0, 150.0]])


def right_turn(radius_m: float) -> FloatArray:
    """From the avenue, right into the street that crosses it."""
    start = 80.0 - radius_m
    return np.concatenate(
        [[[0.0, 50.0], [start, 50.0]], arc((start, 50.0 + radius_m), radius_m, -90, 0), [[80.0, 150.0]]]
    )


@pytest.mark.parametrize("radius_m", [5.0, 8.0, 12.0])
@pytest.mark.parametrize("sd_m", [0.05, 0.2, 0.4])
def test_a_turn_of_three_vehicles_is_a_lane_whatever_its_radius_and_their_errors(radius_m: float, sd_m: float) -> None:
    crossing, turn = [AVENUE] * 9 + [STREET] * 9, right_turn(radius_m)
    graph = graph_of([driven(path) for path in [*crossing, *[turn] * 3]], sd_m=sd_m)
    assert len(graph) == 5
    (short,) = (lane for lane in graph if lane.length_m < 30)
    assert [c.tracks for c in graph.connections if short.number in (c.start, c.end)] == [3, 3]
    assert np.abs(project(short.xy_m, turn)[1]).max() < 2 * sd_m + 0.6
    assert len(graph_of([driven(path) for path in [*crossing, *[turn] * 2]], sd_m=sd_m)) == 2


@pytest.mark.parametrize("radius_m", [5.0, 8.0, 12.0])
def test_a_turn_of_two_vehicles_does_not_cut_the_lane_of_few_that_they_leave(radius_m: float) -> None:
    paths = [AVENUE] * 2 + [right_turn(radius_m)] * 2 + [AVENUE + np.array([80.0, 0.0])] + [STREET] * 4
    graph = graph_of([driven(path) for path in paths])
    assert len(graph) == 2
    assert sorted(lane.tracks for lane in graph) == [5, 6]
    assert min(lane.length_m for lane in graph) > 140


def test_a_junction_reaches_to_where_its_lanes_have_parted() -> None:
    exits = np.array([[0.0, 46.5], [60.0, 46.5], [75.0, 45.0], [150.0, 20.0]])
    graph = graph_of([driven(path) for path in [AVENUE - [0.0, 3.5]] * 8 + [exits] * 5])
    (junction,) = graph.junctions
    assert junction.kind == "diverge"
    out = [gate.xy_m for gate in find_gates(graph, junction).gates if not gate.inwards]
    assert len(out) == 2
    assert np.hypot(*np.subtract(*out)) > 3.0


@pytest.mark.parametrize("lanes_straight_on", [1, 2])
def test_the_far_lanes_of_a_t_junction_are_of_it(lanes_straight_on: int) -> None:
    """From E a left turn has a lane of its own across those from W; beside it nothing meets those straight on."""
    west = AVENUE[::-1] - np.array([0.0, 3.5])
    left = np.concatenate([[[150.0, 46.5], [90.0, 46.5]], arc((90.0, 60.5), 14.0, -90, -180), [[76.0, 150.0]]])
    joins = np.concatenate([[[82.0, 150.0]], arc((98.0, 66.0), 16.0, 180, 270), [[150.0, 50.0]]])
    paths = [AVENUE] * 9 + [left] * 5 + [joins] * 4
    paths += [west - [0.0, 3.5 * k] for k in range(1, lanes_straight_on + 1) for _ in range(6)]
    (found,) = TrafficAnalysis(tracks_of([driven(path) for path in paths])).movements
    counts = {(m.arm_in, m.arm_out): m.seen for m in found.movements}
    assert counts == {("W", "E"): 9, ("E", "S"): 5, ("S", "E"): 4, ("E", "W"): 6 * lanes_straight_on}
    share = next(m.share for m in found.movements if m.arm_out == "S")
    assert share.value == pytest.approx(5 / (5 + 6 * lanes_straight_on))


def test_lanes_of_one_direction_are_neighbours(avenue: LaneGraph) -> None:
    lane = max((lane for lane in avenue if lane.width_source == "neighbour"), key=lambda lane: lane.length_m)
    assert lane.width_m == pytest.approx(3.5, abs=0.35)
    back = max((lane for lane in avenue if abs(np.median(lane.xy_m[:, 1]) - 53.5) < 1), key=lambda lane: lane.length_m)
    assert (back.left, back.right) == (None, None)
    assert back.direction_rad == pytest.approx(np.pi, abs=0.1) or abs(np.median(back.direction_rad)) > 3.0


def test_a_circle_is_a_roundabout() -> None:
    left, right = [[0.0, 42.0], [14.0, 42.0], [24.0, 50.0]], [[80.0, 38.0], [66.0, 38.0], [56.0, 30.0]]
    paths = [
        np.concatenate([entry, arc((40.0, 40.0), 16.0, begin, begin - turn), exit_])
        for entry, begin, onwards, back in (
            (left, 140, [[56.0, 50.0], [66.0, 42.0], [80.0, 42.0]], [[24.0, 30.0], [14.0, 38.0], [0.0, 38.0]]),
            (right, -40, [[24.0, 30.0], [14.0, 38.0], [0.0, 38.0]], [[56.0, 50.0], [66.0, 42.0], [80.0, 42.0]]),
        )
        for turn, exit_ in ((100, onwards), (280, back))
    ]
    made = [driven(path, speed_m_per_s=6.0) for path in paths * 6]
    analysis = TrafficAnalysis(tracks_of(made, sd_m=0.1))
    graph = analysis.lanes
    (circle,) = (junction for junction in graph.junctions if junction.kind == "roundabout")
    gates = find_gates(graph, circle)
    turns = {(m.arm_in, m.arm_out): m.turn for m in analysis.movements[circle.number].movements}
    assert turns == {("W", "E"): "straight", ("E", "W"): "straight", ("W", "W"): "u-turn", ("E", "E"): "u-turn"}
    assert len(gates.arms) == 2  # a road's entry and its exit are one arm, though they diverge at the circle
    assert sorted((gate.arm, gate.inwards) for gate in gates.gates) == [(0, False), (0, True), (1, False), (1, True)]


def test_two_tracks_make_no_lane() -> None:
    assert len(graph_of([driven(AVENUE)] * 2)) == 0
    assert len(graph_of([driven(AVENUE)] * 3)) == 1


def test_no_tracks_no_lanes() -> None:
    none = tracklets_along([driven(AVENUE)]).iloc[:0]
    assert len(find_lanes(from_tracklets(none, GSD_M))) == 0


def test_a_hull_holds_its_points() -> None:
    rng = np.random.default_rng(0)
    xy = rng.normal(0, 5, (20, 2))
    hull = buffered_hull(xy, 1.0)
    assert inside_hull(xy, hull).all()
    assert inside_hull(xy, hull[::-1]).all()
    assert not inside_hull(xy + 100, hull).any()
