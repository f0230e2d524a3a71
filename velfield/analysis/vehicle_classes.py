"""Classes of vehicles from their length and width: motorcycle, car, van, lorry or bus.

Dimensions overlap. So vehicles are counted by class not by the most probable
class of each, but by the shares under which all their dimensions together are most likely; and a share is as uncertain
as the measurements leave it.
"""

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from schemas.arrays import FloatArray, IntArray
from velfield.analysis.intervals import Estimate, estimate_share


@dataclass(frozen=True)
class _VehicleClass:
    """Mean and standard deviation of length and width over the vehicles of a class, m, and its share of traffic."""

    name: str
    length_m: tuple[float, float]
    width_m: tuple[float, float]
    share: float


_CLASSES = (
    _VehicleClass("motorcycle", (2.1, 0.25), (0.8, 0.12), 0.02),
    _VehicleClass("car", (4.35, 0.4), (1.79, 0.1), 0.80),
    _VehicleClass("van", (5.45, 0.45), (1.98, 0.12), 0.12),
    _VehicleClass("lorry or bus", (9.8, 2.4), (2.5, 0.1), 0.06),
)
CLASS_NAMES = tuple(one.name for one in _CLASSES)
COUNTED_CLASSES = ("motorcycle", "car or van", "lorry or bus")
"""Cars and vans are counted together: dimensions do not separate a long car from a short van, wherever the classes are
taken to begin."""
HEAVY = COUNTED_CLASSES.index("lorry or bus")
_COUNTED = np.array([[1.0, 0, 0], [0, 1, 0], [0, 1, 0], [0, 0, 1]])
"""(classes, counted classes) to which of these each class belongs."""
_USUAL_SHARES = np.array([one.share for one in _CLASSES])
_USUAL_VEHICLES = 20.0
"""The shares of usual traffic count as much as so many vehicles of the flight."""
_EM_STEPS = 60
_DRAWS = 500
"""Vehicles drawn, of each class, to find how well the measurements separate the classes."""


@dataclass(frozen=True)
class VehicleClasses:
    """Classes of the vehicles of a flight, of which there are k: `COUNTED_CLASSES`."""

    probability: FloatArray
    """(n, k); NaN of vehicles that were not measured."""
    shares: FloatArray
    """(k,) in the flight's traffic."""
    separability: FloatArray
    """(k,) how well the measurements separate each class from the others: a share of n vehicles is known as well as one
    of this fraction of them whose classes are certain."""

    @property
    def measured(self) -> IntArray:
        """Vehicles whose dimensions are known."""
        return np.flatnonzero(np.isfinite(self.probability[:, 0]))

    def estimate_shares(self, vehicles: IntArray) -> tuple[Estimate | None, ...]:
        """Share of each of `COUNTED_CLASSES` in the traffic that some vehicles, by their numbers (m,), are a sample of.

        None where there are too few, or dimensions do not separate the classes.
        """
        probability = self.probability[vehicles]
        probability = probability[np.isfinite(probability[:, 0])]
        n = len(probability)
        if not n:
            return (None,) * len(COUNTED_CLASSES)
        likelihood = probability / self.shares
        shares = _fit_shares(likelihood, self.shares, 1.0)
        out = []
        for share, separability in zip(shares.tolist(), self.separability.tolist(), strict=True):
            certain = round(separability * n)
            of_class = share * certain
            of_class = of_class if 0.5 <= of_class <= certain - 0.5 else round(of_class)  # less than one is none
            found = estimate_share(of_class, certain)
            out.append(None if found is None else replace(found, value=share, n=n))
        return tuple(out)


def find_classes(dimensions_m: FloatArray, sd_m: FloatArray) -> VehicleClasses:
    """Classes of the vehicles of one flight, whose shares are fitted to them.

    Parameters
    ----------
    dimensions_m, sd_m
        (n, 2) length and width, m, and their standard deviations; NaN of vehicles that were not measured.
    """
    usual = classify(dimensions_m, sd_m)
    known = np.isfinite(usual[:, 0])
    shares = _fit_shares(usual[known] / _USUAL_SHARES, _USUAL_SHARES, _USUAL_VEHICLES)
    probability = _posterior(usual / _USUAL_SHARES, shares)
    return VehicleClasses(probability @ _COUNTED, shares @ _COUNTED, _separability(sd_m[known], shares))


