"""The field as a prior p(v | x) for another tracker: a hierarchical mixture over pixel, neighbourhood and map.

Each level is shrunk towards the next coarser one: a level of n tracks has the weight n against `PRIOR_PSEUDOCOUNT` of
the coarser level. So the density of a pixel without tracks is its neighbourhood's, that of an unknown neighbourhood the
map's, and that of an empty map a broad Gaussian. For prediction, zero velocity has the pseudocount
`STATIONARY_PSEUDOCOUNT` on every level, as a queue of another signal cycle may stop where none has stopped yet. The
gate and the anomaly score use the observed distribution, without it.

The density of a pixel, or of a neighbourhood, is a Gaussian mixture, a component a mode: the mean and the covariance of
its bins' weights, with the variance of kernel and bins subtracted. The covariance of few tracks is pooled with a
typical one, larger along the velocity than across it, as speeds differ more than directions. The kernel density of the
bins has a small weight besides, for what is not Gaussian.
"""

from math import exp, floor, hypot, log, nan, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from velfield.compiled import kernel
from velfield.field.modes import MAX_MODES, bandwidth_bins, pixel_modes

PRIOR_PSEUDOCOUNT = 1.0
"""Pseudocount of the coarser level against the tracks of a level."""
STATIONARY_PSEUDOCOUNT = 0.1
"""Pseudocount of zero velocity on every level, in tracks."""
BIN_SIGMA_BINS = 0.5
"""Standard deviation of the kernel of the bins' kernel density, bins; with a smaller one the density would ripple."""
MIN_SIGMA_BINS = 0.25
"""Lower bound of a component's standard deviation, bins: a grid of half bins resolves it."""
TYPICAL_ALONG, TYPICAL_ACROSS = 0.12, 0.03
"""Typical standard deviations of a mode along its velocity and across it, as fractions of the speed."""
COVARIANCE_PSEUDOCOUNT = 3.0
"""Pseudocount of the typical covariance, in tracks."""
BINS_WEIGHT = 0.1
"""Mixture weight of the kernel density of the bins."""
BROAD_WEIGHT = 0.02
"""Mixture weight of a broad Gaussian on the map's level, so that no velocity has zero density."""


@kernel
def _kernel_density(h: FloatArray, v_y: float, v_x: float) -> float:
    """Kernel density per square bin at (v_y, v_x) of weights ``h``, which need not sum to one."""
    reach = 3.5 * BIN_SIGMA_BINS
    total = 0.0
    for j in range(max(0, floor(v_y - reach + 0.5)), min(h.shape[0] - 1, floor(v_y + reach + 0.5)) + 1):
        for i in range(max(0, floor(v_x - reach + 0.5)), min(h.shape[1] - 1, floor(v_x + reach + 0.5)) + 1):
            if h[j, i] > 0:
                square = (v_x - i) ** 2 + (v_y - j) ** 2
                total += h[j, i] * exp(-0.5 * square / BIN_SIGMA_BINS**2)
    return float(total / (2.0 * pi * BIN_SIGMA_BINS**2))


