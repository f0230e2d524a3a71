"""Rectification: a raw frame resampled once onto the base image's grid.

The inverse map, output pixels to raw pixels, is exact at the centres of cells of 16 px and interpolated bilinearly
between, or of 8 px where the map bends by more than a twentieth of a pixel in between (fast rolling shutter). Inverting
every pixel would cost a hundred times as much. At the centres it is inverted from every fourth of them on: what is
interpolated between those is wrong by less than a pixel, and three evaluations of the forward map correct it.

A frame is resampled whole (`warp_to_base`) or where it is asked for (`Rectification`).
"""

from functools import cached_property, lru_cache
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import Float32Array, FloatArray, GreyImage, IntArray, Mask
from velfield.registration.resampling.cells import CELL_PX, PAD_PX, as_words, resample_kernel

Window = tuple[int, int, int, int]
"""x, y, width, height in base px."""

_INVALID = -1e5
_MIN_SHRINK = 1.35
"""At this many raw pixels per output pixel or more the raw frame is area-averaged first; below, aliasing is slight."""
_BORDER_POINTS = 64
_CELL_PX = 16, 8
"""Sides of the cells that are tried, output px."""
_CHECKS, _MAX_BEND_PX = 24, 0.05
"""Rows and columns of places where interpolation is checked, and the error that is allowed there."""
_SPARSE, _CORRECTIONS, _MAX_ERROR_PX = 4, 3, 2e-3
"""Nodes whose inverse is computed from nothing: every fourth. At the others it starts from their interpolation, and is
corrected so many times; nodes that are not this accurate before the last one, base px, start from nothing."""


class RawToBase(Protocol):
    """The map of a frame: `FrameTransform`, or a composition of it."""

    def to_base(self, xy_raw: FloatArray, /) -> FloatArray:
        """Raw pixels (n, 2) to base pixels (n, 2)."""
        ...

    def to_raw(self, xy_base: FloatArray, /) -> FloatArray:
        """Base pixels (n, 2) to raw pixels (n, 2); NaN rows where there is no inverse."""
        ...


def warp_to_base(
    grey_raw: GreyImage,
    transform: RawToBase,
    *,
    window: Window,
    scale: float = 1.0,
    interpolation: int = cv2.INTER_LINEAR,
    replicate_border: bool = False,
) -> tuple[GreyImage, Mask]:
    """Resample a raw frame (h, w) uint8 onto a window of the base image's grid, with ``scale`` output px per base px.

    Output pixel (i, j) of the window (x0, y0, width, height), base px, lies at base x = x0 + (j + 0.5) / scale - 0.5, y
    likewise. OpenCV's flag ``interpolation`` is linear by default, cubic for base images.

    Returns
    -------
    Image (round(h scale), round(w scale)) uint8, zero outside the frame, or with ``replicate_border`` continued, so
    that no artificial edge appears there; and mask, bool, true inside the frame.
    """
    shape = round(window[3] * scale), round(window[2] * scale)
    step, coarse = _interpolable_map(transform, window=window, scale=scale, shape=shape)
    source, map_xy = _downscale(grey_raw, coarse, _raw_px_per_cell(coarse) / step)
    dense = cv2.resize(map_xy, None, fx=step, fy=step, interpolation=cv2.INTER_LINEAR)
    dense = dense[step : step + shape[0], step : step + shape[1]]
    map_x, map_y = np.ascontiguousarray(dense[..., 0]), np.ascontiguousarray(dense[..., 1])
    image = cv2.remap(source, map_x, map_y, interpolation, borderMode=cv2.BORDER_REPLICATE)
    height, width = source.shape
    mask = (map_x >= -0.5) & (map_x <= width - 0.5) & (map_y >= -0.5) & (map_y <= height - 0.5)
    if not replicate_border:
        image[~mask] = 0
    return np.asarray(image, dtype=np.uint8), np.asarray(mask)


