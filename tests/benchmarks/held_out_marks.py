"""Stability of a road's markings on the map of a run, registered again without half of the base image's patches.

python -m tests.benchmarks.held_out_marks RUN AREA.csv    AREA: polygon around the road, base px

`velfield bench still` tracks corners that registration does not use. Registration uses road markings, so on a road only
asphalt is left for it. Here the patches in every other cell of a chessboard are held out of the base image, every frame
is registered by the others alone, and the sharp ones held out are tracked; then the other half. The frames of the run
must be registered to its own base image.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from schemas.arrays import FloatArray, GreyImage, Mask
from velfield import open_run
from velfield.bench.still import PATCH_HALF_PX, SHARP_PX, centre_on_medians, read_area, track_corners
from velfield.registration.alignment import Templates, extract_templates
from velfield.registration.intrasensor import BaseReference, prepare_base, register_frame
from velfield.registration.keypoints import detect_keypoints
from velfield.run.frame_transforms import read_lens
from velfield.run.run import Run
from velfield.sources.images import read_grey_image

CELL_PX, MARGIN_PX = 40, 8
"""Of the chessboard; markings this near a cell's border are not tracked, because patches of the fit extend over it."""


def main() -> None:
    """Register without either half, track, print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("run", type=Path)
    parser.add_argument("area", type=Path)
    arguments = parser.parse_args()
    run, area = open_run(arguments.run), read_area(arguments.area)
    limit = run.record.config.frames.max_pixels
    grey = read_grey_image(run.layout.own_base_image, limit)
    valid = read_grey_image(run.layout.own_base_mask, limit) > 0
    config, lens = run.record.config.registration, read_lens(run.layout)
    frames = [k for k, status in enumerate(run.registration_status) if status == "ok"]
    images = [run.frames.read(k) for k in frames]
    keypoints = [detect_keypoints(image, config, None) for image in images]
    whole = prepare_base(grey, config, mask=valid, frame_shape=images[0].shape)
    on_road = cv2.fillPoly(np.zeros(grey.shape, np.uint8), [np.rint(area).astype(np.int32)], (1,)) > 0
    for phase in (0, 1):
        half = _hold_out(whole, phase)
        markings = _held_out_markings(whole.templates, grey, on_road, phase)
        positions = np.full((len(frames), len(markings), 2), np.nan)
        for row, (image, detected) in enumerate(zip(images, keypoints, strict=True)):
            result = register_frame(image, detected, half, lens, config)
            if result.transform is not None:
                positions[row] = track_corners(image, result.transform, markings)
        _print_score(run, positions, phase)


def _in_phase(xy: FloatArray, phase: int) -> Mask:
    return np.asarray((xy // CELL_PX).sum(axis=1) % 2 == phase)


def _hold_out(base: BaseReference, phase: int) -> BaseReference:
    kept = [part.select(~_in_phase(part.xy, phase)) for part in (base.templates, base.dense_templates)]
    return replace(base, templates=kept[0], dense_templates=kept[1])


def _held_out_markings(templates: Templates, grey: GreyImage, on_road: Mask, phase: int) -> Templates:
    """The sharp corners on the road that are held out, with larger patches."""
    xy = templates.xy
    at = xy.astype(np.int64)
    within = np.minimum(xy % CELL_PX, CELL_PX - xy % CELL_PX).min(axis=1) > MARGIN_PX
    margin = 2 * PATCH_HALF_PX + 1
    inside = ((at >= margin) & (at < np.array([grey.shape[1], grey.shape[0]]) - margin)).all(axis=1)
    sharp = templates.sigma_px < SHARP_PX
    markings = templates.select(within & inside & sharp & on_road[at[:, 1], at[:, 0]] & _in_phase(xy, phase))
    return extract_templates(grey, markings.xy, markings.sigma_px, PATCH_HALF_PX)


def _print_score(run: Run, positions: FloatArray, phase: int) -> None:
    residuals, sd = centre_on_medians(positions)
    print(
        f"{run.layout.root.name}, half {phase + 1}: {len(sd)} markings in {len(residuals)} frames: standard "
        f"deviation {np.median(sd):.3f} px per axis (median; 90 % below {np.percentile(sd, 90):.3f})"
    )


if __name__ == "__main__":
    main()
