"""Identity of tracks under trees and in queues, on simulated flights: ``python -m tests.benchmarks.identity``.

130 frames of 960x720 at 5 frames a second, 1,400 vehicles an hour and lane, a cycle of 36 s, rows of street trees over
30 % of the kerbs. Base image and labels of one frame are given. Scores are of the vehicles that move at some time.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import numpy as np

from schemas.simulation import SceneSimulation, SimulationConfig, TrafficSimulation
from velfield.analysis.vehicle_classes import HEAVY
from velfield.run.run import open_run
from velfield.synthetic.run_score import RunScore, score_run
from velfield.synthetic.truth import load_truth
from velfield.synthetic.write import write_flight

HEAVY_M = 6.5
"""Longer than any car or van of the simulator, shorter than any lorry."""
FRAMES, WIDTH, HEIGHT, GSD_M = 130, 960, 720, 0.23


def simulate(flight: Path, seed: int) -> None:
    """Write the flight of a seed, where it is not there yet."""
    if (flight / "truth" / "camera.json").exists():
        return
    traffic = TrafficSimulation(flow_veh_per_h=1400, cycle_s=36)
    scene = SceneSimulation(street_tree_share=0.3)
    config = SimulationConfig(
        seed=seed, frames=FRAMES, width=WIDTH, height=HEIGHT, gsd_m=GSD_M, traffic=traffic, scene=scene
    )
    write_flight(flight, config)


def run(flight: Path, out: Path, settings: list[str]) -> RunScore:
    """Run the whole job, or what is new of it, and score it."""
    inputs = [f"--timestamps={flight}/timestamps.csv", f"--base={flight}/base.png", f"--labels={flight}/labels.csv"]
    command = [sys.executable, "-m", "flows.cli", "run", f"{flight}/frames", *inputs, f"--gsd-m={GSD_M}", "--quiet"]
    command += [word for setting in settings for word in ("--set", setting)]
    subprocess.run([*command, f"--out={out}"], check=True)
    return score_run(out, flight)


def line(score: RunScore) -> str:
    """The scores of the traffic's tracks."""
    t = score.traffic
    return (
        f"tracks a vehicle {t.tracks_per_vehicle:.3f}, IDF1 {t.idf1:.3f}, MOTA {t.mota:.3f}, switches {t.switches}, "
        f"tracks with two vehicles {100 * t.mixed_tracks:.2f} %, misses {t.misses} and false positions "
        f"{t.false_positives} of {t.positions}, tracklets: recall {score.tracking.recall_moving:.3f}, precision "
        f"{score.traffic_precision:.3f}"
    )


def heavy_vehicles(flight: Path, out: Path) -> str:
    """Lorries and buses among the vehicles that move: true, and by `velfield.analysis.vehicle_classes`."""
    analysis = open_run(out).analysis.traffic
    cars = load_truth(flight).cars
    seen = (
        cars[cars["visible"]]
        .groupby("vehicle_id")
        .agg(frames=("frame", "size"), moving=("moving", "any"), length_px=("length_px", "first"))
    )
    seen = seen[(seen["frames"] >= 5) & seen["moving"]]
    true = int((seen["length_px"] * GSD_M > HEAVY_M).sum())
    share = analysis.classes.estimate_shares(analysis.classes.measured)[HEAVY] if analysis.classes else None
    found = (
        "too little data"
        if share is None
        else f"{100 * share.value:.1f} % ({100 * share.low:.1f} to {100 * share.high:.1f})"
    )
    return f"lorries and buses: {true} of {len(seen)}, {100 * true / len(seen):.1f} %; found {found}"


def main() -> None:
    """Simulate, run, score."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path, help="folder for flights and runs, which are kept")
    parser.add_argument("--seeds", type=int, nargs="+", required=True)
    parser.add_argument("settings", nargs="*", help="handed to velfield run as --set")
    asked = parser.parse_args()
    scores = []
    for seed in asked.seeds:
        flight = asked.work / f"flight-{seed}"
        simulate(flight, seed)
        scores.append(run(flight, asked.work / f"run-{seed}", asked.settings))
        print(f"seed {seed}: {line(scores[-1])}", flush=True)
        print(f"  {heavy_vehicles(flight, asked.work / f'run-{seed}')}", flush=True)
    mean = [
        float(np.mean([getattr(score.traffic, name) for score in scores]))
        for name in ("tracks_per_vehicle", "idf1", "mota", "switches", "mixed_tracks")
    ]
    print("mean: tracks a vehicle {:.3f}, IDF1 {:.3f}, MOTA {:.3f}, switches {:.1f}, mixed {:.4f}".format(*mean))


if __name__ == "__main__":
    main()
