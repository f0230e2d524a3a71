"""Segments into one tile of the velocity histogram (paper: velocity model).

How a pixel is weighed. A segment touches the pixels whose centre lies within ``radius_px`` of its path, and it dwells
at such a pixel for as long as the vehicle's centre is within that radius: the chord of the path through the disc around
the pixel, in time. Everything follows from that one number:

- ``passage`` (the default): a passage adds exactly one unit at each pixel that it touches, shared among its segments
  by their dwell. So a pixel at the joint of two segments is not weighed twice, a slow vehicle weighs as much as a fast
  one, and ``histogram.sum((2, 3)) == count * UNIT`` everywhere;
- ``time``: each segment adds its dwell, ``UNIT`` a second: what a camera would see at a random moment;
- ``segment``: each segment adds one unit wherever it touches (the paper's, there with lines of one pixel).

All sums are of integers, made passage by passage: the result does not depend on the order or the cutting of the work,
and fields of whole passages add and subtract exactly.
"""

from math import erf, floor, sqrt
from typing import Literal, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from velfield.errors import InputError
from velfield.field.bins import VelocityBins
from velfield.field.segments import Segments

UNIT_BITS = 14
UNIT = 1 << UNIT_BITS
"""Fixed-point one. int32 then holds 131,071 passages (or 36 hours of standing) at a pixel."""

NOISE_UNIT = 1 << 12
"""Fixed-point one of a velocity's variance, bins^2 ..."""
MOST_NOISE_BINS2 = 4.0
"""... and the most that one passage counts for: int32 then holds as many passages as the histogram does."""

MICROSECONDS = 1_000_000

REACH_SIGMAS = 3.0
"""A blob reaches this far; the 0.3 % beyond fall to its outermost bins. Four would cost two thirds more updates."""

Weight = Literal["passage", "segment", "time"]
_WEIGHTS: dict[Weight, int] = {"passage": 0, "segment": 1, "time": 2}


class FieldTile(NamedTuple):
    """One tile of the field."""

    histogram: NDArray[np.int32]
    """(ty, tx, nvy, nvx) fixed-point weights, `UNIT` being one."""
    count: NDArray[np.int32]  # type: ignore[assignment]  # hides tuple.count, which nobody needs of a tile
    """(ty, tx) distinct passages."""
    dwell_ms: NDArray[np.int32]
    """(ty, tx) time that vehicles spent within the band's radius of the pixel, all together, ms."""
    noise: NDArray[np.int32]
    """(ty, tx) sum over passages of the variance of a velocity component by measurement, bins^2, `NOISE_UNIT` being
    one."""


