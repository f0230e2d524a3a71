"""Stability of stationary points on the map of a run: the jitter of registration, measured without ground truth.

Corners of the base image that registration does not use (half a patch away from those it uses) are located in every
registered frame to subpixel accuracy and mapped to base pixels by the frame's transform. Their remaining motion is what
a stationary vehicle would appear to do: the registration error plus the noise of the alignment. To reduce the latter,
only sharp corners are tracked, with patches larger than those of registration: with the latter, compression artefacts
alone moved road markings by 0.15 px. Points above the ground move on the map of a moving camera by parallax; an area
restricts the measurement to the ground.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from schemas.arrays import FloatArray, GreyImage
from velfield.errors import InputError
from velfield.registration.alignment import (
    N_PATCHES_CROSS_SENSOR,
    N_PATCHES_SAME_SENSOR,
    Templates,
    align_patches,
    make_templates,
    smooth_fine,
)
from velfield.registration.transforms import FrameTransform
from velfield.run.run import Run
from velfield.sources.images import read_grey_image
from velfield.sources.table import finite_cell, read_csv_rows

_MAX_SHIFT_PX = 3.0
_MIN_FRAME_FRACTION = 0.5
PATCH_HALF_PX = 12
SHARP_PX, _MIN_CORNERS = 0.1, 30
"""Corners of a larger standard deviation under noise are not tracked, unless fewer than this number remain."""
_MAD_TO_SD = 1.4826


@dataclass(frozen=True)
class StabilityScore:
    """Stability of stationary corners on the map."""

    points: int
    frames: int
    """Corners tracked in at least half of the registered frames; number of frames."""
    noise_px: float
    """Standard deviation per axis of the typical corner due to image noise of three grey levels alone."""
    sd_median_px: float
    sd_p90_px: float
    """Robust standard deviation of a corner's position per axis, its median and 90th percentile over the corners, base
    px."""
    drift_px: float
    """Displacement of the corners' mean position from the first to the last tenth of the frames, base px."""

    def text(self) -> str:
        """One line."""
        return (
            f"{self.points} stationary corners in {self.frames} frames: standard deviation {self.sd_median_px:.3f} px "
            f"per axis (median; 90 % below {self.sd_p90_px:.3f}; {self.noise_px:.3f} expected from noise of 3 grey "
            f"levels, as in compressed video), drift from first to last tenth {self.drift_px:.3f} px"
        )


def read_area(path: Path) -> FloatArray:
    """Read the corners (n, 2) of a polygon in order, base px, from a CSV ``x_px,y_px``.

    Raises
    ------
    InputError
        No such file, a cell that is not a number, fewer than three corners.
    """
    rows = read_csv_rows(path, required=("x_px", "y_px"), what="an area")
    corners = np.array([[finite_cell(path, line, row, name) for name in ("x_px", "y_px")] for line, row in rows])
    if len(corners) < 3 or not np.isfinite(corners).all():
        raise InputError(
            f"{path.name}: found {len(corners)} corners, expected 3 or more, each with x_px and y_px; add those missing"
        )
    return corners


def measure_stability(run: Run, *, max_frames: int = 200, within: FloatArray | None = None) -> StabilityScore:
    """Track stationary corners through at most ``max_frames`` frames, sampled over the run.

    ``within`` (n, 2) is the polygon of the area to measure, base px; None: everywhere.

    Raises
    ------
    InputError
        Fewer than three registered frames, or no corner to track.
    """
    maps = replace(run.frame_transforms, base_maps=())
    registered = [frame for frame, status in enumerate(run.registration_status) if status == "ok"]
    sampled = np.unique(np.linspace(0, len(registered) - 1, min(max_frames, len(registered))).astype(int))
    if len(sampled) < 3:
        raise InputError(f"{run.layout.root}: {len(registered)} registered frames, 3 or more needed to see jitter")
    templates = _select_sharpest(run, within)
    positions = np.full((len(sampled), len(templates), 2), np.nan)
    for row, k in enumerate(sampled):
        transform = maps.transform(registered[k])
        assert isinstance(transform, FrameTransform), "a registered frame has a map"
        positions[row] = track_corners(run.frames.read(registered[k]), transform, templates)
    return _score(positions, run, float(np.median(templates.sigma_px)))


