"""Statistics of a pixel's histogram: mean, speed percentiles, circular variance, entropy, and their standard errors.

The histogram weighs each track once, so these are statistics over vehicles (in traffic terms: time-mean speeds, as of
a loop detector). A histogram accumulated with ``weight="time"`` gives space-mean speeds in the same way.

90 % confidence intervals of a pixel's modal direction and median speed.

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

from dataclasses import dataclass
from math import erf, hypot, log, pi, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from velfield.compiled import kernel
from velfield.field.accumulate import VARIANCE_UNIT
from velfield.field.modes import (
    Box,
    bandwidth_bins,
    deconvolution_factor,
    kernel_variance,
    main_mode,
    max_cells,
    occupied_box,
    quantile,
    speed_cells,
    speed_variance,
)
from velfield.field.segments import VelocityBins

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


@kernel
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


@kernel
def _half_width(variance: float, typical: float, pseudocount: float, tracks: float, correlation: float) -> float:
    """Half the 90 % interval of a mean of ``tracks`` whose sample has ``variance`` (about its mean, divisor n)."""
    design_effect = 1.0 + correlation * (min(tracks, PLATOON_SIZE) - 1.0)
    dof = max(tracks - design_effect, 0.0) + pseudocount
    pooled = (variance * tracks + pseudocount * typical) / dof
    return float(_student_t95(dof) * sqrt(pooled * design_effect / tracks))


@kernel
def _median_speed(
    cells: FloatArray, total: float, median: float, factor: float, variance: float, tracks: float, measured: float
) -> tuple[float, float]:
    """90 % interval of a median speed, bins, by the cells of speed and their sum.

    ``factor``: `deconvolution_factor`. ``variance``: of the speed, without the kernel's. ``measured``: mean variance of
    a measured velocity component.
    """
    typical = measured + (TYPICAL_SPEED_SD * median) ** 2 + MIN_SPEED_SD_BINS**2
    half_width = MEDIAN_SE_RATIO * _half_width(variance, typical, SPEED_PSEUDOCOUNT, tracks, SPEED_CORRELATION)
    n_effective = max(tracks / (1.0 + SPEED_CORRELATION * (min(tracks, PLATOON_SIZE) - 1.0)), 1.0)
    rank = 0.5 * _Z / sqrt(n_effective + 2.0)
    below = factor * (median - quantile(cells, total, 0.5 - rank))
    above = factor * (quantile(cells, total, 0.5 + rank) - median)
    return max(median - max(half_width, below), 0.0), median + max(half_width, above)


@kernel
def _modal_direction(
    h: NDArray[np.int32],
    box: Box,
    mode_x: float,
    mode_y: float,
    tracks: float,
    measurement_variance: float,
    blur: float,
) -> float:
    """Half the 90 % interval of the direction of a mode at (mode_x, mode_y) bins from rest, rad."""
    reach = (h.shape[0] - 1) // 2
    speed = hypot(mode_x, mode_y)
    along_x, along_y = mode_x / speed, mode_y / speed
    mode_weight, total, mean, square = 0.0, 0.0, 0.0, 0.0
    top, bottom, left, right = box
    for y in range(top, bottom):
        for x in range(left, right):
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


PERCENTILES = (15.0, 50.0, 85.0)
"""Speed percentiles, %; p85 is the one that speed limits are set by."""


@dataclass(frozen=True)
class TileStatistics:
    """Statistics of a tile, each (ty, tx) float64 unless stated otherwise, NaN where no vehicle passed.

    Attributes
    ----------
    n : int32
        Number of tracks.
    modal_velocity_px_per_s : (ty, tx, 2)
        Velocity of the highest mode, px/s.
    mode_fraction
        Fraction of the weight within two bins of that mode.
    mean_velocity_px_per_s : (ty, tx, 2)
        Mean velocity, px/s.
    speed_percentiles_px_per_s : (ty, tx, 3)
        15th, 50th and 85th percentile of speed, px/s, deconvolved: the broadening by kernel and bins is removed.
    stationary_fraction
        Fraction of tracks that are stationary: the central bin's weight over that of a kernel at zero velocity. A
        vehicle of half a bin's speed counts for a half.
    circular_variance
        1 - length of the mean direction vector of the moving weight: 0 all in one direction, 1 no mean direction; NaN
        where none moves.
    entropy_nats
        Entropy of the normalised histogram, nats; log(number of bins) for a uniform one.
    direction_se_rad
        Standard error of the mean direction of the moving weight, rad; NaN with fewer than two tracks.
    direction_half_width_rad
        Half the 90 % interval of the modal direction, rad; NaN where the mode is stationary.
    median_speed_low_px_per_s, median_speed_high_px_per_s
        90 % interval of the median speed, px/s.
    speed_se_px_per_s
        Standard error of the median speed, px/s: of its binomial rank, and of the kernel as one track's error; NaN with
        fewer than two tracks.
    """

    n: NDArray[np.int32]
    modal_velocity_px_per_s: FloatArray
    mode_fraction: FloatArray
    mean_velocity_px_per_s: FloatArray
    speed_percentiles_px_per_s: FloatArray
    stationary_fraction: FloatArray
    circular_variance: FloatArray
    entropy_nats: FloatArray
    direction_se_rad: FloatArray
    speed_se_px_per_s: FloatArray
    direction_half_width_rad: FloatArray
    median_speed_low_px_per_s: FloatArray
    median_speed_high_px_per_s: FloatArray


class _Tile(NamedTuple):
    """What the kernel finds of a tile, each (ty, tx, n), in bins: modal velocity (x, y); `_moments`; percentiles of
    speed; standard errors of direction and of median speed, and half the interval of the modal direction; ends of the
    median speed's interval."""

    modes: FloatArray
    moments: FloatArray
    speeds: FloatArray
    errors: FloatArray
    median: FloatArray


