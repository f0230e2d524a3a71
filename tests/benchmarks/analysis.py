"""Accuracy of `velfield analyse` on simulated traffic without images: ``python -m tests.benchmarks.analysis``.

Tracks are true trajectories with the errors of tracking (`tests.benchmarks.observed_tracks`).
"""

import argparse
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from schemas.arrays import FloatArray, IntArray
from schemas.simulation import SimulationConfig
from tests.benchmarks.lane_score import DirectedGraph, score_lanes
from tests.benchmarks.observed_tracks import observed_tracks
from velfield.analysis.flow.conflicts import MAX_PET_S, find_conflicts
from velfield.analysis.flow.passings import LaneTraffic
from velfield.analysis.flow.speeds import Reduction
from velfield.analysis.lanes.find import find_lanes
from velfield.analysis.movements.movements import JunctionMovements, find_passes
from velfield.analysis.movements.scene import trace_trips
from velfield.analysis.signals.cycles import JunctionSignal, queues
from velfield.analysis.signals.queues import Stops, Stream, observe_stream
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.analysis.trajectories import PathSamples, Trajectories, make_trajectories, moving
from velfield.synthetic.city.city_plan import STOP_A, STOP_B
from velfield.synthetic.flight import Flight
from velfield.synthetic.observed import NO_ERRORS, observed_detections
from velfield.synthetic.traffic.traffic import STEP_S

GSD_M, CYCLE_S = 0.23, 60.0
AVENUE_KM_PER_H, STREET_KM_PER_H = 49.8, 34.2
"""Medians of the speeds that drivers want: mean 50 km/h, one in twenty a tenth slower; the limit of a street."""
SAME_ENTRY_M = 6.0
CANNOT_STOP_M_PER_S2 = 3.5
"""A driver who would have to brake harder at the end of green crosses: `velfield.synthetic.traffic.driving`."""


@dataclass(frozen=True)
class Case:
    """A simulated flight: what a tracker reports, and the truth."""

    flight: Flight
    tracks: pd.DataFrame
    true: pd.DataFrame
    lengths_m: FloatArray


@dataclass(frozen=True)
class Results:
    """Values by measure."""

    values: defaultdict[str, list[float]]


def simulate(seed: int, minutes: float) -> Case:
    """Simulate one flight."""
    flight = Flight(SimulationConfig(seed=seed, frames=round(300 * minutes), gsd_m=GSD_M))
    traffic, times, city = flight.city.traffic, flight.times_s, flight.city
    rng = np.random.default_rng(seed)
    tracks = observed_tracks(traffic, times, city.to_px, shape=flight.base_shape, gsd_m=GSD_M, rng=rng)
    true = observed_detections(traffic, times, city.to_px, shape=flight.base_shape, rng=rng, errors=NO_ERRORS)
    return Case(flight, tracks, true, traffic.dimensions.length_m)


def trajectories(table: pd.DataFrame, owner: str) -> Trajectories:
    """Trajectories of a table of positions."""
    known = "dx_px" in table
    return moving(
        make_trajectories(
            table[owner].to_numpy(np.int64),
            table["frame"].to_numpy(np.int64),
            table["time_s"].to_numpy(np.float64),
            table[["x_px", "y_px"]].to_numpy(np.float64) * GSD_M,
            gsd_m=GSD_M,
            displacement_m=table[["dx_px", "dy_px"]].to_numpy(np.float64) * GSD_M if known else None,
        )
    )


def measure(case: Case) -> Results:
    """Everything about one flight."""
    results = Results(defaultdict(list))
    found = TrafficAnalysis(trajectories(case.tracks, "track_id"))
    true = TrafficAnalysis(trajectories(case.true, "vehicle_id"))
    _lanes(case, found, results)
    _movements(found, true, results)
    _scene(found, true, results)
    _speeds(found, true, results)
    _signals(case, found, true, results)
    _u_turns(case, found, results)
    _conflicts(case, found, true, results)
    return results


def _lanes(case: Case, found: TrafficAnalysis, results: Results) -> None:
    graph = DirectedGraph([lane.xy_m for lane in found.lanes], found.lanes.successors)
    score = score_lanes(graph, driven_plan(case))
    results.values["lanes: topology F1"].append(score.f1)
    results.values["lanes: centre line, median m"].append(score.centre_median_m)


