"""Sub-pixel displacement of a link: robust Lucas-Kanade alignment of the two upright crops of a car.

A detection's position is accurate to about a pixel, i.e. 4.7 km/h of a segment's speed at 0.23 m and 5 Hz; the
alignment of the two crops is far more accurate. The method, as tuned on real cars moved over their background:

- only pixels on the car in both crops have weight, without a margin: the background is stationary and biases the shift;
- background pixels that remain, and specular reflections, are outliers, downweighted by Tukey's biweight about the
  median difference;
- a blur of half a pixel: without it cubic interpolation of noise biases the shift towards whole pixels, with a larger
  one the background bleeds into the car;
- the initial value is the integer shift of minimum absolute difference, which is robust to reflections;
- the alignments forward and backward must agree (consistency check); their mean cancels the bias of either.

Root mean square error along an axis, 660 links of 110 cars 14-16 px long, noise of 3-5 grey levels: 0.04-0.07 px;
minimum sum of absolute differences 0.21, normalised cross-correlation 0.29-0.34, Lucas-Kanade with a margin and no
robust weights 0.17-0.19. A link that does not align keeps the displacement of the detections, with its standard
deviation.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import ByteArray, Float32Array, FloatArray, IntArray
from velfield.compiled import kernel

CAR_LENGTH_PX = 14.0
CAR_WIDTH_PX = 6.0
"""Rectangle that lies on a car, working px, of the paper's 16 x 8."""
TAPER_PX = 2.0
"""Width over which the weights fall to zero outside the rectangle, working px."""
BLUR_SIGMA_PX = 0.5
"""Standard deviation of the blur of both crops before alignment, working px."""
MAX_SHIFT_PX = 6
"""Largest shift searched, working px: about three standard deviations of the jitter of two positions."""
MAX_DISAGREEMENT_PX = 0.35
"""Largest difference of the forward shift and the backward one that starts from it, working px: two cars that do not
belong together pass as rarely as with 0.75 where both start from the whole-pixel shift, one and the same more often."""
MIN_SD_PX = 0.03
"""Lower bound of a shift's standard deviation, working px: the error on crops without noise."""
MIN_PIXELS = 20
"""With fewer pixels on the car in both crops there is no alignment."""
TUKEY_C = 4.685
"""Constant of Tukey's biweight: differences beyond this many standard deviations have no weight."""
MAX_ITERATIONS = 15
"""Gauss-Newton iterations; two or three are typical."""
REWEIGHTING_ITERATIONS = 4
"""Iterations in which the weights follow the shift; fixed afterwards, or they could alternate without convergence."""
CONVERGENCE_PX = 0.01
"""A step shorter than this ends the iterations."""

_TAPS = cv2.getGaussianKernel(2 * math.ceil(3 * BLUR_SIGMA_PX) + 1, BLUR_SIGMA_PX, cv2.CV_32F)
_SHIFTS = np.array(
    sorted(
        ((x, y) for y in range(-MAX_SHIFT_PX, MAX_SHIFT_PX + 1) for x in range(-MAX_SHIFT_PX, MAX_SHIFT_PX + 1)),
        key=lambda shift: (shift[0] ** 2 + shift[1] ** 2, shift[1], shift[0]),
    )
)
_INNER_SQUARE, _NEAR_SQUARE = 5, 10
"""Squares of lengths: where the best of the shifts up to the second is no longer than the first, those around it are
known to be worse, and none farther away is tried. Positions jitter by a pixel: of two minima the near one is right."""
_SPREAD, _PIECE = 5, 16
"""Pixels of the search come in so many passes over the car; after each piece of so many it may be given up."""
_REACH = math.ceil(math.hypot(CAR_LENGTH_PX / 2 + TAPER_PX, CAR_WIDTH_PX / 2 + TAPER_PX))
"""No pixel farther from the centre than this has weight, working px."""
_ROWS, _COLUMNS = 2 * _REACH + 1, 2 * (_REACH + 1)
"""The box about the centre that holds the car however it lies; its columns fill whole vectors of the processor."""
_MIDDLE = _REACH + 1 + MAX_SHIFT_PX + 2
_SIDE = 2 * _MIDDLE
"""Index of the centre, and side, of the images that hold the box at every shift, with the samples to interpolate."""
_LEFT = _MIDDLE - _REACH - 1
"""First column of the box in these."""
_RUN = 32
"""Values that are counted at a time."""
_BEYOND = 1e6
"""Difference of a pixel without weight, grey levels."""
_MEDIAN_STEPS = 13
"""Halvings of the range of grey levels for a median: to a sixteenth of one. It decides weights only."""
_NEAR_MEDIAN, _NEAR_STEPS = np.float32(8.0), 8
"""Most medians lie within this of zero, in a range that so many halvings lead to from the whole one."""


