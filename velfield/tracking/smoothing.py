"""Smoothing of positions whose errors are independent from one to the next, as those of detections are.

The error is measured from the positions themselves: how far each lies from the cubic through its neighbours. Then a
Kalman filter of nearly constant velocity (white noise in the acceleration; Bar-Shalom and others 2001, 6.2) runs over
each track, and back (Rauch, Tung and Striebel 1965).
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from schemas.arrays import FloatArray, IntArray

ACCELERATION_NOISE = 2.0
"""Spectral density of the acceleration, m^2/s^3: a vehicle's velocity changes by 1.4 m/s within a second."""
_FIRST_SPEED_M_PER_S = 20.0
"""Standard deviation of a velocity of which nothing is known yet."""
_NORMAL_MEDIAN = 0.6745
"""Median of the absolute value of a standard normal variable."""


@dataclass(frozen=True)
class SmoothedPaths:
    """Smoothed positions ``xy_m`` (m, 2), and the standard deviations (m,) of a position along one axis,
    ``position_sd_m``, and of a velocity, ``velocity_sd_m_per_s``."""

    xy_m: FloatArray
    position_sd_m: FloatArray
    velocity_sd_m_per_s: FloatArray


def estimate_position_error(first: IntArray, time_s: FloatArray, xy_m: FloatArray) -> float | None:
    """Standard deviation of the positions' errors along one axis, m.

    Parameters
    ----------
    first
        (n + 1,) track k has the rows ``first[k]:first[k + 1]``, in time order.
    time_s, xy_m
        (m,) times, (m, 2) positions.

    Returns
    -------
    float
        None where no track has five positions.
    """
    errors = _cubic_residuals(first, time_s, xy_m)
    errors = errors[np.isfinite(errors)]
    return float(np.median(np.abs(errors)) / _NORMAL_MEDIAN) if len(errors) else None


def smooth_paths(first: IntArray, time_s: FloatArray, xy_m: FloatArray, error_m: float) -> SmoothedPaths:
    """Smooth the positions of tracks (as of `estimate_position_error`) whose standard deviation is ``error_m``."""
    out = _smooth(first, time_s, xy_m, ACCELERATION_NOISE, error_m**2, _FIRST_SPEED_M_PER_S**2)
    return SmoothedPaths(out[:, :2].copy(), np.sqrt(out[:, 2]), np.sqrt(out[:, 3]))


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _cubic_residuals(first: IntArray, time_s: FloatArray, xy: FloatArray) -> FloatArray:
    """Distance of each position from the cubic through the two before and the two after, along each axis, over the
    standard deviation that it has where each position's own is 1; NaN where there are none."""
    out = np.full(xy.shape, np.nan)
    weight = np.zeros(4)
    for k in range(len(first) - 1):
        for i in range(first[k] + 2, first[k + 1] - 2):
            if not (np.diff(time_s[i - 2 : i + 3]) > 0).all():
                continue  # the same vehicle twice at one time
            variance = 1.0
            for u in range(4):
                j = i - 2 + u + (u > 1)
                weight[u] = 1.0
                for v in range(4):
                    other = i - 2 + v + (v > 1)
                    if v != u:
                        weight[u] *= (time_s[i] - time_s[other]) / (time_s[j] - time_s[other])
                variance += weight[u] ** 2
            for axis in range(2):
                expected = 0.0
                for u in range(4):
                    expected += weight[u] * xy[i - 2 + u + (u > 1), axis]
                out[i, axis] = (xy[i, axis] - expected) / np.sqrt(variance)
    return out


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _smooth(
    first: IntArray, time_s: FloatArray, xy: FloatArray, noise: float, error2: float, speed2: float
) -> FloatArray:
    """Rows (x, y, variance of a position, variance of a velocity). Both axes have one covariance [a b; b c]."""
    out = np.empty((len(xy), 4))
    for k in range(len(first) - 1):
        begin, n = first[k], first[k + 1] - first[k]
        state, covariance = np.empty((n, 2, 2)), np.empty((n, 3))  # after each position
        ahead, predicted = np.empty((n, 2, 2)), np.empty((n, 3))  # before it
        for i in range(n):
            if i == 0:
                a, b, c = error2, 0.0, speed2
                state[0, 0], state[0, 1] = xy[begin], 0.0
                ahead[0], predicted[0] = state[0], (a, b, c)
            else:
                dt = time_s[begin + i] - time_s[begin + i - 1]
                a, b, c = (
                    a + 2 * dt * b + dt**2 * c + noise * dt**3 / 3,
                    b + dt * c + noise * dt**2 / 2,
                    c + noise * dt,
                )
                predicted[i] = (a, b, c)
                ahead[i, 0], ahead[i, 1] = state[i - 1, 0] + dt * state[i - 1, 1], state[i - 1, 1]
                gain, speed_gain = a / (a + error2), b / (a + error2)
                miss = xy[begin + i] - ahead[i, 0]
                state[i, 0], state[i, 1] = ahead[i, 0] + gain * miss, ahead[i, 1] + speed_gain * miss
                a, b, c = (1 - gain) * a, (1 - gain) * b, c - speed_gain * b
            covariance[i] = (a, b, c)
        last, sure = state[n - 1].copy(), covariance[n - 1].copy()
        for i in range(n - 1, -1, -1):
            if i < n - 1:
                dt = time_s[begin + i + 1] - time_s[begin + i]
                a, b, c = covariance[i]
                p, q, r = predicted[i + 1]
                determinant = p * r - q * q
                # gain of the smoother: covariance, times the transposed motion, times the inverse of the prediction's
                g00 = ((a + dt * b) * r - b * q) / determinant
                g01 = (b * p - (a + dt * b) * q) / determinant
                g10 = ((b + dt * c) * r - c * q) / determinant
                g11 = (c * p - (b + dt * c) * q) / determinant
                change = last - ahead[i + 1]
                last[0] = state[i, 0] + g00 * change[0] + g01 * change[1]
                last[1] = state[i, 1] + g10 * change[0] + g11 * change[1]
                d0, d1, d2 = sure[0] - p, sure[1] - q, sure[2] - r
                sure[0] = a + g00 * (g00 * d0 + g01 * d1) + g01 * (g00 * d1 + g01 * d2)
                sure[1] = b + g10 * (g00 * d0 + g01 * d1) + g11 * (g00 * d1 + g01 * d2)
                sure[2] = c + g10 * (g10 * d0 + g11 * d1) + g11 * (g10 * d1 + g11 * d2)
            out[begin + i, 0], out[begin + i, 1] = last[0, 0], last[0, 1]
            out[begin + i, 2], out[begin + i, 3] = max(sure[0], 0.0), max(sure[2], 0.0)
    return out
