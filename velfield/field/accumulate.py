"""Accumulation of segments into one tile of the velocity histogram (paper: velocity model).

A segment touches the pixels whose centre lies within ``radius_px`` of its path; its dwell time at such a pixel is the
time that the vehicle's centre is within that radius, i.e. the chord of the path through the disc around the pixel, in
time. The weight that it adds there, spread over the velocity bins by a Gaussian kernel, is one of three:

- ``track`` (the default): a track adds exactly one unit at each pixel that it touches, divided among its segments in
  proportion to their dwell times. So a pixel where two segments meet does not count twice, a slow vehicle weighs as
  much as a fast one (time-mean statistics), and ``histogram.sum((2, 3)) == count * UNIT`` everywhere;
- ``time``: each segment adds its dwell time, ``UNIT`` a second (space-mean statistics: traffic at a random moment);
- ``segment``: each segment adds one unit at each pixel (the paper's, there with lines of one pixel).

All sums are of integers, track by track: the result does not depend on the order or the partition of the work, and
fields of whole tracks add and subtract exactly.
"""

from math import erf, floor, sqrt
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, IntArray
from velfield.compiled import kernel
from velfield.errors import InputError
from velfield.field.segments import Segments, VelocityBins

UNIT_BITS = 14
UNIT = 1 << UNIT_BITS
"""Fixed-point one. int32 then holds 131,071 tracks (or 36 hours of a stationary vehicle) at a pixel."""

VARIANCE_UNIT = 1 << 12
"""Fixed-point one of a velocity's variance, bins^2."""
MAX_VARIANCE_BINS2 = 4.0
"""Upper bound of the variance of one track: int32 then holds as many tracks as the histogram does."""

MICROSECONDS = 1_000_000

KERNEL_RADIUS_SIGMAS = 3.0
"""Truncation of the kernel; the 0.3 % beyond are added to its outermost bins. Four would cost two thirds more
updates."""

Weight = Literal["track", "segment", "time"]
_WEIGHTS: dict[Weight, int] = {"track": 0, "segment": 1, "time": 2}


class FieldTile(NamedTuple):
    """One tile of the field."""

    histogram: NDArray[np.int32]
    """(ty, tx, nvy, nvx) fixed-point weights, `UNIT` being one."""
    count: NDArray[np.int32]  # type: ignore[assignment]  # hides tuple.count, which nobody needs of a tile
    """(ty, tx) tracks."""
    occupancy_ms: NDArray[np.int32]
    """(ty, tx) sum of the dwell times of all vehicles, ms."""
    variance_sum: NDArray[np.int32]
    """(ty, tx) sum over tracks of the measurement variance of a velocity component, bins^2, `VARIANCE_UNIT` being
    one."""


def accumulate_tile(
    segments: Segments,
    *,
    origin_xy: tuple[int, int],
    shape: tuple[int, int],
    bins: VelocityBins,
    radius_px: float | None,
    weight: Weight = "track",
    zeros: NDArray[np.int32] | None = None,
) -> FieldTile:
    """The histogram of one tile.

    Parameters
    ----------
    segments
        Rows of a segment table, in its order; those outside the tile cost little and change nothing.
    origin_xy
        Base pixel (x, y) of the tile's first pixel.
    shape
        (height, width) of the tile, px.
    radius_px
        Half the width of a segment's band, px; None: lines of one pixel, as in the paper.
    weight
        Weight of a track at a pixel; see the head of this file.
    zeros
        (height, width, nvy, nvx) of zeros that becomes the histogram; None: allocated.

    Raises
    ------
    InputError
        A pixel's weight does not fit 32 bits.
    """
    histogram = np.zeros((*shape, bins.n, bins.n), np.int32) if zeros is None else zeros
    count, occupancy_ms, variance_sum = np.zeros((3, *shape), np.int32)
    weight_sum = np.zeros(shape, np.int64)
    path = np.column_stack([segments[name] for name in ("x0_px", "y0_px", "x1_px", "y1_px")]).astype(np.float64)
    path -= np.array([*origin_xy, *origin_xy], np.float64)
    velocity = np.column_stack([segments["vx_px_per_s"], segments["vy_px_per_s"]])
    _accumulate(
        path,
        bins.to_bins(velocity),
        (segments["sd_px_per_s"] / bins.width_px_per_s) ** 2,
        np.ascontiguousarray(segments["duration_s"]),
        np.ascontiguousarray(segments["track"]),
        -1.0 if radius_px is None else float(radius_px),
        bins.kernel_sigma_bins,
        _WEIGHTS[weight],
        histogram,
        count,
        occupancy_ms,
        variance_sum,
        weight_sum,
    )
    if weight_sum.max(initial=0) > np.iinfo(np.int32).max:
        y, x = np.unravel_index(int(weight_sum.argmax()), shape)
        raise InputError(
            f"the histogram at pixel ({origin_xy[0] + int(x)}, {origin_xy[1] + int(y)}) sums to "
            f"{weight_sum.max() / UNIT:.0f}, and 32 bits hold {(1 << 31) / UNIT:.0f}: "
            "cut the flight into time intervals"
        )
    return FieldTile(histogram, count, occupancy_ms, variance_sum)


