"""Scale and north of simulated drones by MISB KLV, against their subtitles: the same flights and errors of sensors.

python -m tests.benchmarks.klv [FIRST_SEED] [SEEDS]

The frames are on the base image exactly; the KLV is encoded from what the subtitles say, with the true angle of view in
place of a focal length in whole millimetres.
"""

import argparse

import numpy as np

from schemas.simulation import SimulationConfig
from tests.misb import encode_telemetry
from tests.sources.test_klv import true_hfov_deg
from tests.sources.test_telemetry import simulated_poses
from velfield.sources.telemetry.klv import parse_klv
from velfield.sources.telemetry.placement import FramePoses, estimate_north, estimate_scale


def errors(config: SimulationConfig, poses: FramePoses) -> tuple[float, float, bool]:
    """Error of the scale, %; error of north, degrees; and whether the scale's interval holds the truth."""
    scale, north = estimate_scale(poses), estimate_north(poses)
    turned = north.direction_rad - np.radians(-90 - config.telemetry.north_deg)
    return (
        100 * (scale.gsd_m / config.gsd_m - 1),
        float(np.degrees(np.angle(np.exp(1j * turned)))),
        scale.low_m < config.gsd_m < scale.high_m,
    )


def main() -> None:
    """Print a line for each source."""
    parser = argparse.ArgumentParser()
    parser.add_argument("first", type=int, nargs="?", default=401)
    parser.add_argument("seeds", type=int, nargs="?", default=20)
    given = parser.parse_args()
    found: dict[str, list[tuple[float, float, bool]]] = {"subtitles": [], "KLV": []}
    for seed in range(given.first, given.first + given.seeds):
        config, poses = simulated_poses(seed)
        read = parse_klv(b"".join(encode_telemetry(poses.telemetry, true_hfov_deg(seed))), "x.klv")
        at = read.at(poses.telemetry.time_s)
        by_klv = FramePoses(at, poses.width, poses.height, poses.centre_xy, poses.jacobian)
        found["subtitles"].append(errors(config, poses))
        found["KLV"].append(errors(config, by_klv))
    for name, rows in found.items():
        scale, north, held = (np.array(column, float) for column in zip(*rows, strict=True))
        print(
            f"{name}: scale RMS {np.sqrt(np.mean(scale**2)):.2f} %, at most {np.abs(scale).max():.2f} %; north RMS "
            f"{np.sqrt(np.mean(north**2)):.2f}°, at most {np.abs(north).max():.2f}°; "
            f"interval held {held.sum():.0f} of {len(rows)}"
        )


if __name__ == "__main__":
    main()
