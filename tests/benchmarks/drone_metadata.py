"""Scale, north and place of a base image by a drone's metadata, with the errors that drones make, on simulated flights.

python -m tests.benchmarks.drone_metadata [FIRST_SEED] [SEEDS]

Frames are registered exactly: these are the errors of the metadata and of what is made of it.
"""

import argparse

import numpy as np

from tests.sources.test_telemetry import simulated_poses
from velfield.sources.telemetry.placement import estimate_north, estimate_scale


def errors(seed: int) -> tuple[float, float, bool]:
    """Error of the scale, as a fraction; error of north, deg; and whether the scale's interval holds the truth."""
    config, poses = simulated_poses(seed)
    scale, north = estimate_scale(poses), estimate_north(poses)
    true_rad = np.radians(-90 - config.telemetry.north_deg)
    off_deg = float(np.degrees(np.angle(np.exp(1j * (north.direction_rad - true_rad)))))
    return scale.gsd_m / config.gsd_m - 1, off_deg, scale.low_m <= config.gsd_m <= scale.high_m


def main() -> None:
    """Print the errors over the seeds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("first", nargs="?", type=int, default=201)
    parser.add_argument("seeds", nargs="?", type=int, default=20)
    given = parser.parse_args()
    scale, north, held = np.array([errors(seed) for seed in range(given.first, given.first + given.seeds)]).T
    print(f"scale: RMS {np.sqrt(np.mean(scale**2)):.2%}, at most {np.abs(scale).max():.2%}; held by {held.mean():.0%}")
    print(f"north: RMS {np.sqrt(np.mean(north**2)):.2f} deg, at most {np.abs(north).max():.2f} deg")


if __name__ == "__main__":
    main()