@kernel
def _moments(h: NDArray[np.int32], box: Box, stationary: float, mode_y: float, mode_x: float, out: FloatArray) -> None:
    """Fill ``out`` of one pixel, in bins: 0 mode fraction, 1-2 mean (x, y), 3 central bin's fraction, 4 circular
    variance, 5 entropy, 6 circular dispersion: n times the variance of the mean direction, rad^2."""
    reach = (h.shape[0] - 1) // 2
    total, mode_weight, sum_x, sum_y = 0.0, 0.0, 0.0, 0.0
    moving, cosine, sine, plogp = 0.0, 0.0, 0.0, 0.0
    cosine_2, sine_2 = 0.0, 0.0  # of twice the angle
    top, bottom, left, right = box
    for y in range(top, bottom):
        for x in range(left, right):
            if h[y, x] <= 0:
                continue
            weight = float(h[y, x])
            vx, vy = float(x - reach), float(y - reach)
            speed = hypot(vx, vy)
            total += weight
            sum_x += weight * vx
            sum_y += weight * vy
            plogp += weight * log(weight)
            if (x - mode_x) ** 2 + (y - mode_y) ** 2 <= 4.0:
                mode_weight += weight
            if speed > stationary:
                ux, uy = vx / speed, vy / speed
                moving += weight
                cosine += weight * ux
                sine += weight * uy
                cosine_2 += weight * (ux * ux - uy * uy)
                sine_2 += weight * 2.0 * ux * uy
    out[0] = mode_weight / total
    out[1], out[2] = sum_x / total, sum_y / total
    out[3] = h[reach, reach] / total
    out[5] = max(log(total) - plogp / total, 0.0)
    out[4], out[6] = np.nan, np.nan
    if moving > 0.0:
        length = hypot(cosine, sine) / moving
        out[4], out[6] = max(1.0 - length, 0.0), np.inf
        if length > 1e-9:  # (1 - mean cos 2(theta - mean direction)) / (2 length^2)
            ux, uy = cosine / (moving * length), sine / (moving * length)
            about = (cosine_2 * (ux * ux - uy * uy) + sine_2 * 2.0 * ux * uy) / moving
            out[6] = max(1.0 - about, 0.0) / (2.0 * length * length)


