"""How still marked parked cars lie on the map of a run: their corners, which registration does not use, followed.

python -m tests.benchmarks.parked_cars RUN FOLDER    FOLDER: the run's pictures, each with a YOLO file beside it

A camera that flies by sees a roof, 1.4 m above the road, move on the map, as it must: steadily, by as much as the car's
height and the camera's path say. So two figures are told: of the place as it is, and about a path of its own for each
corner, a parabola in time, which is what registration leaves. The run must be one whose frames are registered to its
own base image, and each of its frames one of the pictures.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from tools.shipped_detector import read_boxes
from velfield import open_run
from velfield.bench.still import SHARP_PX, about_their_middles, places_on_map, unused_corners
from velfield.registration.alignment import Templates
from velfield.run.run import Run

STANDS_WITHIN, ITS_OWN, SEEN = 0.3, 0.35, 0.6
"""Car lengths that a parked car's mark strays by; that a corner of it lies from its middle; share of pictures."""
DEGREE = 2


def main() -> None:
    """Find what stands, follow it, print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("run", type=Path)
    parser.add_argument("folder", type=Path)
    asked = parser.parse_args()
    run = open_run(asked.run)
    pictures = sorted(path for path in asked.folder.glob("*.png") if path.with_suffix(".txt").exists())
    parked = _parked(run, [read_boxes(picture)[1] for picture in pictures])
    corners = _corners_on(run, parked)
    maps = replace(run.maps, onward=())
    frames = [k for k, status in enumerate(run.registration_status) if status == "ok"]
    places = np.stack([places_on_map(run.frames.read(k), maps.transform(k), corners) for k in frames])
    rest, sd = about_their_middles(places)
    _, sd_about_path = about_their_middles(_less_own_path(rest, run.times_s[frames]))
    sd_about_path *= np.sqrt(len(frames) / (len(frames) - DEGREE))  # the path's parameters, less the one of the middle
    print(
        f"{asked.run.name}: {len(sd)} corners of {len(parked)} parked cars in {len(frames)} frames: standard deviation "
        f"{np.median(sd):.3f} px an axis (median), about a path of its own for each {np.median(sd_about_path):.3f} px"
    )


def _parked(run: Run, boxes: list[NDArray[np.float64]]) -> FloatArray:
    """Of the cars marked in the same place on the map in most pictures, that place and the length: (n, 3) base px."""
    cars = [table[table[:, 0] == 0] for table in boxes]
    places = [run.to_base(k, np.ascontiguousarray(table[:, 1:3])) for k, table in enumerate(cars)]
    found: list[FloatArray] = []
    for xy, length in zip(np.concatenate(places), np.concatenate([table[:, 5] for table in cars]), strict=True):
        near = [bool(len(other)) and np.hypot(*(other - xy).T).min() < STANDS_WITHIN * length for other in places]
        new = all(np.hypot(*(xy - other[:2])) > 0.5 * length for other in found)
        if new and np.mean(near) >= SEEN:
            found.append(np.array([*xy, length]))
    return np.array(found).reshape(-1, 3)


def _corners_on(run: Run, parked: FloatArray) -> Templates:
    """The sharp corners on these cars that registration does not use."""
    found, _ = unused_corners(run)
    on_car = np.zeros(len(found), np.bool_)
    for x, y, length in parked:
        on_car |= np.hypot(*(found.xy - (x, y)).T) < ITS_OWN * length
    return found.select(np.flatnonzero(on_car & (found.sigma_px < SHARP_PX)))


def _less_own_path(places: FloatArray, times_s: FloatArray) -> FloatArray:
    """Places (frames, n, 2) less the parabola in time of each corner and axis."""
    rest, at = places.copy(), times_s - times_s.mean()
    for corner in range(places.shape[1]):
        for axis in range(2):
            seen = np.isfinite(places[:, corner, axis])
            rest[:, corner, axis] -= np.polyval(np.polyfit(at[seen], places[seen, corner, axis], DEGREE), at)
    return rest


if __name__ == "__main__":
    main()
