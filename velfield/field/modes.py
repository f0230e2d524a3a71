"""Modes of the velocity distribution at a pixel, with sub-bin accuracy (paper: velocity field).

A mode is a local maximum of the histogram smoothed by a Gaussian kernel, found by mean shift from each bin that is a
local maximum. The bandwidth decreases with the number of tracks: the bins of few vehicles are sparse. Mean shift
assumes no shape of the peak and has no discretisation, where the bins of 2 m/s alone would quantise the direction to 10
degrees at 12 m/s.

The distribution of speed at a pixel, from its velocity histogram.
"""

from math import exp, floor, hypot, sqrt

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from velfield.compiled import kernel
from velfield.field.segments import VelocityBins

CELLS_PER_BIN = 8
"""Bins of the speed histogram (cells) a bin of velocity."""


@kernel
def max_cells(reach: int) -> int:
    """Number of cells for the speeds of a velocity histogram with ``reach`` bins on either side."""
    return int((floor(1.5 * reach) + 3) * CELLS_PER_BIN)


@kernel
def kernel_variance(sigma: float) -> float:
    """Variance that the histogram adds to a speed, bins^2: the kernel's, and twice that of a bin's width (once when
    bins are filled, once when they are spread over cells)."""
    return sigma * sigma + 2.0 / 12.0


Box = tuple[int, int, int, int]
"""First row, row after the last, first column and column after the last of some bins."""


@kernel
def occupied_box(h: NDArray[np.int32]) -> Box:
    """Where the bins are that are not zero; zeros where all are.

    A vehicle fills some ten of the thousand bins, and each statistic would look at all of them.
    """
    top, bottom = h.shape[0], 0
    for y in range(h.shape[0]):
        any_bit = 0
        for x in range(h.shape[1]):  # without a branch, so that several bins are compared at once
            any_bit |= h[y, x]
        if any_bit != 0:
            top, bottom = min(top, y), y + 1
    if bottom == 0:
        return 0, 0, 0, 0
    left, right = h.shape[1], 0
    for y in range(top, bottom):
        x = 0
        while x < left and h[y, x] == 0:
            x += 1
        left = x
        x = h.shape[1]
        while x > right and h[y, x - 1] == 0:
            x -= 1
        right = x
    return top, bottom, left, right


@kernel
def speed_cells(h: NDArray[np.int32], box: Box, cells: FloatArray) -> float:
    """Fill ``cells`` with the histogram of speed, each bin spread uniformly over one bin's width of speed; returns the
    sum. ``box``: the histogram's `occupied_box`."""
    cells[:] = 0.0
    total = 0.0
    reach, half = (h.shape[0] - 1) // 2, CELLS_PER_BIN // 2
    top, bottom, left, right = box
    for y in range(top, bottom):
        for x in range(left, right):
            if h[y, x] <= 0:
                continue
            weight = float(h[y, x])
            total += weight
            low = hypot(float(y - reach), float(x - reach)) * CELLS_PER_BIN - half
            if low < 0.0:  # the central bin: speeds are not negative
                for c in range(half):
                    cells[c] += weight / half
                continue
            first = floor(low)
            part = low - first
            for c in range(CELLS_PER_BIN):
                cells[first + c] += weight * (1.0 - part) / CELLS_PER_BIN
                cells[first + c + 1] += weight * part / CELLS_PER_BIN
    return total


@kernel
def quantile(cells: FloatArray, total: float, probability: float) -> float:
    """Quantile of the speed, bins; linear within a cell."""
    target = min(max(probability, 0.0), 1.0) * total
    below = 0.0
    for c in range(cells.size):
        if cells[c] > 0.0:  # most are empty: only the sums of the others wait for one another
            if below + cells[c] >= target:
                return float((c + max(target - below, 0.0) / cells[c]) / CELLS_PER_BIN)
            below += cells[c]
    return cells.size / CELLS_PER_BIN


@kernel
def speed_variance(cells: FloatArray, total: float) -> float:
    """Variance of the speed, bins^2, broadened by the kernel and the bins."""
    mean, square = 0.0, 0.0
    for c in range(cells.size):
        if cells[c] > 0.0:
            speed = (c + 0.5) / CELLS_PER_BIN
            mean += cells[c] * speed
            square += cells[c] * speed * speed
    return square / total - (mean / total) ** 2