@kernel
def _bin_fractions(position: float, sigma: float, n: int, fractions: FloatArray) -> tuple[int, int]:
    """Fractions of a Gaussian (in bins) in each bin, truncated at three sigmas; returns the first bin and their number.

    The outermost bins include the tails beyond them, so that ``fractions`` sums to one.
    """
    position = min(max(position, 0.0), n - 1.0)
    first = max(floor(position - KERNEL_RADIUS_SIGMAS * sigma + 0.5), 0)
    last = min(floor(position + KERNEL_RADIUS_SIGMAS * sigma + 0.5), n - 1)
    scale = 1.0 / (sigma * sqrt(2.0))
    below = 0.0
    for b in range(first, last + 1):
        above = 1.0 if b == last else 0.5 * (1.0 + erf((b + 0.5 - position) * scale))
        fractions[b - first] = above - below
        below = above
    return first, last - first + 1


@kernel
def _band_pixels(
    x0: float,
    y0: float,
    x1: float,
    y1: float,
    duration_s: float,
    radius: float,
    height: int,
    width: int,
    pixels: IntArray,
    dwell_us: IntArray,
) -> int:
    """Pixels (flat) of the tile within ``radius`` of the path, and the dwell time at each, microseconds."""
    dx, dy = x1 - x0, y1 - y0
    a = dx * dx + dy * dy
    found = 0
    for y in range(max(0, floor(min(y0, y1) - radius)), min(height - 1, floor(max(y0, y1) + radius)) + 1):
        for x in range(max(0, floor(min(x0, x1) - radius)), min(width - 1, floor(max(x0, x1) + radius)) + 1):
            px, py = x - x0, y - y0
            c = px * px + py * py - radius * radius
            if a < 1e-12:
                chord = 1.0 if c < 0 else 0.0
            else:
                b = dx * px + dy * py
                discriminant = b * b - a * c
                if discriminant <= 0:
                    continue
                root = sqrt(discriminant)
                chord = min((b + root) / a, 1.0) - max((b - root) / a, 0.0)
            microseconds = floor(chord * duration_s * 1e6 + 0.5)
            if microseconds > 0:
                pixels[found] = y * width + x
                dwell_us[found] = microseconds
                found += 1
    return found


@kernel
def _line_pixels(
    x0: float,
    y0: float,
    x1: float,
    y1: float,
    duration_s: float,
    height: int,
    width: int,
    pixels: IntArray,
    dwell_us: IntArray,
) -> int:
    """Pixels (flat) of the tile on a line of one pixel, with equal dwell times."""
    start_x, start_y = floor(x0 + 0.5), floor(y0 + 0.5)
    step_x, step_y = floor(x1 + 0.5) - start_x, floor(y1 + 0.5) - start_y
    steps = max(abs(step_x), abs(step_y))
    microseconds = max(1, floor(duration_s * 1e6 / (steps + 1) + 0.5))
    found = 0
    for i in range(steps + 1):
        x, y = start_x, start_y
        if steps > 0:
            x, y = floor(start_x + i * step_x / steps + 0.5), floor(start_y + i * step_y / steps + 0.5)
        if 0 <= x < width and 0 <= y < height and found < pixels.size:
            pixels[found] = y * width + x
            dwell_us[found] = microseconds
            found += 1
    return found


