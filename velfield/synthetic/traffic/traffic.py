"""Traffic on a road network: arrivals, routes, and the trajectories of all vehicles.

The distance driven is interpolated between time steps by cubic Hermite polynomials, so that velocity is the derivative
of position everywhere.
"""

from collections.abc import Sequence, Sized
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, IntArray
from schemas.simulation import TrafficSimulation
from velfield.compiled import kernel
from velfield.synthetic.city.road_network import RoadNetwork, clear_until_m
from velfield.synthetic.traffic.driving import CarStates, RoadArrays, advance, try_enter

_CAR_LENGTH_M = 4.35
"""Median of the lengths as they are drawn, before they are scaled to a place's."""
STEP_S = 0.1
MAX_LEGS = 60


class VehicleDimensions(NamedTuple):
    """Dimensions of vehicles, one row each: ``length_m``, ``width_m``, ``height_m``, ``shape`` (see vehicles.py)."""

    length_m: FloatArray
    width_m: FloatArray
    height_m: FloatArray
    shape: IntArray


@dataclass(frozen=True)
class Traffic:
    """All trajectories of a simulation.

    Trajectory i has the rows ``first[i] : first[i + 1]``, one a time step from ``start_step[i] * STEP_S`` on: the
    distance ``distance_m`` along its path and ``speed_m_per_s``. Its path is
    ``points_m[path_first[i] : path_first[i + 1]]``, at the distances ``along_m``.
    """

    dimensions: VehicleDimensions
    points_m: FloatArray
    along_m: FloatArray
    path_first: IntArray
    start_step: IntArray
    first: IntArray
    distance_m: FloatArray
    speed_m_per_s: FloatArray

    def __len__(self) -> int:
        return len(self.start_step)

    def path(self, vehicle: int) -> tuple[FloatArray, FloatArray]:
        """Points (n, 2) m of a vehicle's path and their distances (n,) along it."""
        piece = slice(int(self.path_first[vehicle]), int(self.path_first[vehicle + 1]))
        return self.points_m[piece], self.along_m[piece]

    def present(self, time_s: float) -> IntArray:
        """Indices of the vehicles on the road at a time."""
        last = self.start_step + np.diff(self.first) - 1
        step = time_s / STEP_S
        return np.flatnonzero((self.start_step <= step) & (step < last))

    def at(self, vehicle: IntArray, time_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Position (n, 2) m, direction (n,) rad and speed (n,) m/s of vehicles (n,) at their own times (n,)."""
        out = _states_at(
            np.asarray(vehicle, dtype=np.int64),
            np.asarray(time_s, dtype=np.float64) / STEP_S,
            (self.start_step, self.first, self.distance_m, self.speed_m_per_s * STEP_S),
            (self.path_first, self.points_m, self.along_m),
        )
        return out[:, :2], out[:, 2], out[:, 3] / STEP_S


def simulate_traffic(
    road_network: RoadNetwork, config: TrafficSimulation, *, duration_s: float, rng: np.random.Generator
) -> Traffic:
    """Simulate from ``-warm_up_s`` to ``duration_s``; times of the result are from the first frame."""
    roads = road_arrays(road_network, config)
    start_s, routes = _arrivals(road_network, config, config.warm_up_s + duration_s, rng)
    dimensions = _draw_route_dimensions(len(routes), config, routes, road_network, rng)
    spread = np.clip(rng.standard_normal(len(routes)), -2, 2)
    desired_speed = (config.speed_mean_km_per_h + config.speed_sd_km_per_h * spread) / 3.6
    desired_speed = np.where(dimensions.length_m > 7, 0.9 * desired_speed, desired_speed)
    n = len(routes)
    cars = CarStates(
        s=np.zeros(n),
        v=desired_speed.copy(),
        leg=np.zeros(n, np.int64),
        accepted_node=np.full(n, -1, np.int64),
        waiting_s=np.zeros(n),
        length=dimensions.length_m,
        desired_speed=desired_speed,
        headway=np.clip(rng.normal(0.85, 0.1, n), 0.65, 1.2),
        route=np.array([e for route in routes for e in route], dtype=np.int64),
        route_first=np.concatenate([[0], np.cumsum([len(route) for route in routes])]).astype(np.int64),
    )
    steps = int(np.ceil((config.warm_up_s + duration_s) / STEP_S)) + 2
    log = _drive(steps, start_s, roads, cars, len(road_network.nodes))
    return _trajectories(road_network, dimensions, routes, log, config.warm_up_s)


def road_arrays(road_network: RoadNetwork, config: TrafficSimulation) -> RoadArrays:
    """The road network as arrays for the kernels."""
    edges = road_network.edges
    into, out = road_network.in_edges(), road_network.out_edges()
    clear_end = np.array([e.length_m for e in edges])
    siblings: list[list[tuple[int, float]]] = [[] for _ in edges]
    for group in into:
        for a in group:
            for b in group:
                if a != b and edges[a].start != edges[b].start:
                    clear_end[a] = min(clear_end[a], clear_until_m(edges[a].path, edges[b].path, from_end=True))
    for group in out:
        for a in group:
            for b in group:
                if a != b:
                    siblings[a].append((b, clear_until_m(edges[b].path, edges[a].path, from_end=False)))
    boxes: list[list[int]] = [[] for _ in range(2 * max(len(road_network.signal_offsets_s), 1))]
    for edge in edges:
        if edge.signal >= 0:
            boxes[edge.signal] += out[edge.end]
    return RoadArrays(
        length=np.array([e.length_m for e in edges]),
        limit=np.array([e.speed_m_per_s for e in edges]),
        end=np.array([e.end for e in edges], dtype=np.int64),
        signal=np.array([e.signal for e in edges], dtype=np.int64),
        yields=np.array([e.yields for e in edges], dtype=np.int64),
        clear_end=clear_end,
        sibling_first=_offsets(siblings),
        sibling=np.array([b for s in siblings for b, _ in s], dtype=np.int64),
        sibling_clear=np.array([c for s in siblings for _, c in s], dtype=np.float64),
        merges=np.array([len(into[e.end]) > 1 for e in edges], dtype=np.int64),
        boxes_first=_offsets(boxes),
        boxes=np.array([b for group in boxes for b in group], dtype=np.int64),
        offsets=np.array(road_network.signal_offsets_s or [0.0]),
        cycle_s=config.cycle_s,
        all_red_s=config.all_red_s,
    )


def _offsets(groups: Sequence[Sized]) -> IntArray:
    """Start of each group in their concatenation, and its end."""
    return np.concatenate([[0], np.cumsum([len(group) for group in groups])]).astype(np.int64)


def _arrivals(
    road_network: RoadNetwork, config: TrafficSimulation, duration_s: float, rng: np.random.Generator
) -> tuple[FloatArray, list[list[int]]]:
    """Arrival time of each vehicle (sorted), and its route; headways are shifted exponential."""
    out = road_network.out_edges()
    when: list[float] = []
    where: list[int] = []
    for node, weight in road_network.sources:
        rate = config.flow_veh_per_h * weight / 3600
        if rate <= 0 or not out[node]:
            continue
        t = 0.0
        while t < duration_s:
            t += 1.2 + float(rng.exponential(max(1 / rate - 1.2, 0.1)))
            when.append(t)
            where.append(node)
    order = np.argsort(when, kind="stable")
    routes = [_random_route(road_network, out, where[k], rng) for k in order]
    return np.array(when)[order], routes


def _random_route(road_network: RoadNetwork, out: list[list[int]], node: int, rng: np.random.Generator) -> list[int]:
    route: list[int] = []
    while out[node] and len(route) < MAX_LEGS:
        weights = np.array([road_network.edges[e].weight for e in out[node]])
        route.append(out[node][int(rng.choice(len(weights), p=weights / weights.sum()))])
        node = road_network.edges[route[-1]].end
    return route


def _draw_route_dimensions(
    n: int, config: TrafficSimulation, routes: list[list[int]], road_network: RoadNetwork, rng: np.random.Generator
) -> VehicleDimensions:
    """Dimensions of vehicles; large ones only on routes without tight turns."""
    slow = np.array([min(road_network.edges[e].speed_m_per_s for e in route) < 8 for route in routes], dtype=bool)
    large = (rng.uniform(size=n) < config.large_share) & ~slow
    return draw_dimensions(large, rng, config.car_length_m)


def draw_dimensions(
    large: NDArray[np.bool_], rng: np.random.Generator, car_length_m: float = _CAR_LENGTH_M
) -> VehicleDimensions:
    """Dimensions of vehicles (n,): cars and vans; lorries and buses where ``large``."""
    n = len(large)
    pick = rng.uniform(size=n)
    bus = large & (pick < 0.4)
    van = ~large & (pick < 0.12)
    length = np.clip(rng.normal(_CAR_LENGTH_M, 0.35, n), 3.5, 5.2) * (car_length_m / _CAR_LENGTH_M)
    width = np.clip(1.2 + 0.135 * length + rng.normal(0, 0.04, n), 1.6, 2.0)
    height = rng.uniform(1.4, 1.7, n)
    length = np.where(van, rng.uniform(4.8, 5.8, n), length)
    height = np.where(van, rng.uniform(1.9, 2.4, n), height)
    length = np.where(large, np.where(bus, 11.5, rng.uniform(7, 9.5, n)), length)
    width = np.where(large, 2.5, width)
    height = np.where(large, rng.uniform(2.9, 3.4, n), height)
    shape = np.where(bus, 3, np.where(large, 2, np.where(van, 1, 0)))
    return VehicleDimensions(length, width, height, shape.astype(np.int64))


def _drive(steps: int, start_s: FloatArray, roads: RoadArrays, cars: CarStates, n_nodes: int) -> FloatArray:
    """Run all time steps; log of (step, vehicle, leg, distance along the edge, speed), one row a vehicle and step."""
    source = cars.route[cars.route_first[:-1]]
    first, head = np.zeros(len(roads.length) + 1, np.int64), np.empty(n_nodes, np.int64)
    active = np.empty(0, dtype=np.int64)
    waiting: list[int] = []
    next_up = 0
    log = []
    for step in range(steps):
        size = 8 * len(active) + 64
        scratch = (first, np.empty(len(active) + 1, np.int64), head, *np.empty((3, size), np.int64), np.empty(size))
        if len(active):
            active = active[advance(active, step * STEP_S, STEP_S, roads, cars, scratch)]
        while next_up < len(start_s) and start_s[next_up] <= step * STEP_S:
            waiting.append(next_up)
            next_up += 1
        full: set[int] = set()
        for i in list(waiting):
            # each source is a queue
            if source[i] not in full and try_enter(i, active, roads, cars, first, np.empty(len(active) + 1, np.int64)):
                waiting.remove(i)
                active = np.append(active, i)
            else:
                full.add(int(source[i]))
        log.append(
            np.column_stack([np.full(len(active), step), active, cars.leg[active], cars.s[active], cars.v[active]])
        )
    return np.concatenate(log)


def _trajectories(
    road_network: RoadNetwork, dimensions: VehicleDimensions, routes: list[list[int]], log: FloatArray, warm_up_s: float
) -> Traffic:
    order = np.lexsort((log[:, 0], log[:, 1]))
    log = log[order]
    vehicle = log[:, 1].astype(np.int64)
    seen, start, count = np.unique(vehicle, return_index=True, return_counts=True)
    keep = count >= 2
    rows = np.repeat(keep, count)
    seen, start, count, log, vehicle = seen[keep], start[keep], count[keep], log[rows], vehicle[rows]
    lengths = np.array([e.length_m for e in road_network.edges])
    paths, alongs = [], []
    driven = np.empty(len(log))
    first = np.concatenate([[0], np.cumsum(count)])
    for k, i in enumerate(seen):
        piece = slice(int(first[k]), int(first[k + 1]))
        legs = log[piece, 2].astype(np.int64)
        before = np.concatenate([[0.0], np.cumsum(lengths[routes[i]])])
        driven[piece] = before[legs] + log[piece, 3]
        path = np.concatenate(
            [road_network.edges[e].path[(0 if h == 0 else 1) :] for h, e in enumerate(routes[i][: int(legs[-1]) + 2])]
        )
        paths.append(path)
        alongs.append(np.concatenate([[0.0], np.hypot(*np.diff(path, axis=0).T).cumsum()]))
    start_step = log[first[:-1], 0].astype(np.int64) - round(warm_up_s / STEP_S)
    return Traffic(
        dimensions=VehicleDimensions._make(column[seen] for column in dimensions),
        points_m=np.concatenate(paths) if paths else np.empty((0, 2)),
        along_m=np.concatenate(alongs) if alongs else np.empty(0),
        path_first=_offsets(paths),
        start_step=start_step,
        first=first.astype(np.int64),
        distance_m=driven,
        speed_m_per_s=log[:, 4].copy(),
    )


@kernel
def _states_at(
    vehicle: IntArray,
    step: FloatArray,
    drives: tuple[IntArray, IntArray, FloatArray, FloatArray],
    paths: tuple[IntArray, FloatArray, FloatArray],
) -> FloatArray:
    """Position x, y, direction and speed (m a step) of vehicles, each at its own time in steps."""
    start_step, first, driven, speed = drives
    path_first, points, along = paths
    out = np.empty((len(vehicle), 4))
    for n in range(len(vehicle)):
        i = vehicle[n]
        at = step[n] - start_step[i]
        k = first[i] + min(max(int(np.floor(at)), 0), first[i + 1] - first[i] - 2)
        t = at - (k - first[i])
        s, v = _interpolate_step(driven[k], driven[k + 1], speed[k], speed[k + 1], t)
        a, b = path_first[i], path_first[i + 1]
        x, y, direction = _point_on_path(points[a:b], along[a:b], s)
        out[n, 0], out[n, 1], out[n, 2], out[n, 3] = x, y, direction, v
    return out


@kernel
def _interpolate_step(s0: float, s1: float, v0: float, v1: float, t: float) -> tuple[float, float]:
    """Distance and speed at fraction ``t`` of a step: cubic Hermite; extrapolated at constant speed."""
    if t < 0:
        return s0 + v0 * t, v0
    if t > 1:
        return s1 + v1 * (t - 1), v1
    d = s1 - s0
    c, q = v0 + v1 - 2 * d, 3 * d - 2 * v0 - v1
    return s0 + t * (v0 + t * (q + t * c)), v0 + t * (2 * q + 3 * c * t)


@kernel
def _point_on_path(points: FloatArray, along: FloatArray, s: float) -> tuple[float, float, float]:
    """Position and direction at distance ``s`` along a path; the direction is interpolated between pieces."""
    last = len(along) - 2
    k = min(max(int(np.searchsorted(along, s, side="right")) - 1, 0), last)
    length = along[k + 1] - along[k]
    dx, dy = (points[k + 1, 0] - points[k, 0]) / length, (points[k + 1, 1] - points[k, 1]) / length
    x, y = points[k, 0] + (s - along[k]) * dx, points[k, 1] + (s - along[k]) * dy
    t = (s - along[k]) / length
    other = k + 1 if t > 0.5 else k - 1
    if 0 <= other <= last:
        near = along[other + 1] - along[other]
        w = min(abs(t - 0.5), 1.0)
        dx += w * ((points[other + 1, 0] - points[other, 0]) / near - dx)
        dy += w * ((points[other + 1, 1] - points[other, 1]) / near - dy)
    return x, y, np.arctan2(dy, dx)
