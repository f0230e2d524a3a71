"""The road network and the city's plan: geometry of lanes, connectivity, signals, priorities."""

from collections import deque
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.arrays import FloatArray
from velfield.synthetic.city import city_plan as p
from velfield.synthetic.city.city_plan import CityPlan, make_city_plan, view_centre_m
from velfield.synthetic.city.road_network import (
    CLEAR_M,
    LATERAL_M_PER_S2,
    STEP_M,
    Lane,
    Node,
    RoadNetwork,
    clear_until_m,
    min_radius_m,
    smooth_curve,
)

SMALL_M = (-190.0, -160.0, 200.0, 140.0)
LARGE_M = (-400.0, -330.0, 410.0, 320.0)


@pytest.fixture(scope="module", params=[SMALL_M, LARGE_M], ids=["one intersection", "several"])
def plan(request: pytest.FixtureRequest) -> CityPlan:
    return make_city_plan(request.param, np.random.default_rng(3), turn_share=0.15, cycle_s=60.0)


def steps_m(path: FloatArray) -> FloatArray:
    return np.asarray(np.hypot(*np.diff(path, axis=0).T))


def direction(step: FloatArray) -> float:
    return float(np.arctan2(step[1], step[0]))


def angle_between(a: float, b: float) -> float:
    return abs(float(np.angle(np.exp(1j * (a - b)))))


def test_a_turn_is_limited_by_lateral_acceleration_and_by_its_speed() -> None:
    network = RoadNetwork()
    a, b = network.node(0.0, 0.0, 0.0), network.node(10.0, 10.0, np.pi / 2)
    network.turn(a, b, weight=1.0)
    network.turn(a, b, weight=1.0, speed=4.0)
    free, limited = network.edges
    assert free.speed_m_per_s**2 / min_radius_m(free.path) == pytest.approx(LATERAL_M_PER_S2)
    assert limited.speed_m_per_s == 4.0
    assert free.yields
    assert free.kind == "turn"


def test_an_arc_stays_on_its_circle_and_has_the_arcs_length() -> None:
    network = RoadNetwork()
    a, b = network.node(13.0, 0.0, -np.pi / 2), network.node(0.0, -13.0, np.pi)
    network.arc(a, b, (0.0, 0.0), (0.0, -np.pi / 2), 5.6)
    edge = network.edges[0]
    assert np.abs(np.hypot(*edge.path.T) - 13.0).max() < 1e-9
    assert edge.length_m == pytest.approx(13.0 * np.pi / 2, rel=1e-3)
    assert edge.path[-1] == pytest.approx([0.0, -13.0])


def test_a_lane_is_cut_into_contiguous_edges_at_its_nodes() -> None:
    network = RoadNetwork()
    lane = Lane(network, (0.0, 5.0), (100.0, 5.0), "avenue", 22.0)
    assert lane.at(40.0) == lane.at(40.0)
    assert lane.at(-5.0) == lane.at(0.0)
    assert lane.at_point(60.0, 9.0) == lane.at(60.0)
    lane.box(40.0, 5.0, group=3)
    lane.finish()
    edges = sorted(network.edges, key=lambda edge: edge.path[0, 0])
    assert [edge.length_m for edge in edges] == pytest.approx([40.0, 20.0, 40.0])
    assert all(before.end == after.start for before, after in pairwise(edges))
    assert [edge.kind for edge in edges] == ["avenue", "box", "avenue"]
    assert [edge.signal for edge in edges] == [3, -1, -1]  # the stop line is at the end of the edge before the box


