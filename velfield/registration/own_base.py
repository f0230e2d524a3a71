"""The flight's own base image: a median mosaic of its frames, free of traffic.

First of two passes: frames sampled over the flight are registered to the sharpest one (the reference), and their median
on its undistorted grid is the base image. In short chains, forward and backward in time, each starts from its
neighbour, and the first from the reference, by optical flow, as in any registration: keypoints are detected where that
fails. Frames that do not overlap the reference are added in further rounds, in which all are registered to the median
of the round before. The second pass is the usual registration of all frames of the flight to this base image.

The rolling shutter of the reference frame distorts the grid, and all frames would be registered to that distortion. Its
row motion is estimated as the mean displacement of all frames' control points relative to their smooth maps, as a
function of the reference's row: the frames' own row motions average out. It is removed from the grid in every round.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from schemas.arrays import FloatArray, GreyImage, IntArray, Mask
from schemas.flight import RegistrationConfig
from velfield.camera.lens import Lens
from velfield.errors import Failure
from velfield.parallel import parallel_map, usable_processors
from velfield.registration import kernels
from velfield.registration.background import NOT_COVERED, median_of_stack
from velfield.registration.control_points import ControlPoints
from velfield.registration.frame_fit import BaseReference, FrameRegistration
from velfield.registration.intrasensor import ChainFrame, prepare_base, register_chain
from velfield.registration.keypoints import Keypoints
from velfield.registration.transforms import FrameTransform, PolyprojectiveTransform, as_points, fit_normalisation
from velfield.registration.warp import RawToBase, Rectification, Window, footprint, warp_to_base

ReadFrame = Callable[[int], GreyImage]
DetectKeypoints = Callable[[int], Keypoints]

_MIN_FRAMES = 3
_MAX_ROUNDS = 4
"""Rounds after the first add frames that did not overlap the base image before."""
_CHAIN_FRAMES = 8
"""Frames of a chain at most; chains are registered side by side."""
_MAX_EXTENT = 2.0
"""The base image extends at most this many frame sizes beyond the reference on each side."""
_STACK_BYTES = 400_000_000
"""Rectified frames in memory at a time: a band of rows of all of them."""
_MOTION_KNOTS = 48
_MOTION_RIDGE = 1e-3


@dataclass(frozen=True, eq=False)
class OwnBase:
    """The flight's own base image."""

    image: GreyImage
    """(h, w) uint8, the median."""
    valid: Mask
    """(h, w) bool, covered by enough frames that the median is free of traffic."""
    origin_xy: tuple[int, int]
    """Base pixel (0, 0) on the reference frame's undistorted grid (column, row); integers."""
    frames: int
    """Number of frames in the median."""


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
    detect: DetectKeypoints,
    frames: Sequence[int],
    *,
    reference: int,
    lens: Lens,
    config: RegistrationConfig,
) -> OwnBase | Failure:
    """Build the flight's own base image on the undistorted grid of a reference frame, the sharpest of the frames.

    These are in time order; ``read`` gives the grey frame (h, w) uint8 of a number, ``detect`` its keypoints, raw px,
    the same ones several times. A failure if fewer than three frames overlap the reference.
    """
    grey = read(reference)
    grid, base, mask = _undistort_reference(grey, lens)
    count = 0
    for _ in range(_MAX_ROUNDS):
        reference_image = prepare_base(base, config, mask=mask, frame_shape=grey.shape)
        known = ChainFrame.of_known_map(grey, grid.transform, reference_image)
        registered = _register_chains(read, detect, _chains(frames, reference), reference_image, known, config)
        if len(registered) < _MIN_FRAMES:
            return Failure(
                f"{len(registered)} of {len(frames)} frames overlap with frame {reference}, {_MIN_FRAMES} needed"
            )
        motion = _estimate_row_motion(registered, grid)
        offset, base, mask = _build_mosaic(read, registered, grid, motion)
        grid = replace(grid, origin=(grid.origin[0] + offset[0], grid.origin[1] + offset[1]))
        if len(registered) in (len(frames), count):
            break
        count = len(registered)
    return OwnBase(base, mask, grid.origin, len(registered))


def _undistort_reference(grey: GreyImage, lens: Lens) -> tuple[_Grid, GreyImage, Mask]:
    """Undistort the reference frame: its grid, image and mask."""
    height, width = grey.shape
    x0, y0, x1, y1 = footprint(_Grid(width, height, lens, (0, 0)).transform, grey.shape)
    grid = _Grid(width, height, lens, (int(np.floor(x0)), int(np.floor(y0))))
    window = (0, 0, int(np.ceil(x1)) - grid.origin[0] + 1, int(np.ceil(y1)) - grid.origin[1] + 1)
    return grid, *warp_to_base(grey, grid.transform, window=window, interpolation=cv2.INTER_CUBIC)