def _interpolable_map(
    transform: RawToBase, *, window: Window, scale: float, shape: tuple[int, int]
) -> tuple[int, FloatArray]:
    """Side of the cells, output px, and raw coordinates at their centres: large cells where interpolation is accurate.

    It is least accurate in the middle between four centres: there some are compared with the exact map.
    """
    step = _CELL_PX[0]
    coarse = _coarse_map(transform, window=window, scale=scale, step=step, shape=shape)
    rows, columns = (_checked_nodes(size) for size in coarse.shape[:2])
    at = np.ix_(rows, columns)
    between = (coarse[at] + coarse[np.ix_(rows + 1, columns)] + coarse[np.ix_(rows, columns + 1)]) / 4
    between += coarse[np.ix_(rows + 1, columns + 1)] / 4
    x, y = (columns * step - 0.5) / scale, (rows * step - 0.5) / scale  # the corner that four cells share
    base_x, base_y = np.meshgrid(window[0] + (x + 0.5 / scale) - 0.5, window[1] + (y + 0.5 / scale) - 0.5)
    exact = transform.to_raw(np.stack([base_x.ravel(), base_y.ravel()], axis=1)).reshape(between.shape)
    if not (np.abs(between - exact)[np.isfinite(exact + between)] > _MAX_BEND_PX).any():
        return step, coarse
    half = _CELL_PX[1]
    return half, _coarse_map(transform, window=window, scale=scale, step=half, shape=shape, twice_as_large=coarse)


@lru_cache(maxsize=16)
def _checked_nodes(count: int) -> IntArray:
    """Some of all ``count`` nodes but the last; kept, as are the others, for the frames of a flight are alike."""
    return np.unique(np.linspace(0, count - 2, _CHECKS).round().astype(np.int64))


