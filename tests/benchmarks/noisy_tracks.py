"""What errors of positions change in the analysis of a flight: ``python -m tests.benchmarks.noisy_tracks``.

Flights of 140 s over a crossroads with a signal, analysed with true positions and with white or lasting errors: lanes
and their length as fractions of those without errors, flights whose number of lanes is within 10 % of that without
errors, U-turns seen 20 m before and after, signals denied, cycles wrong.
"""

import argparse
from collections import defaultdict

import numpy as np

from schemas.simulation import TrafficSimulation
from tests.analysis.noisy_tracks import Noise, analyse, flight, true_numbers, true_tracks
from tests.benchmarks.short_clips import FLIGHT_S, NOISES, true_u_turns, turn_middles_m
from velfield.analysis.traffic_analysis import TrafficAnalysis

SLACK_S = 0.5
"""Beyond its interval a cycle is wrong by more than this."""


def rows(seed: int) -> list[tuple[Noise, list[float]]]:
    """By kind of errors: number and length of lanes, U-turns in truth, found and false, signals denied, cycles wrong
    and found."""
    rng = np.random.default_rng(seed)
    traffic = TrafficSimulation(cycle_s=float(rng.uniform(24, 60)), flow_veh_per_h=float(rng.choice([400, 700])))
    made = flight(seed, FLIGHT_S, traffic, True)
    tracks, middles = true_tracks(made), turn_middles_m(made)
    whole, begun = (true_u_turns(tracks, middles, seen_m=seen_m) for seen_m in (20.0, 0.0))
    out = []
    for noise in NOISES:
        analysis = analyse(tracks, noise, seed=seed)
        turned = [turn.track for turn in analysis.reversals if not turn.round_circle]
        found = true_numbers(analysis, tracks)[turned].tolist()
        turns = [len(whole), len(whole & set(found)), sum(k not in begun for k in found)]
        out.append((noise, [*_lanes(analysis), *turns, *_signals(analysis, traffic.cycle_s)]))
    return out


def _lanes(analysis: TrafficAnalysis) -> tuple[float, float]:
    return len(analysis.lanes), sum(lane.length_m for lane in analysis.lanes)


def _signals(analysis: TrafficAnalysis, cycle_s: float) -> tuple[int, int, int]:
    cycles = [signal.cycle_s for signal in analysis.signals.values() if signal.cycle_s]
    wrong = sum(not cycle.low - SLACK_S <= cycle_s <= cycle.high + SLACK_S for cycle in cycles)
    return sum(signal.signalised is False for signal in analysis.signals.values()), wrong, len(cycles)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=[8200, 8206], help="first, and the one after the last")
    table: defaultdict[Noise, list[list[float]]] = defaultdict(list)
    for seed in range(*parser.parse_args().seeds):
        found = rows(seed)
        for noise, values in found:
            table[noise].append([values[0] / found[0][1][0], values[1] / found[0][1][1], *values[2:]])
    print("lanes: number, length (least to largest), flights within 10 % in number;")
    print("U-turns: found of true, false; signals: denied, wrong of found")
    for noise, values in table.items():
        low, high, total = (of(values, axis=0) for of in (np.min, np.max, np.sum))
        spread = ", ".join(f"{low[k]:.2f} to {high[k]:.2f}" for k in range(2))
        within = sum(abs(row[0] - 1) <= 0.1 for row in values)
        turns = f"{total[3]:.0f} of {total[2]:.0f}, {total[4]:.0f}"
        signals = f"{total[5]:.0f}, {total[6]:.0f} of {total[7]:.0f}"
        print(f"{spread}, {within} of {len(values)}; {turns}; {signals}  {noise}")


if __name__ == "__main__":
    main()
