"""Appearance difference of two detections: mean absolute difference of their oriented patches (paper: tracking), or
of upright crops.

A patch is sampled with the car's axis along its rows. An axis is known up to 180 degrees only, so a patch is compared
in both orientations; and a detection's position is accurate to about a pixel, so the patches are compared at small
shifts. The smallest difference is taken.
"""

import math
from dataclasses import dataclass
from itertools import product

import numpy as np

from schemas.arrays import ByteArray, FloatArray, IntArray, Mask
from velfield.compiled import kernel

MAX_PATCH_SHIFT_PX = 2
"""Patches are compared at shifts of up to this, working px, either way and either axis."""
MAX_CROP_SHIFT_PX = 3
"""Crops are compared at shifts of up to this, working px, either way and either axis."""
CAR_LENGTH_PX = 16.0
CAR_WIDTH_PX = 8.0
"""Rectangle of a crop that is compared, about its centre along the car's axis, working px."""

_REACH = math.ceil(math.hypot(CAR_LENGTH_PX / 2, CAR_WIDTH_PX / 2))
"""No pixel farther from the centre than this lies on the car, working px."""
_CHUNK = 64
"""Pixels of crops that are compared at a time."""
_HALF_SIDE, _PART = 16, 256
"""Side and size of a part of a crop."""


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
    length, width = before.shape[1] - 2 * max_shift_px, before.shape[2] - 2 * max_shift_px
    inner = before[first, max_shift_px:, max_shift_px:][:, :length, :width].astype(np.int16)
    other, best = after[second].astype(np.int16), np.full(first.size, 255 * length * width)
    for turned in (other, other[:, ::-1, ::-1]):
        for y, x in product(range(2 * max_shift_px + 1), repeat=2):
            difference = np.abs(inner - turned[:, y : y + length, x : x + width])
            best = np.minimum(best, difference.reshape(first.size, -1).sum(axis=1))
    return np.asarray(best / (length * width))


@dataclass(frozen=True)
class PreparedCrops:
    """Upright crops of one frame's detections, prepared for comparison."""

    parts: ByteArray
    """(n, 4, 4, 256) uint8: grey levels, minimum and maximum within half a pixel (by interpolation) of each pixel, and
    255 on the car; of each, the pixels of even rows and columns, of even rows and odd columns, and so on, 16 x 16 in
    the middle of the crop. At a shift, every second pixel of one crop meets neighbours of one part of the other."""
    spare: ByteArray
    """(n * 4096 + 128,) uint8, the same with 64 bytes before and after: those at its border are read, but not
    counted."""
    rows: IntArray
    """(n, 2) int64, first of the 16 odd rows with a pixel on the car, and the one after the last."""


def prepare_crops(crops: ByteArray, axis_rad: FloatArray) -> PreparedCrops:
    """Interpolated ranges and car masks of the crops of one frame.

    Parameters
    ----------
    crops
        (n, 32, 32) uint8, upright, centred on the cars.
    axis_rad
        (n,) axes; NaN: the mask is a disc.

    Raises
    ------
    ValueError
        The crops have another size.
    """
    if crops.shape[1:] != (2 * _HALF_SIDE, 2 * _HALF_SIDE):
        raise ValueError(f"crops of {crops.shape[1:]} px, expected {2 * _HALF_SIDE} x {2 * _HALF_SIDE}")
    low, high, middle = crops.copy(), crops.copy(), crops[:, 1:-1, 1:-1]
    near = [crops[:, 1 + y : 31 + y, 1 + x : 31 + x] for y, x in ((-1, 0), (1, 0), (0, -1), (0, 1))]
    below, above = middle - np.minimum.reduce([middle, *near]), np.maximum.reduce([middle, *near]) - middle
    low[:, 1:-1, 1:-1] -= below - below // 2  # half, rounded up: differences of uint8 do not overflow
    high[:, 1:-1, 1:-1] += above - above // 2
    on_car = _car_masks(axis_rad)
    spare = np.zeros(len(crops) * _PART * 16 + 2 * _CHUNK, np.uint8)
    parts = spare[_CHUNK:-_CHUNK].reshape(len(crops), 4, 2, 2, _HALF_SIDE, _HALF_SIDE)
    for k, one in enumerate((crops, low, high, np.where(on_car, np.uint8(255), np.uint8(0)))):
        parts[:, k] = one.reshape(-1, _HALF_SIDE, 2, _HALF_SIDE, 2).transpose(0, 2, 4, 1, 3)
    odd = np.asarray(on_car[:, 1::2].any(axis=2))
    rows = np.stack([odd.argmax(axis=1), _HALF_SIDE - odd[:, ::-1].argmax(axis=1)], axis=1)
    return PreparedCrops(parts.reshape(len(crops), 4, 4, _PART), spare, rows)


Appearance = PreparedCrops | ByteArray
"""Of the detections of one frame: their crops, or oriented patches (n, length, width) uint8."""


