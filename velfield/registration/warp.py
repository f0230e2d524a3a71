"""Rectification: a raw frame resampled once onto the base image's grid.

The inverse map, output pixels to raw pixels, is exact at the centres of cells of 16 px and interpolated bilinearly
between, or of 8 px where the map bends by more than a twentieth of a pixel in between (fast rolling shutter). Inverting
every pixel would cost a hundred times as much. At the centres it is inverted from every fourth of them on: what is
interpolated between those is wrong by less than a pixel, and two or three evaluations of the forward map correct it.

A frame is resampled whole (`warp_to_base`) or where it is asked for (`Rectification`).
"""

from functools import cached_property, lru_cache
from typing import Protocol

import cv2
import numpy as np

from schemas.arrays import Float32Array, FloatArray, GreyImage, IntArray, Mask
from velfield.compiled import kernel
from velfield.registration.resampling.cells import CELL_PX, PAD_PX, resample_kernel

Window = tuple[int, int, int, int]
"""x, y, width, height in base px."""

_Places = tuple[IntArray, FloatArray, FloatArray]
"""Nodes along an axis: number of the known node before each, distance from it, and from it to the next, in nodes."""
_INVALID = -1e5
_MIN_SHRINK = 1.35
"""At this many raw pixels per output pixel or more the raw frame is area-averaged first; below, aliasing is slight."""
_BORDER_POINTS = 64
_CELL_PX = 16, 8
"""Sides of the cells that are tried, output px."""
_CHECKS, _MAX_BEND_PX = 24, 0.05
"""Rows and columns of places where interpolation is checked, and the error that is allowed there."""
_SPARSE, _CORRECTIONS, _MAX_ERROR_PX = 4, 8, 2e-3
"""Nodes whose inverse is computed from nothing: every fourth. At the others it starts from their interpolation, and is
corrected until it is this accurate, base px, at most so many times; nodes that are not by then start from nothing."""


class RawToBase(Protocol):
    """The map of a frame: `FrameTransform`, or a composition of it."""

    def to_base(self, xy_raw: FloatArray) -> FloatArray:
        """Raw pixels (n, 2) to base pixels (n, 2)."""
        ...

    def to_raw(self, xy_base: FloatArray) -> FloatArray:
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
    """Resample a raw frame onto a window of the base image's grid.

    Parameters
    ----------
    grey_raw
        (h, w) uint8 raw frame.
    window
        x, y, width, height of the output window, base px.
    scale
        Output px per base px. Output pixel (i, j) lies at base x = x0 + (j + 0.5) / scale - 0.5, y likewise.
    interpolation
        OpenCV's flag: linear by default, cubic for base images.
    replicate_border
        Replicate the frame's border outside the frame in place of zeros, so that no artificial edge appears there.

    Returns
    -------
    Image (round(h scale), round(w scale)) uint8, zero outside the frame unless ``replicate_border``, and mask, bool,
    true inside the frame.
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
    return _invert_between(transform, base, twice_as_large, _within_halved(rows), _within_halved(columns))


def _within_halved(count: int) -> _Places:
    """Places of ``count`` cells in cells twice as large: centres lie a quarter of those before or behind theirs."""
    before, odd = np.divmod(np.arange(count), 2)
    return before, np.where(odd, 1.5, 0.5), np.full(count, 2.0)


def invert_on_grid(transform: RawToBase, base: FloatArray) -> FloatArray:
    """Raw coordinates at the nodes of a regular grid of base px, both (my, mx, 2); NaN where there is no inverse.

    Some nodes by `to_raw`. The others start from what is interpolated between those; the slope of that is the inverse's
    Jacobian, near enough for the error to fall by a factor of ten or more with every correction.
    """
    (rows, in_rows), (columns, in_columns) = (_sparse_nodes(size) for size in base.shape[:2])
    sparse_base = base[np.ix_(rows, columns)]
    sparse = transform.to_raw(sparse_base.reshape(-1, 2)).reshape(sparse_base.shape)
    return _invert_between(transform, base, sparse, in_rows, in_columns)


def _invert_between(
    transform: RawToBase, base: FloatArray, known: FloatArray, in_rows: _Places, in_columns: _Places
) -> FloatArray:
    """As `invert_on_grid`, from raw coordinates (r, c, 2) known on another grid, and the nodes' places in it."""
    pitch_x, pitch_y = base[0, 1, 0] - base[0, 0, 0], base[1, 0, 1] - base[0, 0, 1]
    raw, slopes, near, lost = _starts(known, *in_rows, *in_columns, pitch_x, pitch_y)
    target = base.reshape(-1, 2)
    for _ in range(_CORRECTIONS):
        near = _correct(raw, slopes, near, target, transform.to_base(_take(raw, near)), lost)
        if not near.size:
            break
    at = np.flatnonzero(lost)
    if at.size:
        raw[at] = transform.to_raw(target[at])
    return np.asarray(raw.reshape(base.shape))


