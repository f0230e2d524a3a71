"""The peaks of a heatmap: sub-pixel positions, orientation vectors and probabilities of the candidates."""

import math

import cv2
import numpy as np
from numba import njit

from schemas.arrays import Float32Array, FloatArray, Mask

SMOOTHING_SIGMA = 0.8
"""Of the heatmap, in its pixels."""
_LEAST_PROBABILITY = 1e-6
_QUARTER_CAR_PX = 4.0


def find_peaks(
    probability: Float32Array, orientation: Float32Array, valid: Mask | None, *, stride: int, min_probability: float
) -> FloatArray:
    """Candidates (n, 5) of a heatmap, top to bottom: x, y in px of the image, orientation vector, probability.

    Parameters
    ----------
    probability, orientation
        (h, w) and (2, h, w), a pixel for every ``stride`` of the image.
    valid
        Of the image: where a peak counts; none: everywhere.
    min_probability
        After smoothing.
    """
    smooth = cv2.GaussianBlur(probability, (0, 0), SMOOTHING_SIGMA)
    everywhere = np.empty((0, 0), np.bool_) if valid is None else valid
    return np.asarray(_peaks_kernel(smooth, orientation, everywhere, stride, np.float32(min_probability)))


@njit(cache=True, nogil=True)
def _peaks_kernel(smooth, orientation, valid, stride, least):  # type: ignore[no-untyped-def]
    """A peak is no smaller than its eight neighbours. Its offset is that of a parabola through their logarithms."""
    height, width = smooth.shape
    masked = valid.size > 0
    count = 0
    for y in range(height):
        for x in range(width):
            count += smooth[y, x] > least
    out = np.empty((count, 5))
    n = 0
    for y in range(height):
        for x in range(width):
            value = smooth[y, x]
            if not value > least or (masked and not valid[y * stride, x * stride]):
                continue
            left, right, top, bottom = max(x - 1, 0), min(x + 1, width - 1), max(y - 1, 0), min(y + 1, height - 1)
            highest = True
            for v in range(top, bottom + 1):
                for u in range(left, right + 1):
                    highest = highest and value >= smooth[v, u]
            if not highest:
                continue
            out[n, 0] = (x + _offset(smooth[y, left], value, smooth[y, right])) * stride + (stride - 1) / 2
            out[n, 1] = (y + _offset(smooth[top, x], value, smooth[bottom, x])) * stride + (stride - 1) / 2
            out[n, 2], out[n, 3], out[n, 4] = orientation[0, y, x], orientation[1, y, x], value
            n += 1
    return out[:n]


@njit(cache=True, nogil=True)
def _offset(before, at, after):  # type: ignore[no-untyped-def]
    before, after = math.log(max(before, _LEAST_PROBABILITY)), math.log(max(after, _LEAST_PROBABILITY))
    bend = max(2 * math.log(max(at, _LEAST_PROBABILITY)) - before - after, 1e-6)
    return min(max((after - before) / (2 * bend), -0.5), 0.5)


def are_mostly_visible(cars: FloatArray, shape: tuple[int, ...], valid: Mask | None) -> Mask:
    """Whether three quarters of each car (n, 3...), x, y, axis, lie in an image of a shape, where it is ``valid``.

    The centre of a car that is truncated more is unreliable.
    """
    everywhere = np.empty((0, 0), np.bool_) if valid is None else valid
    return np.asarray(_visible_kernel(cars, shape[0], shape[1], everywhere))


@njit(cache=True, nogil=True)
def _visible_kernel(cars, height, width, valid):  # type: ignore[no-untyped-def]
    out = np.ones(len(cars), np.bool_)
    for n in range(len(cars)):
        for way in (-1.0, 1.0):
            x = cars[n, 0] + way * _QUARTER_CAR_PX * math.cos(cars[n, 2])
            y = cars[n, 1] + way * _QUARTER_CAR_PX * math.sin(cars[n, 2])
            near_x, near_y = int(min(max(np.rint(x), 0), width - 1)), int(min(max(np.rint(y), 0), height - 1))
            inside = abs(x - near_x) <= 0.5 and abs(y - near_y) <= 0.5
            out[n] &= inside and (valid.size == 0 or valid[near_y, near_x])
    return out