@settings(max_examples=40)
@given(
    x=st.floats(4, 40),
    y=st.floats(-40, 40),
    start=st.floats(-0.6, 0.6),
    turn=st.floats(-2.2, 2.2).filter(lambda a: abs(a) > 0.3),
)
def test_curves_are_tangent_to_both_nodes(x: float, y: float, start: float, turn: float) -> None:
    path = smooth_curve(Node(0.0, 0.0, start), Node(x, y, start + turn))
    step = np.diff(path, axis=0)
    assert path[0] == pytest.approx([0.0, 0.0])
    assert path[-1] == pytest.approx([x, y])
    # of a curve of radius r a chord of length s deviates by s / 2r from its tangent
    tolerance = 0.05 + steps_m(path).max() / min_radius_m(path)
    assert angle_between(direction(step[0]), start) < tolerance
    assert angle_between(direction(step[-1]), start + turn) < tolerance


def test_the_minimum_radius_of_a_circle_is_its_radius() -> None:
    angle = np.linspace(0, np.pi, 200)
    assert min_radius_m(12.0 * np.column_stack([np.cos(angle), np.sin(angle)])) == pytest.approx(12.0, rel=1e-3)


@pytest.mark.parametrize("angle_deg", [20.0, 45.0, 90.0])
def test_paths_that_diverge_are_clear_at_the_distance_of_their_angle(angle_deg: float) -> None:
    """From a common start at an angle: a point s along one is s sin(angle) from the other."""
    along = np.arange(0.0, 60.0, STEP_M)
    path = np.column_stack([along, np.zeros_like(along)])
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    other = np.column_stack([along * c, along * s])
    expected = CLEAR_M / s
    assert clear_until_m(path, other, from_end=False) == pytest.approx(expected, abs=1.5 * STEP_M)
    assert clear_until_m(path[::-1], other[::-1], from_end=True) == pytest.approx(
        along[-1] - expected, abs=1.5 * STEP_M
    )
    assert clear_until_m(path, other + np.array([0.0, 50.0]), from_end=True) == pytest.approx(along[-1])


def test_edges_join_their_nodes_and_follow_their_directions(plan: CityPlan) -> None:
    nodes = plan.road_network.nodes
    for edge in plan.road_network.edges:
        start, end = nodes[edge.start], nodes[edge.end]
        assert edge.path[0] == pytest.approx([start.x, start.y], abs=1e-6)
        assert edge.path[-1] == pytest.approx([end.x, end.y], abs=1e-6)
        step = np.diff(edge.path, axis=0)
        assert angle_between(direction(step[0]), start.direction) < 0.2, edge.kind
        assert angle_between(direction(step[-1]), end.direction) < 0.2, edge.kind
        assert steps_m(edge.path).max() < 2.1 * STEP_M
        assert edge.speed_m_per_s >= 3.0


def reachable(starts: set[int], neighbours: list[set[int]]) -> set[int]:
    """Nodes that can be reached, the starts included."""
    found, queue = set(starts), deque(starts)
    while queue:
        for other in neighbours[queue.popleft()] - found:
            found.add(other)
            queue.append(other)
    return found


def test_every_edge_is_reached_from_a_source_and_leads_to_an_exit_at_the_border(plan: CityPlan) -> None:
    network = plan.road_network
    ahead: list[set[int]] = [set() for _ in network.nodes]
    back: list[set[int]] = [set() for _ in network.nodes]
    for edge in network.edges:
        ahead[edge.start].add(edge.end)
        back[edge.end].add(edge.start)
    sources = {node for node, weight in network.sources if weight > 0}
    exits = {edge.end for edge in network.edges if not ahead[edge.end]}
    used = {node for edge in network.edges for node in (edge.start, edge.end)}
    assert used <= reachable(sources, ahead)
    assert used <= reachable(exits, back)
    x0, y0, x1, y1 = plan.rect
    for node in exits | sources:
        at = network.nodes[node]
        assert min(abs(at.x - x0), abs(at.x - x1), abs(at.y - y0), abs(at.y - y1)) < 1e-6, at


