"""What the analysis says of short, sparse and noisy clips: ``python -m tests.benchmarks.short_clips``.

Flights with a signal of 24 to 75 s, or with none, cut to 20 to 90 s; vehicles and frames are left out, positions have
white or lasting errors. Every statement is held against the simulation: `tests.analysis.statements`.
"""

import argparse
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from schemas.simulation import TrafficSimulation
from tests.analysis.noisy_tracks import GSD_M, Noise, TrueTracks, analyse, clip, flight, true_tracks
from tests.analysis.statements import Interval, Statement, Truth, conflicts_found, intervals, statements, u_turns_found
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.analysis.vehicle_classes import find_classes
from velfield.synthetic.flight import Flight

FLIGHT_S, CLIPS = 140.0, 4
NOISES = (*map(Noise, (0.0, 0.2, 0.5, 1.0)), Noise(0.05, 0.3), Noise(0.05, 0.6, 1.5), Noise(0.05, 0.35, 0.5, True))


@dataclass(frozen=True)
class Case:
    """A clip: its analysis and the truth of it."""

    name: str
    analysis: TrafficAnalysis
    truth: Truth
    u_turns: tuple[set[int], set[int]]

    def statements(self) -> list[Statement]:
        """What is said of it."""
        return list(statements(self.analysis, self.truth, self.u_turns))

    def intervals(self) -> list[Interval]:
        """Intervals of known values."""
        return list(intervals(self.analysis, self.truth))


def make_cases(seed: int, *, clips: int = CLIPS) -> Iterator[Case]:
    """Clips of one flight."""
    rng = np.random.default_rng(seed)
    signals = bool(rng.uniform() < 0.7)
    traffic = TrafficSimulation(
        cycle_s=float(rng.uniform(24, 75)),
        flow_veh_per_h=float(rng.choice([150, 400, 700, 1000])),
        speed_mean_km_per_h=float(rng.choice([40, 50, 60])),
        large_share=float(rng.choice([0.0, 0.05, 0.2])),
    )
    made = flight(seed, FLIGHT_S, traffic, signals)
    whole, middles = true_tracks(made), turn_middles_m(made)
    scene = analyse(whole, Noise(), lengths_m=made.city.traffic.dimensions.length_m)
    parked = made.city.vehicles.parked_pose
    parked = parked[((parked[:, :2] > 0) & (parked[:, :2] < made.base_shape[::-1])).all(axis=1)] * [GSD_M, GSD_M, 1]
    for k in range(clips):
        seconds, keep, every = rng.uniform(20, 90), rng.choice([1.0, 1.0, 0.6]), rng.choice([1, 1, 2])
        begin = rng.uniform(0, FLIGHT_S - seconds)
        noise = NOISES[rng.integers(len(NOISES))]
        every_track = clip(whole, begin, begin + seconds)
        piece = _sparse(every_track, keep, every, rng)
        left_out = np.setdiff1d(every_track.vehicle, piece.vehicle)
        lengths, classes = made.city.traffic.dimensions.length_m, None
        if rng.uniform() < 0.5:
            sd = float(rng.choice([0.04, 0.1]))
            size = np.column_stack([lengths, made.city.traffic.dimensions.width_m])
            size *= 1 + rng.normal(0, sd, size.shape)
            lengths, classes = size[:, 0], find_classes(size[piece.vehicle], sd * size[piece.vehicle])
        else:
            lengths = np.full(len(lengths), np.nan)
        analysis = analyse(piece, noise, seed=seed + k, lengths_m=lengths, parked=parked, classes=classes)
        turns = tuple(true_u_turns(piece, middles, seen_m=m) for m in (20.0, 0.0))
        name = f"{seed}/{k} {seconds:.0f} s {'signal' if signals else 'no signal'} {keep:g} 1/{every} {noise}"
        seen = scene
        if len(left_out):
            others = ~np.isin(whole.vehicle, left_out)
            seen = analyse(whole.select(others[whole.owner]), Noise(), lengths_m=made.city.traffic.dimensions.length_m)
        yield Case(name, analysis, Truth(made, signals, piece, seen), (turns[0], turns[1]))


def turn_middles_m(made: Flight) -> list[np.ndarray]:
    """(2,) middles of the turns on which vehicles reverse from one carriageway of a road to the other."""
    city = made.city
    net = city.plan.road_network
    into, out = net.in_edges(), net.out_edges()
    middles = []
    for edge in net.edges:
        first, last = np.diff(edge.path[:2], axis=0)[0], np.diff(edge.path[-2:], axis=0)[0]
        turn = abs(float(np.angle(np.exp(1j * (np.arctan2(*last[::-1]) - np.arctan2(*first[::-1]))))))
        in_car_park = any(net.edges[k].kind == "aisle" for k in into[edge.start] + out[edge.end])
        if edge.kind == "turn" and turn >= 2.6 and not in_car_park:
            middles.append(city.to_px(edge.path[len(edge.path) // 2][None])[0] * GSD_M)
    return middles


def true_u_turns(tracks: TrueTracks, middles_m: list[np.ndarray], *, seen_m: float) -> set[int]:
    """Numbers of the tracks that reverse, seen so far before and after the middle of the turn."""
    out = set()
    for k, (a, b) in enumerate(zip(tracks.first[:-1], tracks.first[1:], strict=True)):
        own = tracks.xy_m[a:b]
        along = np.r_[0.0, np.hypot(*np.diff(own, axis=0).T).cumsum()]
        for middle in middles_m:
            distance = np.hypot(*(own - middle).T)
            at = along[np.argmin(distance)]
            if distance.min() < 2.5 and min(at, along[-1] - at) >= seen_m:
                out.add(k)
    return out


def _sparse(tracks: TrueTracks, keep: float, every: int, rng: np.random.Generator) -> TrueTracks:
    """A part of the vehicles, and of the frames."""
    kept = rng.uniform(size=len(tracks.vehicle)) < keep
    return tracks.select(kept[tracks.owner] & (tracks.frame % every == 0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=[3000, 3050], help="first, and the one after the last")
    parser.add_argument("--kinds", nargs="*", help="print the false statements of these kinds alone")
    arguments = parser.parse_args()
    said: Counter[str] = Counter()
    false: Counter[str] = Counter()
    withheld: Counter[str] = Counter()
    doubtless, turns = np.zeros((2, 2), np.int64)
    covered: defaultdict[str, list[bool]] = defaultdict(list)
    for seed in range(*arguments.seeds):
        for case in make_cases(seed):
            for s in case.statements():
                said[s.kind] += not s.withheld
                withheld[s.kind] += s.withheld
                false[s.kind] += not s.true
                if not s.true and (not arguments.kinds or s.kind in arguments.kinds):
                    print(f"{case.name}: {s.kind}: {s.text}", flush=True)
            doubtless += conflicts_found(case.analysis, case.truth)
            turns += u_turns_found(case.analysis, case.truth, case.u_turns[0])
            for i in case.intervals():
                covered[i.kind].append(i.estimate.low <= i.truth <= i.estimate.high)
    print(f"\nconflicts beyond doubt: {doubtless[0]}, found {doubtless[1]}")
    print(f"U-turns seen 20 m before and after: {turns[0]}, found {turns[1]}")
    print(f"\n{'kind':24} {'said':>6} {'false':>6} {'withheld':>8}")
    for kind in sorted(said | withheld):
        print(f"{kind:24} {said[kind]:6d} {false[kind]:6d} {withheld[kind]:8d}")
    for kind, hits in covered.items():
        print(f"90 % intervals, {kind:12} {np.mean(hits):.3f} of {len(hits)}")


if __name__ == "__main__":
    main()
