"""Where two frames differ: by more than noise, illumination and the error of their registration.

The difference is averaged over about half a car, without its slow part (exposure, shadows of clouds), and compared by
cells of `CELL_PX`, all at half the resolution.
"""

import cv2
import numpy as np
from numba import njit

from schemas.arrays import Float32Array, Mask
from velfield.detection.frame import CELL_PX, SearchableFrame

_BOX_PX, _SLOW_PX = 8, 96
"""Sides of the boxes that the difference is averaged over: about half a car, and what counts as illumination."""
_BOX_AREA = (_BOX_PX // 2) ** 2
"""In pixels at half the resolution."""
_NOISE_SIGMAS, _CHANGE_LEVELS = 5.0, (3.0, 8.0)
"""A change is a mean difference above so many standard deviations of the noise, but at least and at most so many grey
levels: in a frame that changed everywhere the noise cannot be estimated. In a simulated city every vehicle that moved
by 4 px changed its place by more than 10."""
_SHIFT_PX = 0.3
"""Between two frames the map is wrong by about as much, working px, by rolling shutter and by the noise of its fit. At
every edge of a city that makes a change: without the allowance up to three quarters of a shaken frame were searched."""
_SAMPLE_PX = CELL_PX // 2
"""Distance of the pixels, at half the resolution, that noise is estimated from: one a cell."""


def changed_cells(frame: SearchableFrame, reference: SearchableFrame, slope: Float32Array | None = None) -> Mask:
    """Where two frames on one grid differ by more than noise, illumination and the error of their registration; where
    just one covers the grid as well.

    Parameters
    ----------
    slope
        `box_mean_slope` of the reference, where it is known already.

    Returns
    -------
    (rows, columns) bool, of cells of `CELL_PX`, the last of each row and column perhaps smaller.
    """
    if frame.image.shape != reference.image.shape:
        raise ValueError(f"found frames of {frame.image.shape} and {reference.image.shape} px, expected one grid")
    slope = box_mean_slope(reference) if slope is None else slope
    side = CELL_PX // 2
    rows, columns = (-(-size // side) for size in frame.half_valid.shape)
    sums, counts = np.zeros((rows, columns), np.float32), np.zeros((rows, columns), np.float32)
    one_only = np.zeros((rows, columns), bool)
    images, masks = (frame.half_image, reference.half_image), (frame.half_valid, reference.half_valid)
    difference = _difference_kernel(*images, *masks, sums, counts, one_only)
    boxes = _box_sums_kernel(difference)
    share = np.float32(1 / side**2)
    slow = _slow_part(sums * share, counts * share)
    sample = (slice(_SAMPLE_PX // 2, None, _SAMPLE_PX),) * 2
    at = boxes[sample] * np.float32(1 / _BOX_AREA)
    at = np.abs(at - slow[: at.shape[0], : at.shape[1]])[masks[0][sample] & masks[1][sample]]
    noise = 1.4826 * float(np.median(at)) if at.size else 0.0
    lowest, highest = _CHANGE_LEVELS
    limit = np.float32(min(max(_NOISE_SIGMAS * noise, lowest), highest))
    changed = _changed_kernel(boxes, slow, slope, *masks, limit, np.float32(_SHIFT_PX / 2))
    return np.asarray(changed | one_only)


def box_mean_slope(frame: SearchableFrame) -> Float32Array:
    """Steepness of a frame's mean over boxes of `_BOX_PX`, grey levels a pixel of half the resolution."""
    side = _BOX_PX // 2
    mean = cv2.boxFilter(frame.half_image, cv2.CV_32F, (side, side), borderType=cv2.BORDER_REPLICATE)
    along, across = (cv2.Sobel(mean, cv2.CV_32F, 1 - k, k, scale=1 / 8) for k in (0, 1))
    return np.asarray(cv2.magnitude(along, across), np.float32)


def _slow_part(difference: Float32Array, covered: Float32Array) -> Float32Array:
    """Mean difference about each cell, over `_SLOW_PX`, where both frames cover the grid, from the means of cells."""
    reach = _SLOW_PX // CELL_PX
    parts = [cv2.blur(mean, (reach, reach), borderType=cv2.BORDER_REPLICATE) for mean in (difference, covered)]
    return np.asarray(parts[0] / np.maximum(parts[1], 1e-3), np.float32)


@njit(cache=True, nogil=True)
def _difference_kernel(image, other, valid, other_valid, sums, counts, one_only):  # type: ignore[no-untyped-def]
    """Difference of two images (h, w) where both are valid, else 0; of each cell its sum, the number of such pixels,
    and whether there are some where just one is valid."""
    side = np.uint64(CELL_PX // 2)
    height, width = np.uint64(image.shape[0]), np.uint64(image.shape[1])
    out = np.empty(image.shape, np.int16)
    for y in range(height):
        for x in range(width):
            both = valid[y, x] & other_valid[y, x]
            out[y, x] = (np.int16(image[y, x]) - np.int16(other[y, x])) * both
        row = y // side
        for column in range(np.uint64(sums.shape[1])):
            total = number = unlike = np.int32(0)
            for x in range(column * side, min((column + np.uint64(1)) * side, width)):
                total = np.int32(total + out[y, x])
                number = np.int32(number + (valid[y, x] & other_valid[y, x]))
                unlike = np.int32(unlike + (valid[y, x] ^ other_valid[y, x]))
            sums[row, column] += np.float32(total)
            counts[row, column] += np.float32(number)
            one_only[row, column] |= unlike > 0
    return out


@njit(cache=True, nogil=True)
def _box_sums_kernel(difference):  # type: ignore[no-untyped-def]
    """Sums over boxes of `_BOX_PX` at half the resolution, from two pixels before each; beyond the edge it goes on."""
    height, width = difference.shape
    out = np.empty((height, width), np.int16)
    padded = np.empty(width + 3, np.int16)
    for y in range(height):
        a, b = difference[max(y - 2, 0)], difference[max(y - 1, 0)]
        c, d = difference[y], difference[min(y + 1, height - 1)]
        for x in range(np.uint64(width)):
            padded[x + np.uint64(2)] = a[x] + b[x] + c[x] + d[x]
        padded[:2], padded[width + 2] = padded[2], padded[width + 1]
        for x in range(np.uint64(width)):
            out[y, x] = padded[x] + padded[x + np.uint64(1)] + padded[x + np.uint64(2)] + padded[x + np.uint64(3)]
    return out


@njit(cache=True, nogil=True)
def _changed_kernel(boxes, slow, slope, valid, other_valid, limit, shift):  # type: ignore[no-untyped-def]
    """Cells that hold a pixel whose change exceeds the limit and what a shift by so many px would make."""
    side, scale = np.uint64(CELL_PX // 2), np.float32(1 / _BOX_AREA)
    out = np.zeros(slow.shape, np.bool_)
    height, width = np.uint64(valid.shape[0]), np.uint64(valid.shape[1])
    for y in range(height):
        row = y // side
        for column in range(np.uint64(slow.shape[1])):
            about, above = slow[row, column], np.int32(0)
            for x in range(column * side, min((column + np.uint64(1)) * side, width)):
                change = abs(np.float32(boxes[y, x]) * scale - about)
                exceeds = (change > limit + shift * slope[y, x]) & valid[y, x] & other_valid[y, x]
                above = np.int32(above + exceeds)
            out[row, column] |= above > 0
    return out


def any_in_cells(half: Mask) -> Mask:
    """Whether a mask at half the resolution holds anywhere in each cell."""
    side = CELL_PX // 2
    rows, columns = (-(-size // side) for size in half.shape)
    padded = np.zeros((rows * side, columns * side), bool)
    padded[: half.shape[0], : half.shape[1]] = half
    return np.asarray(padded.reshape(rows, side, columns, side).any(axis=(1, 3)))
