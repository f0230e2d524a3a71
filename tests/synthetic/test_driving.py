"""Driving: the intelligent driver model, platoons, signals, gap acceptance, arrivals, trajectories."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.arrays import FloatArray
from schemas.simulation import TrafficSimulation
from velfield.synthetic.city.road_network import RoadNetwork
from velfield.synthetic.traffic.driving import (
    ACCELERATION,
    BRAKING,
    FAR,
    MAX_BRAKING,
    MIN_GAP,
    CarStates,
    advance,
    find_leader,
    idm_acceleration,
    is_green,
    sort_by_edge,
)
from velfield.synthetic.traffic.traffic import (
    STEP_S,
    Traffic,
    draw_dimensions,
    road_arrays,
    simulate_traffic,
)

CONFIG = TrafficSimulation()
CAR_M = 4.5


def chain(lengths_m: Sequence[float], speed: float = 20.0, signals: dict[int, int] | None = None) -> RoadNetwork:
    """Straight edges one after the other along x."""
    network = RoadNetwork(signal_offsets_s=[0.0])
    nodes = [network.node(float(x), 0.0, 0.0) for x in np.concatenate([[0.0], np.cumsum(lengths_m)])]
    for k, (a, b) in enumerate(pairwise(nodes)):
        kind = "box" if k - 1 in (signals or {}) else "avenue"
        network.straight(a, b, kind, speed, signal=(signals or {}).get(k, -1))
    network.sources.append((nodes[0], 1.0))
    return network


def cars_on(network: RoadNetwork, s: Sequence[float], v: Sequence[float], desired: float = 14.0) -> CarStates:
    """Cars on the first edge, all with a route along all edges."""
    n, route = len(s), np.arange(len(network.edges))
    return CarStates(
        s=np.array(s, np.float64),
        v=np.array(v, np.float64),
        leg=np.zeros(n, np.int64),
        accepted_node=np.full(n, -1, np.int64),
        waiting_s=np.zeros(n),
        length=np.full(n, CAR_M),
        desired_speed=np.full(n, desired),
        headway=np.full(n, 1.0),
        route=np.tile(route, n).astype(np.int64),
        route_first=(np.arange(n + 1) * len(route)).astype(np.int64),
    )


def run(network: RoadNetwork, cars: CarStates, seconds: float, config: TrafficSimulation = CONFIG) -> FloatArray:
    """Advance all cars; (steps, n, 2) distance driven, NaN once off the route, and speed."""
    roads = road_arrays(network, config)
    before = np.concatenate([[0.0], np.cumsum(roads.length)])
    active, log = np.arange(len(cars.s)), []
    first, head = np.zeros(len(roads.length) + 1, np.int64), np.empty(len(network.nodes), np.int64)
    for step in range(round(seconds / STEP_S)):
        size = 8 * len(active) + 64
        scratch = (first, np.empty(len(active) + 1, np.int64), head, *np.empty((3, size), np.int64), np.empty(size))
        if len(active):
            active = active[advance(active, step * STEP_S, STEP_S, roads, cars, scratch)]
        row = np.full((len(cars.s), 2), np.nan)
        row[active] = np.column_stack([before[cars.leg[active]] + cars.s[active], cars.v[active]])
        log.append(row)
    return np.array(log)


@given(v=st.floats(0.0, 30.0), desired=st.floats(5.0, 30.0))
def test_on_a_free_road_acceleration_is_a_times_one_minus_the_fourth_power(v: float, desired: float) -> None:
    expected = ACCELERATION * (1 - (v / desired) ** 4)
    assert idm_acceleration(v, desired, FAR, 0.0, 1.0) == pytest.approx(expected)


@given(v=st.floats(0.5, 13.0), headway=st.floats(0.6, 1.6))
def test_acceleration_is_zero_at_the_equilibrium_gap(v: float, headway: float) -> None:
    """Treiber's equilibrium: (s0 + v T) / sqrt(1 - (v / v0)^4)."""
    gap = (MIN_GAP + v * headway) / np.sqrt(1 - (v / 14.0) ** 4)
    assert idm_acceleration(v, 14.0, gap, 0.0, headway) == pytest.approx(0.0, abs=1e-9)
    assert idm_acceleration(v, 14.0, 1.1 * gap, 0.0, headway) > 0
    assert idm_acceleration(v, 14.0, 0.9 * gap, 0.0, headway) < 0
    assert idm_acceleration(v, 14.0, gap, 1.0, headway) < 0  # closing in


def test_braking_is_harder_than_needed_in_an_emergency_and_softer_far_from_it() -> None:
    """Against the kinematic deceleration v^2 / 2 gap that just stops before a stationary obstacle."""
    v = 12.0
    for needed, harder in ((2 * BRAKING, True), (BRAKING / 4, False)):
        assert (idm_acceleration(v, 14.0, v * v / (2 * needed), v, 0.0) < -needed) == harder


