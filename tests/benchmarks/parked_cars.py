"""Stability of labelled parked cars on the map of a run: their corners, which registration does not use, are tracked.

python -m tests.benchmarks.parked_cars RUN FOLDER    FOLDER: the run's images, each with a YOLO file beside it

A car's roof, 1.4 m above the road, moves on the map of a moving camera by parallax: smoothly, depending on the car's
height and the camera's path. So two figures are printed: of the positions themselves, and after a quadratic trend in
time is removed for each corner, which leaves the error of registration. The frames of the run must be registered to its
own base image, and each of them must be one of the images.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from schemas.arrays import FloatArray
from tools.training_data import read_boxes
from velfield import open_run
from velfield.bench.still import SHARP_PX, centre_on_medians, track_corners, unused_corners
from velfield.registration.alignment import Templates
from velfield.run.run import Run

MAX_SCATTER, MAX_CORNER_DISTANCE, MIN_LABELLED = 0.3, 0.35, 0.6
"""Scatter of a parked car's labels and distance of its corners, in car lengths; fraction of the images labelled."""
DEGREE = 2


def main() -> None:
    """Find the parked cars, track their corners, print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("run", type=Path)
    parser.add_argument("folder", type=Path)
    arguments = parser.parse_args()
    run = open_run(arguments.run)
    images = sorted(path for path in arguments.folder.glob("*.png") if path.with_suffix(".txt").exists())
    parked = _parked(run, [read_boxes(image)[1] for image in images])
    corners = _corners_on(run, parked)
    maps = replace(run.frame_transforms, base_maps=())
    frames = [k for k, status in enumerate(run.registration_status) if status == "ok"]
    positions = np.stack([track_corners(run.frames.read(k), maps.transform(k), corners) for k in frames])
    residuals, sd = centre_on_medians(positions)
    _, sd_detrended = centre_on_medians(_detrend(residuals, run.times_s[frames]))
    sd_detrended *= np.sqrt(len(frames) / (len(frames) - DEGREE))  # degrees of freedom of the trend
    print(
        f"{arguments.run.name}: {len(sd)} corners of {len(parked)} parked cars in {len(frames)} frames: standard "
        f"deviation {np.median(sd):.3f} px per axis (median), {np.median(sd_detrended):.3f} px after detrending each"
    )


def _parked(run: Run, boxes: list[FloatArray]) -> FloatArray:
    """Cars labelled at the same position on the map in most images: position and length (n, 3), base px."""
    cars = [table[table[:, 0] == 0] for table in boxes]
    positions = [run.to_base(k, np.ascontiguousarray(table[:, 1:3])) for k, table in enumerate(cars)]
    parked: list[FloatArray] = []
    for xy, length in zip(np.concatenate(positions), np.concatenate([table[:, 5] for table in cars]), strict=True):
        near = [bool(len(other)) and np.hypot(*(other - xy).T).min() < MAX_SCATTER * length for other in positions]
        new = all(np.hypot(*(xy - other[:2])) > 0.5 * length for other in parked)
        if new and np.mean(near) >= MIN_LABELLED:
            parked.append(np.array([*xy, length]))
    return np.array(parked).reshape(-1, 3)


def _corners_on(run: Run, parked: FloatArray) -> Templates:
    """The sharp corners on these cars that registration does not use."""
    corners, _ = unused_corners(run)
    on_car = np.zeros(len(corners), np.bool_)
    for x, y, length in parked:
        on_car |= np.hypot(*(corners.xy - (x, y)).T) < MAX_CORNER_DISTANCE * length
    return corners.select(np.flatnonzero(on_car & (corners.sigma_px < SHARP_PX)))


def _detrend(positions: FloatArray, times_s: FloatArray) -> FloatArray:
    """Positions (frames, n, 2) minus a parabola in time for each corner and axis."""
    residuals, t = positions.copy(), times_s - times_s.mean()
    for corner in range(positions.shape[1]):
        for axis in range(2):
            valid = np.isfinite(positions[:, corner, axis])
            trend = np.polyfit(t[valid], positions[valid, corner, axis], DEGREE)
            residuals[:, corner, axis] -= np.polyval(trend, t)
    return residuals


if __name__ == "__main__":
    main()
