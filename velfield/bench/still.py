"""How still things that stand lie on the map of a run: the jitter of registration, measured without any truth.

Corners of the base image that registration itself does not use (those at least half of its patches away from its own)
are found in every registered frame below the pixel, and carried to the map by the frame's transform. What is left of
their motion is what a standing car would seem to do: registration's residual, and the alignment's own noise. For the
latter's sake only sharp corners are followed, and by patches larger than registration's: by those, compressed pictures
alone moved a road's marks by .15 px. What is higher than the ground moves on the map of a camera that flies by, as it
must: an area tells where the ground is.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from velfield.errors import InputError
from velfield.registration.alignment import (
    N_PATCHES_CROSS_SENSOR,
    N_PATCHES_SAME_SENSOR,
    Templates,
    align_patches,
    make_templates,
    smooth_levels,
)
from velfield.registration.transforms import FrameTransform
from velfield.run.run import Run
from velfield.sources.images import read_grey_image
from velfield.sources.table import finite_cell, read_csv_rows

_MAX_SHIFT_PX = 3.0
_MIN_SHARE = 0.5
PATCH_HALF_PX = 12
SHARP_PX, _AT_LEAST = 0.1, 30
"""Corners that noise would move by more are not followed; but so many at least are."""
_MAD_TO_SD = 1.4826


@dataclass(frozen=True)
class StillScore:
    """What stands, on the map.

    Attributes
    ----------
    points, frames : corners followed in at least half of the registered frames; the frames.
    sd_median_px, sd_p90_px : robust standard deviation of a corner's place an axis, its median and 90th percentile over
        the corners, base px.
    drift_px : how far the corners' mean place moved from the first to the last tenth of the frames, base px.
    noise_px : what noise of three grey levels alone would move the usual corner an axis; clean pictures have less.
    """

    points: int
    frames: int
    noise_px: float
    sd_median_px: float
    sd_p90_px: float
    drift_px: float

    def text(self) -> str:
        """One line."""
        return (
            f"{self.points} still corners in {self.frames} frames: standard deviation {self.sd_median_px:.3f} px "
            f"an axis (median; 90 % below {self.sd_p90_px:.3f}; noise of 3 grey levels, as in "
            f"compressed pictures, would move one by {self.noise_px:.3f}), "
            f"drift from first to last tenth {self.drift_px:.3f} px"
        )


def read_area(path: Path) -> FloatArray:
    """Corners (n, 2) in order around an area, base px: a CSV ``x_px,y_px``.

    Raises
    ------
    InputError
        No such file, a cell that is no number, fewer than three corners.
    """
    rows = read_csv_rows(path, required=("x_px", "y_px"), what="an area")
    corners = np.array([[finite_cell(path, line, row, name) for name in ("x_px", "y_px")] for line, row in rows])
    if len(corners) < 3 or not np.isfinite(corners).all():
        raise InputError(
            f"{path.name}: found {len(corners)} corners, expected 3 or more, each with x_px and y_px; add those missing"
        )
    return corners


def still_things(run: Run, *, max_frames: int = 200, within: FloatArray | None = None) -> StillScore:
    """Follow still corners through at most ``max_frames`` frames, spread over the run.

    ``within`` (n, 2): corners around the area to look at, base px; none: everywhere.

    Raises
    ------
    InputError
        Fewer than three registered frames, or nothing to follow in them.
    """
    maps = replace(run.maps, onward=())
    registered = [frame for frame, status in enumerate(run.registration_status) if status == "ok"]
    chosen = np.unique(np.linspace(0, len(registered) - 1, min(max_frames, len(registered))).astype(int))
    if len(chosen) < 3:
        raise InputError(f"{run.layout.root}: {len(registered)} registered frames, 3 or more needed to see jitter")
    templates = _sharpest(run, within)
    places = np.full((len(chosen), len(templates), 2), np.nan)
    for row, k in enumerate(chosen):
        transform = maps.transform(registered[k])
        assert isinstance(transform, FrameTransform), "a registered frame has a map"
        places[row] = places_on_map(run.frames.read(registered[k]), transform, templates)
    return _score(places, run, float(np.median(templates.sigma_px)))


def unused_corners(run: Run) -> tuple[Templates, NDArray[np.uint8]]:
    """Corners that registration does not use, and the image (h, w) that frames were registered to."""
    layout, limit = run.layout, run.record.config.frames.max_pixels
    own = run.grid.frames_to == "own"
    grey = read_grey_image(layout.own_base_image, limit) if own else run.base_image
    known = read_grey_image(layout.own_base_mask, limit) > 0 if own else np.ones(grey.shape, np.bool_)
    used = [make_templates(grey, known, count=count).xy for count in (N_PATCHES_SAME_SENSOR, N_PATCHES_CROSS_SENSOR)]
    return make_templates(grey, known, exclude=np.concatenate(used), half_patch=PATCH_HALF_PX), grey


def _sharpest(run: Run, within: FloatArray | None) -> Templates:
    """The sharpest of those corners, in an area where one is given."""
    found, grey = unused_corners(run)
    inside = np.ones(len(found), np.bool_)
    if within is not None:
        area = cv2.fillPoly(np.zeros(grey.shape, np.uint8), [np.rint(within).astype(np.int32)], (1,))
        inside = area[found.xy[:, 1].astype(np.int64), found.xy[:, 0].astype(np.int64)] > 0
    if not inside.any():
        raise InputError(
            f"{run.layout.root}: found no corner in the area that registration does not use, expected an area on the "
            f"base image of {grey.shape[1]}x{grey.shape[0]} px; move it there or give a larger one"
        )
    noise = np.where(inside, found.sigma_px, np.inf)
    wanted = max(int((noise <= SHARP_PX).sum()), min(_AT_LEAST, int(inside.sum())))
    order = np.argsort(noise, kind="stable")[:wanted]
    return found.select(order)


def places_on_map(grey: NDArray[np.uint8], transform: FrameTransform, templates: Templates) -> FloatArray:
    """Where a frame puts the corners on the map, (n, 2) base px; NaN where it does not show them."""
    found, _ = align_patches(smooth_levels(grey)[0], transform, templates, coarse=False, max_shift_px=_MAX_SHIFT_PX)
    number = {(float(x), float(y)): k for k, (x, y) in enumerate(templates.xy)}
    rows = [number[(float(x), float(y))] for x, y in found.xy_base]
    places = np.full((len(templates), 2), np.nan)
    places[rows] = transform.to_base(found.xy_raw)
    return places


def about_their_middles(places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Of places (frames, n, 2), those followed in half of the frames (m of n), about their medians: (frames, m, 2).

    And the robust standard deviation an axis of each, (m,).
    """
    kept = places[:, np.isfinite(places[..., 0]).mean(axis=0) >= _MIN_SHARE]
    rest = kept - np.nanmedian(kept, axis=0)
    return rest, _MAD_TO_SD * np.sqrt(np.mean(np.nanmedian(np.abs(rest), axis=0) ** 2, axis=1))


def _score(places: FloatArray, run: Run, noise_px: float) -> StillScore:
    """Of places (frames, corners, 2)."""
    rest, sd = about_their_middles(places)
    if not len(sd):
        raise InputError(f"{run.layout.root}: no corner of the base image is seen in half of the frames")
    tenth = max(1, len(places) // 10)
    drift = np.nanmedian(rest[-tenth:], axis=(0, 1)) - np.nanmedian(rest[:tenth], axis=(0, 1))
    return StillScore(
        points=len(sd),
        frames=len(places),
        noise_px=noise_px,
        sd_median_px=float(np.median(sd)),
        sd_p90_px=float(np.percentile(sd, 90)),
        drift_px=float(np.hypot(*drift)),
    )