def test_every_intersection_has_signals_on_eight_lanes_and_boxes_behind_them(plan: CityPlan) -> None:
    network = plan.road_network
    assert len(network.signal_offsets_s) == len(plan.avenues_x) * len(plan.avenues_y) >= 1
    out = network.out_edges()
    groups = [edge.signal for edge in network.edges if edge.signal >= 0]
    assert sorted(groups) == sorted(
        group for k in range(len(network.signal_offsets_s)) for group in 4 * [2 * k, 2 * k + 1]
    )
    for edge in network.edges:
        if edge.signal >= 0:
            kinds = {network.edges[after].kind for after in out[edge.end]}
            assert "box" in kinds
            assert kinds <= {"box", "turn"}


def test_boxes_of_one_signal_group_are_parallel_and_cross_the_other_groups(plan: CityPlan) -> None:
    network = plan.road_network
    out = network.out_edges()
    for edge in network.edges:
        if edge.signal < 0:
            continue
        horizontal = abs(np.cos(network.nodes[edge.end].direction)) > 0.5
        assert horizontal == (edge.signal % 2 == 0)
        box = next(network.edges[k] for k in out[edge.end] if network.edges[k].kind == "box")
        assert box.length_m == pytest.approx(2 * (p.STOP_A if horizontal else p.STOP_B))


def test_turns_yield_where_they_merge_and_priority_lanes_do_not(plan: CityPlan) -> None:
    network = plan.road_network
    for group in network.in_edges():
        edges = [network.edges[k] for k in group]
        if len(edges) > 1:
            assert sum(not edge.yields for edge in edges) <= 1, [edge.kind for edge in edges]
    assert not any(edge.yields for edge in network.edges if edge.kind in ("avenue", "box", "ring"))


@pytest.mark.parametrize("turn_share", [0.05, 0.3])
def test_the_fraction_of_right_turns_at_signals_is_the_parameter(turn_share: float) -> None:
    network = make_city_plan(SMALL_M, np.random.default_rng(0), turn_share=turn_share, cycle_s=60.0).road_network
    out = network.out_edges()
    fractions = []
    for edge in network.edges:
        after = [network.edges[k] for k in out[edge.end]]
        turns = [other for other in after if other.kind == "turn"]
        if edge.signal >= 0 and turns:
            fractions.append(sum(t.weight for t in turns) / sum(other.weight for other in after))
    assert len(fractions) == 4  # the outer lane of each approach
    assert fractions == pytest.approx([turn_share] * 4)


def test_lanes_of_an_avenue_are_a_lane_apart_and_opposed_across_the_median(plan: CityPlan) -> None:
    network = plan.road_network
    y0 = plan.avenues_y[0]
    lanes = {
        round(edge.path[0, 1] - y0, 3): np.sign(edge.path[-1, 0] - edge.path[0, 0])
        for edge in network.edges
        if edge.kind == "avenue" and abs(edge.path[0, 1] - y0) < 15 and abs(np.diff(edge.path[[0, -1], 1])[0]) < 1e-9
    }
    assert lanes == {p.INNER_A: 1, p.CURB_A: 1, -p.INNER_A: -1, -p.CURB_A: -1}
    assert pytest.approx(p.LANE_M) == p.CURB_A - p.INNER_A
    assert p.INNER_A - p.LANE_M / 2 == p.MEDIAN_M / 2


def test_a_plan_is_the_same_for_the_same_generator_and_offsets_are_within_the_cycle() -> None:
    plans = [make_city_plan(LARGE_M, np.random.default_rng(9), turn_share=0.1, cycle_s=45.0) for _ in range(2)]
    offsets = [made.road_network.signal_offsets_s for made in plans]
    assert offsets[0] == offsets[1]
    assert all(0 <= offset < 45.0 for offset in offsets[0])
    assert len(set(offsets[0])) == len(offsets[0])


def test_a_narrow_view_is_near_the_intersection_and_a_wide_one_at_the_centre_of_the_cell() -> None:
    narrow, wide = view_centre_m(100.0), view_centre_m(400.0)
    intersection = (p.INTERSECTION_X_M, p.INTERSECTION_Y_M)
    assert np.hypot(*np.subtract(narrow, intersection)) < np.hypot(*np.subtract(wide, intersection))
    assert view_centre_m(1000.0) == wide
