"""90 % confidence intervals of a pixel's modal direction and median speed.

They are intervals for the values of endless traffic. Their variance has two parts: the measurement variance of a
track's velocity (registration and displacement, accumulated with the histogram), and the sampling variance, estimated
from the histogram with the variance of its kernel and bins subtracted. The sample is of tracks, not of segments, and
tracks are correlated, as vehicles drive in platoons at the speed of the first. The intra-cluster correlation ``r``
gives the design effect ``1 + r (n - 1)``, ``n`` being at most a platoon's size, by which the effective sample size is
smaller.

The variance of few tracks is itself uncertain: it is pooled with a typical variance that has a pseudocount, and the
interval is Student's. For skewed speeds (some vehicles stop, others do not) the distribution-free interval of the
median, by ranks, is wider, and the wider one is taken.

The constants were set on simulated traffic and hold on other seeds; `docs/field.md` gives the coverage.
"""

from math import hypot, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from velfield.field.speeds import CELLS_PER_BIN, deconvolution_factor, kernel_variance, max_cells, quantile, speed_cells

PLATOON_SIZE = 20.0
"""Largest number of correlated tracks."""
SPEED_CORRELATION, DIRECTION_CORRELATION = 0.13, 0.0
"""Correlation of two tracks of a platoon: a vehicle has the speed of the one ahead, its lateral motion is its own."""
SPEED_PSEUDOCOUNT, DIRECTION_PSEUDOCOUNT = 3.0, 1.5
"""Pseudocount of the typical variance: lateral deviations are rare and then large, where lanes diverge or merge."""
TYPICAL_SPEED_SD = 0.07
"""Standard deviation of speed at a position, as a fraction of the speed."""
TYPICAL_SWAY = 0.008
"""Standard deviation of the lateral velocity at a position, as a fraction of the speed."""
MIN_SPEED_SD_BINS = 0.15
"""Standard deviation of the speed of stationary vehicles, and of the discretisation into cells."""
MIN_MODE_SD_BINS = 0.002
"""Standard deviation of a mode by the discretisation into bins."""
MODE_RADIUS_BINS = 2.5
"""Bins within this distance of a mode belong to it."""
MEDIAN_SE_RATIO = 1.2533
"""Standard error of a median over that of a mean."""
_Z = 1.6449


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _student_t95(dof: float) -> float:
    """95 % quantile of Student's t (Cornish-Fisher expansion): accurate to 0.3 % from 3 degrees of freedom on.

    With fewer it is too small; the constants were set with it.

    Examples
    --------
    >>> round(_student_t95(3.0), 2), round(_student_t95(10.0), 3)
    (2.35, 1.812)
    """
    z, z2 = _Z, _Z * _Z
    return float(
        z
        + z * (z2 + 1) / (4 * dof)
        + z * ((5 * z2 + 16) * z2 + 3) / (96 * dof**2)
        + z * (((3 * z2 + 19) * z2 + 17) * z2 - 15) / (384 * dof**3)
    )


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _half_width(variance: float, typical: float, pseudocount: float, tracks: float, correlation: float) -> float:
    """Half the 90 % interval of a mean of ``tracks`` whose sample has ``variance`` (about its mean, divisor n)."""
    design_effect = 1.0 + correlation * (min(tracks, PLATOON_SIZE) - 1.0)
    dof = max(tracks - design_effect, 0.0) + pseudocount
    pooled = (variance * tracks + pseudocount * typical) / dof
    return float(_student_t95(dof) * sqrt(pooled * design_effect / tracks))


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _median_speed(
    h: NDArray[np.int32], tracks: float, measurement_variance: float, blur: float, cells: FloatArray
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
    typical = measurement_variance + (TYPICAL_SPEED_SD * median) ** 2 + MIN_SPEED_SD_BINS**2
    half_width = MEDIAN_SE_RATIO * _half_width(variance, typical, SPEED_PSEUDOCOUNT, tracks, SPEED_CORRELATION)
    n_effective = max(tracks / (1.0 + SPEED_CORRELATION * (min(tracks, PLATOON_SIZE) - 1.0)), 1.0)
    rank = 0.5 * _Z / sqrt(n_effective + 2.0)
    factor = deconvolution_factor(cells, total, blur)
    below = factor * (median - quantile(cells, total, 0.5 - rank))
    above = factor * (quantile(cells, total, 0.5 + rank) - median)
    return max(median - max(half_width, below), 0.0), median + max(half_width, above)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _modal_direction(
    h: NDArray[np.int32], mode_x: float, mode_y: float, tracks: float, measurement_variance: float, blur: float
) -> float:
    """Half the 90 % interval of the direction of a mode at (mode_x, mode_y) bins from rest, rad."""
    reach = (h.shape[0] - 1) // 2
    speed = hypot(mode_x, mode_y)
    along_x, along_y = mode_x / speed, mode_y / speed
    mode_weight, total, mean, square = 0.0, 0.0, 0.0, 0.0
    for y in range(h.shape[0]):
        for x in range(h.shape[1]):
            if h[y, x] > 0:
                weight = float(h[y, x])
                total += weight
                dx, dy = x - reach - mode_x, y - reach - mode_y
                if dx * dx + dy * dy <= MODE_RADIUS_BINS**2:
                    lateral = dy * along_x - dx * along_y
                    mode_weight += weight
                    mean += weight * lateral
                    square += weight * lateral * lateral
    if mode_weight <= 0.0:
        return float(np.pi)
    mean /= mode_weight
    variance = max(square / mode_weight - mean * mean - blur, 0.0)
    typical = measurement_variance + (TYPICAL_SWAY * speed) ** 2
    n_effective = max(tracks * mode_weight / total, 1.0)
    half_width = _half_width(variance, typical, DIRECTION_PSEUDOCOUNT, n_effective, DIRECTION_CORRELATION)
    return min(hypot(half_width, _Z * MIN_MODE_SD_BINS) / speed, float(np.pi))


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def tile_intervals(
    histogram: NDArray[np.int32],
    count: NDArray[np.int32],
    variance_bins2: FloatArray,
    mode_bins: FloatArray,
    sigma_bins: float,
    stationary_bins: float,
    out: FloatArray,
) -> None:
    """Fill ``out`` (ty, tx, 3): half the interval of the modal direction, rad; ends of the median speed's, bins.

    Parameters
    ----------
    histogram, count
        (ty, tx, nvy, nvx) weights and (ty, tx) tracks; nothing is filled where the count is zero.
    variance_bins2
        (ty, tx) mean measurement variance of a track's velocity component.
    mode_bins
        (ty, tx, 2) modal velocity as (vx, vy), bins from zero. Below ``stationary_bins`` it has no direction.
    sigma_bins
        Standard deviation of the histogram's kernel.
    """
    cells = np.zeros(max_cells((histogram.shape[2] - 1) // 2))
    for y in range(count.shape[0]):
        for x in range(count.shape[1]):
            n = float(count[y, x])
            if n == 0.0:
                continue
            h, measurement_variance = histogram[y, x], variance_bins2[y, x]
            out[y, x, 1], out[y, x, 2] = _median_speed(h, n, measurement_variance, kernel_variance(sigma_bins), cells)
            mode_x, mode_y = mode_bins[y, x, 0], mode_bins[y, x, 1]
            if hypot(mode_x, mode_y) > stationary_bins:
                blur = sigma_bins * sigma_bins + 1.0 / 12.0
                out[y, x, 0] = _modal_direction(h, mode_x, mode_y, n, measurement_variance, blur)
