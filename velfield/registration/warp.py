"""Rectification: a raw frame resampled once onto the base image's grid.

The inverse map, output pixels to raw pixels, is exact at the centres of cells of 16 px and interpolated bilinearly
between, or of 8 px where the map bends by more than a twentieth of a pixel in between (fast rolling shutter). Inverting
every pixel would cost a hundred times as much.
"""

from typing import Protocol

import cv2
import numpy as np

from schemas.arrays import FloatArray, GreyImage, Mask

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
    raw = transform.to_raw(np.stack([base_x.ravel(), base_y.ravel()], axis=1))
    return raw.reshape(rows, columns, 2)


def _downscale(grey_raw: GreyImage, coarse: FloatArray, *, step: int) -> tuple[GreyImage, FloatArray]:
    """The raw frame, area-averaged if the map shrinks it, and the map (float32) into it."""
    shrink = _raw_px_per_output_px(coarse, step)
    source = grey_raw
    if shrink >= _MIN_SHRINK:
        height, width = grey_raw.shape
        size = max(1, round(width / shrink)), max(1, round(height / shrink))
        source = np.asarray(cv2.resize(grey_raw, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        coarse = (coarse + 0.5) * np.array([size[0] / width, size[1] / height]) - 0.5
    return source, np.where(np.isfinite(coarse), coarse, _INVALID).astype(np.float32)


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
