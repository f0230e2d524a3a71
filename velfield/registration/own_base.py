"""The flight's own base image: a median mosaic of its frames, free of traffic.

First of two passes: frames sampled over the flight are registered to the sharpest one (the reference), and their median
on its undistorted grid is the base image. It is built in rounds: first a few frames are registered to the reference,
then all to the median of the round before, which sharpens the median and adds frames that do not overlap the reference.
The second pass is the usual registration of all frames of the flight to this base image.

The rolling shutter of the reference frame distorts the grid, and all frames would be registered to that distortion. Its
row motion is estimated as the mean displacement of all frames' control points relative to their smooth maps, as a
function of the reference's row: the frames' own row motions average out. It is removed from the grid in every round.
"""

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np

from schemas.arrays import FloatArray, GreyImage, Mask
from schemas.flight import RegistrationConfig
from velfield.camera.lens import Lens
from velfield.errors import Failure
from velfield.registration import kernels
from velfield.registration.background import median_background
from velfield.registration.intrasensor import BaseReference, FrameRegistration, prepare_base, register_frame
from velfield.registration.joint import ControlPoints
from velfield.registration.keypoints import Keypoints
from velfield.registration.transforms import FrameTransform, PolyprojectiveTransform, as_points, fit_normalisation
from velfield.registration.warp import Window, footprint, warp_to_base

ReadFrame = Callable[[int], GreyImage]

_MIN_FRAMES = 3
_FIRST_FRAMES = 24
"""Frames of the first round, in which the reference is a single frame."""
_MAX_ROUNDS = 4
"""Rounds after the second only add frames that did not overlap the base image before."""
_MAX_EXTENT = 2.0
"""The base image extends at most this many frame sizes beyond the reference on each side."""
_STACK_BYTES = 200_000_000
_MOTION_KNOTS = 48
_MOTION_RIDGE = 1e-3


@dataclass(frozen=True, eq=False)
class OwnBase:
    """The flight's own base image.

    Attributes
    ----------
    image : (h, w) uint8, the median.
    valid : (h, w) bool, covered by enough frames that the median is free of traffic.
    origin_xy : base pixel (0, 0) on the reference frame's undistorted grid (column, row); integers.
    frames : number of frames in the median.
    row_motion_px : (rows, 2) row motion of the reference frame that was removed, undistorted px.
    """

    image: GreyImage
    valid: Mask
    origin_xy: tuple[int, int]
    frames: int
    row_motion_px: FloatArray


@dataclass(frozen=True, eq=False)
class _Grid:
    """The undistorted grid of the reference frame, shifted to ``origin``."""

    width: int
    height: int
    lens: Lens
    origin: tuple[int, int]

    @property
    def transform(self) -> FrameTransform:
        """The reference frame's own map: lens and origin alone."""
        corners = np.array([[0.0, 0.0], [self.width - 1.0, self.height - 1.0]])
        norm = fit_normalisation(corners)
        shift = np.array([[1.0, 0.0, -self.origin[0]], [0.0, 1.0, -self.origin[1]], [0.0, 0.0, 1.0]])
        polyprojective = PolyprojectiveTransform.from_homography(shift, norm, norm)
        return FrameTransform(width=self.width, height=self.height, lens=self.lens, polyprojective=polyprojective)

    def rows(self, xy_base: FloatArray) -> FloatArray:
        """Raw row (n,) of the reference frame at base pixels (n, 2); the undistorted row outside the lens's domain."""
        undistorted = as_points(xy_base) + np.array(self.origin, dtype=np.float64)
        raw = self.lens.distort_points(undistorted)[:, 1]
        return np.where(np.isfinite(raw), raw, undistorted[:, 1])