@kernel
def _mode_gaussians(h: FloatArray, n: float, blur: float, out: FloatArray) -> int:
    """Fill ``out`` (k, 6) with a Gaussian a mode: weight, mean x and y, covariance xx, xy, yy, in bins; returns k.

    ``n``: tracks of the weights, which sum to one; ``blur``: variance of kernel and bins, bins^2.
    """
    modes = np.empty((out.shape[0], 3))
    found = pixel_modes((h * (1 << 20)).astype(np.int32), bandwidth_bins(max(int(n), 1)), modes)
    sums = np.zeros((found, 6))
    for y in range(h.shape[0]):
        for x in range(h.shape[1]):
            if h[y, x] > 0:
                nearest, min_distance = 0, np.inf
                for k in range(found):
                    distance = (modes[k, 0] - y) ** 2 + (modes[k, 1] - x) ** 2
                    if distance < min_distance:
                        min_distance, nearest = distance, k
                w = h[y, x]
                dx, dy = x - modes[nearest, 1], y - modes[nearest, 0]
                sums[nearest, 0] += w
                sums[nearest, 1] += w * dx
                sums[nearest, 2] += w * dy
                sums[nearest, 3] += w * dx * dx
                sums[nearest, 4] += w * dx * dy
                sums[nearest, 5] += w * dy * dy
    centre = (h.shape[0] - 1) / 2
    total = sums[:, 0].sum()
    kept = 0
    for m in range(found):
        s = sums[m]
        if s[0] <= 0.0:  # a mode whose bins are all nearer to others
            continue
        dx, dy = s[1] / s[0], s[2] / s[0]
        x, y = modes[m, 1] + dx, modes[m, 0] + dy
        vx, vy = x - centre, y - centre
        speed = hypot(vx, vy)
        along = (TYPICAL_ALONG * speed) ** 2 + MIN_SIGMA_BINS**2
        across = (TYPICAL_ACROSS * speed) ** 2 + MIN_SIGMA_BINS**2
        ux, uy = (vx / speed, vy / speed) if speed > 1e-6 else (1.0, 0.0)  # zero velocity has no direction
        n_mode = max(n * s[0] / total, 1e-9)
        known = n_mode / (n_mode + COVARIANCE_PSEUDOCOUNT)
        # Predictive variance: the next track's, and that of the mean.
        predictive = 1.0 + 1.0 / max(n_mode, 1.0)
        # Along and across the velocity, so that subtracting the blur cannot leave a negative variance.
        xx, xy, yy = s[3] / s[0] - dx * dx, s[4] / s[0] - dx * dy, s[5] / s[0] - dy * dy
        sample_along = max(ux * ux * xx + 2 * ux * uy * xy + uy * uy * yy - blur, MIN_SIGMA_BINS**2)
        sample_across = max(uy * uy * xx - 2 * ux * uy * xy + ux * ux * yy - blur, MIN_SIGMA_BINS**2)
        a = predictive * (known * sample_along + (1 - known) * along)
        b = predictive * (known * sample_across + (1 - known) * across)
        out[kept, 0], out[kept, 1], out[kept, 2] = s[0] / total, x, y
        out[kept, 3], out[kept, 4], out[kept, 5] = (
            ux * ux * a + uy * uy * b,
            ux * uy * (a - b),
            uy * uy * a + ux * ux * b,
        )
        kept += 1
    return kept


@kernel
def _level_density(h: FloatArray, gaussians: FloatArray, v_y: float, v_x: float) -> float:
    """Density per square bin of a level: the mixture of its modes and the kernel density of its bins."""
    density = 0.0
    for k in range(gaussians.shape[0]):
        dx, dy = v_x - gaussians[k, 1], v_y - gaussians[k, 2]
        xx, xy, yy = gaussians[k, 3], gaussians[k, 4], gaussians[k, 5]
        determinant = xx * yy - xy * xy
        square = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / determinant
        density += gaussians[k, 0] * exp(-0.5 * square) / (2.0 * pi * sqrt(determinant))
    return float((1.0 - BINS_WEIGHT) * density + BINS_WEIGHT * _kernel_density(h, v_y, v_x))


@kernel
def _neighbourhood(
    histogram: NDArray[np.int32], count: NDArray[np.int32], x: int, y: int, radius: int, nearby: FloatArray
) -> float:
    """Fill ``nearby`` with the weights of the pixels within ``radius`` of (x, y), summing to one; returns their mean
    number of tracks, 0 without any."""
    window, tracks, unit = 0.0, 0.0, 0.0
    for j in range(max(0, y - radius), min(count.shape[0], y + radius + 1)):
        for i in range(max(0, x - radius), min(count.shape[1], x + radius + 1)):
            distance = (j - y) ** 2 + (i - x) ** 2
            if count[j, i] > 0 and distance <= radius * radius:
                near = exp(-2.0 * distance / max(radius * radius, 1))
                window += near
                tracks += near * count[j, i]
                for b in range(nearby.shape[0]):
                    for a in range(nearby.shape[1]):
                        if histogram[j, i][b, a] > 0:
                            nearby[b, a] += near * histogram[j, i][b, a]
                            unit += near * histogram[j, i][b, a]
    if window == 0.0:
        return 0.0
    nearby /= unit
    # Neighbouring pixels have the same tracks: the sample size is their mean number, not the sum.
    return float(tracks / window)


@kernel
def _gaussian_at_rest(v_y: float, v_x: float, reach: float, sigma: float) -> float:
    """Density per square bin of an isotropic Gaussian at zero velocity, i.e. at the bin ``reach`` of either axis."""
    square = (v_x - reach) ** 2 + (v_y - reach) ** 2
    return exp(-0.5 * square / (sigma * sigma)) / (2.0 * pi * sigma * sigma)


