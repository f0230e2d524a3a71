"""The field as a prior for another tracker: log p(v | x).

Three levels, each speaking as loud as its data: the pixel's own passages; those of the pixels around; all of the map.
A level with n passages stands against the next with weight n : `STRENGTH`, so that where nothing is known the density
is the map's, and where the map is empty a broad Gaussian. Within a level each bin is spread by a Gaussian along its
velocity, narrower across: vehicles at one place differ in speed more than in direction. It narrows with the number of
passages (n to the power -1/6, as Scott's rule has it in two dimensions).
"""

from math import exp, floor, hypot, log, nan, pi

import numpy as np
from numba import njit
from numpy.typing import NDArray

STRENGTH = 1.0
"""Passages that a level counts for against the one before it."""
ALONG_SIGMA_BINS = 1.2
"""Standard deviation of a bin's spread along its velocity where one passage is known, bins."""
LEAST_SIGMA_BINS = 0.5
"""The spread across, and the least along: below half a bin the density would ripple."""
BROAD_SHARE = 0.02
"""Share of the map's level that is a broad Gaussian, so that no velocity is impossible."""

Float = NDArray[np.float64]


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _spread(h: Float, v_y: float, v_x: float, along: float) -> float:
    """Density per square bin at (v_y, v_x) of weights ``h``, each spread by a Gaussian; they need not sum to one."""
    reach = 3.5 * max(along, LEAST_SIGMA_BINS)
    centre = (h.shape[0] - 1) / 2
    total = 0.0
    for j in range(max(0, floor(v_y - reach + 0.5)), min(h.shape[0] - 1, floor(v_y + reach + 0.5)) + 1):
        for i in range(max(0, floor(v_x - reach + 0.5)), min(h.shape[1] - 1, floor(v_x + reach + 0.5)) + 1):
            if h[j, i] > 0:
                speed = hypot(j - centre, i - centre)
                # At rest there is no along: the spread is round.
                ux, uy, s = 1.0, 0.0, LEAST_SIGMA_BINS
                if speed > 0.5:
                    ux, uy, s = (i - centre) / speed, (j - centre) / speed, along
                forth = ((v_x - i) * ux + (v_y - j) * uy) / s
                aside = ((v_y - j) * ux - (v_x - i) * uy) / LEAST_SIGMA_BINS
                total += h[j, i] * exp(-0.5 * (forth * forth + aside * aside)) / s
    return float(total / (2.0 * pi * LEAST_SIGMA_BINS))


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _sigma(n: float) -> float:
    return max(float(ALONG_SIGMA_BINS * max(n, 1.0) ** (-1.0 / 6.0)), LEAST_SIGMA_BINS)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _around(
    histogram: NDArray[np.int32], count: NDArray[np.int32], x: int, y: int, radius: int, around: Float
) -> float:
    """Fill ``around`` with the weights of the pixels near (x, y), summing to one; returns their mean passages, 0 where
    there are none."""
    window, passages, unit = 0.0, 0.0, 0.0
    for j in range(max(0, y - radius), min(count.shape[0], y + radius + 1)):
        for i in range(max(0, x - radius), min(count.shape[1], x + radius + 1)):
            distance = (j - y) ** 2 + (i - x) ** 2
            if count[j, i] > 0 and distance <= radius * radius:
                near = exp(-2.0 * distance / max(radius * radius, 1))
                window += near
                passages += near * count[j, i]
                for b in range(around.shape[0]):
                    for a in range(around.shape[1]):
                        if histogram[j, i][b, a] > 0:
                            around[b, a] += near * histogram[j, i][b, a]
                            unit += near * histogram[j, i][b, a]
    if window == 0.0:
        return 0.0
    around /= unit
    # Neighbouring pixels see the same passages: their mean number is what is known, not their sum.
    return float(passages / window)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _of_the_map(everywhere: Float, known: bool, v_y: float, v_x: float) -> float:
    """Density per square bin where nothing is known of the place; ``known``: whether anything is of the map."""
    reach = (everywhere.shape[0] - 1) / 2
    broad = reach / 2
    of_broad = exp(-0.5 * ((v_x - reach) ** 2 + (v_y - reach) ** 2) / (broad * broad)) / (2.0 * pi * broad * broad)
    share = BROAD_SHARE if known else 1.0
    return float((1.0 - share) * _spread(everywhere, v_y, v_x, LEAST_SIGMA_BINS) + share * of_broad)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def densities_at_pixel(
    histogram: NDArray[np.int32],
    count: NDArray[np.int32],
    everywhere: Float,
    x: int,
    y: int,
    velocity_bins: Float,
    radius: int,
) -> Float:
    """Density per square bin of velocities (n, 2) as (vx, vy) at one pixel of a window of the field, (n,).

    Parameters are those of `log_density_in_window`.
    """
    around: Float = np.zeros(everywhere.shape)
    near = _around(histogram, count, x, y, radius, around)
    inside = 0 <= y < count.shape[0] and 0 <= x < count.shape[1]
    here = float(count[y, x]) if inside else 0.0
    known = everywhere.sum() > 0.0
    own: Float = np.zeros(everywhere.shape)
    if here > 0.0:
        own += histogram[y, x]
        own /= own.sum()
    out = np.empty(velocity_bins.shape[0])
    for k in range(velocity_bins.shape[0]):
        v_x, v_y = velocity_bins[k, 0], velocity_bins[k, 1]
        density = _of_the_map(everywhere, known, v_y, v_x)
        if near > 0.0:
            density = (near * _spread(around, v_y, v_x, _sigma(near)) + STRENGTH * density) / (near + STRENGTH)
        if here > 0.0:
            density = (here * _spread(own, v_y, v_x, _sigma(here)) + STRENGTH * density) / (here + STRENGTH)
        out[k] = density
    return out


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def log_density_in_window(
    histogram: NDArray[np.int32],
    count: NDArray[np.int32],
    everywhere: Float,
    pixels: NDArray[np.int64],
    velocity_bins: Float,
    radius: int,
) -> Float:
    """Log density per square bin of velocities at pixels of a window of the field.

    Parameters
    ----------
    histogram, count
        A window of the field: (h, w, nvy, nvx) and (h, w).
    everywhere
        (nvy, nvx) the whole map's distribution, summing to one; all zero where it is empty.
    pixels
        (n, 2) as (x, y) in the window; may lie outside it, where only the map speaks.
    velocity_bins
        (n, 2) as (vx, vy) in bins, 0 being the first bin's centre; NaN in, NaN out.
    radius
        How far the pixels around reach, px.
    """
    out = np.empty(pixels.shape[0])
    for k in range(pixels.shape[0]):
        v_x, v_y = velocity_bins[k, 0], velocity_bins[k, 1]
        if not (np.isfinite(v_x) and np.isfinite(v_y)):
            out[k] = nan
            continue
        x, y = pixels[k, 0], pixels[k, 1]
        density = densities_at_pixel(histogram, count, everywhere, x, y, velocity_bins[k : k + 1], radius)[0]
        out[k] = log(max(density, 1e-300))
    return out
