"""The simulated traffic: no overlaps, stops at red, speed as the derivative of position."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial import cKDTree

from schemas.arrays import FloatArray
from schemas.simulation import TrafficSimulation
from velfield.synthetic.city.city_plan import make_city_plan
from velfield.synthetic.city.road_network import RoadNetwork
from velfield.synthetic.traffic.driving import is_green
from velfield.synthetic.traffic.traffic import Traffic, road_arrays, simulate_traffic

CITY_M = (-190.0, -160.0, 200.0, 140.0)
CONFIG = TrafficSimulation()


@cache
def city(seed: int = 0) -> tuple[RoadNetwork, Traffic]:
    rng = np.random.default_rng(seed)
    plan = make_city_plan(CITY_M, rng, turn_share=CONFIG.turn_share, cycle_s=CONFIG.cycle_s)
    return plan.road_network, simulate_traffic(plan.road_network, CONFIG, duration_s=120.0, rng=rng)


def boxes_overlap(a: FloatArray, b: FloatArray) -> bool:
    """Whether two rectangles (x, y, direction, length, width) overlap, by the separating axis theorem."""
    offset = b[:2] - a[:2]
    axes = [np.array([[np.cos(r[2]), np.sin(r[2])], [-np.sin(r[2]), np.cos(r[2])]]) for r in (a, b)]
    halves = [r[3:] / 2 for r in (a, b)]
    for pair in axes:
        for axis in pair:
            reach = sum(float(np.abs(other @ axis) @ half) for other, half in zip(axes, halves, strict=True))
            if abs(offset @ axis) >= 0.97 * reach:
                return False
    return True


@pytest.mark.parametrize("seed", [0, 1])
def test_cars_never_overlap(seed: int) -> None:
    _, traffic = city(seed)
    for time_s in np.arange(0, 120, 1.5):
        present = traffic.present(float(time_s))
        position, direction, _ = traffic.at(present, np.full(len(present), time_s))
        boxes = np.column_stack(
            [position, direction, traffic.dimensions.length_m[present], traffic.dimensions.width_m[present]]
        )
        for i, j in cKDTree(position).query_pairs(12.5):
            assert not boxes_overlap(boxes[i], boxes[j]), (time_s, present[i], present[j], position[i])


def test_no_car_enters_an_intersection_on_red() -> None:
    road_network, traffic = city()
    roads = road_arrays(road_network, CONFIG)
    lines = {
        (round(n.x, 2), round(n.y, 2)): edge.signal
        for edge in road_network.edges
        if edge.signal >= 0
        for n in [road_network.nodes[edge.end]]
    }
    entries = 0
    for i, start in enumerate(traffic.start_step):
        path, along = traffic.path(i)
        a, b = traffic.first[i], traffic.first[i + 1]
        for point, group in lines.items():
            hit = np.flatnonzero(np.hypot(*(path - point).T) < 0.3)
            if not len(hit) or not (traffic.distance_m[a] < along[hit[0]] < traffic.distance_m[b - 1]):
                continue
            step = start + np.searchsorted(traffic.distance_m[a:b], along[hit[0]]) - 1
            time_s = step * 0.1 + CONFIG.warm_up_s
            # three seconds of amber: a car that cannot stop drives on
            greens = [is_green(group, time_s - d, roads.offsets, roads.cycle_s, roads.all_red_s) for d in (0, 1, 2, 3)]
            assert any(greens), (point, time_s)
            entries += 1
    assert entries > 200


def test_queues_stop_at_red_and_discharge_at_green() -> None:
    _, traffic = city()
    speed = traffic.speed_m_per_s
    assert 0.1 < (speed < 0.3).mean() < 0.8
    gone = [traffic.distance_m[b - 1] > 250 for b in traffic.first[1:]]
    assert sum(gone) > 80


def test_speed_is_the_derivative_of_position() -> None:
    _, traffic = city()
    present = traffic.present(60.0)
    for time_s in (60.03, 60.1, 60.17):
        ahead, _, _ = traffic.at(present, np.full(len(present), time_s + 0.002))
        behind, _, _ = traffic.at(present, np.full(len(present), time_s - 0.002))
        _, direction, speed = traffic.at(present, np.full(len(present), time_s))
        velocity = (ahead - behind) / 0.004
        true = speed[:, None] * np.column_stack([np.cos(direction), np.sin(direction)])
        # paths are polylines of half a metre: a turn of 5 m radius bends by 3 degrees at each
        assert np.median(np.abs(velocity - true)) < 0.01
        assert np.abs(velocity - true).max() < 0.6


def test_the_flow_is_the_demand() -> None:
    _, traffic = city()
    came = (traffic.start_step > -900) & (traffic.start_step <= 1200)
    lanes = 8
    wanted = lanes * 900 * 210 / 3600
    assert came.sum() > 0.85 * wanted


def test_speeds_are_those_of_a_city() -> None:
    _, traffic = city()
    fast = np.percentile(traffic.speed_m_per_s, 98) * 3.6
    assert 35 < fast < 65
    assert traffic.speed_m_per_s.max() * 3.6 < 70
    for a, b in zip(traffic.first, traffic.first[1:], strict=False):
        assert (np.diff(traffic.distance_m[a:b]) >= -1e-9).all()