@dataclass(frozen=True, eq=False)
class _RowCorrectedMap:
    """A frame's map to a base image, corrected for the row motion remaining in that."""

    transform: FrameTransform
    grid: _Grid
    motion: FloatArray

    def to_base(self, xy_raw: FloatArray) -> FloatArray:
        """Raw pixels (n, 2) to pixels of the base image (n, 2)."""
        base = self.transform.to_base(xy_raw)
        return np.asarray(base - _row_motion(self.motion, self.grid, base))

    def to_raw(self, xy_base: FloatArray) -> FloatArray:
        """Pixels of the base image (n, 2) to raw pixels (n, 2)."""
        target = as_points(xy_base)
        base = target
        for _ in range(4):  # fixed point: the motion changes by at most 0.1 px per row, so each round gains a digit
            base = target + _row_motion(self.motion, self.grid, base)
        return self.transform.to_raw(base)


def build_own_base(
    read: ReadFrame,
    keypoints: Mapping[int, Keypoints],
    *,
    reference: int,
    lens: Lens,
    config: RegistrationConfig,
    threads: int = 1,
) -> OwnBase | Failure:
    """Build the flight's own base image on the undistorted grid of a reference frame.

    Parameters
    ----------
    read
        Frame number to grey frame (h, w) uint8.
    keypoints
        Keypoints, raw px, of the frames to use, including the reference.
    reference
        The frame that defines the grid: the sharpest.
    threads
        Frames registered concurrently; the result does not depend on it.

    Returns
    -------
    The base image, or a failure if fewer than three frames overlap the reference.
    """
    grey = read(reference)
    height = grey.shape[0]
    grid, base, mask = _undistort_reference(grey, lens)
    frames = sorted(keypoints)
    first_round = np.unique(np.linspace(0, len(frames) - 1, min(_FIRST_FRAMES, len(frames))).round().astype(int))
    selected = sorted({reference, *(frames[k] for k in first_round)})
    motion_px, count = np.zeros((height, 2)), 0
    for iteration in range(_MAX_ROUNDS):
        reference_image = prepare_base(base, config, mask=mask, frame_shape=grey.shape)
        registered = _register_frames(read, keypoints, selected, reference_image, lens, config, threads)
        if len(registered) < _MIN_FRAMES:
            return Failure(
                f"{len(registered)} of {len(selected)} frames overlap with frame {reference}, {_MIN_FRAMES} needed"
            )
        motion = _estimate_row_motion(registered, grid)
        motion_px += _evaluate_spline(motion, np.arange(height, dtype=np.float64), height)
        offset, base, mask = _build_mosaic(read, registered, grid, motion)
        grid = replace(grid, origin=(grid.origin[0] + offset[0], grid.origin[1] + offset[1]))
        selected = frames
        if iteration > 0 and (len(registered) == len(frames) or len(registered) == count):
            break
        count = len(registered)
    return OwnBase(base, mask, grid.origin, len(registered), motion_px)


def _undistort_reference(grey: GreyImage, lens: Lens) -> tuple[_Grid, GreyImage, Mask]:
    """Undistort the reference frame: its grid, image and mask."""
    height, width = grey.shape
    x0, y0, x1, y1 = footprint(_Grid(width, height, lens, (0, 0)).transform, grey.shape)
    grid = _Grid(width, height, lens, (int(np.floor(x0)), int(np.floor(y0))))
    window = (0, 0, int(np.ceil(x1)) - grid.origin[0] + 1, int(np.ceil(y1)) - grid.origin[1] + 1)
    return grid, *warp_to_base(grey, grid.transform, window=window, interpolation=cv2.INTER_CUBIC)


def _register_frames(
    read: ReadFrame,
    keypoints: Mapping[int, Keypoints],
    frames: list[int],
    base: BaseReference,
    lens: Lens,
    config: RegistrationConfig,
    threads: int,
) -> dict[int, tuple[FrameTransform, ControlPoints]]:
    """Register frames to the base image, each independently: maps and control points of those that succeed."""

    def register(frame: int) -> FrameRegistration:
        return register_frame(read(frame), keypoints[frame], base, lens, config)

    with ThreadPoolExecutor(max_workers=threads) as pool:
        results = list(pool.map(register, frames))
    return {
        frame: (result.transform, result.control_points)
        for frame, result in zip(frames, results, strict=True)
        if result.transform is not None and result.control_points is not None
    }