@given(time_s=st.floats(0, 500), offset=st.floats(0, 60), red=st.floats(0.5, 5))
def test_the_two_groups_of_an_intersection_are_never_green_together(time_s: float, offset: float, red: float) -> None:
    offsets = np.array([offset])
    green = [is_green(group, time_s, offsets, 60.0, red) for group in (0, 1)]
    assert not all(green)
    phase = (time_s + offset) % 60.0
    assert green[0] == (phase < 30.0 - red)


def test_one_car_reaches_its_desired_speed_and_keeps_it() -> None:
    network = chain([2000.0])
    log = run(network, cars_on(network, [5.0], [0.0]), 60.0)
    assert log[-1, 0, 1] == pytest.approx(14.0, abs=0.05)
    assert np.diff(log[:, 0, 1]).max() <= ACCELERATION * STEP_S + 1e-9
    assert (np.diff(log[:, 0, 1]) >= -1e-9).all()


def test_a_speed_limit_ahead_is_kept_when_it_begins() -> None:
    network = chain([300.0, 200.0])
    network.edges[1] = network.edges[1].__class__(**{**vars(network.edges[1]), "speed_m_per_s": 5.0})
    log = run(network, cars_on(network, [5.0], [14.0]), 60.0)
    on_second = log[:, 0, 0] > 300.0
    assert log[on_second, 0, 1][0] == pytest.approx(5.0, abs=0.7)
    assert np.nanmax(log[log[:, 0, 0] > 310.0, 0, 1]) < 5.3


def test_a_platoon_relaxes_to_the_equilibrium_gap_behind_a_slow_leader() -> None:
    network = chain([4000.0])
    cars = cars_on(network, [200.0, 150.0, 120.0, 60.0], [8.0] * 4)
    cars.desired_speed[0] = 8.0
    log = run(network, cars, 150.0)
    speed, gaps = log[-1, :, 1], -np.diff(log[-1, :, 0]) - CAR_M
    assert speed == pytest.approx([8.0] * 4, abs=0.05)
    assert gaps == pytest.approx([(MIN_GAP + 8.0) / np.sqrt(1 - (8 / 14) ** 4)] * 3, rel=0.02)


@settings(max_examples=15)
@given(seed=st.integers(0, 1000))
def test_cars_behind_one_that_brakes_hard_do_not_collide(seed: int) -> None:
    rng = np.random.default_rng(seed)
    network = chain([3000.0])
    s = 400.0 - np.cumsum(rng.uniform(12.0, 30.0, 8))
    cars = cars_on(network, s.tolist(), rng.uniform(6.0, 10.0, 8).tolist())
    cars.desired_speed[0] = 0.5
    log = run(network, cars, 40.0)
    gaps = -np.diff(log[:, :, 0], axis=1) - CAR_M
    assert gaps.min() > 0.0
    assert np.diff(log[:, :, 1], axis=0).min() >= -MAX_BRAKING * STEP_S - 1e-9
    assert (log[:, :, 1] >= 0).all()


def test_cars_stop_at_red_before_the_line_and_leave_at_green() -> None:
    """Group 1 is red for the first 30 s: (time mod 60) < 30 is the other group's half."""
    network = chain([150.0, 20.0, 600.0], signals={0: 1})
    cars = cars_on(network, [80.0, 40.0, 10.0], [10.0] * 3)
    log = run(network, cars, 60.0)
    front = log[:, :, 0] + CAR_M / 2
    red = np.arange(len(log)) * STEP_S < 29.0
    assert front[red].max() < 150.0
    assert log[280, :, 1].max() < 0.3
    assert 150.0 - front[280, 0] < 3.0
    assert (-np.diff(log[280, :, 0]) - CAR_M > 0.8 * MIN_GAP).all()
    assert (front[-1] > 200.0).all()
    assert (np.diff(np.argmax(front > 150.0, axis=0)) * STEP_S > 1.0).all()  # one after the other


def test_a_box_is_not_entered_without_room_behind_it() -> None:
    """A car that stands beyond the box blocks it: the next one waits at the line although it is green."""
    network = chain([100.0, 20.0, 300.0], signals={0: 0})
    cars = cars_on(network, [3.0, 30.0], [0.0, 8.0])
    cars.leg[0], cars.s[0], cars.desired_speed[0] = 2, 3.0, 1e-3
    cars.length[0] = 4.0
    log = run(network, cars, 20.0)
    assert log[-1, 1, 0] + CAR_M / 2 < 100.0
    assert log[-1, 1, 1] < 0.3


def merge(flow_distance_m: float) -> tuple[RoadNetwork, CarStates]:
    """A main road along x through (0, 0), a side road from the south that yields, and one car on each."""
    network = RoadNetwork()
    west, middle, east = (network.node(x, 0.0, 0.0) for x in (-200.0, 0.0, 300.0))
    south = network.node(-12.0, 12.0, -np.pi / 2)
    far_south = network.node(-12.0, 112.0, -np.pi / 2)
    network.straight(west, middle, "avenue", 14.0)
    network.straight(far_south, south, "street", 9.0)
    network.turn(south, middle, weight=1.0)
    network.straight(middle, east, "avenue", 14.0)
    return network, CarStates(
        s=np.array([200.0 - flow_distance_m, 70.0]),
        v=np.array([13.0, 7.0]),
        leg=np.zeros(2, np.int64),
        accepted_node=np.full(2, -1, np.int64),
        waiting_s=np.zeros(2),
        length=np.full(2, CAR_M),
        desired_speed=np.full(2, 13.0),
        headway=np.full(2, 1.0),
        route=np.array([0, 3, 1, 2, 3], np.int64),
        route_first=np.array([0, 2, 5], np.int64),
    )