def _coarse_map(
    transform: RawToBase,
    *,
    window: Window,
    scale: float,
    step: int,
    shape: tuple[int, int],
    twice_as_large: FloatArray | None = None,
) -> FloatArray:
    """Raw coordinates (my, mx, 2) at the cell centres, with one more cell on each side; NaN where there is none.

    Where those of cells twice as large are given, it starts from them.
    """
    rows, columns = (-(-size // step) + 2 for size in shape)
    y = (np.arange(rows) - 1) * step + (step - 1) / 2
    x = (np.arange(columns) - 1) * step + (step - 1) / 2
    base_x, base_y = np.meshgrid(window[0] + (x + 0.5) / scale - 0.5, window[1] + (y + 0.5) / scale - 0.5)
    base = np.stack([base_x, base_y], axis=2)
    if twice_as_large is None:
        return invert_on_grid(transform, base)
    # centres of cells lie a quarter of those twice as large before or behind theirs
    places = (2.0 * np.arange(size) - 0.5 for size in twice_as_large.shape[:2])
    return _invert_between(transform, base, twice_as_large, *places)


def invert_on_grid(transform: RawToBase, base: FloatArray) -> FloatArray:
    """Raw coordinates at the nodes of a regular grid of base px, both (my, mx, 2); NaN where there is no inverse.

    Some nodes by `to_raw`. The others start from what is interpolated between those; the slope of that is the inverse's
    Jacobian, near enough for the error to fall by a factor of ten or more with every correction.
    """
    rows, columns = (np.unique(np.r_[np.arange(0, size, _SPARSE), size - 1]) for size in base.shape[:2])
    sparse_base = base[np.ix_(rows, columns)]
    sparse = transform.to_raw(sparse_base.reshape(-1, 2)).reshape(sparse_base.shape)
    return _invert_between(transform, base, sparse, rows, columns)


def _invert_between(
    transform: RawToBase, base: FloatArray, known: FloatArray, rows: NDArray[Any], columns: NDArray[Any]
) -> FloatArray:
    """As `invert_on_grid`, from raw coordinates (r, c, 2) known on another grid, at these rows and columns of nodes."""
    (above, down), (before, across) = _places(rows, base.shape[0]), _places(columns, base.shape[1])
    start = known[above] + down[:, None, None] * (known[above + 1] - known[above])
    start = start[:, before] + across[:, None] * (start[:, before + 1] - start[:, before])
    # Where no node around has an inverse, none between them is in the frame.
    lost = np.isfinite(known[..., 0])
    lost = lost[above] | lost[above + 1]
    lost = (lost[:, before] | lost[:, before + 1]).ravel()
    pitches = base[1, 0, 1] - base[0, 0, 1], base[0, 1, 0] - base[0, 0, 0]
    by_y, by_x = (slope.reshape(-1, 2) for slope in np.gradient(start, *pitches, axis=(0, 1)))
    raw, target = start.reshape(-1, 2), base.reshape(-1, 2)
    for _ in range(_CORRECTIONS):
        error = target - transform.to_base(raw)
        raw += by_x * error[:, :1] + by_y * error[:, 1:]
    lost &= ~(np.abs(error) < _MAX_ERROR_PX).all(axis=1)
    if lost.any():
        raw[lost] = transform.to_raw(target[lost])
    return np.asarray(raw.reshape(base.shape))


def _places(known: NDArray[Any], count: int) -> tuple[IntArray, FloatArray]:
    """Where ``count`` nodes lie between known places: the number of the one before each, and the fraction beyond it."""
    before = np.clip(np.searchsorted(known, np.arange(count), side="right") - 1, 0, len(known) - 2)
    return before, (np.arange(count) - known[before]) / (known[before + 1] - known[before])


def _downscale(
    grey_raw: GreyImage, coarse: FloatArray, shrink: float, *, by_whole: bool = False
) -> tuple[GreyImage, Float32Array]:
    """The raw frame, area-averaged if the map shrinks it to one in ``shrink`` px, and the map (float32) into it.

    By a whole factor, the next lower one, it costs a tenth and leaves some aliasing.
    """
    shrink = float(np.floor(shrink)) if by_whole and shrink >= 2 else shrink
    source = grey_raw
    if shrink >= _MIN_SHRINK:
        height, width = grey_raw.shape
        size = max(1, round(width / shrink)), max(1, round(height / shrink))
        source = np.asarray(cv2.resize(grey_raw, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        coarse = (coarse + 0.5) * np.array([size[0] / width, size[1] / height]) - 0.5
    return source, np.where(np.isfinite(coarse), coarse, _INVALID).astype(np.float32)


class Rectification:
    """A raw frame on a window of the base image's grid, resampled where it is asked for, by cells of `CELL_PX`.

    Outside the frame its border goes on. Cubic interpolation.

    Attributes
    ----------
    shape : (height, width) of the window, output px.
    image, valid : of that shape, uint8 and bool: the frame, and where it covers the grid. Zero and false in the cells
        that were not asked for yet.
    """

    def __init__(self, grey_raw: GreyImage, transform: RawToBase, *, window: Window, scale: float = 1.0) -> None:
        """Parameters as of `warp_to_base`."""
        self.shape = round(window[3] * scale), round(window[2] * scale)
        self._raw = grey_raw
        self._step, self._coarse = _interpolable_map(transform, window=window, scale=scale, shape=self.shape)
        self.image: GreyImage = np.zeros(self.shape, np.uint8)
        self.valid: Mask = np.zeros(self.shape, bool)
        self._done = np.zeros([-(-size // CELL_PX) for size in self.shape], bool)

    @cached_property
    def _raw_px_per_cell(self) -> float:
        return _raw_px_per_cell(self._coarse)

    @cached_property
    def _source(self) -> tuple[GreyImage, Float32Array]:
        source, coarse = _downscale(self._raw, self._coarse, self._raw_px_per_cell / self._step)
        return extend_border(source), coarse

    @property
    def half_image(self) -> GreyImage:
        """The whole frame at half the resolution, sizes rounded up."""
        return self._half[0]

    @property
    def half_valid(self) -> Mask:
        """Where it covers the grid."""
        return self._half[1]

    @cached_property
    def _half(self) -> tuple[GreyImage, Mask]:
        step = self._step // 2
        source, coarse = _downscale(self._raw, self._coarse, self._raw_px_per_cell / step, by_whole=True)
        cells = np.ones([-(-size // (2 * CELL_PX)) for size in self.shape], bool)
        size = -(-self.shape[0] // 2), -(-self.shape[1] // 2)
        image, valid = np.empty(size, np.uint8), np.empty(size, bool)
        resample_cells(extend_border(source), coarse, step, np.argwhere(cells), image, valid)
        return image, valid

    def resample_all(self) -> None:
        """Fill `image` and `valid` everywhere."""
        self.resample(np.ones(self._done.shape, bool))

    def resample(self, cells: Mask, side_px: int = CELL_PX) -> None:
        """Fill `image` and `valid` in the cells of `CELL_PX` in which those of a mask (rows, columns) lie,
        unless filled before; a whole number of ``side_px`` makes `CELL_PX`.
        """
        if side_px != CELL_PX:
            cells = _join_cells(cells, CELL_PX // side_px, self._done.shape)
        source, coarse = self._source
        resample_cells(source, coarse, self._step, np.argwhere(cells & ~self._done), self.image, self.valid)
        self._done |= cells


def _join_cells(cells: Mask, count: int, shape: tuple[int, ...]) -> Mask:
    """Cells (rows, columns) so many times as large, of a shape: those in which any of the given ones is marked."""
    rows, columns = shape
    padded = np.zeros((count * rows, count * columns), bool)
    padded[: cells.shape[0], : cells.shape[1]] = cells
    return np.asarray(padded.reshape(rows, count, columns, count).any(axis=(1, 3)))


def extend_border(source: GreyImage) -> GreyImage:
    """A source with `PAD_PX` more on every side."""
    extended = cv2.copyMakeBorder(source, PAD_PX, PAD_PX, PAD_PX, PAD_PX, cv2.BORDER_REPLICATE)
    return np.asarray(extended, np.uint8)


def resample_cells(
    extended: GreyImage, coarse: Float32Array, step: int, cells: IntArray, image: GreyImage, valid: Mask
) -> None:
    """Fill cells of `CELL_PX`, (n, 2) rows and columns, of an image (h, w) and of its mask, true inside the frame.

    ``extended`` is the source by `extend_border`, which goes on outside; ``coarse`` (my, mx, 2) is the position in the
    source itself at centres of cells of ``step`` px, with one more cell on each side.
    """
    resample_kernel(extended, as_words(extended), coarse, step, np.ascontiguousarray(cells), image, valid)


def _raw_px_per_cell(coarse: FloatArray) -> float:
    """Raw px along the side of a cell of the map (my, mx, 2), the median; NaN where there is no cell."""
    right, below = coarse[:-1, 1:] - coarse[:-1, :-1], coarse[1:, :-1] - coarse[:-1, :-1]
    areas = np.abs(right[..., 0] * below[..., 1] - right[..., 1] * below[..., 0])
    areas = areas[np.isfinite(areas)]
    return float(np.sqrt(np.median(areas))) if areas.size else np.nan


def footprint(transform: RawToBase, frame_shape: tuple[int, int]) -> tuple[float, float, float, float]:
    """Bounding box (x0, y0, x1, y1) of a raw frame of (height, width) on the base image, base px; NaN if the map has no
    finite value.
    """
    height, width = frame_shape
    x, y = np.linspace(0, width - 1, _BORDER_POINTS), np.linspace(0, height - 1, _BORDER_POINTS)
    edges = [
        (x, np.zeros_like(x)),
        (x, np.full_like(x, height - 1)),
        (np.zeros_like(y), y),
        (np.full_like(y, width - 1), y),
    ]
    base = transform.to_base(np.concatenate([np.stack(edge, axis=1) for edge in edges]))
    base = base[np.isfinite(base).all(axis=1)]
    if not len(base):
        return np.nan, np.nan, np.nan, np.nan
    (x0, y0), (x1, y1) = base.min(axis=0), base.max(axis=0)
    return float(x0), float(y0), float(x1), float(y1)
