"""Coverage of the 90 % intervals of the analysis, by quantity: ``python -m tests.benchmarks.intervals``.

Clips of simulated traffic over one plan, each with errors of positions from none to 0.5 m, or cut by trees and misses.
What an interval should hold is the value that the same gates and lanes give of hours of other traffic on the same
roads, of true positions; of signals, U-turns and free flow what was simulated; of a queue who stood there.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from schemas.arrays import FloatArray, IntArray
from schemas.simulation import TrafficSimulation
from tests.analysis.noisy_tracks import GSD_M, Noise, analyse, flight, true_tracks
from tests.analysis.statements import Interval, Truth, queue_pairs
from tests.benchmarks.analysis import signal_onsets_s, trajectories
from tests.benchmarks.observed_tracks import observed_tracks
from velfield.analysis.flow.passings import LaneTraffic
from velfield.analysis.flow.speeds import speed_profile
from velfield.analysis.flow.volume import lane_flow
from velfield.analysis.intervals import Estimate, estimate_event_rate
from velfield.analysis.lanes.find import project
from velfield.analysis.lanes.model import LaneGraph, LaneSamples
from velfield.analysis.movements.movements import find_movements
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.analysis.trajectories import Trajectories, make_trajectories, moving, sample_paths
from velfield.synthetic.traffic.traffic import Traffic, simulate_traffic

CLIP_S, LONG_RUN, PART_S, APART_S = 300.0, 12, 600.0, 20.0
"""The long run is so many parts of other traffic, one after the other, with some time between them unseen."""
CUT = None
"""In place of errors of positions: tracks cut, hidden and false, as a tracker makes them."""
ERRORS: tuple[Noise | None, ...] = (Noise(), Noise(0.2), Noise(0.5), Noise(0.05, 0.3), CUT)
BESIDE_M, ALONG_RAD = 1.75, np.radians(35)
"""A vehicle drives on a lane within this of its centre line and of its direction."""


@dataclass(frozen=True)
class LongRun:
    """Hours of true tracks over one plan."""

    trajectories: Trajectories

    @cached_property
    def analysis(self) -> TrafficAnalysis:
        """Its own analysis."""
        return TrafficAnalysis(self.trajectories)

    def on(self, graph: LaneGraph) -> LaneTraffic:
        """Its traffic on the lanes of a clip."""
        samples = sample_paths(self.trajectories)
        owner = np.repeat(np.arange(len(graph)), [len(lane.xy_m) for lane in graph])
        points = np.concatenate([lane.xy_m for lane in graph])
        direction = np.concatenate([lane.direction_rad for lane in graph])
        found = cKDTree(points).query(samples.xy_m, k=8, distance_upper_bound=3.0)
        distance, k = np.asarray(found[0]), np.minimum(found[1], len(points) - 1)
        turn = np.abs(np.angle(np.exp(1j * (direction[k] - samples.direction_rad[:, None]))))
        best = np.argmin(np.where(turn < ALONG_RAD, distance, np.inf), axis=1)
        rows = np.arange(len(samples))
        near = np.isfinite(distance[rows, best]) & (turn[rows, best] < ALONG_RAD)
        lane = np.where(near, owner[k[rows, best]], -1)
        along, offset = np.zeros(len(samples)), np.full(len(samples), np.inf)
        for one in graph:
            own = np.flatnonzero(lane == one.number)
            along[own], offset[own] = project(samples.xy_m[own], one.xy_m)
        use = (lane >= 0) & (np.abs(offset) < BESIDE_M)
        columns = samples.track, lane, along, offset, samples.time_s, samples.speed_m_per_s
        return LaneTraffic(replace(graph, samples=LaneSamples(*(c[use] for c in columns))))


@dataclass(frozen=True)
class Clip:
    """A clip: its analysis, and what is true of it."""

    name: str
    truth: Truth
    analysis: TrafficAnalysis
    long_run: LongRun

    def intervals(self) -> Iterator[Interval]:
        """Intervals, each with the value that it should hold."""
        yield from self._movements()
        yield from self._lanes()
        yield from self._signals()
        true, found = (
            estimate_event_rate(len(a.reversals), a.reversals_seen_s / 3600)
            for a in (self.long_run.analysis, self.analysis)
        )
        yield Interval("U-turns an hour", true.value, found)
        for road in self.analysis.free_flow:
            if road.speed_m_per_s:
                at = np.concatenate([self.analysis.lanes.lanes[k].xy_m for k in road.lanes])
                yield Interval("free flow", self.truth.free_speed_m_per_s(at), road.speed_m_per_s)

    def _movements(self) -> Iterator[Interval]:
        long = self.long_run
        truth = find_movements(long.trajectories, self.analysis.lanes, cut_tracks=long.analysis.cut_tracks)
        for found, real in zip(self.analysis.movements, truth, strict=True):
            known = {(m.arm_in, m.arm_out): m for m in real.movements}
            for m in found.movements:
                other = known.get((m.arm_in, m.arm_out))
                if other is None or other.seen < 30:
                    continue
                for kind, name in (
                    ("movement: share", "share"), ("movement: flow", "flow_veh_per_h"),
                    ("movement: travel time", "travel_time_s"), ("movement: delay", "delay_s"),
                ):  # fmt: skip
                    yield from _pair(kind, getattr(m, name), getattr(other, name))
            for arm, delay in found.delays_s.items():
                yield from _pair("approach: delay", delay, real.delays_s.get(arm))

    def _lanes(self) -> Iterator[Interval]:
        analysis, long = self.analysis, self.long_run.on(self.analysis.lanes)
        hours = self.long_run.trajectories.observed_s
        for lane in analysis.lanes:
            if lane.length_m < 20:
                continue
            found, real = analysis.flows[lane.number], lane_flow(long, lane.number, hours)
            for kind, name in (
                ("lane: flow", "flow_veh_per_h"), ("lane: density", "density_veh_per_km"),
                ("lane: space-mean speed", "space_mean_speed_m_per_s"), ("lane: headway", "headway_s"),
                ("lane: gap", "gap_s"),
            ):  # fmt: skip
                yield from _pair(kind, getattr(found, name), getattr(real, name))
            stations = zip(analysis.profile(lane.number), speed_profile(long, lane.number), strict=True)
            for k, (a, b) in enumerate(stations):
                if k % 3 == 1:
                    for name in ("p15", "p50", "p85"):
                        yield from _pair(f"station: {name}", getattr(a, name), getattr(b, name))

    def _signals(self) -> Iterator[Interval]:
        cycle_s = self.truth.flight.config.traffic.cycle_s
        for signal in self.analysis.signals.values():
            if not signal.signalised or signal.cycle_s is None:
                continue
            yield Interval("signal: cycle", cycle_s, signal.cycle_s)
            for stream in signal.streams:
                for kind, found, onset in zip(
                    ("signal: green", "signal: red"), (stream.green_phase_s, stream.red_phase_s),
                    signal_onsets_s(self.truth.flight, stream.stream), strict=True,
                ):  # fmt: skip
                    if found:
                        off = (onset - found.value + cycle_s / 2) % cycle_s - cycle_s / 2
                        yield Interval(kind, found.value + off, found)
            for estimate, n in queue_pairs(signal, self.truth):
                yield Interval("queue", n, estimate)


def _pair(kind: str, found: Estimate | None, real: Estimate | None) -> Iterator[Interval]:
    if found is not None and real is not None:
        yield Interval(kind, real.value, found)


def make_clips(seed: int, clips: int, *, long_run: int = LONG_RUN) -> Iterator[Clip]:
    """Clips over one plan."""
    rng = np.random.default_rng(seed)
    config = TrafficSimulation(cycle_s=float(rng.uniform(40, 75)), flow_veh_per_h=float(rng.choice([200, 400, 600])))
    made = flight(seed, CLIP_S, config)
    city = made.city

    def drive(number: int, seconds: float) -> Traffic:
        own = np.random.default_rng([seed, number])
        return simulate_traffic(city.plan.road_network, config, duration_s=seconds + 1.0, rng=own)

    parts, step_s = [], float(np.median(np.diff(made.times_s)))
    times = np.arange(0.0, PART_S, step_s)
    for k in range(long_run):
        part, later_s = true_tracks(made, drive(1000 + k, PART_S), times), k * (PART_S + APART_S)
        parts.append((part.owner, part.frame + round(later_s / step_s), part.time_s + later_s, part.xy_m))
    long = LongRun(_join(parts))
    for k in range(clips):
        traffic, errors = drive(k, CLIP_S), ERRORS[k % len(ERRORS)]
        tracks = true_tracks(made, traffic)
        truth = Truth(made, True, tracks, analyse(tracks, Noise(), lengths_m=traffic.dimensions.length_m))
        if errors is CUT:
            own = np.random.default_rng([seed, k])
            table = observed_tracks(traffic, made.times_s, city.to_px, shape=made.base_shape, gsd_m=GSD_M, rng=own)
            analysis = TrafficAnalysis(trajectories(table, "track_id"))
        else:
            analysis = analyse(tracks, errors, seed=seed + k)
        yield Clip(f"{seed}/{k} {errors or 'cut'}", truth, analysis, long)


def _join(parts: list[tuple[IntArray, IntArray, FloatArray, FloatArray]]) -> Trajectories:
    """One long run of true tracks: tracks, frames, times and positions of each of its parts."""
    first = np.cumsum([0, *(owner.max() + 1 for owner, *_ in parts)])
    owner = np.concatenate([part[0] + begin for part, begin in zip(parts, first, strict=False)])
    frame, time_s, xy_m = (np.concatenate([part[k] for part in parts]) for k in (1, 2, 3))
    gaps = np.array([[a[2].max(), b[2].min()] for a, b in pairwise(parts)])
    made = make_trajectories(owner, frame, time_s, xy_m, gsd_m=GSD_M)
    return replace(moving(made), gaps_s=gaps)


def lines(covered: dict[str, list[Interval]]) -> Iterator[str]:
    """The table, for people."""
    yield f"{'quantity':28} {'n':>6} {'holds':>6} {'below':>6} {'above':>6} {'half width':>10}"
    for kind, found in [*sorted(covered.items()), ("pooled", [i for of in covered.values() for i in of])]:
        low, high, value, truth = np.array(
            [(i.estimate.low, i.estimate.high, i.estimate.value, i.truth) for i in found]
        ).T
        half = np.median((high - low) / 2 / np.maximum(np.abs(value), 1e-9))
        below, above = (truth < low).mean(), (truth > high).mean()
        yield f"{kind:28} {len(found):6d} {1 - below - above:6.3f} {below:6.3f} {above:6.3f} {half:10.3f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=[5000, 5004], help="first, and the one after the last")
    parser.add_argument("--clips", type=int, default=10, help="clips over the roads of each seed")
    arguments = parser.parse_args()
    covered: defaultdict[str, list[Interval]] = defaultdict(list)
    for seed in range(*arguments.seeds):
        for clip in make_clips(seed, arguments.clips):
            for interval in clip.intervals():
                covered[interval.kind].append(interval)
            print(clip.name, flush=True)
    for line in lines(covered):
        print(line)


if __name__ == "__main__":
    main()
