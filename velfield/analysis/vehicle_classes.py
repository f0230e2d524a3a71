"""Classes of vehicles from their length and width: motorcycle, car, van, lorry or bus."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from schemas.arrays import FloatArray, IntArray


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


def classify(dimensions_m: FloatArray, sd_m: FloatArray) -> FloatArray:
    """Posterior probability of each class.

    Length and width are normal about their class's mean, with the spread of the class and of the measurement.

    Parameters
    ----------
    dimensions_m, sd_m
        (n, 2) length and width, m, and their standard deviations.

    Returns
    -------
    (n, classes), in the order of `CLASS_NAMES`; NaN where the dimensions are.
    """
    mean = np.array([(one.length_m[0], one.width_m[0]) for one in _CLASSES])
    spread = np.array([(one.length_m[1], one.width_m[1]) for one in _CLASSES])
    sigma = np.hypot(spread, sd_m[:, None])
    log = -0.5 * ((dimensions_m[:, None] - mean) / sigma) ** 2 - np.log(sigma)
    total = log.sum(axis=2) + np.log([one.share for one in _CLASSES])
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
