"""Rectification: a raw frame resampled once onto the base image's grid.

The inverse map, output pixels to raw pixels, is exact at the centres of cells of 16 px and interpolated bilinearly
between, or of 8 px where the map bends by more than a twentieth of a pixel in between (fast rolling shutter). Inverting
every pixel would cost a hundred times as much. At the centres it is inverted from every fourth of them on: what is
interpolated between those is wrong by less than a pixel, and two or three evaluations of the forward map correct it.

A frame is resampled whole (`warp_to_base`) or where it is asked for (`Rectification`).
"""

from functools import cached_property
from typing import Protocol

import cv2
import numpy as np
from numba import njit

from schemas.arrays import Float32Array, FloatArray, GreyImage, IntArray, Mask

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
_SPARSE, _CORRECTIONS, _MAX_ERROR_PX = 4, 8, 2e-3
"""Nodes whose inverse is computed from nothing: every fourth. At the others it starts from their interpolation, and is
corrected until it is this accurate, base px, at most so many times; nodes that are not by then start from nothing."""
CELL_PX = 16
"""Side of the cells in which `Rectification` resamples, output px."""
_CELLS_AT_ONCE = 2000
"""OpenCV's remap takes at most 32,767 columns."""
_FRACTION_BITS = 5
"""Of the fixed-point maps of OpenCV's remap: 1/32 px, to which it rounds maps of floats as well."""
_MARGIN_PX = 1024
"""Of the fixed-point maps about the frame: what lies farther outside is taken as if it were that far."""


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
    source, map_xy = _downscale(grey_raw, coarse, step=step)
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
    rows, columns = (np.unique(np.linspace(0, size - 2, _CHECKS).round().astype(np.int64)) for size in coarse.shape[:2])
    at = np.ix_(rows, columns)
    between = (coarse[at] + coarse[np.ix_(rows + 1, columns)] + coarse[np.ix_(rows, columns + 1)]) / 4
    between += coarse[np.ix_(rows + 1, columns + 1)] / 4
    x, y = (columns * step - 0.5) / scale, (rows * step - 0.5) / scale  # the corner that four cells share
    base_x, base_y = np.meshgrid(window[0] + (x + 0.5 / scale) - 0.5, window[1] + (y + 0.5 / scale) - 0.5)
    exact = transform.to_raw(np.stack([base_x.ravel(), base_y.ravel()], axis=1)).reshape(between.shape)
    if not (np.abs(between - exact)[np.isfinite(exact + between)] > _MAX_BEND_PX).any():
        return step, coarse
    return _CELL_PX[1], _coarse_map(transform, window=window, scale=scale, step=_CELL_PX[1], shape=shape)