@pytest.mark.parametrize(("distance_m", "first"), [(30.0, 0), (60.0, 0), (90.0, 0), (120.0, 1), (190.0, 1)])
def test_a_yielding_turn_accepts_a_gap_that_is_long_enough_only(distance_m: float, first: int) -> None:
    """The side road's car is 8 s away: behind a car that arrives before or a little after, without delaying it much."""
    network, cars = merge(distance_m)
    order, slowest = [], np.inf
    for _ in range(250):
        run(network, cars, STEP_S)
        slowest = min(slowest, cars.v[0])
        merged = [k for k, leg in ((0, 1), (1, 2)) if cars.leg[k] >= leg]
        order += [k for k in merged if k not in order]
        if len(order) == 2:
            break
    assert order == [first, 1 - first]
    assert abs(cars.s[0] - cars.s[1]) > CAR_M
    assert slowest > 9.0


def test_the_leader_is_the_next_car_on_the_route_also_on_a_later_edge() -> None:
    network = chain([100.0, 100.0])
    cars = cars_on(network, [50.0, 80.0, 10.0], [5.0] * 3)
    cars.leg[2] = 1
    roads = road_arrays(network, CONFIG)
    first, order = np.zeros(3, np.int64), np.empty(3, np.int64)
    sort_by_edge(np.arange(3), roads, cars, first, order)
    assert order[first[0] : first[1]].tolist() == [0, 1]
    assert find_leader(0, roads, cars, first, order) == (pytest.approx(30.0 - CAR_M), 1)
    assert find_leader(1, roads, cars, first, order) == (pytest.approx(30.0 - CAR_M), 2)
    assert find_leader(2, roads, cars, first, order)[1] == -1


@pytest.fixture(scope="module")
def straight_traffic() -> Traffic:
    config = TrafficSimulation(flow_veh_per_h=900, warm_up_s=0, large_share=0.3)
    return simulate_traffic(chain([900.0]), config, duration_s=400.0, rng=np.random.default_rng(5))


def test_arrivals_have_the_demand_and_a_minimum_headway(straight_traffic: Traffic) -> None:
    start_s = np.sort(straight_traffic.start_step) * STEP_S
    assert len(start_s) == pytest.approx(900 * 400 / 3600, rel=0.25)
    assert np.diff(start_s).min() >= 1.2 - 2 * STEP_S


def test_trajectories_are_monotonous_and_within_their_path(straight_traffic: Traffic) -> None:
    traffic = straight_traffic
    for vehicle in range(len(traffic)):
        rows = slice(traffic.first[vehicle], traffic.first[vehicle + 1])
        path, along = traffic.path(vehicle)
        assert (np.diff(traffic.distance_m[rows]) >= 0).all()
        assert traffic.distance_m[rows][-1] <= along[-1] + 1e-6
        assert along[-1] == pytest.approx(np.hypot(*np.diff(path, axis=0).T).sum())
    assert traffic.speed_m_per_s.min() >= 0


def test_vehicles_are_present_from_their_first_to_their_last_step(straight_traffic: Traffic) -> None:
    traffic = straight_traffic
    vehicle = 3
    begin = traffic.start_step[vehicle] * STEP_S
    end = begin + (traffic.first[vehicle + 1] - traffic.first[vehicle] - 1) * STEP_S
    for time_s, there in ((begin - 0.05, False), (begin + 0.05, True), (end - 0.05, True), (end + 0.05, False)):
        assert (vehicle in traffic.present(time_s)) == there
    position, direction, speed = traffic.at(np.array([vehicle]), np.array([begin]))
    assert position[0] == pytest.approx([0.0, 0.0], abs=0.5)
    assert direction[0] == pytest.approx(0.0)
    assert speed[0] == pytest.approx(traffic.speed_m_per_s[traffic.first[vehicle]])


def test_dimensions_are_those_of_the_kinds_of_vehicle() -> None:
    rng = np.random.default_rng(0)
    large = rng.uniform(size=3000) < 0.3
    made = draw_dimensions(large, rng)
    assert made.length_m[large].min() >= 7.0
    assert made.length_m[~large].max() <= 5.8
    assert set(made.shape[large]) == {2, 3}
    assert set(made.shape[~large]) == {0, 1}
    assert (made.shape[large] == 3).mean() == pytest.approx(0.4, abs=0.05)
    assert (made.width_m[~large] < made.width_m[large].min()).all()
    assert made.length_m[made.shape == 0].mean() == pytest.approx(4.35, abs=0.05)