@dataclass(frozen=True)
class UprightCrops:
    """Upright crops of one frame's detections."""

    pixels: ByteArray
    """(n, side, side) uint8, working px."""
    centre_x_px: FloatArray
    centre_y_px: FloatArray
    """(n,) positions of the crops' centre pixel (side // 2), base px."""
    axis_rad: FloatArray
    """(n,) axis of each car."""
    scale: float
    """Working px a base px."""

    @cached_property
    def prepared(self) -> "AlignableCrops":
        """Data that every alignment of these crops needs, computed once: a crop is aligned to two frames."""
        return prepare_crops(self.pixels, self.axis_rad)


class AlignableCrops(NamedTuple):
    """Crops prepared for alignment, n of them: all that does not depend on the other crop."""

    grey: Float32Array
    """(n, side, side) float32, blurred grey levels."""
    weight: Float32Array
    """(n, 23, 24) float32, over the box that holds the car, with the crop's centre at (11, 12)."""
    pixels: NDArray[np.int16]
    """(n, 276) int16, flat index into a 40 x 40 image about the centre, at (20, 20), of every second pixel on the car,
    some from all over it first."""
    counts: IntArray
    """(n, 3) int64: number of ``pixels``; first row of the box in which a pixel has weight, and the row after the
    last."""


