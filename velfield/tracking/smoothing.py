"""Smoothing of positions whose errors may last, as those of boxes that keep to a shadow, or of a drifting map, do.

The error along an axis is white noise and an Ornstein-Uhlenbeck process. Both are measured on the tracks, by the
spectrum of residuals: of vehicles that stand along both axes, of those that drive across their direction. The smoother
is the fixed-interval smoother of a vehicle whose acceleration is white noise (Bar-Shalom and others 2001, 6.2) observed
with these errors. As positions and errors are Markov chains its normal equations are banded: all tracks are one system.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import solveh_banded
from scipy.optimize import minimize

from schemas.arrays import FloatArray, IntArray, Mask

LEAST_ERROR_M = 0.05
"""Smaller errors, as data sets of smoothed trajectories have them, are left as they are."""
ACCELERATION_NOISE = 2.0
"""Spectral density of the acceleration, m^2/s^3: a vehicle's velocity changes by 1.4 m/s within a second."""
_WINDOWS_S, _POINTS = (6.0, 3.0, 1.5), 24
"""Windows whose residuals are measured: the longest that enough tracks fill; and points in each at most."""
_MAX_WINDOWS = 4000
_STANDS_M, _DRIVES_M_PER_S = 1.0, 2.5
"""A vehicle stands in a window in whose halves its mean place differs by less, and drives where it is faster."""
_MIN_WINDOWS = 8
_CHI2_MEDIAN = 0.4549
"""Median of the square of a standard normal variable."""
_LASTING_S = (0.3, 3.0)
"""Limits of the time over which errors last."""
_LEAST_M = 1e-3
_CHUNK = 500_000
_JUMP_M, _JUMP_SIGMAS = 3.0, 14.0
"""A step that differs by more from those around it goes from one vehicle to another."""
_STAND_S, _STAND_M_PER_S, _STAND_SIGMAS = 2.0, 0.4, 2.6
"""A vehicle stands where its displacement over 2 s, for as long or longer, is slower than this or within its errors."""
_EDGE_S, _STAND_SD_M = 0.6, 0.01
"""So long after it stops and before it goes a vehicle may still move; between, a step has this standard deviation."""


@dataclass(frozen=True)
class PositionErrors:
    """Errors of positions along one axis: the standard deviations of white noise and of noise that lasts, m, and the
    time ``lasts_s`` in which the correlation of the second falls to 1/e, s."""

    white_m: float
    lasting_m: float
    lasts_s: float

    @property
    def total_m(self) -> float:
        """Standard deviation of a position."""
        return float(np.hypot(self.white_m, self.lasting_m))

    def lasting_covariance(self, lag_s: FloatArray) -> FloatArray:
        """Covariances of the noise that lasts, m^2, between positions that lie these times >= 0 apart."""
        return np.asarray(self.lasting_m**2 * np.exp(-lag_s / self.lasts_s))

    @property
    def text(self) -> str:
        """For people: what errors were found."""
        if self.lasting_m < 0.1 * self.white_m:
            return f"{self.white_m:.2f} m, new at each position"
        return f"{self.total_m:.2f} m, of which {self.lasting_m:.2f} m last {self.lasts_s:.1f} s"


def speed_sd_m_per_s(position_sd_m: float) -> float:
    """Standard deviation of a speed, m/s, of tracks whose smoothed positions have this one: of a smoother of white
    acceleration it follows from it.

    Examples
    --------
    >>> speed_sd_m_per_s(0.0), round(speed_sd_m_per_s(0.3), 2)
    (0.0, 0.6)
    """
    return float(np.cbrt(ACCELERATION_NOISE * position_sd_m / (2 * np.sqrt(2))))