@lru_cache(maxsize=16)
def _sparse_nodes(count: int) -> tuple[IntArray, _Places]:
    """Every fourth of ``count`` nodes, and the last; and the places of all among them."""
    nodes = np.unique(np.r_[np.arange(0, count, _SPARSE), count - 1])
    if count == 1:
        return nodes, (np.zeros(1, np.int64), np.zeros(1), np.ones(1))
    at = np.arange(count)
    before = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, len(nodes) - 2)
    places = before, (at - nodes[before]).astype(np.float64), (nodes[before + 1] - nodes[before]).astype(np.float64)
    return nodes, places


@kernel
def _starts(  # type: ignore[no-untyped-def]
    sparse, above, down, height, before, across, width, pitch_x, pitch_y
) -> tuple[FloatArray, FloatArray, IntArray, Mask]:
    """Where the correction starts: nodes interpolated between the sparse ones (r, c, 2).

    Returns the nodes (n, 2), slopes in x and y (n, 2, 2), the numbers of nodes that can be corrected, and which may
    have an inverse (n,): where no node around has one, none between them is in the frame.
    """
    rows, columns = len(above), len(before)
    raw, slopes = np.empty((rows * columns, 2)), np.empty((rows * columns, 2, 2))
    near, count = np.empty(rows * columns, np.int64), 0
    lost = np.empty(rows * columns, np.bool_)
    left, slope_x, slope_y, twist = np.empty(2), np.empty(2), np.empty(2), np.empty(2)
    known = np.empty((2, 2), np.bool_)
    last_row, last_column = sparse.shape[0] - 1, sparse.shape[1] - 1
    for i in range(rows):
        k = above[i]
        below = min(k + 1, last_row)
        for j in range(columns):
            m, n = before[j], i * columns + j
            if j == 0 or m != before[j - 1]:  # the same for all nodes between two sparse ones
                after = min(m + 1, last_column)
                for c in range(2):
                    slope_y[c] = (sparse[below, m, c] - sparse[k, m, c]) / height[i]
                    slope_after = (sparse[below, after, c] - sparse[k, after, c]) / height[i]
                    left[c] = sparse[k, m, c] + slope_y[c] * down[i]
                    slope_x[c] = (sparse[k, after, c] + slope_after * down[i] - left[c]) / width[j]
                    twist[c] = (slope_after - slope_y[c]) / width[j]
                for side, column in enumerate((m, after)):
                    known[0, side] = down[i] < height[i] and not np.isnan(sparse[k, column, 0])
                    known[1, side] = down[i] > 0 and not np.isnan(sparse[below, column, 0])
            finite = True
            for c in range(2):
                raw[n, c] = left[c] + slope_x[c] * across[j]
                slopes[n, 0, c] = slope_x[c] / pitch_x
                slopes[n, 1, c] = (slope_y[c] + twist[c] * across[j]) / pitch_y
                finite &= np.isfinite(raw[n, c] + slopes[n, 0, c] + slopes[n, 1, c])
            if finite:
                near[count] = n
                count += 1
            lost[n] = (across[j] < width[j] and (known[0, 0] or known[1, 0])) or (
                across[j] > 0 and (known[0, 1] or known[1, 1])
            )
    return raw, slopes, near[:count], lost


