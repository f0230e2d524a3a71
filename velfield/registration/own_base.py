"""A base image from the flight itself, where another one is not given or to register to it.

Two passes, of which this is the first: frames spread over the flight are registered to the sharpest one, and their
median on its undistorted grid is the base image, traffic gone from it. It is made in rounds: a few frames to the
reference, then all of them to the median of those, so that the median is sharp, and frames that do not overlap the
reference join in. The second pass, all frames of the flight to the last median, is the registration every flight has.

The reference frame is itself bent by its rolling shutter, and all frames would be bent to match it. How it moved from
row to row shows as the mean displacement of the frames' control points against their smooth maps, by the reference's
row: the frames' own motions are as often this way as that. That mean is taken out of the grid, in each round.
"""

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, GreyImage
from schemas.flight import RegistrationConfig
from velfield.camera.lens import Lens
from velfield.errors import Failure
from velfield.registration import kernels
from velfield.registration.background import median_background
from velfield.registration.intrasensor import BaseReference, FrameRegistration, prepare_base, register_frame
from velfield.registration.joint import ControlPoints
from velfield.registration.keypoints import KeyPoints
from velfield.registration.transforms import FrameTransform, PolyprojectiveTransform, as_points, normalisation_of
from velfield.registration.warp import Window, footprint, warp_to_base

Read = Callable[[int], GreyImage]

_MIN_FRAMES = 3
_FIRST_FRAMES = 24
"""Frames of the first round, whose reference is a single frame."""
_MAX_ROUNDS = 4
"""Rounds after the second only bring in frames that overlapped nothing before."""
_MAX_GROWTH = 2.0
"""The base image reaches at most this many frame sizes beyond the reference on each side."""
_STACK_BYTES = 200_000_000
_MOTION_KNOTS = 48
_MOTION_RIDGE = 1e-3


@dataclass(frozen=True, eq=False)
class OwnBase:
    """The flight's own base image.

    Attributes
    ----------
    image : (h, w) uint8, the median.
    valid : (h, w) bool, seen by enough frames that traffic is gone.
    origin_xy : column and row of the reference frame's undistorted grid that base pixel (0, 0) has; whole numbers.
    frames : how many frames the median is of.
    row_motion_px : (rows, 2) motion of the reference frame's rows that was taken out, undistorted px.
    """

    image: GreyImage
    valid: NDArray[np.bool_]
    origin_xy: tuple[int, int]
    frames: int
    row_motion_px: FloatArray


@dataclass(frozen=True, eq=False)
class _Grid:
    """The undistorted grid of the reference frame, from ``origin`` on."""

    width: int
    height: int
    lens: Lens
    origin: tuple[int, int]

    @property
    def transform(self) -> FrameTransform:
        """The reference frame's own map: nothing but its lens, and the origin."""
        corners = np.array([[0.0, 0.0], [self.width - 1.0, self.height - 1.0]])
        norm = normalisation_of(corners)
        shift = np.array([[1.0, 0.0, -self.origin[0]], [0.0, 1.0, -self.origin[1]], [0.0, 0.0, 1.0]])
        polyprojective = PolyprojectiveTransform.from_homography(shift, norm, norm)
        return FrameTransform(width=self.width, height=self.height, lens=self.lens, polyprojective=polyprojective)

    def rows(self, xy_base: FloatArray) -> FloatArray:
        """Raw row (n,) of the reference frame at base pixels (n, 2); the row of the grid where the lens has none."""
        undistorted = as_points(xy_base) + np.array(self.origin, dtype=np.float64)
        raw = self.lens.distort_points(undistorted)[:, 1]
        return np.where(np.isfinite(raw), raw, undistorted[:, 1])


@dataclass(frozen=True, eq=False)
class _Straightened:
    """A frame's map to a base image, then the row motion left in that taken out."""

    transform: FrameTransform
    grid: _Grid
    motion: FloatArray

    def to_base(self, xy_raw: FloatArray) -> FloatArray:
        """Raw pixels (n, 2) to pixels of the base image (n, 2)."""
        base = self.transform.to_base(xy_raw)
        return np.asarray(base - _motion_at(self.motion, self.grid, base))

    def to_raw(self, xy_base: FloatArray) -> FloatArray:
        """Pixels of the base image (n, 2) to raw pixels (n, 2)."""
        wanted = as_points(xy_base)
        base = wanted
        for _ in range(4):  # the motion changes by a tenth of a pixel a row at most: each round gains a digit
            base = wanted + _motion_at(self.motion, self.grid, base)
        return self.transform.to_raw(base)


