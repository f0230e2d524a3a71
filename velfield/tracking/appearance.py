"""Appearance difference of two detections: mean absolute difference of their oriented patches (paper: tracking), or
of upright crops.

A patch is sampled with the car's axis along its rows. An axis is known up to 180 degrees only, so a patch is compared
in both orientations; and a detection's position is accurate to about a pixel, so the patches are compared at small
shifts. The smallest difference is taken.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from schemas.arrays import ByteArray, FloatArray, IntArray, Mask

MAX_PATCH_SHIFT_PX = 2
"""Patches are compared at shifts of up to this, working px, either way and either axis."""
MAX_CROP_SHIFT_PX = 3
"""Crops are compared at shifts of up to this, working px, either way and either axis."""
CAR_LENGTH_PX = 16.0
CAR_WIDTH_PX = 8.0
"""Rectangle of a crop that is compared, about its centre along the car's axis, working px."""

_REACH = math.ceil(math.hypot(CAR_LENGTH_PX / 2, CAR_WIDTH_PX / 2))
"""No pixel farther from the centre than this lies on the car, working px."""


@dataclass(frozen=True)
class AppearanceFeatures:
    """Appearance of the detections of one frame: crops, otherwise patches, otherwise unknown."""

    patches: ByteArray | None
    crops: "PreparedCrops | None"


def appearance_differences(
    before: AppearanceFeatures, after: AppearanceFeatures, first: IntArray, second: IntArray
) -> FloatArray:
    """Appearance difference of pairs of detections, (k,) grey levels: of crops where both frames have them, otherwise
    of patches; NaN where neither."""
    if before.crops is not None and after.crops is not None:
        return crop_differences(before.crops, after.crops, first, second)
    if before.patches is not None and after.patches is not None:
        return patch_differences(before.patches, after.patches, first, second)
    return np.full(first.size, np.nan)


def patch_differences(
    before: ByteArray,
    after: ByteArray,
    first: IntArray,
    second: IntArray,
    *,
    max_shift_px: int = MAX_PATCH_SHIFT_PX,
) -> FloatArray:
    """Smallest mean absolute difference of pairs of oriented patches over small shifts and both orientations.

    Parameters
    ----------
    before, after
        (n, length, width) and (m, length, width) uint8, oriented patches of two frames.
    first, second
        (k,) index of each pair's patch in the first and the second frame.
    max_shift_px
        Largest shift; the patches are compared over the pixels that overlap at every shift.

    Returns
    -------
    (k,) float64, grey levels.
    """
    return np.asarray(_differences(before, after, first, second, max_shift_px), dtype=np.float64)


@njit(cache=True, nogil=True)
def _differences(before, after, first, second, shift):  # type: ignore[no-untyped-def]
    length, width = before.shape[1], before.shape[2]
    counted = (length - 2 * shift) * (width - 2 * shift)
    out = np.empty(first.size, np.float64)
    rotated = np.empty((length, width), np.uint8)
    for pair in range(first.size):
        p = before[first[pair]]
        q = after[second[pair]]
        for y in range(length):
            for x in range(width):
                rotated[y, x] = q[length - 1 - y, width - 1 - x]
        best = _min_absolute_sum(p, q, shift, counted * 256)
        out[pair] = _min_absolute_sum(p, rotated, shift, best) / counted
    return out


@njit(cache=True, nogil=True)
def _min_absolute_sum(p, q, shift, best):  # type: ignore[no-untyped-def]
    """Smallest sum of absolute differences over the shifts; a shift ends at the row where it exceeds ``best``."""
    length, width = p.shape
    for dy in range(-shift, shift + 1):
        for dx in range(-shift, shift + 1):
            total = np.int64(0)
            for y in range(shift, length - shift):
                row = np.int64(0)  # the difference of two uint8 would wrap
                for x in range(shift, width - shift):
                    row += abs(np.int64(p[y, x]) - np.int64(q[y + dy, x + dx]))
                total += row
                if total >= best:
                    break
            best = min(best, total)
    return best


@dataclass(frozen=True)
class PreparedCrops:
    """Upright crops of one frame's detections, prepared for comparison.

    Attributes
    ----------
    grey
        (n, side, side) uint8.
    low, high
        (n, side, side) uint8, minimum and maximum within half a pixel (by interpolation) of each pixel.
    car_mask
        (n, side, side) bool, pixels that lie on the car.
    """

    grey: ByteArray
    low: ByteArray
    high: ByteArray
    car_mask: Mask


def prepare_crops(crops: ByteArray, axis_rad: FloatArray) -> PreparedCrops:
    """Interpolated ranges and car masks of the crops of one frame.

    Parameters
    ----------
    crops
        (n, side, side) uint8, upright, centred on the cars.
    axis_rad
        (n,) axes; NaN: the mask is a disc.
    """
    low, high, car_mask = _prepare(crops, axis_rad)
    return PreparedCrops(crops, low, high, car_mask.astype(np.bool_))


