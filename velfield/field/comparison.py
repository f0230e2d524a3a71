"""Changes of direction, speed and volume at each pixel between two fields of one grid, and their significance.

A change of direction or median speed is tested against the 90 % intervals of both fields; a change of volume against
Poisson arrivals at an equal rate, each field with its own observation time. As many tests are made as there are pixels,
so the false discovery rate is controlled (Benjamini and Hochberg): of the significant pixels at most the fraction
``FDR_LEVEL`` is expected to be false.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr
from scipy.stats import false_discovery_control

from schemas.arrays import FloatArray, Mask

Layer = Callable[[str], NDArray[np.generic]]
"""Returns a (y, x) layer of a field by its name."""

_Z90 = 1.6449
FDR_LEVEL = 0.05
"""False discovery rate: expected fraction of false ones among the significant changes."""
MIN_COUNT = 5
"""Tracks that a field needs at a pixel for its direction and speed to be compared."""


@dataclass(frozen=True)
class Change:
    """Change of one quantity, after minus before."""

    change: FloatArray
    """(y, x); NaN where either field is empty."""
    p_value: FloatArray
    """(y, x) two-sided; NaN where ``change`` is."""
    significant: Mask
    """(y, x) bool, at the false discovery rate `FDR_LEVEL`."""

    def summary(self) -> tuple[int, int]:
        """Numbers of pixels compared and of significant ones."""
        return int(np.isfinite(self.change).sum()), int(self.significant.sum())


def compare_fields(
    before: Layer,
    after: Layer,
    *,
    observed_s: tuple[float, float],
    stationary_speed_px_per_s: float,
    min_count: int = MIN_COUNT,
) -> dict[str, Change]:
    """Changes of ``direction`` (rad), ``speed`` (px/s, of the median) and ``volume`` (tracks an hour).

    Parameters
    ----------
    before, after
        Layers of two fields on one grid, named as in ``field.zarr``.
    observed_s
        Observation time of each field, s.
    stationary_speed_px_per_s
        A modal speed below this has no direction.
    min_count
        Tracks that both fields need for direction and speed to be compared: with fewer, one vehicle that turns off is a
        change of direction.
    """
    enough = np.minimum(_float_layer(before, "count"), _float_layer(after, "count")) >= min_count
    return {
        "direction": _direction(before, after, stationary_speed_px_per_s, enough),
        "speed": _speed(before, after, enough),
        "volume": _volume(before, after, observed_s),
    }


def significant(p_value: FloatArray, fdr_level: float = FDR_LEVEL) -> Mask:
    """Which of many tests are significant at a false discovery rate (Benjamini and Hochberg, 1995); NaN never.

    Examples
    --------
    >>> significant(np.array([0.001, 0.9, 0.02, np.nan, 0.8])).tolist()
    [True, False, True, False, False]
    """
    out = np.zeros(p_value.shape, np.bool_)
    known = np.isfinite(p_value)
    out[known] = false_discovery_control(p_value[known]) <= fdr_level
    return out


def _change(change: FloatArray, p_value: FloatArray) -> Change:
    p_value = np.where(np.isfinite(change), p_value, np.nan)
    return Change(np.where(np.isfinite(p_value), change, np.nan), p_value, significant(p_value))


def _two_sided(z: FloatArray) -> FloatArray:
    return np.asarray(2.0 * ndtr(-np.abs(z)), np.float64)


def _float_layer(layer: Layer, name: str) -> FloatArray:
    return np.asarray(layer(name), np.float64)


def _direction(before: Layer, after: Layer, stationary_speed_px_per_s: float, enough: Mask) -> Change:
    angle, half = [], []
    for layer in (before, after):
        vx, vy = _float_layer(layer, "modal_vx"), _float_layer(layer, "modal_vy")
        moves = np.hypot(vx, vy) > stationary_speed_px_per_s
        angle.append(np.where(moves, np.arctan2(vy, vx), np.nan))
        half.append(_float_layer(layer, "direction_ci90_half_width"))
    change = np.where(enough, np.angle(np.exp(1j * (angle[1] - angle[0]))), np.nan)
    return _change(change, _two_sided(change * _Z90 / np.hypot(half[0], half[1])))


def _speed(before: Layer, after: Layer, enough: Mask) -> Change:
    change = np.where(enough, _float_layer(after, "speed_p50") - _float_layer(before, "speed_p50"), np.nan)
    # Distances to the interval ends between the two medians: the upper end of the slower, the lower end of the faster.
    up = change > 0
    slower = np.where(
        up,
        _float_layer(before, "speed_p50_ci90_upper") - _float_layer(before, "speed_p50"),
        _float_layer(after, "speed_p50_ci90_upper") - _float_layer(after, "speed_p50"),
    )
    faster = np.where(
        up,
        _float_layer(after, "speed_p50") - _float_layer(after, "speed_p50_ci90_lower"),
        _float_layer(before, "speed_p50") - _float_layer(before, "speed_p50_ci90_lower"),
    )
    return _change(change, _two_sided(change * _Z90 / np.maximum(np.hypot(slower, faster), 1e-9)))


def _volume(before: Layer, after: Layer, observed_s: tuple[float, float]) -> Change:
    n, m = _float_layer(before, "count"), _float_layer(after, "count")
    hours = observed_s[0] / 3600, observed_s[1] / 3600
    known = (n + m > 0) & (min(hours) > 0)
    change = np.where(known, m / max(hours[1], 1e-9) - n / max(hours[0], 1e-9), np.nan)
    # At equal rates m of n + m tracks is binomial; normal approximation with continuity correction.
    expected = hours[1] / max(hours[0] + hours[1], 1e-9)
    sd = np.sqrt(np.maximum((n + m) * expected * (1 - expected), 1e-9))
    deviation = np.maximum(np.abs(m - (n + m) * expected) - 0.5, 0.0)
    return _change(change, _two_sided(deviation / sd))
