"""Cost of the analysis by the number of tracks: ``python -m tests.benchmarks.analysis_cost --tracks 100000``.

The table of tracks is that of a simulated flight without images, one copy after the other in time, whole signal cycles
apart, each vehicle's path displaced by a few centimetres of its own.
"""

import argparse
import resource
import time

import numpy as np

from flows.launch import keep_memory
from tests.benchmarks.analysis import CYCLE_S, GSD_M, moving, simulate
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.analysis.trajectories import make_trajectories

JITTER_M = 0.05


def repeat(seed: int, minutes: float, tracks: int) -> dict[str, np.ndarray]:
    """Columns of a table of so many tracks."""
    table = simulate(seed, minutes).tracks
    rng = np.random.default_rng(seed)
    _, owner = np.unique(table["track_id"].to_numpy(np.int64), return_inverse=True)
    own, span_s = int(owner.max()) + 1, float(np.ceil((table["time_s"].max() + 1.0) / CYCLE_S) * CYCLE_S)
    frames = int(table["frame"].max()) + 1
    copies = -(-tracks // own)
    xy = table[["x_px", "y_px"]].to_numpy(np.float64) * GSD_M
    moved = table[["dx_px", "dy_px"]].to_numpy(np.float64) * GSD_M
    parts: dict[str, list[np.ndarray]] = {name: [] for name in ("track", "frame", "time_s", "xy_m", "displacement_m")}
    for k in range(copies):
        kept = owner < tracks - k * own
        parts["track"].append(owner[kept] + k * own)
        parts["frame"].append(table["frame"].to_numpy(np.int64)[kept] + k * frames)
        parts["time_s"].append(table["time_s"].to_numpy(np.float64)[kept] + k * span_s)
        parts["xy_m"].append((xy + rng.normal(0, JITTER_M, (own, 2))[owner])[kept])
        parts["displacement_m"].append(moved[kept])
    return {name: np.concatenate(values) for name, values in parts.items()}


def answer(columns: dict[str, np.ndarray]) -> TrafficAnalysis:
    """Every answer of the analysis, with its time printed."""
    begun = time.perf_counter(), time.process_time()
    made = make_trajectories(
        columns["track"], columns["frame"], columns["time_s"], columns["xy_m"],
        gsd_m=GSD_M, displacement_m=columns["displacement_m"],
    )  # fmt: skip
    analysis = TrafficAnalysis(moving(made))
    steps = {"trajectories": (time.perf_counter() - begun[0], time.process_time() - begun[1])}
    for name in ("samples", "lanes", "lane_traffic", "cut_tracks", "all other answers", "speed profiles"):
        wall, cpu = time.perf_counter(), time.process_time()
        if name == "speed profiles":
            for lane in analysis.lanes:
                analysis.profile(lane.number)
        elif name == "all other answers":
            analysis.answer_all()
            slices = analysis.counts_by_time, analysis.scene_by_time
            relations = () if analysis.scene is None else analysis.scene.relations
            print(f"{len(slices[0])} and {len(slices[1])} counts by time, {len(relations)} origins and destinations")
        else:
            getattr(analysis, name)
        steps[name] = (time.perf_counter() - wall, time.process_time() - cpu)
    for name, (wall, cpu) in steps.items():
        print(f"{name:18} wall {wall:7.2f} s  processor {cpu:7.2f} s", flush=True)
    wall, cpu = time.perf_counter() - begun[0], time.process_time() - begun[1]
    print(f"{'all':18} wall {wall:7.2f} s  processor {cpu:7.2f} s")
    return analysis


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tracks", type=int, nargs="+", default=[100_000])
    parser.add_argument("--seed", type=int, default=931)
    parser.add_argument("--minutes", type=float, default=6.0)
    arguments = parser.parse_args()
    keep_memory(large_arrays=True)  # as `velfield analyse` does
    answer(repeat(arguments.seed, arguments.minutes, 500))  # kernels are compiled at their first call
    for tracks in arguments.tracks:
        columns = repeat(arguments.seed, arguments.minutes, tracks)
        print(f"{len(np.unique(columns['track']))} tracks, {len(columns['track'])} positions")
        answer(columns)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        print(f"peak memory {peak:.1f} GiB", flush=True)


if __name__ == "__main__":
    main()