@kernel
def _tile(
    histogram: NDArray[np.int32],
    count: NDArray[np.int32],
    variance_bins2: FloatArray,
    stationary: float,
    sigma: float,
    percentiles: FloatArray,
    out: _Tile,
) -> None:
    """Fill ``out`` where vehicles passed.

    ``variance_bins2``: (ty, tx), mean, of the measurement of a track's velocity component. ``stationary``: speed below
    which there is no direction, ``sigma``: standard deviation of the histogram's kernel, bins.
    """
    reach = (histogram.shape[2] - 1) // 2
    cells = np.zeros(max_cells(reach))
    blur = kernel_variance(sigma)
    at_rest = erf(0.5 / (sigma * sqrt(2.0))) ** 2
    # The kernel at zero velocity extends into the bins next to the central one: directions are of the bins beyond.
    moving = max(stationary, 1.5)
    for y in range(count.shape[0]):
        for x in range(count.shape[1]):
            n = float(count[y, x])
            if n == 0.0:
                continue
            h = histogram[y, x]
            box = occupied_box(h)
            mode_y, mode_x = main_mode(h, box, bandwidth_bins(count[y, x]))
            moments = out.moments[y, x]
            _moments(h, box, moving, mode_y, mode_x, moments)
            moments[3] = min(moments[3] / at_rest, 1.0)
            total = speed_cells(h, box, cells)
            variance = speed_variance(cells, total)
            factor = deconvolution_factor(variance, blur)
            median = quantile(cells, total, 0.5)
            for k in range(percentiles.size):
                out.speeds[y, x, k] = median + factor * (quantile(cells, total, percentiles[k] / 100.0) - median)
            if n >= 2:
                out.errors[y, x, 0] = sqrt(moments[6] / n)
                half = 0.5 / sqrt(n)
                rank = (quantile(cells, total, 0.5 + half) - quantile(cells, total, 0.5 - half)) / 2.0
                out.errors[y, x, 1] = sqrt((factor * rank) ** 2 + sigma * sigma / n)
            measured = variance_bins2[y, x]
            mode_x, mode_y = mode_x - reach, mode_y - reach
            out.modes[y, x, 0], out.modes[y, x, 1] = mode_x, mode_y
            out.median[y, x, 0], out.median[y, x, 1] = _median_speed(
                cells, total, median, factor, max(variance - blur, 0.0), n, measured
            )
            if hypot(mode_x, mode_y) > stationary:
                of_bins = sigma * sigma + 1.0 / 12.0
                out.errors[y, x, 2] = _modal_direction(h, box, mode_x, mode_y, n, measured, of_bins)


def tile_statistics(
    histogram: NDArray[np.int32],
    count: NDArray[np.int32],
    variance_sum: NDArray[np.int32],
    *,
    bins: VelocityBins,
    stationary_speed_px_per_s: float,
) -> TileStatistics:
    """All statistics of a tile.

    Parameters
    ----------
    histogram
        (ty, tx, nvy, nvx) int32 weights, of any unit.
    count
        (ty, tx) int32 tracks.
    variance_sum
        (ty, tx) int32, as in `FieldTile`.
    stationary_speed_px_per_s
        Below it there is no direction, nor below a bin and a half.
    """
    values = (2, 7, len(PERCENTILES), 3, 2)
    found = _Tile(*(np.full((*count.shape, n), np.nan) for n in values))
    variance_bins2 = variance_sum / (np.maximum(count, 1) * float(VARIANCE_UNIT))
    stationary = stationary_speed_px_per_s / bins.width_px_per_s
    limits = np.array(PERCENTILES)
    _tile(histogram, count, variance_bins2, stationary, bins.kernel_sigma_bins, limits, found)
    return TileStatistics(
        n=count,
        modal_velocity_px_per_s=found.modes * bins.width_px_per_s,
        mode_fraction=found.moments[..., 0],
        mean_velocity_px_per_s=found.moments[..., 1:3] * bins.width_px_per_s,
        speed_percentiles_px_per_s=found.speeds * bins.width_px_per_s,
        stationary_fraction=found.moments[..., 3],
        circular_variance=found.moments[..., 4],
        entropy_nats=found.moments[..., 5],
        direction_se_rad=found.errors[..., 0],
        speed_se_px_per_s=found.errors[..., 1] * bins.width_px_per_s,
        direction_half_width_rad=found.errors[..., 2],
        median_speed_low_px_per_s=found.median[..., 0] * bins.width_px_per_s,
        median_speed_high_px_per_s=found.median[..., 1] * bins.width_px_per_s,
    )


def direction_rad(velocity_px_per_s: FloatArray, *, stationary_speed_px_per_s: float = 0.0) -> FloatArray:
    """Direction of motion in (-pi, pi] from +x towards +y (down); NaN where stationary or empty."""
    vx, vy = velocity_px_per_s[..., 0], velocity_px_per_s[..., 1]
    direction = np.arctan2(vy, vx)
    direction = np.where(direction == -pi, pi, direction)
    stationary = ~(np.hypot(vx, vy) > stationary_speed_px_per_s)
    return np.where(stationary, np.nan, direction)


def speed_px_per_s(velocity_px_per_s: FloatArray) -> FloatArray:
    """Length of the velocity, px/s; NaN where empty."""
    return np.hypot(velocity_px_per_s[..., 0], velocity_px_per_s[..., 1])