def unused_corners(run: Run) -> tuple[Templates, GreyImage]:
    """Corners of the registration's base image (h, w) that registration does not use, and that image."""
    layout, limit = run.layout, run.record.config.frames.max_pixels
    own = run.grid.registered_to == "flight"
    grey = read_grey_image(layout.own_base_image, limit) if own else run.base_image
    valid = read_grey_image(layout.own_base_mask, limit) > 0 if own else np.ones(grey.shape, np.bool_)
    used = [make_templates(grey, valid, count=count).xy for count in (N_PATCHES_SAME_SENSOR, N_PATCHES_CROSS_SENSOR)]
    return make_templates(grey, valid, exclude=np.concatenate(used), half_patch=PATCH_HALF_PX), grey


def _select_sharpest(run: Run, within: FloatArray | None) -> Templates:
    """The sharpest of the unused corners, within an area if one is given."""
    corners, grey = unused_corners(run)
    inside = np.ones(len(corners), np.bool_)
    if within is not None:
        area = cv2.fillPoly(np.zeros(grey.shape, np.uint8), [np.rint(within).astype(np.int32)], (1,))
        inside = area[corners.xy[:, 1].astype(np.int64), corners.xy[:, 0].astype(np.int64)] > 0
    if not inside.any():
        raise InputError(
            f"{run.layout.root}: found no corner in the area that registration does not use, expected an area on the "
            f"base image of {grey.shape[1]}x{grey.shape[0]} px; give another or a larger one"
        )
    noise = np.where(inside, corners.sigma_px, np.inf)
    count = max(int((noise <= SHARP_PX).sum()), min(_MIN_CORNERS, int(inside.sum())))
    order = np.argsort(noise, kind="stable")[:count]
    return corners.select(order)


def track_corners(grey: GreyImage, transform: FrameTransform, templates: Templates) -> FloatArray:
    """Positions (n, 2) of the corners by one frame, base px; NaN where they are not located."""
    corners, _ = align_patches(smooth_fine(grey), transform, templates, coarse=False, max_shift_px=_MAX_SHIFT_PX)
    number = {(float(x), float(y)): k for k, (x, y) in enumerate(templates.xy)}
    rows = [number[(float(x), float(y))] for x, y in corners.xy_base]
    positions = np.full((len(templates), 2), np.nan)
    positions[rows] = transform.to_base(corners.xy_raw)
    return positions


def centre_on_medians(positions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals (frames, m, 2) of positions (frames, n, 2) about their medians, of those tracked in half of the frames.

    Also the robust standard deviation per axis of each, (m,).
    """
    kept = positions[:, np.isfinite(positions[..., 0]).mean(axis=0) >= _MIN_FRAME_FRACTION]
    residuals = kept - np.nanmedian(kept, axis=0)
    return residuals, _MAD_TO_SD * np.sqrt(np.mean(np.nanmedian(np.abs(residuals), axis=0) ** 2, axis=1))


def _score(positions: FloatArray, run: Run, noise_px: float) -> StabilityScore:
    """The score of positions (frames, corners, 2)."""
    residuals, sd = centre_on_medians(positions)
    if not len(sd):
        raise InputError(f"{run.layout.root}: no corner of the base image could be tracked in half of the frames")
    tenth = max(1, len(positions) // 10)
    drift = np.nanmedian(residuals[-tenth:], axis=(0, 1)) - np.nanmedian(residuals[:tenth], axis=(0, 1))
    return StabilityScore(
        points=len(sd),
        frames=len(positions),
        noise_px=noise_px,
        sd_median_px=float(np.median(sd)),
        sd_p90_px=float(np.percentile(sd, 90)),
        drift_px=float(np.hypot(*drift)),
    )