def appearance_differences(
    before: Appearance | None, after: Appearance | None, first: IntArray, second: IntArray
) -> FloatArray:
    """Appearance difference of pairs of detections, (k,) grey levels; NaN where one frame's appearance is unknown."""
    if isinstance(before, PreparedCrops) and isinstance(after, PreparedCrops):
        return crop_differences(before, after, first, second)
    if isinstance(before, np.ndarray) and isinstance(after, np.ndarray):
        return patch_differences(before, after, first, second)
    return np.full(first.size, np.nan)


def _car_masks(axis_rad: FloatArray) -> Mask:
    """Pixels (n, 32, 32) on cars of these axes in the middle of their crops; a disc where the axis is NaN."""
    y, x = np.ogrid[-_REACH : _REACH + 1, -_REACH : _REACH + 1]
    cos, sin = np.cos(axis_rad)[:, None, None], np.sin(axis_rad)[:, None, None]
    near = (np.abs(x * cos + y * sin) <= CAR_LENGTH_PX / 2) & (np.abs(y * cos - x * sin) <= CAR_WIDTH_PX / 2)
    near = np.where(np.isnan(axis_rad)[:, None, None], np.hypot(x, y) <= CAR_WIDTH_PX, near)
    on_car, box = np.zeros((len(axis_rad), 32, 32), bool), slice(_HALF_SIDE - _REACH, _HALF_SIDE + _REACH + 1)
    on_car[:, box, box] = near
    return on_car


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
    return np.asarray(
        _crop_differences(before.spare, before.rows, after.spare, _SHIFTS, first, second), dtype=np.float64
    )


def _shifts_shortest_first() -> IntArray:
    """Positions of this crop's odd rows and columns in the parts of the other, after a shift (y, x), shortest first."""
    steps = np.arange(-MAX_CROP_SHIFT_PX, MAX_CROP_SHIFT_PX + 1)
    dy, dx = (grid.ravel() for grid in np.meshgrid(steps, steps, indexing="ij"))
    order = np.argsort(dy**2 + dx**2, kind="stable")
    y, x = 1 + dy[order], 1 + dx[order]
    return np.asarray((2 * (y % 2) + x % 2) * _PART + (y // 2) * _HALF_SIDE + x // 2, dtype=np.int64)


_SHIFTS = _shifts_shortest_first()


@kernel
def _compare_chunk(before: ByteArray, at: np.uint64, after: ByteArray, to: np.uint64) -> int:
    """Sum of the differences of 64 pixels on both cars, and their number times 65536.

    ``before[at]`` and ``after[to]`` are grey levels, with the other parts of `PreparedCrops` at their distances.
    """
    part = np.uint64(4 * _PART)
    both = np.int32(0)
    for k in range(np.uint64(_CHUNK)):
        i, j = at + k, to + k
        grey, other = np.int32(before[i]), np.int32(after[j])
        above, below = grey - np.int32(after[j + part + part]), np.int32(after[j + part]) - grey
        its_above, its_below = other - np.int32(before[i + part + part]), np.int32(before[i + part]) - other
        on_both = np.int32(before[i + part + part + part] & after[j + part + part + part])
        outside = np.maximum(np.maximum(above, below), np.maximum(its_above, its_below))
        both += (np.maximum(outside, np.int32(0)) & on_both) + ((on_both & np.int32(1)) << np.int32(16))
    return int(both)


@kernel
def _crop_differences(
    before: ByteArray, rows: IntArray, after: ByteArray, shifts: IntArray, first: IntArray, second: IntArray
) -> FloatArray:
    """`crop_differences` of crops with 64 bytes about them; ``shifts`` are those of `_shifts_shortest_first`.

    Every second pixel in x and y is as accurate as all of them, in a quarter of the time.
    """
    out = np.empty(first.size, np.float64)
    size = np.uint64(16 * _PART)
    for pair in range(first.size):
        i, j = first[pair], second[pair]
        own, other = np.uint64(i) * size + np.uint64(_CHUNK), np.uint64(j) * size + np.uint64(_CHUNK)
        begin, end = np.uint64(rows[i, 0] * _HALF_SIDE), np.uint64(max(rows[i]) * _HALF_SIDE)
        n = 0
        for at in range(begin, end, np.uint64(_CHUNK)):
            n += _compare_chunk(before, own + at + np.uint64(3 * _PART), before, own + at + np.uint64(3 * _PART)) >> 16
        best = 255.0
        for shift in shifts:
            both = np.int32(0)
            for at in range(begin, end, np.uint64(_CHUNK)):
                both += _compare_chunk(
                    before, own + at + np.uint64(3 * _PART), after, np.uint64(np.int64(other + at) + shift)
                )
            total, counted = both & 65535, both >> 16
            if 2 * counted >= n and counted and total < best * counted:
                best = total / counted
        out[pair] = best
    return out