def _estimate_row_motion(registered: Mapping[int, tuple[FrameTransform, ControlPoints]], grid: _Grid) -> FloatArray:
    """Estimate the row motion remaining in the base image: spline coefficients (3, knots).

    Its second-order part along the rows is not observable: each frame's polyprojective absorbs it.
    """
    rows, displaced = [], []
    for transform, points in registered.values():
        plain = transform.polyprojective(transform.lens.undistort_points(points.xy_raw))
        displacement = points.xy_base - plain
        good = np.isfinite(displacement).all(axis=1)
        rows.append(grid.rows(points.xy_base[good]))
        displaced.append(displacement[good] - np.median(displacement[good], axis=0))
    row, displacement = np.concatenate(rows), np.concatenate(displaced)
    inside = (row >= 0) & (row <= grid.height - 1)
    first, weights = kernels.spline_basis(np.ascontiguousarray(row[inside]), grid.height, _MOTION_KNOTS)
    normal = _MOTION_RIDGE * len(first) / _MOTION_KNOTS * np.eye(_MOTION_KNOTS)
    right = np.zeros((_MOTION_KNOTS, 2))
    for a in range(4):
        np.add.at(right, first + a, weights[:, a, None] * displacement[inside])
        for b in range(4):
            np.add.at(normal, (first + a, first + b), weights[:, a] * weights[:, b])
    return np.vstack([np.linalg.solve(normal, right).T, np.zeros((1, _MOTION_KNOTS))])


def _evaluate_spline(coefficients: FloatArray, rows: FloatArray, height: int) -> FloatArray:
    """Motion (n, 2) at raw rows (n,)."""
    if coefficients.shape[1] < 4:
        return np.zeros((len(rows), 2))
    first, weights = kernels.spline_basis(np.ascontiguousarray(rows), height, coefficients.shape[1])
    return np.asarray(np.einsum("nk,cnk->nc", weights, coefficients[:2, first[:, None] + np.arange(4)]))


def _row_motion(coefficients: FloatArray, grid: _Grid, xy_base: FloatArray) -> FloatArray:
    return _evaluate_spline(coefficients, grid.rows(xy_base), grid.height)


def _build_mosaic(
    read: ReadFrame, registered: Mapping[int, tuple[FrameTransform, ControlPoints]], grid: _Grid, motion: FloatArray
) -> tuple[tuple[int, int], GreyImage, Mask]:
    """Offset from the grid's origin, median of the frames, and mask of the pixels that enough frames cover."""
    width, height = grid.width, grid.height
    maps = {frame: _RowCorrectedMap(registered[frame][0], grid, motion) for frame in sorted(registered)}
    boxes = np.array([footprint(t, (height, width)) for t in maps.values()])
    reach = _MAX_EXTENT * max(width, height)
    x0, y0 = np.maximum(np.floor(np.nanmin(boxes[:, :2], axis=0)), -reach).astype(int)
    x1, y1 = np.minimum(np.ceil(np.nanmax(boxes[:, 2:], axis=0)), np.array([width, height]) + reach).astype(int)
    band = max(64, _STACK_BYTES // (2 * len(maps) * int(x1 - x0 + 1)))
    needed = min(_MIN_FRAMES, len(maps))
    images, masks = [], []
    for top in range(int(y0), int(y1) + 1, band):
        window: Window = (int(x0), top, int(x1 - x0) + 1, min(band, int(y1) + 1 - top))
        warped = [warp_to_base(read(f), t, window=window, interpolation=cv2.INTER_CUBIC) for f, t in maps.items()]
        background = median_background([image for image, _ in warped], [mask for _, mask in warped])
        images.append(background.median)
        masks.append(background.count >= needed)
    return (int(x0), int(y0)), np.concatenate(images), np.concatenate(masks)