@dataclass(frozen=True)
class CleanTracks:
    """Tracks without their errors."""

    track: IntArray
    """(m,) id of the track of each position: new ones where a track was cut."""
    xy_m: FloatArray
    """(m, 2) smoothed positions."""
    errors: PositionErrors | None
    """Errors of the unsmoothed positions; None: not known, or too small to smooth."""
    position_sd_m: float
    velocity_sd_m_per_s: float
    """Standard deviations along one axis that are left; 0 where nothing was smoothed."""
    cuts: int
    """Number of places at which a track jumped from one vehicle to another."""

    @property
    def notes(self) -> list[str]:
        """For people: what errors were found, and what was done."""
        out = (
            []
            if self.errors is None
            else [f"the positions have errors of {self.errors.text}: smoothed to {self.position_sd_m:.2f} m"]
        )
        return out + ([f"{self.cuts} jumps from one vehicle to another: tracks cut there"] if self.cuts else [])


def clean_tracks(track: IntArray, time_s: FloatArray, xy_m: FloatArray) -> CleanTracks:
    """Measure the errors of tracks, cut them where they jump, and smooth them where their errors reach `LEAST_ERROR_M`.

    Parameters
    ----------
    track, time_s, xy_m
        (m,) track and time, (m, 2) position; sorted by track and time.
    """
    first = _first_rows(track)
    errors = measure_errors(first, time_s, xy_m)
    jumps = find_jumps(first, time_s, xy_m, errors.total_m if errors else 0.0)
    if jumps.any():
        piece = np.cumsum(jumps)
        begun = np.repeat(piece[first[:-1]], np.diff(first))  # pieces before this track
        track = np.where(piece > begun, track.max() + piece, track)
        first = _first_rows(track)
    cuts = int(jumps.sum())
    if errors is None or errors.total_m < LEAST_ERROR_M:
        return CleanTracks(track, xy_m, None, 0.0, 0.0, cuts)
    smoothed, position_sd_m, velocity_sd_m_per_s = smooth_paths(first, time_s, xy_m, errors)
    return CleanTracks(track, smoothed, errors, position_sd_m, velocity_sd_m_per_s, cuts)


def _first_rows(track: IntArray) -> IntArray:
    return np.asarray(np.r_[0, np.flatnonzero(np.diff(track)) + 1, len(track)], np.int64)


def measure_errors(first: IntArray, time_s: FloatArray, xy_m: FloatArray) -> PositionErrors | None:
    """Errors of the positions.

    Parameters
    ----------
    first
        (n + 1,) track k has the rows ``first[k]:first[k + 1]``, in time order.
    time_s, xy_m
        (m,) times, (m, 2) positions.

    Returns
    -------
    PositionErrors
        None where too few tracks are long enough to show them.
    """
    found = (_measure(first, time_s, xy_m, window_s) for window_s in _WINDOWS_S)
    return next((errors for errors in found if errors is not None), None)