@kernel
def deconvolution_factor(variance: float, blur: float) -> float:
    """Standard deviation of the speed without the kernel's variance ``blur`` over that with it: the factor by which
    quantiles move towards the median."""
    return sqrt(max(variance - blur, 0.0) / variance)


BANDWIDTH_BINS = 2.0
"""Standard deviation of the kernel for one track, bins; for n it is n^(-1/6) times that (Scott's rule in 2-D)."""
MIN_BANDWIDTH_BINS = 1.0
"""Lower bound of the bandwidth, bins."""
MAX_MODES = 4
"""Modes kept a pixel, those of the largest weight."""
_ITERATIONS = 60
_CONVERGENCE_BINS = 1e-3
_SAME_MODE_BINS = 1.0
"""Modes nearer to each other than this are one, bins."""


@kernel
def _smooth(h: NDArray[np.int32], y: int, x: int) -> np.int64:
    """The histogram at a bin smoothed by a binomial 3x3 kernel, so that a peak spread over two bins is one maximum."""
    total = np.int64(0)
    for j in range(max(y - 1, 0), min(y + 2, h.shape[0])):
        for i in range(max(x - 1, 0), min(x + 2, h.shape[1])):
            total += np.int64(h[j, i]) * (2 - abs(j - y)) * (2 - abs(i - x))
    return total


@kernel
def bandwidth_bins(tracks: int) -> float:
    """Bandwidth for a number of tracks, bins."""
    return max(float(BANDWIDTH_BINS * max(tracks, 1) ** (-1.0 / 6.0)), MIN_BANDWIDTH_BINS)


@kernel
def _mean_shift(h: NDArray[np.int32], box: Box, y: float, x: float, window: float) -> tuple[float, float]:
    """Mean shift from (y, x), bins, to a maximum of the smoothed histogram."""
    n = h.shape[0]
    reach = 3.0 * window
    top, bottom, left, right = box
    kernel_x = np.empty(n)
    for _ in range(_ITERATIONS):
        total, sum_y, sum_x = 0.0, 0.0, 0.0
        first, last = max(left, floor(x - reach + 0.5)), min(right - 1, floor(x + reach + 0.5))
        for i in range(first, last + 1):
            kernel_x[i] = exp(-0.5 * (i - x) ** 2 / (window * window))
        for j in range(max(top, floor(y - reach + 0.5)), min(bottom - 1, floor(y + reach + 0.5)) + 1):
            row, row_x = 0.0, 0.0
            for i in range(first, last + 1):
                w = h[j, i] * kernel_x[i]
                row += w
                row_x += w * i
            if row > 0.0:
                kernel_y = exp(-0.5 * (j - y) ** 2 / (window * window))
                total += kernel_y * row
                sum_y += kernel_y * row * j
                sum_x += kernel_y * row_x
        if total <= 0.0:
            break
        step_y, step_x = sum_y / total - y, sum_x / total - x
        y += step_y
        x += step_x
        if abs(step_y) + abs(step_x) < _CONVERGENCE_BINS:
            break
    return y, x


@kernel
def main_mode(h: NDArray[np.int32], box: Box, window: float) -> tuple[float, float]:
    """(y, x) in bins of the highest mode of a histogram that is not empty. Equal peaks: the first in raster order."""
    best, best_y, best_x = np.int64(-1), 0, 0
    top, bottom, left, right = box
    for y in range(top, bottom):
        for x in range(left, right):
            if h[y, x] > 0:
                value = _smooth(h, y, x)
                if value > best:
                    best, best_y, best_x = value, y, x
    y_mode, x_mode = _mean_shift(h, box, float(best_y), float(best_x), window)
    return y_mode, x_mode


@kernel
def _is_peak(h: NDArray[np.int32], y: int, x: int) -> bool:
    here = _smooth(h, y, x)
    if here <= 0:
        return False
    for j in range(max(y - 1, 0), min(y + 2, h.shape[0])):
        for i in range(max(x - 1, 0), min(x + 2, h.shape[1])):
            if (j, i) == (y, x):
                continue
            there = _smooth(h, j, i)
            # Of equal neighbours the first in raster order is the maximum.
            if there > here or (there == here and (j, i) < (y, x)):
                return False
    return True


