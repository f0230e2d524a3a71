"""The field as a prior for another tracker: log p(v | x).

Three levels, each speaking as loud as its data: the pixel's own passages; those of the pixels around; all of the map.
A level with n passages stands against the next with weight n : `STRENGTH`, so that where nothing is known the density
is the map's, and where the map is empty a broad Gaussian. For who foretells, standing still counts for `STANDING`
passages more on every level: a queue of another cycle of the signals stands where in this one all drove. For who asks
what is usual at a place (gate, anomaly) it does not.

Of a pixel, and of those around, each mode is a Gaussian: its weights' mean, and their covariance with the kernel and
the bins taken out, which are wider than traffic that keeps its lane. The covariance of few passages is taken together
with a usual one, longer along the velocity than across it: vehicles at one place differ in speed more than in
direction. A share stays with the bins as they are, each spread a little, for what is no Gaussian.
"""

from math import exp, floor, hypot, log, nan, pi, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from velfield.field.modes import MAX_MODES, pixel_modes, window_bins

STRENGTH = 1.0
"""Passages that a level counts for against the one before it."""
STANDING = 0.1
"""Passages that standing still counts for on every level, whether one stood there or not."""
SPREAD_SIGMA_BINS = 0.5
"""Standard deviation of a bin's spread: below half a bin the density would ripple."""
LEAST_SIGMA_BINS = 0.25
"""No mode is narrower than this, nor a passage's velocity better known: a grid of half bins can hold it."""
USUAL_ALONG, USUAL_ACROSS = 0.12, 0.03
"""Usual standard deviations of a mode along its velocity and across it, as shares of the speed."""
USUAL_COUNTS_FOR = 3.0
"""Passages that the usual covariance counts for."""
BINS_SHARE = 0.1
"""Share that stays with the bins as they are."""
BROAD_SHARE = 0.02
"""Share of the map's level that is a broad Gaussian, so that no velocity is impossible."""


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _spread(h: FloatArray, v_y: float, v_x: float) -> float:
    """Density per square bin at (v_y, v_x) of weights ``h``, each spread by a Gaussian; they need not sum to one."""
    reach = 3.5 * SPREAD_SIGMA_BINS
    total = 0.0
    for j in range(max(0, floor(v_y - reach + 0.5)), min(h.shape[0] - 1, floor(v_y + reach + 0.5)) + 1):
        for i in range(max(0, floor(v_x - reach + 0.5)), min(h.shape[1] - 1, floor(v_x + reach + 0.5)) + 1):
            if h[j, i] > 0:
                square = (v_x - i) ** 2 + (v_y - j) ** 2
                total += h[j, i] * exp(-0.5 * square / SPREAD_SIGMA_BINS**2)
    return float(total / (2.0 * pi * SPREAD_SIGMA_BINS**2))


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _mode_gaussians(h: FloatArray, n: float, blur: float, out: FloatArray) -> int:
    """Fill ``out`` (k, 6) with a Gaussian a mode: share, mean x and y, covariance xx, xy, yy, in bins; returns k.

    ``n``: passages that the weights (summing to one) stand for; ``blur``: what kernel and bins add to a variance.
    """
    modes = np.empty((out.shape[0], 3))
    found = pixel_modes((h * (1 << 20)).astype(np.int32), window_bins(max(int(n), 1)), modes)
    sums = np.zeros((found, 6))
    for y in range(h.shape[0]):
        for x in range(h.shape[1]):
            if h[y, x] > 0:
                nearest, least = 0, np.inf
                for k in range(found):
                    distance = (modes[k, 0] - y) ** 2 + (modes[k, 1] - x) ** 2
                    if distance < least:
                        least, nearest = distance, k
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
        if s[0] <= 0.0:  # a peak whose bins are all nearer to others
            continue
        dx, dy = s[1] / s[0], s[2] / s[0]
        x, y = modes[m, 1] + dx, modes[m, 0] + dy
        vx, vy = x - centre, y - centre
        speed = hypot(vx, vy)
        along = (USUAL_ALONG * speed) ** 2 + LEAST_SIGMA_BINS**2
        across = (USUAL_ACROSS * speed) ** 2 + LEAST_SIGMA_BINS**2
        ux, uy = (vx / speed, vy / speed) if speed > 1e-6 else (1.0, 0.0)  # at rest there is no along
        mine = max(n * s[0] / total, 1e-9)
        known = mine / (mine + USUAL_COUNTS_FOR)
        # A passage to come strays from the mean of few by what that mean strays, too.
        more = 1.0 + 1.0 / max(mine, 1.0)
        # Along and across the velocity, so that taking the blur out cannot leave a negative variance.
        xx, xy, yy = s[3] / s[0] - dx * dx, s[4] / s[0] - dx * dy, s[5] / s[0] - dy * dy
        own_along = max(ux * ux * xx + 2 * ux * uy * xy + uy * uy * yy - blur, LEAST_SIGMA_BINS**2)
        own_across = max(uy * uy * xx - 2 * ux * uy * xy + ux * ux * yy - blur, LEAST_SIGMA_BINS**2)
        a = more * (known * own_along + (1 - known) * along)
        b = more * (known * own_across + (1 - known) * across)
        out[kept, 0], out[kept, 1], out[kept, 2] = s[0] / total, x, y
        out[kept, 3], out[kept, 4], out[kept, 5] = (
            ux * ux * a + uy * uy * b,
            ux * uy * (a - b),
            uy * uy * a + ux * ux * b,
        )
        kept += 1
    return kept


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _level(h: FloatArray, gaussians: FloatArray, v_y: float, v_x: float) -> float:
    """Density per square bin of a level: its modes, and a share of its bins."""
    density = 0.0
    for k in range(gaussians.shape[0]):
        dx, dy = v_x - gaussians[k, 1], v_y - gaussians[k, 2]
        xx, xy, yy = gaussians[k, 3], gaussians[k, 4], gaussians[k, 5]
        determinant = xx * yy - xy * xy
        square = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / determinant
        density += gaussians[k, 0] * exp(-0.5 * square) / (2.0 * pi * sqrt(determinant))
    return float((1.0 - BINS_SHARE) * density + BINS_SHARE * _spread(h, v_y, v_x))


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _around(
    histogram: NDArray[np.int32], count: NDArray[np.int32], x: int, y: int, radius: int, around: FloatArray
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
def _about_rest(v_y: float, v_x: float, reach: float, sigma: float) -> float:
    """Density per square bin of a round Gaussian about standing still, the bin ``reach`` of either axis."""
    square = (v_x - reach) ** 2 + (v_y - reach) ** 2
    return exp(-0.5 * square / (sigma * sigma)) / (2.0 * pi * sigma * sigma)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _with_next(n: float, level: float, below: float, stands: float, counts: float) -> float:
    """A level's density with that of the level before it and of what stands, each by the passages it counts for."""
    return (n * level + STRENGTH * below + counts * stands) / (n + STRENGTH + counts)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _of_the_map(everywhere: FloatArray, known: bool, v_y: float, v_x: float) -> float:
    """Density per square bin where nothing is known of the place; ``known``: whether anything is of the map."""
    reach = (everywhere.shape[0] - 1) / 2
    of_broad = _about_rest(v_y, v_x, reach, reach / 2)
    share = BROAD_SHARE if known else 1.0
    return float((1.0 - share) * _spread(everywhere, v_y, v_x) + share * of_broad)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def densities_at_pixel(
    histogram: NDArray[np.int32],
    count: NDArray[np.int32],
    everywhere: FloatArray,
    x: int,
    y: int,
    velocity_bins: FloatArray,
    radius: int,
    blur: float,
    standing: float,
) -> FloatArray:
    """Density per square bin of velocities (n, 2) as (vx, vy) at one pixel of a window of the field, (n,).

    ``standing``: passages that standing still counts for. The other parameters are those of `log_density_in_window`.
    """
    around: FloatArray = np.zeros(everywhere.shape)
    near = _around(histogram, count, x, y, radius, around)
    inside = 0 <= y < count.shape[0] and 0 <= x < count.shape[1]
    here = float(count[y, x]) if inside else 0.0
    known = everywhere.sum() > 0.0
    own: FloatArray = np.zeros(everywhere.shape)
    if here > 0.0:
        own += histogram[y, x]
        own /= own.sum()
    of_near, of_here = np.empty((MAX_MODES, 6)), np.empty((MAX_MODES, 6))
    of_near = of_near[: _mode_gaussians(around, near, blur, of_near) if near > 0.0 else 0]
    of_here = of_here[: _mode_gaussians(own, here, blur, of_here) if here > 0.0 else 0]
    out = np.empty(velocity_bins.shape[0])
    for k in range(velocity_bins.shape[0]):
        v_x, v_y = velocity_bins[k, 0], velocity_bins[k, 1]
        stands = _about_rest(v_y, v_x, (everywhere.shape[0] - 1) / 2, LEAST_SIGMA_BINS)
        density = _with_next(0.0, 0.0, _of_the_map(everywhere, known, v_y, v_x), stands, standing)
        if near > 0.0:
            density = _with_next(near, _level(around, of_near, v_y, v_x), density, stands, standing)
        if here > 0.0:
            density = _with_next(here, _level(own, of_here, v_y, v_x), density, stands, standing)
        out[k] = density
    return out


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def log_density_in_window(
    histogram: NDArray[np.int32],
    count: NDArray[np.int32],
    everywhere: FloatArray,
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
    everywhere
        (nvy, nvx) the whole map's distribution, summing to one; all zero where it is empty.
    pixels
        (n, 2) as (x, y) in the window; may lie outside it, where only the map speaks.
    velocity_bins
        (n, 2) as (vx, vy) in bins, 0 being the first bin's centre; NaN in, NaN out.
    radius
        How far the pixels around reach, px.
    blur
        What the kernel and the bins add to a variance, bins^2.
    """
    out = np.empty(pixels.shape[0])
    for k in range(pixels.shape[0]):
        v_x, v_y = velocity_bins[k, 0], velocity_bins[k, 1]
        if not (np.isfinite(v_x) and np.isfinite(v_y)):
            out[k] = nan
            continue
        x, y = pixels[k, 0], pixels[k, 1]
        here = velocity_bins[k : k + 1]
        density = densities_at_pixel(histogram, count, everywhere, x, y, here, radius, blur, STANDING)[0]
        out[k] = log(max(density, 1e-300))
    return out