@kernel
def _add_kernel(
    flat: NDArray[np.int32], offset: int, weight: int, n: int, kernel: NDArray[np.int32], peak: int
) -> None:
    """Add ``weight`` times ``kernel`` (which sums to `UNIT`); the remainder of rounding is added at the kernel's peak.

    ``offset`` is the index of the kernel's corner in the flat histogram: a view a pixel would cost more than the sums.
    """
    n_y, n_x = kernel.shape
    if weight == UNIT:
        for j in range(n_y):
            for i in range(n_x):
                flat[offset + j * n + i] += kernel[j, i]
        return
    remainder = weight
    for j in range(n_y):
        for i in range(n_x):
            part = int((np.int64(kernel[j, i]) * weight) >> UNIT_BITS)
            flat[offset + j * n + i] += part
            remainder -= part
    flat[offset + peak // n_x * n + peak % n_x] += remainder


@kernel
def _unit_kernel(fractions_x: FloatArray, fractions_y: FloatArray, kernel: NDArray[np.int32]) -> int:
    """Fill ``kernel`` with the outer product of the fractions in fixed point, sum `UNIT`; returns its peak (flat)."""
    remainder = UNIT
    for j in range(fractions_y.size):
        for i in range(fractions_x.size):
            kernel[j, i] = floor(fractions_y[j] * fractions_x[i] * UNIT + 0.5)
            remainder -= kernel[j, i]
    peak_y, peak_x = np.argmax(fractions_y), np.argmax(fractions_x)
    kernel[peak_y, peak_x] += remainder
    return int(peak_y * fractions_x.size + peak_x)


@kernel
def _accumulate(
    path: FloatArray,
    velocity: FloatArray,
    variance: FloatArray,
    duration_s: FloatArray,
    track: IntArray,
    radius: float,
    sigma: float,
    weight_kind: int,
    histogram: NDArray[np.int32],
    count: NDArray[np.int32],
    occupancy_ms: NDArray[np.int32],
    variance_sum: NDArray[np.int32],
    weight_sum: IntArray,
) -> None:
    """Track by track: first the dwell time of the whole track at each pixel, then each segment's fraction of it."""
    height, width, n = histogram.shape[0], histogram.shape[1], histogram.shape[2]
    flat = histogram.reshape(-1)
    flat_count, flat_occupancy, flat_sum = count.reshape(-1), occupancy_ms.reshape(-1), weight_sum.reshape(-1)
    flat_variance = variance_sum.reshape(-1)
    total, weighted_variance = np.zeros(height * width, np.int64), np.zeros(height * width)
    dwell_so_far, weight_so_far = np.zeros(height * width, np.int64), np.zeros(height * width, np.int64)
    pixels, dwell = np.empty(height * width, np.int64), np.empty(height * width, np.int64)
    touched = np.empty(height * width, np.int64)
    size = n if n < 2 * floor(KERNEL_RADIUS_SIGMAS * sigma) + 4 else 2 * floor(KERNEL_RADIUS_SIGMAS * sigma) + 4
    fractions_x, fractions_y, kernels = np.empty(size), np.empty(size), np.empty((size, size), np.int32)
    start = 0
    while start < path.shape[0]:
        stop = start
        n_touched = 0
        while stop < path.shape[0] and track[stop] == track[start]:
            x0, y0, x1, y1 = path[stop]
            if radius >= 0:
                found = _band_pixels(x0, y0, x1, y1, duration_s[stop], radius, height, width, pixels, dwell)
            else:
                found = _line_pixels(x0, y0, x1, y1, duration_s[stop], height, width, pixels, dwell)
            for k in range(found):
                if total[pixels[k]] == 0:
                    touched[n_touched] = pixels[k]
                    n_touched += 1
                total[pixels[k]] += dwell[k]
                weighted_variance[pixels[k]] += variance[stop] * dwell[k]
            stop += 1
        for s in range(start, stop):
            x0, y0, x1, y1 = path[s]
            if radius >= 0:
                found = _band_pixels(x0, y0, x1, y1, duration_s[s], radius, height, width, pixels, dwell)
            else:
                found = _line_pixels(x0, y0, x1, y1, duration_s[s], height, width, pixels, dwell)
            if found == 0:
                continue
            first_x, n_x = _bin_fractions(velocity[s, 0], sigma, n, fractions_x)
            first_y, n_y = _bin_fractions(velocity[s, 1], sigma, n, fractions_y)
            kernel = kernels[:n_y, :n_x]
            corner = first_y * n + first_x
            peak = _unit_kernel(fractions_x[:n_x], fractions_y[:n_y], kernel)
            for k in range(found):
                p = pixels[k]
                weight = UNIT
                # Weights are differences of rounded running sums, so that those of a track add up exactly.
                if weight_kind != 1 and (weight_kind == 2 or dwell[k] != total[p]):
                    dwell_so_far[p] += dwell[k]
                    divisor = total[p] if weight_kind == 0 else MICROSECONDS
                    weight = UNIT * dwell_so_far[p] // divisor - weight_so_far[p]
                    weight_so_far[p] += weight
                flat_sum[p] += weight
                _add_kernel(flat, p * n * n + corner, weight, n, kernel, peak)
        for k in range(n_touched):
            p = touched[k]
            flat_count[p] += 1
            flat_occupancy[p] += (total[p] + 500) // 1000
            flat_variance[p] += floor(min(weighted_variance[p] / total[p], MAX_VARIANCE_BINS2) * VARIANCE_UNIT + 0.5)
            total[p], weighted_variance[p] = 0, 0.0
            dwell_so_far[p] = 0
            weight_so_far[p] = 0
        start = stop