def build_own_base(
    read: Read,
    key_points: Mapping[int, KeyPoints],
    *,
    reference: int,
    lens: Lens,
    config: RegistrationConfig,
    threads: int = 1,
) -> OwnBase | Failure:
    """The flight's own base image on the undistorted grid of a reference frame.

    Parameters
    ----------
    read
        Frame number to grey frame (h, w) uint8.
    key_points
        Key points, raw px, of the frames the base image is made of, the reference among them.
    reference
        The frame whose grid it is: the sharpest.
    threads
        Frames worked on at once; the result does not depend on it.

    Returns
    -------
    The base image, or a failure where fewer than three frames overlap the reference.
    """
    grey = read(reference)
    height = grey.shape[0]
    grid, base, mask = _reference_picture(grey, lens)
    frames = sorted(key_points)
    spread = np.unique(np.linspace(0, len(frames) - 1, min(_FIRST_FRAMES, len(frames))).round().astype(int))
    chosen = sorted({reference, *(frames[k] for k in spread)})
    motion_px, count = np.zeros((height, 2)), 0
    for turn in range(_MAX_ROUNDS):
        reference_image = prepare_base(base, config, mask=mask, frame_shape=grey.shape)
        found = _registered(read, key_points, chosen, reference_image, lens, config, threads)
        if len(found) < _MIN_FRAMES:
            return Failure(f"{len(found)} of {len(chosen)} frames overlap with frame {reference}, {_MIN_FRAMES} needed")
        motion = _reference_motion(found, grid)
        motion_px += _spline(motion, np.arange(height, dtype=np.float64), height)
        offset, base, mask = _mosaic(read, found, grid, motion)
        grid = replace(grid, origin=(grid.origin[0] + offset[0], grid.origin[1] + offset[1]))
        chosen = frames
        if turn > 0 and (len(found) == len(frames) or len(found) == count):
            break
        count = len(found)
    return OwnBase(base, mask, grid.origin, len(found), motion_px)


def _reference_picture(grey: GreyImage, lens: Lens) -> tuple[_Grid, GreyImage, NDArray[np.bool_]]:
    """The reference frame undistorted: its grid, picture and mask."""
    height, width = grey.shape
    x0, y0, x1, y1 = footprint(_Grid(width, height, lens, (0, 0)).transform, grey.shape)
    grid = _Grid(width, height, lens, (int(np.floor(x0)), int(np.floor(y0))))
    window = (0, 0, int(np.ceil(x1)) - grid.origin[0] + 1, int(np.ceil(y1)) - grid.origin[1] + 1)
    return grid, *warp_to_base(grey, grid.transform, window=window, interpolation=cv2.INTER_CUBIC)


def _registered(
    read: Read,
    key_points: Mapping[int, KeyPoints],
    frames: list[int],
    base: BaseReference,
    lens: Lens,
    config: RegistrationConfig,
    threads: int,
) -> dict[int, tuple[FrameTransform, ControlPoints]]:
    """Those frames that register to the base image, each by itself, with their control points."""

    def register(frame: int) -> FrameRegistration:
        return register_frame(read(frame), key_points[frame], base, lens, config)

    with ThreadPoolExecutor(max_workers=threads) as pool:
        results = list(pool.map(register, frames))
    return {
        frame: (result.transform, result.control_points)
        for frame, result in zip(frames, results, strict=True)
        if result.transform is not None and result.control_points is not None
    }


def _reference_motion(found: Mapping[int, tuple[FrameTransform, ControlPoints]], grid: _Grid) -> FloatArray:
    """Spline coefficients (3, knots) of the row motion left in the base image.

    What is of second order along the rows stays in: frame by frame the polyprojective takes it up.
    """
    rows, moved = [], []
    for transform, points in found.values():
        plain = transform.polyprojective(transform.lens.undistort_points(points.xy_raw))
        displacement = points.xy_base - plain
        good = np.isfinite(displacement).all(axis=1)
        rows.append(grid.rows(points.xy_base[good]))
        moved.append(displacement[good] - np.median(displacement[good], axis=0))
    row, displacement = np.concatenate(rows), np.concatenate(moved)
    inside = (row >= 0) & (row <= grid.height - 1)
    first, weights = kernels.spline_basis(np.ascontiguousarray(row[inside]), grid.height, _MOTION_KNOTS)
    normal = _MOTION_RIDGE * len(first) / _MOTION_KNOTS * np.eye(_MOTION_KNOTS)
    right = np.zeros((_MOTION_KNOTS, 2))
    for a in range(4):
        np.add.at(right, first + a, weights[:, a, None] * displacement[inside])
        for b in range(4):
            np.add.at(normal, (first + a, first + b), weights[:, a] * weights[:, b])
    return np.vstack([np.linalg.solve(normal, right).T, np.zeros((1, _MOTION_KNOTS))])


def _spline(coefficients: FloatArray, rows: FloatArray, height: int) -> FloatArray:
    """Motion (n, 2) at raw rows (n,)."""
    if coefficients.shape[1] < 4:
        return np.zeros((len(rows), 2))
    first, weights = kernels.spline_basis(np.ascontiguousarray(rows), height, coefficients.shape[1])
    return np.asarray(np.einsum("nk,cnk->nc", weights, coefficients[:2, first[:, None] + np.arange(4)]))


def _motion_at(coefficients: FloatArray, grid: _Grid, xy_base: FloatArray) -> FloatArray:
    return _spline(coefficients, grid.rows(xy_base), grid.height)


def _mosaic(
    read: Read, found: Mapping[int, tuple[FrameTransform, ControlPoints]], grid: _Grid, motion: FloatArray
) -> tuple[tuple[int, int], GreyImage, NDArray[np.bool_]]:
    """Offset from the grid's origin, median of the frames, and where enough of them see."""
    width, height = grid.width, grid.height
    maps = {frame: _Straightened(found[frame][0], grid, motion) for frame in sorted(found)}
    boxes = np.array([footprint(t, (height, width)) for t in maps.values()])
    reach = _MAX_GROWTH * max(width, height)
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