def crop_differences(before: PreparedCrops, after: PreparedCrops, first: IntArray, second: IntArray) -> FloatArray:
    """Smallest mean sampling-insensitive difference (Birchfield and Tomasi, 1998) of pairs of crops over small shifts.

    Displacements are fractions of a pixel, and at a car's outline half a pixel changes the grey value more than two
    cars differ in paint. So the difference of two pixels is how far each lies outside the other's range within half a
    pixel, averaged where the masks of both cars overlap. On a simulated platoon of nearly identical cars its recall of
    tracklets is 98 %, that of patch differences 65 %.

    Parameters
    ----------
    before, after
        Crops of two frames.
    first, second
        (k,) index of each pair's crop in the first and the second frame.

    Returns
    -------
    (k,) float64, grey levels.
    """
    side = before.grey.shape[1]
    out = _crop_differences(*_flatten(before), *_flatten(after), _shifts_shortest_first(side), side, first, second)
    return np.asarray(out, dtype=np.float64)


def _flatten(prepared: PreparedCrops) -> tuple[NDArray[np.generic], ...]:
    """The crops as (n, side * side)."""
    crops = (prepared.grey, prepared.low, prepared.high, prepared.car_mask)
    side = prepared.grey.shape[1]
    return tuple(crop.reshape(len(crop), side * side) for crop in crops)


def _shifts_shortest_first(side: int) -> IntArray:
    """Flat offsets of all shifts, the shortest first."""
    steps = np.arange(-MAX_CROP_SHIFT_PX, MAX_CROP_SHIFT_PX + 1)
    dy, dx = (grid.ravel() for grid in np.meshgrid(steps, steps, indexing="ij"))
    order = np.argsort(dy**2 + dx**2, kind="stable")
    return np.asarray((dy * side + dx)[order], dtype=np.int64)


@njit(cache=True, nogil=True)
def _prepare(crops, axes):  # type: ignore[no-untyped-def]
    n, side = crops.shape[0], crops.shape[1]
    low, high = crops.copy(), crops.copy()
    mask = np.zeros(crops.shape, np.uint8)
    one = np.uint64(1)
    for k in range(n):
        cos, sin = np.cos(axes[k]), np.sin(axes[k])
        for y in range(1, side - 1):
            above, line, under = crops[k, y - 1], crops[k, y], crops[k, y + 1]
            low_line, high_line = low[k, y], high[k, y]
            for x in range(one, np.uint64(side - 1)):  # as unsigned, which makes vectors of it
                here, up, down = np.int32(line[x]), np.int32(above[x]), np.int32(under[x])
                left, right = np.int32(line[x - one]), np.int32(line[x + one])
                low_line[x] = (here + min(here, up, down, left, right)) >> 1
                high_line[x] = (here + max(here, up, down, left, right) + 1) >> 1
        for y in range(max(1, side // 2 - _REACH), min(side - 1, side // 2 + _REACH + 1)):
            for x in range(max(1, side // 2 - _REACH), min(side - 1, side // 2 + _REACH + 1)):
                dx, dy = x - side // 2, y - side // 2
                if np.isnan(axes[k]):
                    mask[k, y, x] = np.hypot(dx, dy) <= CAR_WIDTH_PX
                else:
                    along, across = abs(dx * cos + dy * sin), abs(dy * cos - dx * sin)
                    mask[k, y, x] = along <= 0.5 * CAR_LENGTH_PX and across <= 0.5 * CAR_WIDTH_PX
    return low, high, mask


@njit(cache=True, nogil=True)
def _outside(value, low, high):  # type: ignore[no-untyped-def]
    """How far a value lies outside a range of bytes."""
    return max(value - np.int64(high), np.int64(low) - value, np.int64(0))


@njit(cache=True, nogil=True)
def _crop_differences(p, p_low, p_high, p_mask, q, q_low, q_high, q_mask, shifts, side, first, second):  # type: ignore[no-untyped-def]
    """Crops are (n, side * side); ``shifts`` are flat offsets, the shortest first, so that most sums end early."""
    out = np.empty(first.size, np.float64)
    pixels = np.empty(side * side, np.int64)
    for pair in range(first.size):
        i, j = first[pair], second[pair]
        n = 0
        # Every second pixel in x and y is as accurate as all of them, in a quarter of the time.
        for y in range(MAX_CROP_SHIFT_PX, side - MAX_CROP_SHIFT_PX, 2):
            for x in range(MAX_CROP_SHIFT_PX, side - MAX_CROP_SHIFT_PX, 2):
                if p_mask[i, y * side + x]:
                    pixels[n] = y * side + x
                    n += 1
        best = 255.0
        for shift in shifts:
            total, counted = np.int64(0), 0
            limit = best * n
            for k in range(n):
                at, to = np.uint64(pixels[k]), np.uint64(pixels[k] + shift)  # unsigned: numba omits the wraparound test
                if not q_mask[j, to]:
                    continue
                here = _outside(np.int64(p[i, at]), q_low[j, to], q_high[j, to])
                there = _outside(np.int64(q[j, to]), p_low[i, at], p_high[i, at])
                total += max(here, there)
                counted += 1
                if total > limit:
                    break
            if 2 * counted >= n and counted and total < best * counted:
                best = total / counted
        out[pair] = best
    return out
