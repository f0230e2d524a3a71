"""Estimates with their 90 % intervals; None where there is too little data for one.

An interval says where the quantity lies in the long run of such traffic, not only in the flight. Vehicles that pass
soon after each other are alike: a platoon has one speed, a queue waits. Where their times are given the interval is
that of as many independent vehicles as tell as much.
"""

from dataclasses import dataclass
from itertools import count

import numpy as np
from numpy.typing import NDArray
from scipy import special

from schemas.arrays import FloatArray, IntArray
from velfield.compiled import kernel

LEVEL = 0.9
_LEAST_EXPOSURE_H = 59 / 3600
_BUNCHED = 1.15
"""Variance over mean of the number of U-turns in 300 s, of 150 simulated clips: of few events it cannot be measured."""
MIN_VEHICLES = 5
"""Fewer vehicles give no estimate."""
_MAX_SKEW = 0.8
"""Skewness of a mean times Student's t: by this the longer side of an interval grows by half."""
_ALIKE_S = 5.0
"""Time between two vehicles in which the correlation of their speeds and delays falls to 1/e."""
_ALIKE, _ALIKE_PAIRS = 0.7, 15.0
"""Correlation of vehicles that pass at once before any is seen, and the number of pairs that it counts for."""


@dataclass(frozen=True)
class Estimate:
    """A number, its 90 % interval and the number of vehicles (or cycles, or events) that it rests on."""

    value: float
    low: float
    high: float
    n: int

    def in_units(self, factor: float) -> "Estimate":
        """In another unit."""
        return Estimate(self.value * factor, self.low * factor, self.high * factor, self.n)


def independent_vehicles(values: FloatArray, time_s: FloatArray) -> float:
    """Number of independent vehicles whose mean is as accurate as that of these values (n,), seen at times.

    The correlation is taken to fall exponentially with the time between two vehicles; how large it is follows from all
    pairs, by least squares.

    Examples
    --------
    >>> round(independent_vehicles(np.array([1.0, 2.0, 2.0, 1.0]), 100.0 * np.arange(4)), 1)
    4.0
    >>> round(independent_vehicles(np.array([1.0, 1.1, 2.0, 2.1]), np.array([0.0, 1.0, 50.0, 51.0])), 1)
    2.5
    """
    order = np.argsort(time_s, kind="stable")
    x, n = values[order] - values.mean(), len(values)
    variance = float(x.var())
    decay = np.exp(-np.diff(time_s[order]) / _ALIKE_S)
    pairs, squares, products = _pair_sums(x / np.sqrt(variance) if variance > 0 else 0 * x, decay)
    # of deviations from their own mean a pair's product is too low by 1 / n
    alike = (products + pairs / n + _ALIKE_PAIRS * _ALIKE) / (squares + _ALIKE_PAIRS)
    return float(n / (1 + 2 * np.clip(alike, 0.0, 1.0) * pairs / n))


@kernel
def _pair_sums(x: FloatArray, decay: FloatArray) -> tuple[float, float, float]:
    """Sums over all pairs of their weight, its square, and the weighted product of their values (n,); the weight is the
    product of ``decay`` (n - 1,) between them."""
    pairs = squares = products = 0.0
    weight = square = product = 0.0
    for i in range(1, len(x)):
        weight = (weight + 1.0) * decay[i - 1]
        square = (square + 1.0) * decay[i - 1] ** 2
        product = (product + x[i - 1]) * decay[i - 1]
        pairs += weight
        squares += square
        products += product * x[i]
    return pairs, squares, products


def estimate_mean(
    values: NDArray[np.floating],
    time_s: FloatArray | None = None,
    *,
    min_n: int = MIN_VEHICLES,
    spread: tuple[float, int] = (0.0, 0),
) -> Estimate | None:
    """Mean by Student's t, corrected for skewness (Hall 1992), of independent values unless their times are given.

    Where no value is below 0 the interval is not either.

    Parameters
    ----------
    values, time_s
        (n,) values, NaN where one is not known, and when they were seen.
    min_n
        Fewest values.
    spread
        Standard deviation of values like these, and the number of values that it counts for: few may be alike by
        chance.

    Examples
    --------
    >>> estimate_mean(np.array([1.0, 2.0]))
    >>> estimate_mean(np.array([1.0, 2.0, 3.0, 4.0, 5.0])).value
    3.0
    """
    known, n, effective = _known(values, time_s)
    if n < min_n:
        return None
    mean = float(known.mean())
    degrees = effective - 1 + spread[1]
    sd = np.sqrt(((effective - 1) * known.var(ddof=1) + spread[1] * spread[0] ** 2) / degrees)
    t, error = float(special.stdtrit(degrees, (1 + LEVEL) / 2)), float(sd / np.sqrt(effective))
    scale = float(known.std())
    skewness = float(((known - mean) ** 3).mean()) / scale**3 if scale > 0 else 0.0
    low, high = (mean - _of_skewed(end, skewness / float(np.sqrt(effective))) * error for end in (t, -t))
    return Estimate(mean, max(low, 0.0) if known.min() >= 0 < mean else low, high, n)


