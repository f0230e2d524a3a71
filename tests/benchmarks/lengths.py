"""Effect of measured vehicle lengths on gaps and post-encroachment times: ``python -m tests.benchmarks.lengths``.

Simulated flights without images; lengths are the true ones with an error of 0.3 m (standard deviation), as of tracks.
"""

import argparse
from collections import defaultdict
from dataclasses import replace

import numpy as np

from tests.benchmarks.analysis import Case, simulate, trajectories
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.analysis.trajectories import Trajectories

LENGTH_SD_M = 0.3


def errors(case: Case, seed: int) -> dict[str, list[float]]:
    """Absolute errors by quantity, without lengths and with them."""
    rng, out = np.random.default_rng(seed), defaultdict(list)
    owner = case.tracks.drop_duplicates("track_id").set_index("track_id")["vehicle_id"]
    found = trajectories(case.tracks, "track_id")
    vehicle = owner.reindex(found.track_id).to_numpy(np.int64)
    measured = np.where(vehicle >= 0, case.lengths_m[vehicle], np.nan) + rng.normal(0, LENGTH_SD_M, len(vehicle))
    true = trajectories(case.true, "vehicle_id")
    truth = pairs(replace(true, measured_length_m=case.lengths_m[true.track_id]), true.track_id)
    for name, tracks in (("cars'", found), ("measured", replace(found, measured_length_m=measured))):
        for pair, (kind, value) in pairs(tracks, vehicle).items():
            if pair in truth:
                out[f"{kind}, {name} lengths"].append(abs(value - truth[pair][1]))
    return out


def pairs(tracks: Trajectories, ids: np.ndarray) -> dict[tuple[str, int, int], tuple[str, float]]:
    """Values of conflicts by their kind and vehicles."""
    conflicts = TrafficAnalysis(tracks).conflicts
    return {(c.kind, int(ids[c.first]), int(ids[c.second])): (c.kind, c.value_s) for c in conflicts}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[961, 962])
    parser.add_argument("--minutes", type=float, default=6.0)
    arguments = parser.parse_args()
    total: dict[str, list[float]] = defaultdict(list)
    for seed in arguments.seeds:
        for name, values in errors(simulate(seed, arguments.minutes), seed).items():
            total[name] += values
    for name, values in sorted(total.items()):
        print(f"{name}: n {len(values)}, median {np.median(values):.3f} s, p90 {np.quantile(values, 0.9):.3f} s")


if __name__ == "__main__":
    main()
