"""Through traffic of simulated car parks: ``python -m tests.benchmarks.car_parks``.

Parked vehicles are the simulated ones; tracks have the errors of tracking. The truth is the same count on true paths.
"""

import argparse

import numpy as np

from tests.benchmarks.analysis import GSD_M, simulate, trajectories
from velfield.analysis.movements.car_parks import find_car_parks
from velfield.analysis.traffic_analysis import TrafficAnalysis


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[961, 962, 963])
    parser.add_argument("--minutes", type=float, default=6.0)
    arguments = parser.parse_args()
    for seed in arguments.seeds:
        case = simulate(seed, arguments.minutes)
        pose = case.flight.city.vehicles.parked_pose
        height, width = case.flight.base_shape
        pose = pose[((pose[:, :2] > 0) & (pose[:, :2] < [width, height])).all(axis=1)]
        parked, axis = pose[:, :2] * GSD_M, pose[:, 2]
        parks = []
        for table, owner in ((case.tracks, "track_id"), (case.true, "vehicle_id")):
            analysis = TrafficAnalysis(trajectories(table, owner))
            parks.append(find_car_parks(parked, axis, analysis.samples, analysis.trajectories.duration_s))
        for found, true in zip(*parks, strict=True):
            x, y = np.round(found.hull_m.mean(axis=0))
            print(
                f"seed {seed}, at {x:.0f}, {y:.0f} m, {found.parked} parked: entered {found.entered}, truly "
                f"{true.entered}; through {found.through}, truly {true.through}",
                flush=True,
            )


if __name__ == "__main__":
    main()
