"""90 % intervals of a pixel's modal direction and median speed: how far they may be from those of endless traffic.

Three errors go in, each from its source: what registration and the aligned displacements leave in a passage's velocity
(summed beside the histogram as it is built); how much passages differ, out of the histogram with its kernel and bins
taken out; and that they are few. Passages are what is drawn, not segments. They are not quite independent either:
vehicles come in platoons, and a platoon goes as its first does. Passages of one platoon with correlation ``r`` tell as
much as ``n / (1 + r (n - 1))`` independent ones, up to a platoon's size.

The spread of few passages is itself uncertain. It is taken together with a usual spread that counts as some passages
more, and the interval is Student's. Where speeds are skewed (some stand, others pass) the interval of the median's rank
is wider than that, and is taken instead.

The numbers below were set on simulated traffic and hold on other seeds; `docs/field.md` has the coverage.
"""

from math import hypot, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from velfield.field.speeds import CELLS_PER_BIN, blur_variance, most_cells, narrowing_by, quantile, speed_cells

PLATOON = 20.0
"""Passages beyond this many are of another platoon."""
SPEED_CORRELATION, DIRECTION_CORRELATION = 0.13, 0.0
"""Correlation of two passages of a platoon: one goes as fast as the one ahead, but sways as it will."""
SPEED_COUNTS_FOR, DIRECTION_COUNTS_FOR = 3.0, 1.5
"""Passages that the usual spread counts for: lateral errors are seldom and then large, where lanes part or join."""
USUAL_SPEED_SPREAD = 0.07
"""Standard deviation of speed at a place, as a share of it."""
USUAL_SWAY = 0.008
"""Standard deviation of the sideways velocity at a place, as a share of the speed."""
LEAST_SPEED_SD_BINS = 0.15
"""Usual spread of what stands, and what spreading bins over cells costs."""
LEAST_SWAY_BINS = 0.002
"""Standard deviation of a mode by the bins it is found in."""
MODE_REACH_BINS = 2.5
"""What is so near to the mode belongs to it."""
MEDIAN_COSTS = 1.2533
"""Standard error of a median over that of a mean."""
_Z = 1.6449


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _student(freedom: float) -> float:
    """95 % quantile of Student's t, by its expansion about the normal: within 0.3 % from 3 degrees of freedom on.

    Of fewer it falls short; the constants were set with it.

    Examples
    --------
    >>> round(_student(3.0), 2), round(_student(10.0), 3)
    (2.35, 1.812)
    """
    z, z2 = _Z, _Z * _Z
    return float(
        z
        + z * (z2 + 1) / (4 * freedom)
        + z * ((5 * z2 + 16) * z2 + 3) / (96 * freedom**2)
        + z * (((3 * z2 + 19) * z2 + 17) * z2 - 15) / (384 * freedom**3)
    )


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _half_width(variance: float, usual: float, counts_for: float, passages: float, correlation: float) -> float:
    """Half the 90 % interval of a mean of ``passages`` whose sample has ``variance`` (about its mean, divisor n)."""
    repeats = 1.0 + correlation * (min(passages, PLATOON) - 1.0)
    freedom = max(passages - repeats, 0.0) + counts_for
    pooled = (variance * passages + counts_for * usual) / freedom
    return float(_student(freedom) * sqrt(pooled * repeats / passages))


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _median_speed(
    h: NDArray[np.int32], passages: float, noise: float, blur: float, cells: FloatArray
) -> tuple[float, float]:
    """90 % interval of the median speed, bins."""
    total = speed_cells(h, (h.shape[0] - 1) // 2, cells)
    median = quantile(cells, total, 0.5)
    mean, square = 0.0, 0.0
    for c in range(cells.size):
        speed = (c + 0.5) / CELLS_PER_BIN
        mean += cells[c] * speed
        square += cells[c] * speed * speed
    mean /= total
    variance = max(square / total - mean * mean - blur, 0.0)
    usual = noise + (USUAL_SPEED_SPREAD * median) ** 2 + LEAST_SPEED_SD_BINS**2
    half = MEDIAN_COSTS * _half_width(variance, usual, SPEED_COUNTS_FOR, passages, SPEED_CORRELATION)
    alone = max(passages / (1.0 + SPEED_CORRELATION * (min(passages, PLATOON) - 1.0)), 1.0)
    rank = 0.5 * _Z / sqrt(alone + 2.0)
    narrowing = narrowing_by(cells, total, blur)
    below = narrowing * (median - quantile(cells, total, 0.5 - rank))
    above = narrowing * (quantile(cells, total, 0.5 + rank) - median)
    return max(median - max(half, below), 0.0), median + max(half, above)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _modal_direction(
    h: NDArray[np.int32], mode_x: float, mode_y: float, passages: float, noise: float, blur: float
) -> float:
    """Half the 90 % interval of the direction of a mode at (mode_x, mode_y) bins from rest, rad."""
    reach = (h.shape[0] - 1) // 2
    speed = hypot(mode_x, mode_y)
    along_x, along_y = mode_x / speed, mode_y / speed
    near, total, mean, square = 0.0, 0.0, 0.0, 0.0
    for y in range(h.shape[0]):
        for x in range(h.shape[1]):
            if h[y, x] > 0:
                weight = float(h[y, x])
                total += weight
                dx, dy = x - reach - mode_x, y - reach - mode_y
                if dx * dx + dy * dy <= MODE_REACH_BINS**2:
                    aside = dy * along_x - dx * along_y
                    near += weight
                    mean += weight * aside
                    square += weight * aside * aside
    if near <= 0.0:
        return float(np.pi)
    mean /= near
    variance = max(square / near - mean * mean - blur, 0.0)
    usual = noise + (USUAL_SWAY * speed) ** 2
    alone = max(passages * near / total, 1.0)
    half = _half_width(variance, usual, DIRECTION_COUNTS_FOR, alone, DIRECTION_CORRELATION)
    return min(hypot(half, _Z * LEAST_SWAY_BINS) / speed, float(np.pi))


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def tile_intervals(
    histogram: NDArray[np.int32],
    count: NDArray[np.int32],
    noise_bins2: FloatArray,
    mode_bins: FloatArray,
    sigma_bins: float,
    standing_bins: float,
    out: FloatArray,
) -> None:
    """Fill ``out`` (ty, tx, 3), in bins and rad: half the interval of the modal direction, ends of the median speed's.

    Parameters
    ----------
    histogram, count
        (ty, tx, nvy, nvx) weights and (ty, tx) passages; nothing is filled where the count is zero.
    noise_bins2
        (ty, tx) mean variance of a passage's velocity component by measurement.
    mode_bins
        (ty, tx, 2) modal velocity as (vx, vy), bins from rest. Slower than ``standing_bins`` it has no direction.
    sigma_bins
        Standard deviation of the histogram's kernel.
    """
    cells = np.zeros(most_cells((histogram.shape[2] - 1) // 2))
    for y in range(count.shape[0]):
        for x in range(count.shape[1]):
            n = float(count[y, x])
            if n == 0.0:
                continue
            h, noise = histogram[y, x], noise_bins2[y, x]
            out[y, x, 1], out[y, x, 2] = _median_speed(h, n, noise, blur_variance(sigma_bins), cells)
            mode_x, mode_y = mode_bins[y, x, 0], mode_bins[y, x, 1]
            if hypot(mode_x, mode_y) > standing_bins:
                out[y, x, 0] = _modal_direction(h, mode_x, mode_y, n, noise, sigma_bins * sigma_bins + 1.0 / 12.0)