def _chains(frames: Sequence[int], reference: int) -> list[list[int]]:
    """The frames in short chains that lead away from the reference.

    The reference is a chain of its own: it fits best of all, and beside it every other frame would look worse.
    """
    sides = [one for one in frames if one > reference], [one for one in frames[::-1] if one < reference]
    return [[reference], *(side[k : k + _CHAIN_FRAMES] for side in sides for k in range(0, len(side), _CHAIN_FRAMES))]


def _register_chains(
    read: ReadFrame,
    detect: DetectKeypoints,
    chains: Sequence[Sequence[int]],
    base: BaseReference,
    known: ChainFrame,
    config: RegistrationConfig,
) -> dict[int, tuple[FrameTransform, ControlPoints]]:
    """Register chains of frames to the base image: maps and control points of those that succeed."""

    def register(chain: Sequence[int]) -> list[FrameRegistration]:
        shown = ((frame, read(frame), partial(detect, frame)) for frame in chain)
        return register_chain(shown, base, known.transform.lens, config, before=known)

    return {
        frame: (result.transform, result.control_points)
        for chain, results in zip(chains, parallel_map(register, chains), strict=True)
        for frame, result in zip(chain, results, strict=True)
        if result.transform is not None and result.control_points is not None
    }


def _estimate_row_motion(registered: Mapping[int, tuple[FrameTransform, ControlPoints]], grid: _Grid) -> FloatArray:
    """Estimate the row motion remaining in the base image: spline coefficients (2, knots).

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
    return np.ascontiguousarray(np.linalg.solve(normal, right).T)


def _row_motion(coefficients: FloatArray, grid: _Grid, xy_base: FloatArray) -> FloatArray:
    """Motion (n, 2) at base pixels (n, 2)."""
    first, weights = kernels.spline_basis(np.ascontiguousarray(grid.rows(xy_base)), grid.height, _MOTION_KNOTS)
    return np.asarray(np.einsum("nk,cnk->nc", weights, coefficients[:, first[:, None] + np.arange(4)]))


def _build_mosaic(
    read: ReadFrame,
    registered: Mapping[int, tuple[FrameTransform, ControlPoints]],
    grid: _Grid,
    motion: FloatArray,
) -> tuple[tuple[int, int], GreyImage, Mask]:
    """Offset from the grid's origin, median of the frames, and mask of the pixels that enough frames cover."""
    width, height = grid.width, grid.height
    maps = {frame: _RowCorrectedMap(registered[frame][0], grid, motion) for frame in sorted(registered)}
    boxes = np.array([footprint(t, (height, width)) for t in maps.values()])
    reach = _MAX_EXTENT * max(width, height)
    x0, y0 = np.maximum(np.floor(np.nanmin(boxes[:, :2], axis=0)), -reach).astype(int).tolist()
    x1, y1 = (
        np.minimum(np.ceil(np.nanmax(boxes[:, 2:], axis=0)), np.array([width, height]) + reach).astype(int).tolist()
    )
    band = max(64, _STACK_BYTES // (len(maps) * (x1 - x0 + 1)))
    windows: list[Window] = [(x0, top, x1 - x0 + 1, min(band, y1 + 1 - top)) for top in range(y0, y1 + 1, band)]
    with ThreadPoolExecutor(usable_processors()) as pool:
        parts = [_median_in(read, maps, window, pool) for window in windows]
    covered = np.concatenate([count for _, count in parts]) >= min(_MIN_FRAMES, len(maps))
    return (x0, y0), np.concatenate([median for median, _ in parts]), covered


def _median_in(
    read: ReadFrame, maps: Mapping[int, RawToBase], window: Window, pool: ThreadPoolExecutor
) -> tuple[GreyImage, IntArray]:
    """The median of frames in a window of the grid, and the number of those that cover each pixel, both (h, w)."""
    stack = np.empty((len(maps), window[3], window[2]), np.uint8)

    def rectify(k: int, frame: int) -> Mask:
        found = Rectification(read(frame), maps[frame], window=window)
        found.resample_all()
        stack[k] = found.image
        stack[k][~found.valid] = NOT_COVERED
        return found.valid

    count = np.zeros(stack.shape[1:], np.uint8)
    for valid in pool.map(rectify, range(len(maps)), maps):
        count += valid
    return median_of_stack(stack, count), count