@kernel
def _take(points: FloatArray, numbers: IntArray) -> FloatArray:
    """Some of the points (n, 2), in a quarter of numpy's time."""
    out = np.empty((len(numbers), 2))
    for k in range(len(numbers)):
        out[k, 0], out[k, 1] = points[numbers[k], 0], points[numbers[k], 1]
    return out


@kernel
def _correct(
    raw: FloatArray, slopes: FloatArray, near: IntArray, target: FloatArray, mapped: FloatArray, lost: Mask
) -> IntArray:
    """Correct nodes by what they are mapped to; the numbers of those that were not accurate. The others are not
    lost."""
    inaccurate, count = np.empty_like(near), 0
    for n in range(len(near)):
        at = near[n]
        error_x, error_y = target[at, 0] - mapped[n, 0], target[at, 1] - mapped[n, 1]
        for c in range(2):
            raw[at, c] += slopes[at, 0, c] * error_x + slopes[at, 1, c] * error_y
        if abs(error_x) < _MAX_ERROR_PX and abs(error_y) < _MAX_ERROR_PX:
            lost[at] = False
        else:
            inaccurate[count] = at
            count += 1
    return inaccurate[:count]


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
    return source, _fill_invalid(coarse)


@kernel
def _fill_invalid(coarse: FloatArray) -> Float32Array:
    """A map (my, mx, 2) as float32, `_INVALID` where it is not finite."""
    out = np.empty(coarse.shape, np.float32)
    for i in range(coarse.shape[0]):
        for j in range(coarse.shape[1]):
            for c in range(2):
                out[i, j, c] = coarse[i, j, c] if np.isfinite(coarse[i, j, c]) else _INVALID
    return out


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
        """Fill `image` and `valid` in the cells of `CELL_PX` in which those of a mask lie, unless filled before.

        Parameters
        ----------
        cells
            (rows, columns) of cells of ``side_px``, of which a whole number makes `CELL_PX`.
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
    """Fill cells of an image (h, w) and of its mask, which is true inside the frame; outside its border goes on.

    Parameters
    ----------
    extended
        The source by `extend_border`.
    coarse
        (my, mx, 2) position in the source itself at centres of cells of ``step`` px, with one more cell on each side.
    cells
        (n, 2) row and column of cells of `CELL_PX`.
    """
    resample_kernel(extended, coarse, step, cells, image, valid)


def _raw_px_per_cell(coarse: FloatArray) -> float:
    """Raw px along the side of a cell of the map (my, mx, 2), the median; NaN where there is no cell."""
    areas = _areas(coarse)
    return float(np.sqrt(np.median(areas))) if areas.size else np.nan


@kernel
def _areas(coarse: FloatArray) -> FloatArray:
    """Areas of the cells of a map (my, mx, 2), of those that have one."""
    rows, columns = coarse.shape[0] - 1, coarse.shape[1] - 1
    areas, count = np.empty(rows * columns), 0
    for i in range(rows):
        for j in range(columns):
            x, y = coarse[i, j]
            (right_x, right_y), (below_x, below_y) = coarse[i, j + 1], coarse[i + 1, j]
            area = abs((right_x - x) * (below_y - y) - (right_y - y) * (below_x - x))
            if np.isfinite(area):
                areas[count] = area
                count += 1
    return areas[:count]


def footprint(transform: RawToBase, frame_shape: tuple[int, int]) -> tuple[float, float, float, float]:
    """Bounding box (x0, y0, x1, y1) of a frame on the base image, base px; NaN if the map has no finite value.

    Parameters
    ----------
    frame_shape
        (height, width) of the raw frame.
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
