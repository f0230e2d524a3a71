"""What `velfield analyse --tracks` says of tracks with errors: ``python -m tests.benchmarks.noise``.

True tracks of simulated flights with white and lasting errors, in whole and in short clips: lanes against those of the
tracks without errors, U-turns against the vehicles that turned, signals that are found, withheld, denied or wrong.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from tests.analysis.noisy_tracks import CYCLE_S, GSD_M, Noise, TrueTracks, analyse, clip, driven, flight, true_numbers
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.synthetic.flight import Flight

NOISES = {
    "none": Noise(),
    "white .2 m": Noise(0.2),
    "white .5 m": Noise(0.5),
    "white 1 m": Noise(1.0),
    "lasting .3 m, 1 s": Noise(0.05, 0.3, 1.0),
    "lasting .6 m, 1.5 s": Noise(0.05, 0.6, 1.5),
    "jumps .35 m, .5 s": Noise(0.05, 0.35, 0.5, True),
}
CLIPS_S = (20.0, 35.0, 50.0, 63.0, 90.0)


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


def score(
    analysis: TrafficAnalysis, true: TrafficAnalysis, tracks: TrueTracks, middles_m: list[np.ndarray]
) -> dict[str, float]:
    """Counts of what is said of a clip."""
    whole, begun = (true_u_turns(tracks, middles_m, seen_m=m) for m in (20.0, 0.0))
    numbers = true_numbers(analysis, tracks)
    found = {int(numbers[r.track]) for r in analysis.reversals}
    signals = analysis.signals.values()
    wrong = [s for s in signals if s.cycle_s and not s.cycle_s.low - 0.5 <= CYCLE_S <= s.cycle_s.high + 0.5]
    return {
        "lanes": len(analysis.lanes),
        "true lanes": len(true.lanes),
        "u-turns": len(whole),
        "u-turns found": len(whole & found),
        "u-turns false": len(found - begun),
        "signals": sum(s.signalised is True for s in signals),
        "signals withheld": sum(s.signalised is None for s in signals),
        "signals denied": sum(s.signalised is False for s in signals),
        "cycles wrong": len(wrong),
    }  # fmt: skip


def measure(seed: int, seconds: float, clips_s: tuple[float, ...]) -> Iterator[tuple[str, str, dict[str, float]]]:
    """Errors, length, and counts of each clip of a flight."""
    whole = driven(seed, seconds)
    middles = turn_middles_m(flight(seed, seconds))
    pieces = [("whole", whole)]
    for length in clips_s:
        begins = np.arange(0.0, seconds - length + 1e-9, max(length, 30.0))[:3]
        pieces += [(f"{length:.0f} s", clip(whole, b, b + length)) for b in begins.tolist()]
    for name, piece in pieces:
        true = analyse(piece, Noise())
        for k, (noise_name, noise) in enumerate(NOISES.items()):
            analysis = true if noise == Noise() else analyse(piece, noise, seed=seed + k)
            yield noise_name, name, score(analysis, true, piece, middles)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[913, 914, 915])
    parser.add_argument("--seconds", type=float, default=140.0)
    parser.add_argument("--whole", action="store_true", help="without short clips")
    arguments = parser.parse_args()
    rows: dict[tuple[str, str], list[dict[str, float]]] = defaultdict(list)
    for seed in arguments.seeds:
        for noise, piece, counts in measure(seed, arguments.seconds, () if arguments.whole else CLIPS_S):
            rows[noise, piece].append(counts)
            print(f"{seed} {noise:20} {piece:6} " + ", ".join(f"{k} {v:g}" for k, v in counts.items()), flush=True)
    print(f"\n{'errors':20} {'clip':6} lanes: off | u-turns true found false | signals found withheld denied wrong")
    for (noise, piece), counts in rows.items():
        total = {key: sum(c[key] for c in counts) for key in counts[0]}
        off = np.mean([abs(c["lanes"] / max(c["true lanes"], 1) - 1) for c in counts])
        print(
            f"{noise:20} {piece:6} {total['lanes']:5.0f} {100 * off:4.0f} % | {total['u-turns']:4.0f} "
            f"{total['u-turns found']:4.0f} {total['u-turns false']:4.0f} | {total['signals']:3.0f} "
            f"{total['signals withheld']:3.0f} {total['signals denied']:3.0f} {total['cycles wrong']:3.0f}"
        )


if __name__ == "__main__":
    main()