def _posterior(likelihood: FloatArray, shares: FloatArray) -> FloatArray:
    weighted = likelihood * shares
    return np.asarray(weighted / weighted.sum(axis=1, keepdims=True))


def _fit_shares(likelihood: FloatArray, start: FloatArray, weight: float) -> FloatArray:
    """The shares (classes,) of greatest likelihood (expectation maximisation); ``start`` counts as ``weight``
    vehicles."""
    shares = start
    for _ in range(_EM_STEPS if len(likelihood) else 0):
        shares = (_posterior(likelihood, shares).sum(axis=0) + weight * start) / (len(likelihood) + weight)
    return shares


def _separability(sd_m: FloatArray, shares: FloatArray) -> FloatArray:
    """Variance of the probability of each counted class over that of knowing the class, (k,): Fisher's information of a
    share, a vehicle, over that of a vehicle whose class is certain. By drawn vehicles, measured as these (n, 2) are."""
    if not len(sd_m):
        return np.zeros(len(COUNTED_CLASSES))
    rng = np.random.default_rng(0)
    sd = np.tile(sd_m[np.linspace(0, len(sd_m) - 1, _DRAWS).astype(np.int64)], (len(CLASS_NAMES), 1))
    of = np.repeat(np.arange(len(CLASS_NAMES)), _DRAWS)
    mean, spread = _means_and_spreads()
    drawn = rng.normal(mean[of], np.hypot(spread[of], sd))
    probability, counted = _posterior(classify(drawn, sd) / _USUAL_SHARES, shares) @ _COUNTED, shares @ _COUNTED
    between = ((probability - counted) ** 2).reshape(len(CLASS_NAMES), _DRAWS, -1).mean(axis=1)
    return np.asarray(np.minimum(shares @ between / (counted * (1 - counted)), 1.0))


def _means_and_spreads() -> tuple[FloatArray, FloatArray]:
    """(classes, 2) means of length and width, and their standard deviations over the vehicles of a class, m."""
    mean = np.array([(one.length_m[0], one.width_m[0]) for one in _CLASSES])
    return mean, np.array([(one.length_m[1], one.width_m[1]) for one in _CLASSES])


def classify(dimensions_m: FloatArray, sd_m: FloatArray) -> FloatArray:
    """Posterior probability of each class in usual traffic.

    Length and width are normal about their class's mean, with the spread of the class and of the measurement.

    Parameters
    ----------
    dimensions_m, sd_m
        (n, 2) length and width, m, and their standard deviations.

    Returns
    -------
    (n, classes), in the order of `CLASS_NAMES`; NaN where the dimensions are.
    """
    mean, spread = _means_and_spreads()
    sigma = np.hypot(spread, sd_m[:, None])
    log = -0.5 * ((dimensions_m[:, None] - mean) / sigma) ** 2 - np.log(sigma)
    total = log.sum(axis=2) + np.log(_USUAL_SHARES)
    likelihood = np.exp(total - total.max(axis=1, keepdims=True))
    return np.asarray(likelihood / likelihood.sum(axis=1, keepdims=True))


def add_dimensions(vehicles: pd.DataFrame, dimensions: pd.DataFrame, gsd_m: float | None) -> pd.DataFrame:
    """Vehicles with their dimensions in px and in metres, their class and its probability.

    Parameters
    ----------
    vehicles
        ``track_id``.
    dimensions
        ``schemas.tables.DIMENSION_COLUMNS``; of tracks that it lacks all is NaN.
    gsd_m
        Metres a base pixel; None: metres are NaN and classes missing.
    """
    table = vehicles.merge(dimensions.drop(columns="strips"), on="track_id", how="left")
    metres = np.nan if gsd_m is None else gsd_m
    for name in ("length", "length_sd", "width", "width_sd"):
        table[f"{name}_m"] = table[f"{name}_px"] * metres
    size, sd = (table[[f"length{k}_m", f"width{k}_m"]].to_numpy(np.float64) for k in ("", "_sd"))
    probability = classify(size, sd)
    known = np.isfinite(probability).all(axis=1)
    best: IntArray = np.where(known, np.nan_to_num(probability).argmax(axis=1), -1)
    return table.assign(
        vehicle_class=pd.Categorical.from_codes(best, pd.Index(CLASS_NAMES)),
        class_probability=np.where(known, np.nan_to_num(probability).max(axis=1), np.nan),
    )
