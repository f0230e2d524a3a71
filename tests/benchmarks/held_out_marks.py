"""How still a road's marks lie on the map of a run: registered anew without half of the base image's patches.

python -m tests.benchmarks.held_out_marks RUN AREA.csv    AREA: corners around the road, base px

`velfield bench still` follows corners that registration does not use, and registration uses a road's marks: what is
left there is asphalt. Here the patches in every other cell of a chessboard are left out of the base image, every frame
is registered by the others alone, and the sharp ones left out are followed; then the other half. The run must be one
whose frames are registered to its own base image.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from velfield import open_run
from velfield.bench.still import PATCH_HALF_PX, SHARP_PX, about_their_middles, places_on_map, read_area
from velfield.registration.alignment import Templates, extract_templates
from velfield.registration.intrasensor import BaseReference, prepare_base, register_frame
from velfield.registration.keypoints import detect_keypoints
from velfield.run.frame_transforms import read_lens
from velfield.run.run import Run
from velfield.sources.images import read_grey_image

CELL_PX, MARGIN_PX = 40, 8
"""Of the chessboard; marks so near to a cell's border are not followed: patches of the fit reach over it."""


def main() -> None:
    """Register both halves, follow, print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("run", type=Path)
    parser.add_argument("area", type=Path)
    asked = parser.parse_args()
    run, area = open_run(asked.run), read_area(asked.area)
    limit = run.record.config.frames.max_pixels
    grey = read_grey_image(run.layout.own_base_image, limit)
    known = read_grey_image(run.layout.own_base_mask, limit) > 0
    config, lens = run.record.config.registration, read_lens(run.layout)
    frames = [k for k, status in enumerate(run.registration_status) if status == "ok"]
    pictures = [run.frames.read(k) for k in frames]
    keypoints = [detect_keypoints(picture, config, None) for picture in pictures]
    whole = prepare_base(grey, config, mask=known, frame_shape=pictures[0].shape)
    on_road = cv2.fillPoly(np.zeros(grey.shape, np.uint8), [np.rint(area).astype(np.int32)], (1,)) > 0
    for phase in (0, 1):
        half = _without(whole, phase)
        marks = _marks(whole.templates, grey, on_road, phase)
        places = np.full((len(frames), len(marks), 2), np.nan)
        for row, (picture, found) in enumerate(zip(pictures, keypoints, strict=True)):
            result = register_frame(picture, found, half, lens, config)
            if result.transform is not None:
                places[row] = places_on_map(picture, result.transform, marks)
        _tell(run, places, phase)


def _cell_is(xy: FloatArray, phase: int) -> NDArray[np.bool_]:
    return np.asarray((xy // CELL_PX).sum(axis=1) % 2 == phase)


def _without(base: BaseReference, phase: int) -> BaseReference:
    kept = [part.select(~_cell_is(part.xy, phase)) for part in (base.templates, base.dense_templates)]
    return replace(base, templates=kept[0], dense_templates=kept[1])


def _marks(templates: Templates, grey: NDArray[np.uint8], on_road: NDArray[np.bool_], phase: int) -> Templates:
    """The sharp corners on the road that are left out, with larger patches."""
    xy = templates.xy
    at = xy.astype(np.int64)
    within = np.minimum(xy % CELL_PX, CELL_PX - xy % CELL_PX).min(axis=1) > MARGIN_PX
    reach = 2 * PATCH_HALF_PX + 1
    inside = ((at >= reach) & (at < np.array([grey.shape[1], grey.shape[0]]) - reach)).all(axis=1)
    sharp = templates.sigma_px < SHARP_PX
    marks = templates.select(within & inside & sharp & on_road[at[:, 1], at[:, 0]] & _cell_is(xy, phase))
    return extract_templates(grey, marks.xy, marks.sigma_px, PATCH_HALF_PX)


def _tell(run: Run, places: FloatArray, phase: int) -> None:
    rest, sd = about_their_middles(places)
    print(
        f"{run.layout.root.name}, half {phase + 1}: {len(sd)} marks in {len(rest)} frames: standard "
        f"deviation {np.median(sd):.3f} px an axis (median; 90 % below {np.percentile(sd, 90):.3f})"
    )


if __name__ == "__main__":
    main()