def _of_skewed(t: float, skewness: float) -> float:
    """The quantile of Student's statistic of a mean with a skewness, from that of one without (Hall 1992)."""
    # the expansion holds for small corrections; the skewness of few values is mostly chance
    skewness = float(np.clip(skewness, -_MAX_SKEW / abs(t), _MAX_SKEW / abs(t)))
    if abs(skewness) < 1e-6:
        return t
    return float(3 / skewness * (np.cbrt(1 + skewness * (t - skewness / 6)) - 1))


def _known(values: NDArray[np.floating], time_s: FloatArray | None) -> tuple[FloatArray, int, float]:
    """Values that are known, their number, and the number of independent ones that tell as much of their mean."""
    known = np.isfinite(values)
    used, n = values[known].astype(np.float64), int(known.sum())
    if time_s is None or n < 2:
        return used, n, float(n)
    return used, n, max(independent_vehicles(used, time_s[known]), 2.0)


def estimate_median(values: NDArray[np.floating], time_s: FloatArray | None = None) -> Estimate | None:
    """Median, the interval by order statistics: of independent values unless their times are given."""
    return estimate_quantile(values, 0.5, time_s)


def estimate_quantile(
    values: NDArray[np.floating], q: float, time_s: FloatArray | None = None, *, min_n: int = MIN_VEHICLES
) -> Estimate | None:
    """A quantile; the interval lies between order statistics, interpolated to the level; None where it would reach
    beyond the least or the largest value. The values are independent unless their times are given."""
    known = np.isfinite(values)
    n = int(known.sum())
    if n < min_n:
        return None
    used = values[known].astype(np.float64)
    value = float(np.quantile(used, q))
    effective = float(n) if time_s is None else independent_vehicles((used <= value) * 1.0, time_s[known])
    if not _has_interval(effective, q):
        return None
    # The level of the sample quantile is a beta variable (Hutson 1999): interpolated order statistics.
    ordered = np.sort(used)
    low, high = (float(_fractional_order(ordered, effective, q, a)) for a in ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
    return Estimate(value, low, high, n)


def _has_interval(n: float, q: float) -> bool:
    """Whether all of n independent values lie on one side of a quantile less often than its interval may miss it."""
    return bool(max(q, 1 - q) ** n <= (1 - LEVEL) / 2)


def vehicles_for_quantile(q: float) -> int:
    """Smallest number of independent vehicles of which the quantile ``q``, between 0 and 1, has an interval.

    Examples
    --------
    >>> vehicles_for_quantile(0.5), vehicles_for_quantile(0.15), vehicles_for_quantile(0.85)
    (5, 19, 19)
    """
    return next(n for n in count(MIN_VEHICLES) if _has_interval(n, q))


def estimate_censored_quantile(
    values: NDArray[np.floating], observed: NDArray[np.bool_], q: float, *, min_n: int = MIN_VEHICLES
) -> Estimate | None:
    """A quantile of independent values of which some are known only to be larger than what was measured.

    The product-limit estimator (Kaplan and Meier); the interval inverts its own at each value, by Greenwood's variance
    of log(-log S). Without such values it is `estimate_quantile`.

    Parameters
    ----------
    values
        (n,) values, or lower bounds.
    observed
        (n,) False where the value is a lower bound.
    min_n
        Fewest observed values.

    Examples
    --------
    >>> values, observed = np.arange(1.0, 12.0), np.arange(11) != 2
    >>> estimate_censored_quantile(values, observed, 0.5).value
    7.0
    """
    if observed.all():
        return estimate_quantile(values, q, min_n=min_n)
    n = int(observed.sum())
    if n < min_n or not _has_interval(n, q):
        return None
    order = np.lexsort((~observed, values))
    ordered, event = values[order].astype(np.float64), observed[order].astype(np.float64)
    at_risk = len(ordered) - np.arange(len(ordered))
    last = int(np.flatnonzero(event)[-1])
    ordered, event, at_risk = ordered[: last + 1], event[: last + 1], at_risk[: last + 1]
    survival = np.cumprod(1 - event / at_risk)
    variance = np.cumsum(event / np.maximum(at_risk * (at_risk - event), 0.5))
    known = np.flatnonzero((survival > 0) & (survival < 1))
    if not len(known):
        return None
    z = float(special.ndtri((1 + LEVEL) / 2)) * np.sqrt(variance[known]) / np.abs(np.log(survival[known]))
    curves = (survival[known] ** np.exp(z), survival[known], survival[known] ** np.exp(-z))
    low, value, high = (_first_below(np.asarray(curve), ordered[known], 1 - q) for curve in curves)
    if low is None or value is None:
        return None  # too many lower bounds: the quantile lies above all that was observed
    return Estimate(value, low, float(ordered[-1]) if high is None else high, n)


def _first_below(curve: FloatArray, values: FloatArray, level: float) -> float | None:
    rows = np.flatnonzero(curve <= level)
    return float(values[rows[0]]) if len(rows) else None


def _fractional_order(ordered: FloatArray, n: float, q: float, alpha: float) -> float:
    """The order statistic, interpolated, that lies above the quantile ``q`` with probability ``alpha`` if ``n`` of the
    values are independent."""
    ranks = np.linspace(1, n, round(n))
    above = 1 - special.betainc(ranks, n - ranks + 1, q)  # probability that the statistic of a rank lies above
    level = np.interp(alpha, above, ranks / (n + 1))
    return float(np.interp(level, np.arange(1, len(ordered) + 1) / (len(ordered) + 1), ordered))


def estimate_share(successes: float, n: int) -> Estimate | None:
    """A fraction of independent vehicles, by the interval of Jeffreys."""
    if n < MIN_VEHICLES:
        return None
    a, b = successes + 0.5, n - successes + 0.5
    low = 0.0 if successes <= 0 else float(special.betaincinv(a, b, (1 - LEVEL) / 2))
    high = 1.0 if successes >= n else float(special.betaincinv(a, b, (1 + LEVEL) / 2))
    return Estimate(successes / n, low, high, n)


def estimate_rate(counts: IntArray | FloatArray, exposure: float) -> Estimate | None:
    """Events per unit of exposure from counts of equal slices of it; slices show how much more, or less, than Poisson
    the events vary.

    Parameters
    ----------
    counts
        (k,) events in k slices of equal length.
    exposure
        Total time of all slices, h; None is returned of less than a minute, in which a platoon may come or not.
    """
    total = float(np.sum(counts))
    if total < MIN_VEHICLES or exposure < _LEAST_EXPOSURE_H:
        return None
    factor = _dispersion(np.asarray(counts, np.float64))
    shape = (total + 0.5) / factor
    low, high = (float(special.gammaincinv(shape, p) * factor) for p in ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
    return Estimate(total / exposure, low / exposure, high / exposure, round(total))


def estimate_event_rate(events: int, hours: float) -> Estimate:
    """Events an hour of few that come by chance, the interval by Poisson's law, a little wider as they come in bunches;
    of none from 0 to the rate that is not exceeded.

    Examples
    --------
    >>> rate = estimate_event_rate(3, 0.1)
    >>> round(rate.value), round(rate.low), round(rate.high)
    (30, 10, 73)
    """
    if events == 0:
        return Estimate(0.0, 0.0, float(-np.log(1 - LEVEL)) / hours, 0)
    shape = (events + 0.5) / _BUNCHED
    low, high = (float(special.gammaincinv(shape, p)) * _BUNCHED / hours for p in ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
    return Estimate(events / hours, low, high, events)


def _dispersion(counts: FloatArray) -> float:
    """Variance over mean of the counts of slices, drawn towards 1 where there are few."""
    k = len(counts)
    if k < 2 or counts.mean() <= 0:
        return 1.0
    ratio = counts.var(ddof=1) / counts.mean()
    return float(np.clip((ratio * (k - 1) + 4.0) / (k - 1 + 4.0), 0.1, 10.0))