def accumulate_tile(
    segments: Segments,
    *,
    origin_xy: tuple[int, int],
    shape: tuple[int, int],
    bins: VelocityBins,
    radius_px: float | None,
    weight: Weight = "passage",
) -> FieldTile:
    """The histogram of one tile.

    Parameters
    ----------
    segments
        Rows of a segment table, in its order; those that miss the tile cost little and change nothing.
    origin_xy
        Base pixel (x, y) of the tile's first pixel.
    shape
        (height, width) of the tile, px.
    radius_px
        Half the width of a segment's band, px; None: lines of one pixel, as in the paper.
    weight
        What a passage adds at a pixel; see the head of this file.

    Raises
    ------
    InputError
        Where a pixel's weight does not fit 32 bits.
    """
    histogram = np.zeros((*shape, bins.n, bins.n), np.int32)
    count, dwell_ms, noise = np.zeros((3, *shape), np.int32)
    weight_sum = np.zeros(shape, np.int64)
    path = np.column_stack([segments[name] for name in ("x0_px", "y0_px", "x1_px", "y1_px")]).astype(np.float64)
    path -= np.array([*origin_xy, *origin_xy], np.float64)
    velocity = np.column_stack([segments["vx_px_per_s"], segments["vy_px_per_s"]])
    _accumulate(
        path,
        bins.to_bins(velocity),
        (segments["sd_px_per_s"] / bins.width_px_per_s) ** 2,
        np.ascontiguousarray(segments["duration_s"]),
        np.ascontiguousarray(segments["passage"]),
        -1.0 if radius_px is None else float(radius_px),
        bins.kernel_sigma_px_per_s / bins.width_px_per_s,
        _WEIGHTS[weight],
        histogram,
        count,
        dwell_ms,
        noise,
        weight_sum,
    )
    if weight_sum.max(initial=0) > np.iinfo(np.int32).max:
        y, x = np.unravel_index(int(weight_sum.argmax()), shape)
        raise InputError(
            f"the histogram at pixel ({origin_xy[0] + int(x)}, {origin_xy[1] + int(y)}) sums to "
            f"{weight_sum.max() / UNIT:.0f}, and 32 bits hold {(1 << 31) / UNIT:.0f}: "
            "cut the flight into time intervals"
        )
    return FieldTile(histogram, count, dwell_ms, noise)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _bin_shares(position: float, sigma: float, n: int, shares: NDArray[np.float64]) -> tuple[int, int]:
    """Shares of a Gaussian (in bins) that fall into each bin, to three sigmas; returns the first bin and how many.

    The outermost bins take what lies beyond them. ``shares`` sums to one.
    """
    position = min(max(position, 0.0), n - 1.0)
    first = max(floor(position - REACH_SIGMAS * sigma + 0.5), 0)
    last = min(floor(position + REACH_SIGMAS * sigma + 0.5), n - 1)
    scale = 1.0 / (sigma * sqrt(2.0))
    below = 0.0
    for b in range(first, last + 1):
        above = 1.0 if b == last else 0.5 * (1.0 + erf((b + 0.5 - position) * scale))
        shares[b - first] = above - below
        below = above
    return first, last - first + 1


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _band_pixels(
    x0: float,
    y0: float,
    x1: float,
    y1: float,
    duration_s: float,
    radius: float,
    height: int,
    width: int,
    pixels: NDArray[np.int64],
    dwell_us: NDArray[np.int64],
) -> int:
    """Pixels (flat) of the tile within ``radius`` of the path, and the microseconds spent within ``radius`` of each."""
    dx, dy = x1 - x0, y1 - y0
    a = dx * dx + dy * dy
    found = 0
    for y in range(max(0, floor(min(y0, y1) - radius)), min(height - 1, floor(max(y0, y1) + radius)) + 1):
        for x in range(max(0, floor(min(x0, x1) - radius)), min(width - 1, floor(max(x0, x1) + radius)) + 1):
            px, py = x - x0, y - y0
            c = px * px + py * py - radius * radius
            if a < 1e-12:
                share = 1.0 if c < 0 else 0.0
            else:
                b = dx * px + dy * py
                discriminant = b * b - a * c
                if discriminant <= 0:
                    continue
                root = sqrt(discriminant)
                share = min((b + root) / a, 1.0) - max((b - root) / a, 0.0)
            microseconds = floor(share * duration_s * 1e6 + 0.5)
            if microseconds > 0:
                pixels[found] = y * width + x
                dwell_us[found] = microseconds
                found += 1
    return found


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _line_pixels(
    x0: float,
    y0: float,
    x1: float,
    y1: float,
    duration_s: float,
    height: int,
    width: int,
    pixels: NDArray[np.int64],
    dwell_us: NDArray[np.int64],
) -> int:
    """Pixels (flat) of the tile on a line of one pixel, each with an equal share of the time."""
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


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _add_blob(flat: NDArray[np.int32], place: int, weight: int, n: int, blob: NDArray[np.int32], peak: int) -> None:
    """Add ``weight`` spread by ``blob`` (which sums to `UNIT`); what rounding leaves goes to the blob's peak.

    ``place`` is where the blob's corner stands in the flat histogram: a view a pixel would cost more than the sums.
    """
    n_y, n_x = blob.shape
    if weight == UNIT:
        for j in range(n_y):
            for i in range(n_x):
                flat[place + j * n + i] += blob[j, i]
        return
    left = weight
    for j in range(n_y):
        for i in range(n_x):
            part = int((np.int64(blob[j, i]) * weight) >> UNIT_BITS)
            flat[place + j * n + i] += part
            left -= part
    flat[place + peak // n_x * n + peak % n_x] += left


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _unit_blob(shares_x: NDArray[np.float64], shares_y: NDArray[np.float64], blob: NDArray[np.int32]) -> int:
    """Fill ``blob`` with the shares' outer product in fixed point, `UNIT` in all; returns its peak (flat)."""
    left = UNIT
    for j in range(shares_y.size):
        for i in range(shares_x.size):
            blob[j, i] = floor(shares_y[j] * shares_x[i] * UNIT + 0.5)
            left -= blob[j, i]
    peak_y, peak_x = np.argmax(shares_y), np.argmax(shares_x)
    blob[peak_y, peak_x] += left
    return int(peak_y * shares_x.size + peak_x)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _accumulate(
    path: NDArray[np.float64],
    velocity: NDArray[np.float64],
    variance: NDArray[np.float64],
    duration_s: NDArray[np.float64],
    passage: NDArray[np.int64],
    radius: float,
    sigma: float,
    weight_kind: int,
    histogram: NDArray[np.int32],
    count: NDArray[np.int32],
    dwell_ms: NDArray[np.int32],
    noise: NDArray[np.int32],
    weight_sum: NDArray[np.int64],
) -> None:
    """Passage by passage: first the dwell of the whole passage at each pixel, then each segment's share of it."""
    height, width, n = histogram.shape[0], histogram.shape[1], histogram.shape[2]
    flat = histogram.reshape(-1)
    flat_count, flat_dwell, flat_sum = count.reshape(-1), dwell_ms.reshape(-1), weight_sum.reshape(-1)
    flat_noise = noise.reshape(-1)
    total, uncertain = np.zeros(height * width, np.int64), np.zeros(height * width)
    spent, given = np.zeros(height * width, np.int64), np.zeros(height * width, np.int64)
    pixels, dwell = np.empty(height * width, np.int64), np.empty(height * width, np.int64)
    touched = np.empty(height * width, np.int64)
    size = n if n < 2 * floor(REACH_SIGMAS * sigma) + 4 else 2 * floor(REACH_SIGMAS * sigma) + 4
    shares_x, shares_y, blobs = np.empty(size), np.empty(size), np.empty((size, size), np.int32)
    start = 0
    while start < path.shape[0]:
        stop = start
        n_touched = 0
        while stop < path.shape[0] and passage[stop] == passage[start]:
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
                uncertain[pixels[k]] += variance[stop] * dwell[k]
            stop += 1
        for s in range(start, stop):
            x0, y0, x1, y1 = path[s]
            if radius >= 0:
                found = _band_pixels(x0, y0, x1, y1, duration_s[s], radius, height, width, pixels, dwell)
            else:
                found = _line_pixels(x0, y0, x1, y1, duration_s[s], height, width, pixels, dwell)
            if found == 0:
                continue
            first_x, n_x = _bin_shares(velocity[s, 0], sigma, n, shares_x)
            first_y, n_y = _bin_shares(velocity[s, 1], sigma, n, shares_y)
            blob = blobs[:n_y, :n_x]
            corner = first_y * n + first_x
            peak = _unit_blob(shares_x[:n_x], shares_y[:n_y], blob)
            for k in range(found):
                p = pixels[k]
                weight = UNIT
                # Shares are differences of rounded running sums, so that a passage's add up to the bit.
                if weight_kind != 1 and (weight_kind == 2 or dwell[k] != total[p]):
                    spent[p] += dwell[k]
                    weight = UNIT * spent[p] // (total[p] if weight_kind == 0 else MICROSECONDS) - given[p]
                    given[p] += weight
                flat_sum[p] += weight
                _add_blob(flat, p * n * n + corner, weight, n, blob, peak)
        for k in range(n_touched):
            p = touched[k]
            flat_count[p] += 1
            flat_dwell[p] += (total[p] + 500) // 1000
            flat_noise[p] += floor(min(uncertain[p] / total[p], MOST_NOISE_BINS2) * NOISE_UNIT + 0.5)
            total[p], uncertain[p] = 0, 0.0
            spent[p] = 0
            given[p] = 0
        start = stop