@kernel
def _mix_levels(n: float, level: float, coarser: float, at_rest: float, stationary_count: float) -> float:
    """A level's density shrunk towards the coarser level's and that of zero velocity, by tracks and pseudocounts."""
    total = n + PRIOR_PSEUDOCOUNT + stationary_count
    return (n * level + PRIOR_PSEUDOCOUNT * coarser + stationary_count * at_rest) / total


@kernel
def _map_density(map_weights: FloatArray, known: bool, v_y: float, v_x: float) -> float:
    """Density per square bin of the coarsest level; ``known``: whether the map has any tracks."""
    reach = (map_weights.shape[0] - 1) / 2
    broad = _gaussian_at_rest(v_y, v_x, reach, reach / 2)
    weight = BROAD_WEIGHT if known else 1.0
    return float((1.0 - weight) * _kernel_density(map_weights, v_y, v_x) + weight * broad)


@kernel
def densities_at_pixel(
    histogram: NDArray[np.int32],
    count: NDArray[np.int32],
    map_weights: FloatArray,
    x: int,
    y: int,
    velocity_bins: FloatArray,
    radius: int,
    blur: float,
    stationary_count: float,
) -> FloatArray:
    """Density per square bin of velocities (n, 2) as (vx, vy) at one pixel of a window of the field, (n,).

    ``stationary_count``: pseudocount of zero velocity. The other parameters are those of `log_density_in_window`.
    """
    nearby: FloatArray = np.zeros(map_weights.shape)
    n_near = _neighbourhood(histogram, count, x, y, radius, nearby)
    inside = 0 <= y < count.shape[0] and 0 <= x < count.shape[1]
    n_here = float(count[y, x]) if inside else 0.0
    known = map_weights.sum() > 0.0
    own: FloatArray = np.zeros(map_weights.shape)
    if n_here > 0.0:
        own += histogram[y, x]
        own /= own.sum()
    near_gaussians, pixel_gaussians = np.empty((MAX_MODES, 6)), np.empty((MAX_MODES, 6))
    near_gaussians = near_gaussians[: _mode_gaussians(nearby, n_near, blur, near_gaussians) if n_near > 0.0 else 0]
    pixel_gaussians = pixel_gaussians[: _mode_gaussians(own, n_here, blur, pixel_gaussians) if n_here > 0.0 else 0]
    out = np.empty(velocity_bins.shape[0])
    for k in range(velocity_bins.shape[0]):
        v_x, v_y = velocity_bins[k, 0], velocity_bins[k, 1]
        at_rest = _gaussian_at_rest(v_y, v_x, (map_weights.shape[0] - 1) / 2, MIN_SIGMA_BINS)
        density = _mix_levels(0.0, 0.0, _map_density(map_weights, known, v_y, v_x), at_rest, stationary_count)
        if n_near > 0.0:
            level = _level_density(nearby, near_gaussians, v_y, v_x)
            density = _mix_levels(n_near, level, density, at_rest, stationary_count)
        if n_here > 0.0:
            level = _level_density(own, pixel_gaussians, v_y, v_x)
            density = _mix_levels(n_here, level, density, at_rest, stationary_count)
        out[k] = density
    return out


@kernel
def log_density_in_window(
    histogram: NDArray[np.int32],
    count: NDArray[np.int32],
    map_weights: FloatArray,
    pixels: NDArray[np.int64],
    velocity_bins: FloatArray,
    radius: int,
    blur: float,
) -> FloatArray:
    """Log density per square bin of velocities at pixels of a window of the field.

    Parameters
    ----------
    histogram, count
        A window of the field: (h, w, nvy, nvx) and (h, w).
    map_weights
        (nvy, nvx) the whole map's distribution, summing to one; all zero if it is empty.
    pixels
        (n, 2) as (x, y) in the window; outside it the density is the map's.
    velocity_bins
        (n, 2) as (vx, vy) in bins, 0 being the first bin's centre; NaN in, NaN out.
    radius
        Radius of the neighbourhood, px.
    blur
        Variance of kernel and bins, bins^2.
    """
    out = np.empty(pixels.shape[0])
    for k in range(pixels.shape[0]):
        v_x, v_y = velocity_bins[k, 0], velocity_bins[k, 1]
        if not (np.isfinite(v_x) and np.isfinite(v_y)):
            out[k] = nan
            continue
        x, y = pixels[k, 0], pixels[k, 1]
        here = velocity_bins[k : k + 1]
        density = densities_at_pixel(histogram, count, map_weights, x, y, here, radius, blur, STATIONARY_PSEUDOCOUNT)[0]
        out[k] = log(max(density, 1e-300))
    return out