def _coarse_map(transform: RawToBase, *, window: Window, scale: float, step: int, shape: tuple[int, int]) -> FloatArray:
    """Raw coordinates (my, mx, 2) at the cell centres, with one more cell on each side; NaN where there is none."""
    rows, columns = (-(-size // step) + 2 for size in shape)
    y = (np.arange(rows) - 1) * step + (step - 1) / 2
    x = (np.arange(columns) - 1) * step + (step - 1) / 2
    base_x, base_y = np.meshgrid(window[0] + (x + 0.5) / scale - 0.5, window[1] + (y + 0.5) / scale - 0.5)
    return invert_on_grid(transform, np.stack([base_x, base_y], axis=2))


def invert_on_grid(transform: RawToBase, base: FloatArray) -> FloatArray:
    """Raw coordinates at the nodes of a regular grid of base px, both (my, mx, 2); NaN where there is no inverse.

    Some nodes by `to_raw`. The others start from what is interpolated between those; the slope of that is the inverse's
    Jacobian, near enough for the error to fall by a factor of ten or more with every correction.
    """
    rows, columns = (_sparse_nodes(size) for size in base.shape[:2])
    sparse_base = base[np.ix_(rows, columns)]
    sparse = transform.to_raw(sparse_base.reshape(-1, 2)).reshape(sparse_base.shape)
    guess, slope_x, slope_y = _interpolate_grid(sparse, rows, columns)
    pitch_x, pitch_y = base[0, 1, 0] - base[0, 0, 0], base[1, 0, 1] - base[0, 0, 1]
    target = base.reshape(-1, 2)
    raw, slope_x, slope_y = guess.reshape(-1, 2), slope_x.reshape(-1, 2) / pitch_x, slope_y.reshape(-1, 2) / pitch_y
    near = np.flatnonzero(np.isfinite(raw + slope_x + slope_y).all(axis=1))
    outside, _, _ = _interpolate_grid(np.isnan(sparse).astype(np.float64), rows, columns)
    lost = outside.reshape(-1, 2)[:, 0] < 1  # where no node around has an inverse, none between them is in the frame
    for _ in range(_CORRECTIONS):
        error = target[near] - transform.to_base(raw[near])
        with np.errstate(invalid="ignore"):
            inaccurate = ~(np.maximum(np.abs(error[:, 0]), np.abs(error[:, 1])) < _MAX_ERROR_PX)
        raw[near] += slope_x[near] * error[:, :1] + slope_y[near] * error[:, 1:]
        lost[near[~inaccurate]] = False
        near = near[inaccurate]
        if not near.size:
            break
    at = np.flatnonzero(lost)
    if at.size:
        raw[at] = transform.to_raw(target[at])
    return raw.reshape(base.shape)


def _sparse_nodes(count: int) -> IntArray:
    """Every fourth of ``count`` nodes, and the last."""
    return np.unique(np.r_[np.arange(0, count, _SPARSE), count - 1])


def _interpolate_grid(
    values: FloatArray, rows: IntArray, columns: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Values (r, c, 2) at some rows and columns of a grid, interpolated at all of it; and the slopes, a node."""

    def along(values: FloatArray, nodes: IntArray) -> tuple[FloatArray, FloatArray]:
        if len(nodes) == 1:
            return values, np.zeros_like(values)
        at = np.arange(nodes[-1] + 1)
        left = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, len(nodes) - 2)
        width = (nodes[left + 1] - nodes[left]).astype(np.float64)
        slope = (values[left + 1] - values[left]) / width[:, None, None]
        return values[left] + slope * (at - nodes[left])[:, None, None], slope

    by_row, slope_y = along(values, rows)
    both, slope_x = along(by_row.transpose(1, 0, 2), columns)
    slope_y, _ = along(slope_y.transpose(1, 0, 2), columns)
    whole, slope_x, slope_y = (np.ascontiguousarray(part.transpose(1, 0, 2)) for part in (both, slope_x, slope_y))
    return whole, slope_x, slope_y


def _downscale(
    grey_raw: GreyImage, coarse: FloatArray, *, step: int, by_whole: bool = False
) -> tuple[GreyImage, Float32Array]:
    """The raw frame, area-averaged if the map shrinks it, and the map (float32) into it.

    By a whole factor, the next lower one, it costs a tenth and leaves some aliasing.
    """
    shrink = _raw_px_per_output_px(coarse, step)
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
    def _source(self) -> tuple[GreyImage, Float32Array]:
        return _downscale(self._raw, self._coarse, step=self._step)

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
        source, coarse = _downscale(self._raw, self._coarse, step=step, by_whole=True)
        cells = np.ones([-(-size // (2 * CELL_PX)) for size in self.shape], bool)
        size = -(-self.shape[0] // 2), -(-self.shape[1] // 2)
        image, valid = np.empty(size, np.uint8), np.empty(size, bool)
        _resample(source, coarse, step, cells, image, valid)
        return image, valid

    def resample(self, cells: Mask) -> None:
        """Fill the cells (rows, columns) of a mask in `image` and `valid`, where they are not filled yet."""
        source, coarse = self._source
        _resample(source, coarse, self._step, cells & ~self._done, self.image, self.valid)
        self._done |= cells


def _resample(source: GreyImage, coarse: Float32Array, step: int, cells: Mask, image: GreyImage, valid: Mask) -> None:
    """Fill cells of an image and of its mask."""
    chosen = np.argwhere(cells)
    for start in range(0, len(chosen), _CELLS_AT_ONCE):
        part = chosen[start : start + _CELLS_AT_ONCE]
        whole, fraction, inside = _fixed_point_map(coarse, step, part, source.shape[0], source.shape[1])
        pixels = cv2.remap(source, whole, fraction, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        _place_cells(pixels, inside, part, image, valid)


@njit(cache=True, nogil=True)
def _fixed_point_map(coarse, step, cells, height, width):  # type: ignore[no-untyped-def]
    """The map of some cells, side by side, in whole pixels and in fractions of them; and whether it is inside.

    ``coarse`` (my, mx, 2) is the map at centres of cells of ``step`` px, with one more cell on each side.
    """
    whole = np.empty((CELL_PX, len(cells) * CELL_PX, 2), np.int16)
    fraction = np.empty((CELL_PX, len(cells) * CELL_PX), np.uint16)
    inside = np.empty((CELL_PX, len(cells) * CELL_PX), np.bool_)
    unit, mask = np.float32(1 << _FRACTION_BITS), np.int32((1 << _FRACTION_BITS) - 1)
    # In units of the fraction, from a margin of so many pixels: all positive, so that truncation rounds down.
    margin = np.float32(_MARGIN_PX)
    last_x, last_y = np.float32(width + 2 * _MARGIN_PX) * unit, np.float32(height + 2 * _MARGIN_PX) * unit
    half, zero = np.float32(0.5), np.float32(0)
    first = (margin - half) * unit
    end_x, end_y = first + np.float32(width) * unit, first + np.float32(height) * unit
    nodes = CELL_PX // step + 2
    across = np.empty(CELL_PX, np.float32)
    run_ends = np.empty(nodes - 1, np.int64)  # runs of pixels between the same two centres: alike in all cells
    for j in range(CELL_PX):
        at = (j + 0.5) / step + 0.5
        across[j] = at - int(at)
        run_ends[int(at)] = j + 1
    x, y = np.empty(nodes, np.float32), np.empty(nodes, np.float32)
    for n in range(len(cells)):
        k0, m0 = cells[n, 0] * CELL_PX // step, cells[n, 1] * CELL_PX // step
        for i in range(CELL_PX):
            down, k = across[i], k0 + int((i + 0.5) / step + 0.5)
            for m in range(nodes):
                above, below = (
                    coarse[k, min(m0 + m, coarse.shape[1] - 1)],
                    coarse[k + 1, min(m0 + m, coarse.shape[1] - 1)],
                )
                x[m] = (above[0] + down * (below[0] - above[0]) + margin) * unit
                y[m] = (above[1] + down * (below[1] - above[1]) + margin) * unit
            for m in range(nodes - 1):
                dx, dy = x[m + 1] - x[m], y[m + 1] - y[m]
                start = np.uint64(run_ends[m - 1] if m else 0)
                for q in range(start, np.uint64(run_ends[m])):
                    at_cell = np.uint64(n * CELL_PX) + q
                    px, py = x[m] + across[q] * dx, y[m] + across[q] * dy
                    inside[i, at_cell] = (px >= first) & (px <= end_x) & (py >= first) & (py <= end_y)
                    fine_x = np.int32(min(max(px + half, zero), last_x))
                    fine_y = np.int32(min(max(py + half, zero), last_y))
                    whole[i, at_cell, 0] = (fine_x >> _FRACTION_BITS) - _MARGIN_PX
                    whole[i, at_cell, 1] = (fine_y >> _FRACTION_BITS) - _MARGIN_PX
                    fraction[i, at_cell] = ((fine_y & mask) << _FRACTION_BITS) + (fine_x & mask)
    return whole, fraction, inside


@njit(cache=True, nogil=True)
def _place_cells(pixels, inside, cells, image, valid):  # type: ignore[no-untyped-def]
    """Copy cells, side by side, to their places in an image and its mask; what lies beyond these is dropped."""
    for n in range(len(cells)):
        top, left = cells[n, 0] * CELL_PX, cells[n, 1] * CELL_PX
        for i in range(min(CELL_PX, image.shape[0] - top)):
            for j in range(min(CELL_PX, image.shape[1] - left)):
                image[top + i, left + j] = pixels[i, n * CELL_PX + j]
                valid[top + i, left + j] = inside[i, n * CELL_PX + j]


def _raw_px_per_output_px(coarse: FloatArray, step: int) -> float:
    along_x, along_y = np.diff(coarse, axis=1)[:-1], np.diff(coarse, axis=0)[:, :-1]
    area = np.abs(along_x[..., 0] * along_y[..., 1] - along_x[..., 1] * along_y[..., 0])
    finite = area[np.isfinite(area)]
    return float(np.sqrt(np.median(finite))) / step if finite.size else 1.0


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
