"""Estimates with their 90 % intervals; None where there is too little data for one.

An interval says where the quantity lies in the long run of such traffic, not only in the flight.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from schemas.arrays import FloatArray, IntArray

LEVEL = 0.9
MIN_VEHICLES = 5
"""Fewer vehicles give no estimate."""
MIN_QUANTILE_TAIL = 2
"""A quantile needs so many values on either side of it in expectation."""


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


def estimate_mean(values: NDArray[np.floating], *, min_n: int = MIN_VEHICLES) -> Estimate | None:
    """Mean of independent values by Student's t.

    Examples
    --------
    >>> estimate_mean(np.array([1.0, 2.0]))
    >>> estimate_mean(np.array([1.0, 2.0, 3.0, 4.0, 5.0])).value
    3.0
    """
    known = values[np.isfinite(values)]
    if len(known) < min_n:
        return None
    mean = float(known.mean())
    half = float(special.stdtrit(len(known) - 1, (1 + LEVEL) / 2) * known.std(ddof=1) / np.sqrt(len(known)))
    return Estimate(mean, mean - half, mean + half, len(known))


def estimate_median(values: NDArray[np.floating]) -> Estimate | None:
    """Median of independent values, the interval by order statistics."""
    return estimate_quantile(values, 0.5)


def estimate_quantile(values: NDArray[np.floating], q: float, *, min_n: int = MIN_VEHICLES) -> Estimate | None:
    """A quantile of independent values; the interval lies between order statistics, interpolated to the level."""
    known = np.sort(values[np.isfinite(values)])
    n = len(known)
    if n < min_n or min(q, 1 - q) * n < MIN_QUANTILE_TAIL:
        return None
    # The level of the sample quantile is a beta variable (Hutson 1999): interpolated order statistics.
    low, high = (float(_fractional_order(known, q, alpha)) for alpha in ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
    return Estimate(float(np.quantile(known, q)), low, high, n)


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
    if n < min_n or min(q, 1 - q) * n < MIN_QUANTILE_TAIL:
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


def _fractional_order(ordered: FloatArray, q: float, alpha: float) -> float:
    """The order statistic, interpolated, that lies above the quantile ``q`` with probability ``alpha``."""
    n = len(ordered)
    ranks = np.arange(1, n + 1)
    above = 1 - special.betainc(ranks, n - ranks + 1, q)  # probability that the statistic of a rank lies above
    return float(np.interp(alpha, above, ordered))


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
        Total time of all slices, h.
    """
    total = float(np.sum(counts))
    if total < MIN_VEHICLES or exposure <= 0:
        return None
    factor = _dispersion(np.asarray(counts, np.float64))
    shape = (total + 0.5) / factor
    low, high = (float(special.gammaincinv(shape, p) * factor) for p in ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
    return Estimate(total / exposure, low / exposure, high / exposure, round(total))


def _dispersion(counts: FloatArray) -> float:
    """Variance over mean of the counts of slices, drawn towards 1 where there are few."""
    k = len(counts)
    if k < 2 or counts.mean() <= 0:
        return 1.0
    ratio = counts.var(ddof=1) / counts.mean()
    return float(np.clip((ratio * (k - 1) + 4.0) / (k - 1 + 4.0), 0.1, 10.0))
