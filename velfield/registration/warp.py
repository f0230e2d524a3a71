"""Frames on the base image's grid: one resampling from raw, by a map that is found coarsely and enlarged.

The map from working pixels to raw pixels is exact at the centres of cells of ``step`` px and bilinear between; an
inversion a pixel would cost some fifty times as much for a few hundredths of a pixel.
"""

from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray

Window = tuple[int, int, int, int]
"""x, y, width, height in base px."""

_NOWHERE = -1e5
_SHRINK = 1.35
"""From this many raw pixels a working pixel the raw frame is averaged over areas first; below, aliasing is slight."""
_BORDER_POINTS = 64


class RawToBase(Protocol):
    """The map of a frame: `FrameTransform`, or one composed of it."""

    def to_base(self, xy_raw: FloatArray) -> FloatArray:
        """Raw pixels (n, 2) to base pixels (n, 2)."""
        ...

    def to_raw(self, xy_base: FloatArray) -> FloatArray:
        """Base pixels (n, 2) to raw pixels (n, 2); NaN rows where there is no inverse."""
        ...


def warp_to_base(
    grey_raw: NDArray[np.uint8],
    transform: RawToBase,
    *,
    window: Window,
    scale: float = 1.0,
    step: int = 8,
    interpolation: int = cv2.INTER_LINEAR,
    continued: bool = False,
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """A raw frame on a window of the base image's grid.

    Parameters
    ----------
    grey_raw
        (h, w) uint8 raw frame.
    window
        x, y, width, height of the wanted window, base px.
    scale
        Working px a base px. Working pixel (i, j) lies at base x = x0 + (j + .5) / scale - .5, y alike.
    step
        Side of the cells at whose centres the map is exact, working px.
    interpolation
        OpenCV's: linear by default, cubic where the result is a base image or looked at closely.
    continued
        Outside the frame its edge goes on, rather than zeros: no edge where there is none.

    Returns
    -------
    Image (round(h scale), round(w scale)) uint8, zero outside the frame unless continued, and mask, bool, where it is
    not outside.
    """
    shape = round(window[3] * scale), round(window[2] * scale)
    coarse = _coarse_map(transform, window=window, scale=scale, step=step, shape=shape)
    source, map_xy = _reduced(grey_raw, coarse, step=step)
    dense = cv2.resize(map_xy, None, fx=step, fy=step, interpolation=cv2.INTER_LINEAR)
    dense = dense[step : step + shape[0], step : step + shape[1]]
    map_x, map_y = np.ascontiguousarray(dense[..., 0]), np.ascontiguousarray(dense[..., 1])
    image = cv2.remap(source, map_x, map_y, interpolation, borderMode=cv2.BORDER_REPLICATE)
    height, width = source.shape
    mask = (map_x >= -0.5) & (map_x <= width - 0.5) & (map_y >= -0.5) & (map_y <= height - 0.5)
    if not continued:
        image[~mask] = 0
    return np.asarray(image, dtype=np.uint8), np.asarray(mask)


def _coarse_map(transform: RawToBase, *, window: Window, scale: float, step: int, shape: tuple[int, int]) -> FloatArray:
    """Raw coordinates (my, mx, 2) at the centres of the cells, one cell more on each side; NaN where nowhere."""
    rows, columns = (-(-size // step) + 2 for size in shape)
    y = (np.arange(rows) - 1) * step + (step - 1) / 2
    x = (np.arange(columns) - 1) * step + (step - 1) / 2
    base_x, base_y = np.meshgrid(window[0] + (x + 0.5) / scale - 0.5, window[1] + (y + 0.5) / scale - 0.5)
    raw = transform.to_raw(np.stack([base_x.ravel(), base_y.ravel()], axis=1))
    return raw.reshape(rows, columns, 2)


def _reduced(grey_raw: NDArray[np.uint8], coarse: FloatArray, *, step: int) -> tuple[NDArray[np.uint8], FloatArray]:
    """The raw frame, averaged over areas where the map shrinks it, and the map (float32) into it."""
    shrink = _raw_pixels_a_working_pixel(coarse, step)
    source = grey_raw
    if shrink >= _SHRINK:
        height, width = grey_raw.shape
        size = max(1, round(width / shrink)), max(1, round(height / shrink))
        source = np.asarray(cv2.resize(grey_raw, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        coarse = (coarse + 0.5) * np.array([size[0] / width, size[1] / height]) - 0.5
    return source, np.where(np.isfinite(coarse), coarse, _NOWHERE).astype(np.float32)


def _raw_pixels_a_working_pixel(coarse: FloatArray, step: int) -> float:
    along_x, along_y = np.diff(coarse, axis=1)[:-1], np.diff(coarse, axis=0)[:, :-1]
    area = np.abs(along_x[..., 0] * along_y[..., 1] - along_x[..., 1] * along_y[..., 0])
    finite = area[np.isfinite(area)]
    return float(np.sqrt(np.median(finite))) / step if finite.size else 1.0


def footprint(transform: RawToBase, frame_shape: tuple[int, int]) -> tuple[float, float, float, float]:
    """Bounding box (x0, y0, x1, y1) of a frame on the base image, base px; NaN where the map has no value at all.

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