def _measure(first: IntArray, time_s: FloatArray, xy_m: FloatArray, window_s: float) -> PositionErrors | None:
    rows, step_s = _windows(first, time_s, window_s)
    if len(rows) < _MIN_WINDOWS:
        return None
    n = rows.shape[1]
    place = xy_m[rows]
    half = place[:, n // 2 :].mean(axis=1) - place[:, : n // 2].mean(axis=1)
    gone = np.hypot(*(place[:, -n // 4 :].mean(axis=1) - place[:, : n // 4].mean(axis=1)).T)
    stands, drives = np.hypot(*half.T) < _STANDS_M, gone > _DRIVES_M_PER_S * step_s * n
    direction = half / np.maximum(np.hypot(*half.T), 1e-9)[:, None]
    across = place[..., 1] * direction[:, None, 0] - place[..., 0] * direction[:, None, 1]
    groups = [
        (np.concatenate([place[stands][..., 0], place[stands][..., 1]]), 1),  # a slow creep is not an error
        (across[drives], 3),  # nor is a bend
    ]
    spectra = []
    lag_s = np.asarray(step_s * np.arange(n), np.float64)
    for values, degree in groups:
        if len(values) < _MIN_WINDOWS:
            continue
        basis = _contrasts(n, degree)
        power = np.median((values @ basis) ** 2, axis=0) / _CHI2_MEDIAN
        weight = np.full(len(power), min(len(values), 200) / len(power))
        spectra.append((_lag_weights(basis), power, weight))
    if not spectra:
        return None
    by_lag, power, weight = (np.concatenate(parts) for parts in zip(*spectra, strict=True))
    measured = np.log(power + _LEAST_M**2)

    def misfit(parameters: FloatArray) -> float:
        errors = _errors(parameters)
        # White noise gives all contrasts the same power: they are orthonormal.
        expected = by_lag @ errors.lasting_covariance(lag_s) + (errors.white_m**2 + _LEAST_M**2)
        return float(weight @ (measured - np.log(expected)) ** 2)

    start = np.sqrt(max(float(np.median(spectra[0][1][-n // 3 :])), _LEAST_M**2))
    found = [
        minimize(misfit, np.log([start, lasting, lasts]), method="Nelder-Mead", options={"maxiter": 300})
        for lasting in (0.1 * start + _LEAST_M, 3 * start)
        for lasts in (0.6, 1.5)
    ]
    return _errors(min(found, key=lambda result: float(result.fun)).x)


def _lag_weights(basis: FloatArray) -> FloatArray:
    """(k, n) weights that take the covariances at lags of 0 to n - 1 points to the powers of contrasts (n, k)."""
    n = len(basis)
    products = np.stack([np.sum(basis[lag:] * basis[: n - lag], axis=0) for lag in range(n)], axis=1)
    return np.asarray(products * np.where(np.arange(n) == 0, 1, 2))


def _errors(parameters: FloatArray) -> PositionErrors:
    white, lasting, lasts = np.exp(np.minimum(np.maximum(parameters, -12.0), 5.0)).tolist()
    return PositionErrors(white, lasting, min(max(lasts, _LASTING_S[0]), _LASTING_S[1]))


def _windows(first: IntArray, time_s: FloatArray, window_s: float) -> tuple[IntArray, float]:
    """Rows (windows, points) evenly spaced in time, and their spacing, s; windows with gaps are left out."""
    own_s = _median_step_s(first, time_s)
    stride = max(round(window_s / _POINTS / own_s), 1)
    points = max(min(int(window_s / (stride * own_s)), _POINTS), 8)
    span = (points - 1) * stride
    windows = [np.arange(a, b - span, span + 1) for a, b in pairwise(first.tolist())]
    starts = np.concatenate([np.empty(0, np.int64), *windows])
    lasts = time_s[starts + span] - time_s[starts]
    starts = starts[np.abs(lasts - span * own_s) < 0.15 * span * own_s]
    starts = starts[:: max(len(starts) // _MAX_WINDOWS, 1)]
    return starts[:, None] + stride * np.arange(points), stride * own_s


def _contrasts(n: int, degree: int) -> FloatArray:
    """(n, n - degree - 1) orthonormal contrasts free of polynomials of a degree, slow ones first."""
    k = np.arange(n)
    cosines = np.cos(np.pi * (k[:, None] + 0.5) * k / n)
    powers = np.linspace(-1, 1, n)[:, None] ** np.arange(degree + 1)
    return np.asarray(np.linalg.qr(np.column_stack([powers, cosines]))[0][:, degree + 1 : n])


def smooth_paths(
    first: IntArray, time_s: FloatArray, xy_m: FloatArray, errors: PositionErrors
) -> tuple[FloatArray, float, float]:
    """Smoothed positions (m, 2) of tracks (as of `measure_errors`) that have these errors.

    Also the standard deviations along one axis in the middle of a long track: of a position, m, and of a velocity, m/s.
    """
    position, velocity, slow = _deviations(first, time_s, errors)
    out = _solve(first, time_s, xy_m, errors, np.zeros(len(xy_m), bool))
    stands = _find_stands(first, time_s, out, position, slow)
    if stands.any():
        out = _solve(first, time_s, xy_m, errors, stands)
    return out, position, velocity


def _solve(first: IntArray, time_s: FloatArray, xy_m: FloatArray, errors: PositionErrors, stands: Mask) -> FloatArray:
    """The most probable positions; where a vehicle stands, one place."""
    out = np.empty_like(xy_m)
    begin = 0
    while begin < len(first) - 1:  # whole tracks, so many rows at a time
        end = max(int(np.searchsorted(first, first[begin] + _CHUNK, side="right")) - 1, begin + 1)
        rows = slice(int(first[begin]), int(first[end]))
        bands = _bands(first[begin : end + 1] - first[begin], time_s[rows], errors, stands[rows])
        origin = xy_m[rows].mean(axis=0) if rows.stop > rows.start else 0.0
        observed = np.zeros((2 * (rows.stop - rows.start), 2))
        observed[::2] = observed[1::2] = (xy_m[rows] - origin) / max(errors.white_m, _LEAST_M) ** 2
        out[rows] = solveh_banded(bands, observed)[::2] + origin
        begin = end
    return out


def _find_stands(
    first: IntArray, time_s: FloatArray, xy_m: FloatArray, position_sd_m: float, slow_sd_m_per_s: float
) -> Mask:
    """Whether a vehicle stands at each of its smoothed positions."""
    out = np.zeros(len(time_s), bool)
    owner = np.repeat(np.arange(len(first) - 1), np.diff(first))
    reach = max(round(_STAND_S / 2 / _median_step_s(first, time_s)), 1)
    rows = np.arange(len(time_s))
    low = np.maximum(rows - reach, first[:-1][owner])
    high = np.minimum(rows + reach, first[1:][owner] - 1)
    duration = np.maximum(time_s[high] - time_s[low], 1e-3)
    speed = np.hypot(*(xy_m[high] - xy_m[low]).T) / duration
    slow = (speed < max(_STAND_M_PER_S, _STAND_SIGMAS * slow_sd_m_per_s)) & (duration > _STAND_S / 2)
    edge = np.flatnonzero(np.diff(np.r_[-1, np.where(slow, owner, -1), -1]) != 0)
    for a, b in pairwise(edge.tolist()):
        if not slow[a] or time_s[b - 1] - time_s[a] < _STAND_S:
            continue
        a_in, b_in = (int(np.searchsorted(time_s[a:b], t)) + a for t in (time_s[a] + _EDGE_S, time_s[b - 1] - _EDGE_S))
        middle = (a_in + b_in) // 2
        if b_in - a_in < 2:
            continue
        drift = float(np.hypot(*(xy_m[middle:b_in].mean(axis=0) - xy_m[a_in : middle + 1].mean(axis=0))))
        out[a_in:b_in] = drift < max(1.0, 4 * position_sd_m)
    return out


def _median_step_s(first: IntArray, time_s: FloatArray) -> float:
    """Median time from one position of a track to the next, s."""
    within = np.ones(max(len(time_s) - 1, 0), bool)
    within[first[1:-1] - 1] = False
    steps = np.diff(time_s)[within]
    steps = steps[steps > 0]
    return float(np.median(steps)) if len(steps) else 0.2


def _bands(first: IntArray, time_s: FloatArray, errors: PositionErrors, stands: Mask) -> FloatArray:
    """Upper bands (5, 2 n) of the normal equations of position and lasting error, alternating, of each row."""
    n = len(time_s)
    out = np.zeros((5, 2 * n))
    main, off1, off2, off4 = out[4], out[3], out[2], out[0]
    weight = 1 / max(errors.white_m, _LEAST_M) ** 2
    main += weight
    off1[1::2] = weight  # position and error of one row add up to the observation
    same = np.ones(n, bool)
    same[first[:-1][first[:-1] < n]] = False  # whether the row before is of the same track
    dt = np.maximum(np.diff(time_s, prepend=time_s[:1]), 1e-3)
    # an Ornstein-Uhlenbeck process: e[i] = a e[i - 1] + noise
    variance = max(errors.lasting_m, _LEAST_M) ** 2
    a = np.where(same, np.exp(-dt / errors.lasts_s), 0.0)
    precision = 1 / (variance * (1 - a**2))
    main[1::2] += precision
    main[1:-1:2] += (a**2 * precision)[1:]
    off2[3::2] -= (a * precision)[1:]
    # white acceleration: the second divided difference of the positions has the variance noise / duration
    inner = np.flatnonzero(same[1:-1] & same[2:]) + 1
    before, after = dt[inner], dt[inner + 1]
    w = (before + after) / 2 / ACCELERATION_NOISE
    c0, c2 = 2 / (before * (before + after)), 2 / (after * (before + after))
    c1 = -c0 - c2
    even = 2 * inner
    np.add.at(main, even - 2, w * c0**2)
    np.add.at(main, even, w * c1**2)
    np.add.at(main, even + 2, w * c2**2)
    np.add.at(off2, even, w * c0 * c1)
    np.add.at(off2, even + 2, w * c1 * c2)
    np.add.at(off4, even + 2, w * c0 * c2)
    still = 2 * (np.flatnonzero(stands[1:] & stands[:-1] & same[1:]) + 1)
    for band, rows, sign in ((main, still, 1), (main, still - 2, 1), (off2, still, -1)):
        np.add.at(band, rows, sign / _STAND_SD_M**2)
    return out


def _deviations(first: IntArray, time_s: FloatArray, errors: PositionErrors) -> tuple[float, float, float]:
    """Standard deviations in the middle of a long track: of a position, m, of a velocity, and of the mean velocity of
    `_STAND_S`, m/s."""
    dt = _median_step_s(first, time_s)
    n = int(np.clip(24.0 / dt, 21, 2000))
    bands = _bands(np.array([0, n]), np.asarray(dt * np.arange(n), np.float64), errors, np.zeros(n, bool))
    k = n - n % 2
    unit = np.zeros((2 * n, 3))
    unit[k, 0] = 1.0
    unit[k + 2, 1], unit[k - 2, 1] = 0.5 / dt, -0.5 / dt
    reach = min(max(round(_STAND_S / 2 / dt), 1), n // 4)
    unit[k + 2 * reach, 2], unit[k - 2 * reach, 2] = 0.5 / (reach * dt), -0.5 / (reach * dt)
    position, velocity, slow = np.sqrt(np.maximum((unit * solveh_banded(bands, unit)).sum(axis=0), 0.0)).tolist()
    return position, velocity, slow


def find_jumps(first: IntArray, time_s: FloatArray, xy_m: FloatArray, error_m: float) -> Mask:
    """Whether each position (m,) begins the track of another vehicle: the step to it differs from those before and
    after by more than errors, or driving, explain."""
    same = np.ones(len(time_s), bool)
    same[first[:-1][first[:-1] < len(time_s)]] = False
    out = np.zeros(len(time_s), bool)
    if len(time_s) < 4:
        return out
    dt = np.maximum(np.diff(time_s), 1e-3)
    moved = np.diff(xy_m, axis=0)
    rows = np.flatnonzero(same[1:-2] & same[2:-1] & same[3:]) + 2  # the step to row i lies between two others
    around = (moved[rows - 2] / dt[rows - 2, None] + moved[rows] / dt[rows, None]) / 2
    excess = np.hypot(*(moved[rows - 1] - around * dt[rows - 1, None]).T)
    driven = 4.0 * dt[rows - 1] ** 2  # braking hard across a gap
    unlike = np.zeros(len(time_s))
    unlike[rows] = excess
    largest = (unlike[rows] > unlike[rows - 1]) & (unlike[rows] >= unlike[rows + 1])  # the steps beside it differ, too
    out[rows] = largest & (excess > np.maximum(_JUMP_M, _JUMP_SIGMAS * error_m) + driven)
    return out