def refine_links(
    before: UprightCrops, after: UprightCrops, first: IntArray, second: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Displacement of each link from its two crops.

    Parameters
    ----------
    before, after
        Crops of the earlier and the later frame.
    first, second
        (k,) index of each link's detection in the earlier and the later frame.

    Returns
    -------
    (k,) each, base px: displacement in x and y, and its standard deviation along either axis; NaN where the crops do
    not align.
    """
    if before.scale != after.scale:
        # One detector, one working scale: another would change a car's size between the crops.
        raise ValueError(f"working scales {before.scale} and {after.scale} differ between linked frames")
    shift = align_prepared(before.prepared, after.prepared, first, second)
    return (
        after.centre_x_px[second] - before.centre_x_px[first] + shift[:, 0] / before.scale,
        after.centre_y_px[second] - before.centre_y_px[first] + shift[:, 1] / before.scale,
        shift[:, 2] / before.scale,
    )


def prepare_crops(crops: ByteArray, axis_rad: FloatArray) -> AlignableCrops:
    """Prepare crops (n, side, side), uint8, of cars of axes (n,) for alignment; NaN: the weights are a disc."""
    grey = np.empty(crops.shape, np.float32)
    for crop, out in zip(crops, grey, strict=True):
        cv2.sepFilter2D(crop, cv2.CV_32F, _TAPS, _TAPS, out, borderType=cv2.BORDER_REPLICATE)
    weight = _box_weights(axis_rad)
    # Pixels that have all neighbours, and lie no farther away on one side than on the other.
    half = crops.shape[1] // 2
    low, high = max(0, _REACH + 1 - half), min(_ROWS, crops.shape[1] - 1 - half + _REACH)
    weight[:, :low], weight[:, high:], weight[:, :, : low + 1], weight[:, :, high + 1 :] = 0.0, 0.0, 0.0, 0.0
    pixels, counts = _list_pixels(weight)
    return AlignableCrops(grey, weight, pixels, counts)


def _box_weights(axis_rad: FloatArray) -> Float32Array:
    """Weights (n, 23, 24): one on cars of these axes, tapering to zero around it; a disc where the axis is NaN."""
    y, x = np.ogrid[-_REACH : _ROWS - _REACH, -_REACH - 1 : _COLUMNS - _REACH - 1]
    y, x = y.astype(np.float32), x.astype(np.float32)
    cos, sin = (f(axis_rad).astype(np.float32)[:, None, None] for f in (np.cos, np.sin))
    beyond = np.maximum(abs(x * cos + y * sin) - 0.5 * CAR_LENGTH_PX, abs(y * cos - x * sin) - 0.5 * CAR_WIDTH_PX)
    beyond[np.isnan(axis_rad)] = np.hypot(x, y) - CAR_WIDTH_PX
    return np.asarray(np.clip(1.0 - beyond / TAPER_PX, 0.0, 1.0), np.float32)


def align_prepared(before: AlignableCrops, after: AlignableCrops, first: IntArray, second: IntArray) -> FloatArray:
    """(k, 3) shift of the car between pairs of crops in x and y, and its standard deviation, working px; otherwise as
    `refine_links`."""
    return np.asarray(_align_all(before, after, first, second, _SHIFTS), dtype=np.float64)


@kernel
def _list_pixels(weight: Float32Array) -> tuple[NDArray[np.int16], IntArray]:
    """The fields ``pixels`` and ``counts`` of `AlignableCrops`."""
    n = len(weight)
    pixels, counts = np.empty((n, _ROWS * _COLUMNS // 2), np.int16), np.zeros((n, 3), np.int64)
    on_car = np.empty(_ROWS * _COLUMNS, np.int16)
    for i in range(n):
        found, first, last = 0, _ROWS, 0
        for row in range(_ROWS):
            before = found
            for column in range(_COLUMNS):
                on_car[found] = (row + _MIDDLE - _REACH) * _SIDE + _LEFT + column
                found += weight[i, row, column] > 0
            if found > before:
                first, last = min(first, row), row + 1
        kept = 0
        for begin in range(0, 2 * _SPREAD, 2):  # some from all over the car first
            for k in range(begin, found, 2 * _SPREAD):
                pixels[i, kept] = on_car[k]
                kept += 1
        counts[i, 0], counts[i, 1], counts[i, 2] = kept, min(first, last), last
    return pixels, counts


@kernel
def _unfold(blurred: Float32Array, weight: Float32Array, unfolded: tuple[Float32Array, ...]) -> None:
    """Fill in a crop's images about its centre, (40, 40) each: grey levels and weights, 0 beyond the crop and the box;
    and over the box the slopes of the grey levels in x and in y, those without weight too."""
    grey, weights, slope_x, slope_y = unfolded
    side = blurred.shape[0]
    offset = _MIDDLE - side // 2  # of the crop in the images
    low, high = max(0, -offset), min(side, _SIDE - offset)
    for y in range(low, high):
        line, into = blurred[y, low:high], grey[y + offset, low + offset : high + offset]
        for x in range(np.uint64(high - low)):
            into[x] = line[x]
    half, two = np.float32(0.5), np.uint64(2)
    for row in range(_ROWS):
        y = _MIDDLE - _REACH + row
        line, into = weight[row], weights[y, _LEFT : _LEFT + _COLUMNS]
        for x in range(np.uint64(_COLUMNS)):
            into[x] = line[x]
        near, along = grey[y, _LEFT - 1 : _LEFT + _COLUMNS + 1], slope_x[row]
        for x in range(np.uint64(_COLUMNS)):
            along[x] = half * (near[x + two] - near[x])
        above, below = grey[y - 1, _LEFT : _LEFT + _COLUMNS], grey[y + 1, _LEFT : _LEFT + _COLUMNS]
        across = slope_y[row]
        for x in range(np.uint64(_COLUMNS)):
            across[x] = half * (below[x] - above[x])


@kernel
def _integer_shift(template, own_weight, pixels, image, image_weight, shifts) -> tuple[int, int]:  # type: ignore[no-untyped-def]
    """Integer shift of minimum mean absolute difference over the pixels on the car in both; over half of the pixels,
    which suffices here."""
    value_at, weight_at = template.ravel(), own_weight.ravel()
    grey, weight = image.ravel(), image_weight.ravel()
    count = pixels.size
    here, value, own = np.empty(count, np.int64), np.empty(count, np.float32), np.empty(count, np.float32)
    most = np.float32(0.0)
    for i in range(count):
        here[i] = pixels[i]
        value[i], own[i] = value_at[here[i]], weight_at[here[i]]
        most += own[i]
    best, best_x, best_y, min_weight = np.float32(np.inf), 0, 0, np.float32(0.25) * most
    # Shortest first, as the least is among those: whatever is worse than the best so far is soon given up.
    for k in range(shifts.shape[0]):
        dx, dy = shifts[k, 0], shifts[k, 1]
        if dx * dx + dy * dy > _NEAR_SQUARE and best_x * best_x + best_y * best_y <= _INNER_SQUARE:
            break
        shift, limit = dy * _SIDE + dx, most * best + np.float32(1e-3)
        total, weights = np.float32(0.0), np.float32(0.0)
        for begin in range(0, count, _PIECE):
            for i in range(begin, min(begin + _PIECE, count)):
                there = np.uint64(here[i] + shift)  # unsigned: numba checks no index for its sign
                w = min(own[i], weight[there])
                total += w * abs(grey[there] - value[i])
                weights += w
            if total > limit:
                break
        if total <= limit and weights > min_weight and total < best * weights:
            best, best_x, best_y = total / weights, dx, dy
    return best_x, best_y


@kernel
def _cubic(fraction: float) -> tuple[np.float32, ...]:
    """Weights of Catmull-Rom interpolation at a fraction in [0, 1) between the second and the third of four samples."""
    t = fraction
    return (
        np.float32(((-0.5 * t + 1.0) * t - 0.5) * t),
        np.float32((1.5 * t - 2.5) * t * t + 1.0),
        np.float32(((-1.5 * t + 2.0) * t + 0.5) * t),
        np.float32((0.5 * t - 0.5) * t * t),
    )


@kernel
def _differences(grey, own, image, image_weight, top, u, v, near, lines, difference, weight) -> int:  # type: ignore[no-untyped-def]
    """Fill in the differences of image and template (rows, columns) at this shift, and the weights of those pixels on
    the car in both; returns their number. A pixel without weight has the difference `_BEYOND`.

    The shift is the same for all pixels, so that the interpolation is separable; loops over whole rows of the box,
    which compilers turn into vector instructions, cost less than those over the car's pixels alone.
    """
    ix, iy = int(np.floor(u)), int(np.floor(v))
    a, b, c, d = _cubic(u - ix)
    rows, one, columns = difference.shape[0], np.uint64(1), np.uint64(_COLUMNS)
    for y in range(rows + 3):
        line, into = image[top + y + iy - 1, _LEFT + ix - 1 : _LEFT + ix + _COLUMNS + 2], lines[y]
        for x in range(columns):
            into[x] = a * line[x] + b * line[x + one] + c * line[x + one + one] + d * line[x + one + one + one]
    a, b, c, d = _cubic(v - iy)
    n = 0
    for y in range(rows):
        p, q, r, s = lines[y], lines[y + 1], lines[y + 2], lines[y + 3]
        values, here = grey[top + y, _LEFT : _LEFT + _COLUMNS], own[top + y, _LEFT : _LEFT + _COLUMNS]
        there = image_weight[top + y + near[1], _LEFT + near[0] : _LEFT + near[0] + _COLUMNS]
        out, kept = difference[y], weight[y]
        for x in range(columns):
            w = min(here[x], there[x])
            kept[x] = w
            out[x] = a * p[x] + b * q[x] + c * r[x] + d * s[x] - values[x] if w > 0 else np.float32(_BEYOND)
            n += w > 0
    return n


@kernel
def _count_below(values: Float32Array, limit: np.float32) -> np.int32:
    """Number of the values that lie below ``limit``."""
    count = np.int32(0)
    for k in range(np.uint64(values.size)):
        count += np.int32(values[k] < limit)
    return count


@kernel
def _median(values: Float32Array, low: np.float32, count: int) -> np.float32:
    """Median of ``count`` grey levels from ``low`` on, to a sixteenth of one; by halving the range, as counting takes
    vector instructions. Values above 256 do not count: so many of them follow that ``values`` are whole vectors."""
    high, steps, half = np.float32(256.0), _MEDIAN_STEPS, (count + 1) // 2
    near = max(low, -_NEAR_MEDIAN)
    if _count_below(values, near) < half <= _count_below(values, _NEAR_MEDIAN):
        low, high, steps = near, _NEAR_MEDIAN, _NEAR_STEPS
    for _ in range(steps):
        limit = np.float32(0.5) * (low + high)
        if _count_below(values, limit) < half:
            low = limit
        else:
            high = limit
    return np.float32(0.5) * (low + high)


@kernel
def _sum_columns(difference, weight, slope_x, slope_y, middle, scale, sums) -> None:  # type: ignore[no-untyped-def]
    """Sums for each column of what a step needs, ``sums`` (10, columns): of the weights, and by these of the slopes in
    x and in y, the differences, their squares, the squares and products of slopes, xx, xy and yy, and the products of
    either slope and the differences. These are less ``middle``, and their weights include Tukey's biweight.

    A sum for each column leaves no order of additions to the compiler.
    """
    sums[:] = 0.0
    s, sx, sy, sd, dd = sums[0], sums[1], sums[2], sums[3], sums[4]
    xx, xy, yy, xd, yd = sums[5], sums[6], sums[7], sums[8], sums[9]
    for row in range(weight.shape[0]):
        values, weights = difference[row * _COLUMNS : (row + 1) * _COLUMNS], weight[row]
        along, across = slope_x[row], slope_y[row]
        for k in range(np.uint64(_COLUMNS)):
            d, x, y = values[k] - middle, along[k], across[k]
            root = max(np.float32(1.0) - (d * scale) * (d * scale), np.float32(0.0))
            w = weights[k] * (root * root)
            wx, wy, wd = w * x, w * y, w * d
            s[k] += w
            sx[k] += wx
            sy[k] += wy
            sd[k] += wd
            dd[k] += wd * d
            xx[k] += wx * x
            xy[k] += wx * y
            yy[k] += wy * y
            xd[k] += wx * d
            yd[k] += wy * d


@kernel
def _step(difference, weight, slope_x, slope_y, count, sums) -> tuple[float, float, float]:  # type: ignore[no-untyped-def]
    """One robust Gauss-Newton step with the brightness offset eliminated: (step x, step y, variance); NaN where it is
    underdetermined.

    ``difference`` is flat, as `_median` takes it, ``weight`` and the slopes are (rows, columns); ``sums`` (10, columns)
    is scratch.
    """
    middle = _median(difference, np.float32(-256.0), count)
    distances = np.abs(difference - middle)
    spread = np.float32(1.4826) * _median(distances, np.float32(0.0), count) + np.float32(1.0)
    scale = np.float32(1.0) / (np.float32(TUKEY_C) * spread)
    _sum_columns(difference, weight, slope_x, slope_y, middle, scale, sums)
    s = sx = sy = sd = dd = xx = xy = yy = xd = yd = 0.0
    for x in range(np.uint64(_COLUMNS)):
        s += sums[0, x]
        sx += sums[1, x]
        sy += sums[2, x]
        sd += sums[3, x]
        dd += sums[4, x]
        xx += sums[5, x]
        xy += sums[6, x]
        yy += sums[7, x]
        xd += sums[8, x]
        yd += sums[9, x]
    if s <= 0.0:
        return np.nan, np.nan, np.nan
    xx, xy, yy = xx - sx * sx / s, xy - sx * sy / s, yy - sy * sy / s
    xd, yd = xd - sx * sd / s, yd - sy * sd / s
    determinant = xx * yy - xy * xy
    if determinant <= 1e-6 * (xx + yy) ** 2:
        return np.nan, np.nan, np.nan
    variance = (dd - sd * sd / s) / s * 0.5 * (xx + yy) / determinant
    return -(yy * xd - xy * yd) / determinant, -(xx * yd - xy * xd) / determinant, variance


@kernel
def _lucas_kanade(
    template: tuple[Float32Array, Float32Array, Float32Array, Float32Array, IntArray],
    image: tuple[Float32Array, Float32Array, Float32Array, Float32Array, IntArray],
    u: float,
    v: float,
    scratch: tuple[Float32Array, Float32Array, Float32Array, Float32Array],
) -> tuple[float, float, float]:
    """Shift of the template in the image, and its variance; NaN where it leaves the search range or does not
    converge. Each crop is (grey, weight, slopes in x and in y, counts), as in `AlignableCrops`; the scratch is that of
    `_align_all`."""
    grey, own_weight, slope_x, slope_y, counts = template
    first, last = counts[1], counts[2]
    rows, top = last - first, _MIDDLE - _REACH + first
    lines, values, weights, sums = scratch
    used, whole = rows * _COLUMNS, (rows * _COLUMNS + _RUN - 1) // _RUN * _RUN
    values[used:whole] = np.float32(_BEYOND)
    flat, difference, weight = values[:whole], values[:used].reshape(rows, _COLUMNS), weights[:rows]
    along, across = slope_x[first:last], slope_y[first:last]
    near = (0, 0)
    for count in range(MAX_ITERATIONS):
        if count < REWEIGHTING_ITERATIONS:
            near = (int(np.rint(u)), int(np.rint(v)))
        n = _differences(grey, own_weight, image[0], image[1], top, u, v, near, lines, difference, weight)
        if n < MIN_PIXELS:
            break
        du, dv, variance = _step(flat, weight, along, across, n, sums)
        if np.isnan(du):
            break
        length = np.hypot(du, dv)
        u += du / max(length, 1.0)
        v += dv / max(length, 1.0)
        if max(abs(u), abs(v)) > MAX_SHIFT_PX + 0.5:
            break
        if length < CONVERGENCE_PX:
            return u, v, variance
    return np.nan, np.nan, np.nan


@kernel
def _images() -> tuple[Float32Array, ...]:
    """Buffers that `_unfold` fills in."""
    return (
        np.zeros((_SIDE, _SIDE), np.float32),
        np.zeros((_SIDE, _SIDE), np.float32),
        np.empty((_ROWS, _COLUMNS), np.float32),
        np.empty((_ROWS, _COLUMNS), np.float32),
    )


@kernel
def _align_all(
    before: AlignableCrops, after: AlignableCrops, first: IntArray, second: IntArray, shifts: IntArray
) -> FloatArray:
    """`align_prepared`."""
    grey_a, weight_a, pixels_a, counts_a = before
    grey_b, weight_b, _, counts_b = after
    out = np.full((first.size, 3), np.nan)
    # Neighbouring residuals of a blurred image are correlated: the variance grows by the blur's footprint.
    correlated_pixels = 4 * np.pi * BLUR_SIGMA_PX**2
    lines, values = np.empty((_ROWS + 3, _COLUMNS), np.float32), np.empty(_ROWS * _COLUMNS + _RUN, np.float32)
    scratch = (lines, values, np.empty((_ROWS, _COLUMNS), np.float32), np.empty((10, _COLUMNS), np.float32))
    of_a, of_b = _images(), _images()
    for k in range(first.size):
        i, j = first[k], second[k]
        _unfold(grey_a[i], weight_a[i], of_a)
        _unfold(grey_b[j], weight_b[j], of_b)
        here, there = (*of_a, counts_a[i]), (*of_b, counts_b[j])
        x, y = _integer_shift(here[0], here[1], pixels_a[i, : counts_a[i, 0]], there[0], there[1], shifts)
        # Each way from where the other ended: half of the iterations of two that start from the whole-pixel shift.
        fx, fy, forward = _lucas_kanade(here, there, float(x), float(y), scratch)
        if np.isnan(fx):
            bx, by, backward = _lucas_kanade(there, here, -float(x), -float(y), scratch)
            if np.isnan(bx):
                continue
            fx, fy, forward = _lucas_kanade(here, there, -bx, -by, scratch)
        else:
            bx, by, backward = _lucas_kanade(there, here, -fx, -fy, scratch)
        disagreement = np.hypot(fx + bx, fy + by)
        if not disagreement <= MAX_DISAGREEMENT_PX:  # NaN too
            continue
        out[k, 0] = 0.5 * (fx - bx)
        out[k, 1] = 0.5 * (fy - by)
        out[k, 2] = np.sqrt(correlated_pixels * 0.5 * (forward + backward) + (0.5 * disagreement) ** 2 + MIN_SD_PX**2)
    return out