def driven_plan(case: Case, *, min_vehicles: int = 3) -> DirectedGraph:
    """The plan's edges that so many vehicles drove during the flight, within the image."""
    network, city = case.flight.city.plan.road_network, case.flight.city
    height, width = case.flight.base_shape
    vehicles = np.zeros(len(network.edges), np.int64)
    middles = cKDTree([edge.path[len(edge.path) // 2] for edge in network.edges])
    times = case.true.groupby("vehicle_id")["time_s"].agg(["min", "max"])
    traffic = city.traffic
    for vehicle, begin, end in times.itertuples():
        points, along = traffic.path(vehicle)
        rows = slice(int(traffic.first[vehicle]), int(traffic.first[vehicle + 1]))
        at = STEP_S * (traffic.start_step[vehicle] + np.arange(rows.stop - rows.start))
        driven = np.interp([begin, end], at, traffic.distance_m[rows])
        seen = points[(along >= driven[0]) & (along <= driven[1])]
        near, edge = middles.query(seen, distance_upper_bound=0.3)
        vehicles[np.unique(edge[np.isfinite(near)])] += 1
    number: dict[int, int] = {}
    paths: list[FloatArray] = []
    for k in np.flatnonzero(vehicles >= min_vehicles):
        path = city.to_px(network.edges[k].path)
        inside = ((path >= 0) & (path <= [width, height])).all(axis=1)
        if inside.sum() >= 2:
            number[int(k)] = len(paths)
            paths.append(path[inside] * GSD_M)
    out = network.out_edges()
    return DirectedGraph(paths, [[number[j] for j in out[network.edges[k].end] if j in number] for k in number])


def _movements(found: TrafficAnalysis, true: TrafficAnalysis, results: Results) -> None:
    for junction in found.movements:
        names = [arm.name for arm in junction.gates.arms]
        counts = _true_counts(junction, true.samples)
        for m in junction.movements:
            i, j = names.index(m.arm_in), names.index(m.arm_out)
            n, total = counts[i, j], m.seen + m.inferred
            results.values["movements: GEH"].append(float(np.sqrt(2 * (total - n) ** 2 / max(total + n, 1))))
            if n >= 20 and m.share:
                results.values["movements: share, points"].append(100 * abs(m.share.value - n / counts[i].sum()))


def _true_counts(junction: JunctionMovements, samples: PathSamples) -> IntArray:
    """Vehicles (arms, arms) from arm to arm."""
    passes = find_passes(samples, junction.junction, junction.gates)
    arm = np.array([gate.arm for gate in junction.gates.gates] + [-1], np.int64)
    i, j = arm[passes.gate_in], arm[passes.gate_out]
    n = len(junction.gates.arms)
    whole = (i >= 0) & (j >= 0)
    return np.bincount(i[whole] * n + j[whole], minlength=n * n).reshape(n, n)


def _scene(found: TrafficAnalysis, true: TrafficAnalysis, results: Results) -> None:
    """Origins and destinations, against true trajectories at the same gates."""
    if found.scene is None or true.scene is None:
        results.values["scene: arms"].append(0.0)
        return
    at = np.array([arm.xy_m for arm in true.scene.arms])
    near = [np.hypot(*(at - arm.xy_m).T).min() < 20 for arm in found.scene.arms]
    results.values["scene: arms"].append(len(at))
    results.values["scene: of these found"].append(sum(near))
    results.values["scene: arms, false"].append(len(near) - sum(near))
    gates, arms = found.scene.gates, found.scene.arms
    truth = trace_trips(true.cut_tracks, true.lanes, gates, arms)
    entered = len(found.scene.trips.track), len(truth.trips.track)
    results.values["scene: vehicles entered, error in %"].append(100 * abs(entered[0] / entered[1] - 1))
    counts, known = ({(r.origin.number, r.destination.number): r for r in s.relations} for s in (found.scene, truth))
    for pair in counts.keys() | known.keys():
        a, b = (c[pair].vehicles if pair in c else 0.0 for c in (counts, known))
        results.values["scene: GEH"].append(float(np.sqrt(2 * (a - b) ** 2 / max(a + b, 1))))
        results.values["scene: vehicles inferred of cut tracks"].append(counts[pair].cut if pair in counts else 0.0)
        results.values["scene: vehicles"].append(a)
        entering = [sum(r.vehicles for (i, _), r in c.items() if i == pair[0]) for c in (counts, known)]
        if b >= 20:
            results.values["scene: share, points"].append(100 * abs(a / entering[0] - b / entering[1]))


def _speeds(found: TrafficAnalysis, true: TrafficAnalysis, results: Results) -> None:
    for road in found.free_flow:
        if road.speed_m_per_s:
            speed = road.speed_m_per_s.in_units(3.6)
            truth = min((AVENUE_KM_PER_H, STREET_KM_PER_H, 20.2, 15.1), key=lambda v: abs(v - speed.value))
            results.values["limit: error, km/h"].append(abs(speed.value - truth))
    for r in found.reductions:
        if found.lanes.junctions[r.junction].kind != "roundabout" or not r.reduction_m_per_s:
            continue
        other = next((o for o in true.reductions if _same_entry(found, r, true, o)), None)
        if other and other.reduction_m_per_s:
            change = r.reduction_m_per_s.value - other.reduction_m_per_s.value
            results.values["circle: reduction, km/h"].append(3.6 * abs(change))


def _same_entry(found: TrafficAnalysis, r: Reduction, true: TrafficAnalysis, other: Reduction) -> bool:
    """Whether two lanes enter a junction at one place."""
    a, b = (
        np.array([g.xy_m for g in analysis.movements[k.junction].gates.gates if g.inwards and g.lane == k.lane])
        for analysis, k in ((found, r), (true, other))
    )
    return bool(len(a) and len(b) and np.hypot(*(a[0] - b[0])) < SAME_ENTRY_M)


def _signals(case: Case, found: TrafficAnalysis, true: TrafficAnalysis, results: Results) -> None:
    samples, stops = true.samples, true.stops
    for junction in found.lanes.junctions:
        signal = found.signals.get(junction.number)
        if signal is None:
            continue
        if junction.kind != "intersection":
            results.values["signals: found where there is none"].append(float(signal.signalised is True))
            continue
        results.values["signals: found"].append(float(signal.signalised is True))
        if signal.cycle_s:
            results.values["signals: cycle, s"].append(abs(signal.cycle_s.value - CYCLE_S))
            _streams(case, signal, samples, stops, results)


def _streams(case: Case, signal: JunctionSignal, samples: PathSamples, stops: Stops, results: Results) -> None:
    for stream in signal.streams:
        for name, onset in zip(("green", "red"), signal_onsets_s(case.flight, stream.stream), strict=True):
            found = stream.green_phase_s if name == "green" else stream.red_phase_s
            if found:
                error = (found.value - onset + CYCLE_S / 2) % CYCLE_S - CYCLE_S / 2
                results.values[f"signals: {name} onset, s"].append(abs(error))
        path, line = stream.stream.approach.path_m, stream.stream.stop_line_m
        if line is not None:
            number, axis = _crossing_of(case.flight, path)
            at = path[0] + (path[-1] - path[0]) / np.hypot(*(path[-1] - path[0])) * line
            distance = abs(float((at - crossings_m(case.flight)[number])[axis]))
            results.values["signals: stop line, m"].append(abs(distance - (STOP_B if axis else STOP_A)))
        truth = observe_stream(stream.stream.approach, samples, stops)
        pairs = zip(queues(stream.stream, stream.green_s), queues(truth, stream.green_s), strict=False)
        results.values["signals: queue, vehicles"] += [abs(a.vehicles.value - b.vehicles.value) for a, b in pairs]


def crossings_m(made: Flight) -> FloatArray:
    """(n, 2) crossings of avenues, m of the base image."""
    plan = made.city.plan
    return made.city.to_px(np.array([[x, y] for x in plan.avenues_x for y in plan.avenues_y])) * GSD_M


def _crossing_of(made: Flight, path_m: FloatArray) -> tuple[int, int]:
    """Number of the crossing to which a path leads, and the axis along which it does."""
    step = path_m[-1] - path_m[0]
    return int(np.argmin(np.hypot(*(crossings_m(made) - path_m[-20]).T))), int(abs(step[1]) > abs(step[0]))


def signal_onsets_s(made: Flight, stream: Stream) -> tuple[float, float]:
    """Onsets of green and of red of a stream, as simulated."""
    number, axis = _crossing_of(made, stream.approach.path_m)
    traffic = made.config.traffic
    green = axis * traffic.cycle_s / 2 - made.city.plan.road_network.signal_offsets_s[number] - traffic.warm_up_s
    # simulated signals have no yellow: who cannot stop crosses after the end of green
    late = AVENUE_KM_PER_H / 3.6 / (2 * CANNOT_STOP_M_PER_S2)
    return green, green + traffic.cycle_s / 2 - traffic.all_red_s + late


def _u_turns(case: Case, found: TrafficAnalysis, results: Results) -> None:
    """U-turns between an avenue's lanes, of vehicles that were seen before the turn and after it."""
    true = true_u_turns(case)
    owner = case.tracks.drop_duplicates("track_id").set_index("track_id")["vehicle_id"]
    reversed_ = [int(owner[found.trajectories.track_id[r.track]]) for r in found.reversals if not r.round_circle]
    results.values["u-turns: true"].append(len(true))
    results.values["u-turns: found"].append(len(true & set(reversed_)))
    begun = true_u_turns(case, seen_m=0.0)
    results.values["u-turns: false"].append(sum(v not in begun for v in reversed_))


def true_u_turns(case: Case, *, seen_m: float = 20.0) -> set[int]:
    """Vehicles that reverse on a turn onto an avenue, seen so far before and after its middle."""
    city, net = case.flight.city, case.flight.city.plan.road_network
    into, out = net.in_edges(), net.out_edges()
    xy, vehicle = case.true[["x_px", "y_px"]].to_numpy(np.float64), case.true["vehicle_id"].to_numpy(np.int64)
    tree, true = cKDTree(xy), set()
    rows = case.true.sort_values(["vehicle_id", "frame"], kind="stable").groupby("vehicle_id").groups
    for edge in net.edges:
        first, last = np.diff(edge.path[:2], axis=0)[0], np.diff(edge.path[-2:], axis=0)[0]
        turn = abs(float(np.angle(np.exp(1j * (np.arctan2(*last[::-1]) - np.arctan2(*first[::-1]))))))
        in_car_park = any(net.edges[k].kind == "aisle" for k in into[edge.start] + out[edge.end])
        if edge.kind != "turn" or turn < 2.6 or in_car_park:
            continue
        middle = city.to_px(edge.path[len(edge.path) // 2][None])[0]
        for v in np.unique(vehicle[tree.query_ball_point(middle, 2.5 / GSD_M)]).tolist():
            own = xy[rows[v]]
            along = np.r_[0.0, np.hypot(*np.diff(own, axis=0).T).cumsum()] * GSD_M
            at = along[np.argmin(np.hypot(*(own - middle).T))]
            if min(at, along[-1] - at) >= seen_m:
                true.add(v)
    return true


def _conflicts(case: Case, found: TrafficAnalysis, true: TrafficAnalysis, results: Results) -> None:
    owner = case.tracks.drop_duplicates("track_id").set_index("track_id")["vehicle_id"]
    ids = owner.reindex(found.trajectories.track_id).to_numpy(np.int64)
    lengths = case.lengths_m[true.trajectories.track_id]
    traffic = LaneTraffic(find_lanes(true.trajectories))
    truth = _pairs(find_conflicts(true.trajectories, traffic, lengths_m=lengths), true.trajectories.track_id)
    seen = _pairs(found.conflicts, ids)
    for pair, value in seen.items():
        if pair in truth:
            results.values["conflicts: PET error, s"].append(abs(value - truth[pair]))
    # a value near the limit may be on either side of it
    results.values["conflicts: true"].append(sum(v < MAX_PET_S - 0.3 for v in truth.values()))
    results.values["conflicts: of these found"].append(
        sum(v < MAX_PET_S - 0.3 and pair in seen for pair, v in truth.items())
    )
    results.values["conflicts: found"].append(sum(v < MAX_PET_S - 0.3 for v in seen.values()))
    results.values["conflicts: of these true"].append(
        sum(v < MAX_PET_S - 0.3 and pair in truth for pair, v in seen.items())
    )


def _pairs(conflicts: list, ids: IntArray) -> dict[tuple[int, int], float]:
    return {(int(ids[c.first]), int(ids[c.second])): c.value_s for c in conflicts if c.kind != "following"}


def lines(all_results: list[Results]) -> Iterator[str]:
    """The table, for people."""
    names = sorted({name for results in all_results for name in results.values})
    for name in names:
        values = np.array([v for results in all_results for v in results.values[name]], np.float64)
        yield (
            f"{name:38} n {len(values):5d}  sum {values.sum():9.1f}  median {np.median(values):7.3f}  "
            f"p90 {np.quantile(values, 0.9):7.3f}  p95 {np.quantile(values, 0.95):7.3f}  max {values.max():7.3f}"
        )
    share = np.array([v for r in all_results for v in r.values["movements: share, points"]])
    yield f"shares within 3 points: {np.mean(share <= 3):.3f} of {len(share)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(913, 923)))
    parser.add_argument("--minutes", type=float, default=6.0)
    arguments = parser.parse_args()
    made: list[Results] = []
    for seed in arguments.seeds:
        case = simulate(seed, arguments.minutes)
        made.append(measure(case))
        print(f"seed {seed}: {', '.join(f'{k} {np.mean(v):.2f}' for k, v in made[-1].values.items())}", flush=True)
    for line in lines(made):
        print(line)


if __name__ == "__main__":
    main()