@kernel
def pixel_modes(h: NDArray[np.int32], window: float, modes: NDArray[np.float64]) -> int:
    """Fill ``modes`` (k, 3) with (y, x, weight) in bins, the largest weight first; returns their number.

    Each bin's weight is assigned to the nearest mode, so that the weights of all modes sum to one. The highest bin of
    the smoothed histogram may itself be empty, where vehicles went a little faster or slower.
    """
    found = np.empty((64, 3), np.float64)
    n_found = 0
    box = top, bottom, left, right = occupied_box(h)
    for y in range(top, bottom):
        for x in range(left, right):
            if n_found < found.shape[0] and _is_peak(h, y, x):
                mode_y, mode_x = _mean_shift(h, box, float(y), float(x), window)
                known = False
                for k in range(n_found):
                    if (found[k, 0] - mode_y) ** 2 + (found[k, 1] - mode_x) ** 2 < _SAME_MODE_BINS**2:
                        known = True
                if not known:
                    found[n_found, 0], found[n_found, 1], found[n_found, 2] = mode_y, mode_x, 0.0
                    n_found += 1
    total = 0.0
    for y in range(top, bottom):
        for x in range(left, right):
            if h[y, x] > 0:
                nearest = 0
                min_distance = np.inf
                for k in range(n_found):
                    distance = (found[k, 0] - y) ** 2 + (found[k, 1] - x) ** 2
                    if distance < min_distance:
                        min_distance, nearest = distance, k
                found[nearest, 2] += h[y, x]
                total += h[y, x]
    order = np.argsort(-found[:n_found, 2], kind="mergesort")
    kept = min(n_found, modes.shape[0])
    for k in range(kept):
        y, x, weight = found[order[k]]
        modes[k, 0], modes[k, 1], modes[k, 2] = y, x, weight / total
    return int(kept)


@kernel
def _modal_tile(histogram: NDArray[np.int32], count: NDArray[np.int32], out: NDArray[np.float64]) -> None:
    for y in range(count.shape[0]):
        for x in range(count.shape[1]):
            if count[y, x] > 0:
                h = histogram[y, x]
                mode_y, mode_x = main_mode(h, occupied_box(h), bandwidth_bins(count[y, x]))
                out[y, x, 0], out[y, x, 1] = mode_x, mode_y


@kernel
def _modes_tile(histogram: NDArray[np.int32], count: NDArray[np.int32], out: NDArray[np.float64]) -> None:
    modes = np.empty((out.shape[2], 3))
    for y in range(count.shape[0]):
        for x in range(count.shape[1]):
            if count[y, x] > 0:
                kept = pixel_modes(histogram[y, x], bandwidth_bins(count[y, x]), modes)
                for k in range(kept):
                    out[y, x, k] = (modes[k, 1], modes[k, 0], modes[k, 2])


def modal_velocity(
    histogram: NDArray[np.int32], count: NDArray[np.int32], *, bins: VelocityBins
) -> NDArray[np.float64]:
    """Velocity of the highest mode at each pixel of a tile: (ty, tx, 2) as (vx, vy) px/s, NaN where empty."""
    out = np.full((*count.shape, 2), np.nan)
    _modal_tile(histogram, count, out)
    return bins.from_bins(out)


def velocity_modes(
    histogram: NDArray[np.int32], count: NDArray[np.int32], *, bins: VelocityBins, k: int = MAX_MODES
) -> NDArray[np.float64]:
    """Up to ``k`` modes a pixel: (ty, tx, k, 3) as (vx, vy) px/s and weight, the largest weight first, NaN-padded.

    The weights of all modes of a pixel sum to one. The first mode is that of the largest weight, which need not be the
    highest, `modal_velocity`.
    """
    out = np.full((*count.shape, k, 3), np.nan)
    _modes_tile(histogram, count, out)
    out[..., :2] = bins.from_bins(out[..., :2])
    return out
