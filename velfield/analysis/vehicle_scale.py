"""The ground sample distance by the lengths of vehicles.

Cars are of known lengths: of those on the road the middle is 4.45 m, their logarithms scatter by 7 to 8 %, and the
averages of countries and decades differ by some 3 %. Vans, lorries and buses are longer and fewer. The scale is that
under which measured lengths are the most likely of such traffic. Its interval holds the scatter of the sample and the
3 % that no sample removes; how well the lengths are measured is the caller's to say, in their standard deviations.
"""

import numpy as np

from schemas.arrays import FloatArray
from schemas.scale import CAR_LENGTH_M, ScaleEstimate

POPULATION_SD = 0.03
"""Standard deviation of the logarithm of that over places."""
MIN_VEHICLES = 20
"""Fewer may be of one street's few models."""
_CLASSES = ((0.84, np.log(CAR_LENGTH_M), 0.075), (0.08, np.log(5.5), 0.09), (0.06, np.log(9.5), 0.25))
"""Fraction, mean and standard deviation of the logarithm of the length, m: cars; vans; lorries and buses."""
_OUTLIERS = 0.02
TRACK_LENGTH_BIAS, TRACK_LENGTH_SD = 1.073, 0.035
"""Ratio of the lengths measured on tracks of vehicles that moved to the true ones, by the scale of eight simulated
flights (seeds 971 to 978); its standard deviation, of places. It was 0.016 among these flights, but parked cars, and
cars in labelled pictures, are measured shorter by 0.05 and more."""
_EXTRA_SD = 0.0, 0.05, 0.1, 0.15, 0.2
"""Standard deviations of the logarithm that all lengths may have on top of their own: of blurred images of cars of 10
px those are too small by half. The one under which the lengths are the most likely is taken."""
_STEP = 0.004
_Z = 1.645  # of a 90 % interval


def estimate_vehicle_scale(
    length_px: FloatArray, length_sd_px: FloatArray | None = None, *, measurement_sd: float = 0.0
) -> ScaleEstimate | None:
    """Estimate the ground sample distance from the lengths of vehicles, each counted once.

    Parameters
    ----------
    length_px
        (n,) base px; NaN where not measured.
    length_sd_px
        (n,) standard deviations of each, base px; None: measured exactly.
    measurement_sd
        Relative error that all lengths may have in common: that of the method that measured them.

    Returns
    -------
    The estimate with its 90 % interval; None of fewer than `MIN_VEHICLES`.
    """
    length = np.asarray(length_px, np.float64)
    sd = np.zeros_like(length) if length_sd_px is None else np.asarray(length_sd_px, np.float64)
    good = np.isfinite(length) & np.isfinite(sd) & (length > 0)
    if good.sum() < MIN_VEHICLES:
        return None
    log_px, variance = np.log(length[good]), (sd[good] / length[good]) ** 2
    middle = float(np.median(log_px))
    shifts = np.log(CAR_LENGTH_M) - middle + np.arange(-0.9, 0.4, _STEP)
    likelihoods = [
        np.array([_log_likelihood(log_px + shift, variance + extra**2) for shift in shifts]) for extra in _EXTRA_SD
    ]
    likelihood = max(likelihoods, key=np.max)
    best = int(np.clip(np.argmax(likelihood), 1, len(shifts) - 2))
    curvature = -(likelihood[best - 1] - 2 * likelihood[best] + likelihood[best + 1]) / _STEP**2
    sample_variance = 1.0 / curvature if curvature > 0 else 1.0
    total = float(np.sqrt(sample_variance + POPULATION_SD**2 + measurement_sd**2))
    gsd_m = float(np.exp(shifts[best]))
    return ScaleEstimate(
        gsd_m=gsd_m,
        low_m=gsd_m * float(np.exp(-_Z * total)),
        high_m=gsd_m * float(np.exp(_Z * total)),
        source="vehicles",
        note=f"{int(good.sum())} vehicles; the median car is taken to be {CAR_LENGTH_M:g} m long",
    )


def estimate_track_scale(length_px: FloatArray, length_sd_px: FloatArray) -> ScaleEstimate | None:
    """`estimate_vehicle_scale` by the lengths of tracks (`velfield.tracking.dimensions`), without their bias."""
    length = np.asarray(length_px, np.float64) / TRACK_LENGTH_BIAS
    return estimate_vehicle_scale(length, length_sd_px, measurement_sd=TRACK_LENGTH_SD)


def _log_likelihood(log_m: FloatArray, variance: FloatArray) -> float:
    """Log likelihood of logarithms of lengths (n,) m with measurement variances (n,), by the classes of vehicles."""
    density = np.full_like(log_m, _OUTLIERS / 3.0)
    for fraction, mean, sd in _CLASSES:
        total = sd**2 + variance
        density += fraction * np.exp(-0.5 * (log_m - mean) ** 2 / total) / np.sqrt(2.0 * np.pi * total)
    return float(np.log(density).sum())
