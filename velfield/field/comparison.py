"""What changed between two fields of one grid: direction, speed and volume at each pixel, and whether it is chance.

A change of direction or median speed is held against the 90 % intervals of both; a change of volume against the Poisson
law of vehicles that come independently of each other, each field by the time it watched. Thousands of pixels are tested
at once, so what is called significant is what survives Benjamini and Hochberg's rule: of those pixels at most a share
``false_share`` is expected to be chance.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from schemas.arrays import FloatArray

Layer = Callable[[str], NDArray[np.generic]]
"""Gives a (y, x) layer of a field by its name."""

_Z90 = 1.6449
FALSE_SHARE = 0.05
"""Share of chance among what is called significant."""
MIN_COUNT = 5
"""Passages that a field must have at a pixel for its direction and speed to be compared."""


@dataclass(frozen=True)
class Change:
    """How one quantity changed, after less before.

    Attributes
    ----------
    change
        (y, x); NaN where either field knows nothing.
    chance
        (y, x) two-sided probability of so large a change by chance; NaN where ``change`` is.
    significant
        (y, x) whether it is taken for real.
    """

    change: FloatArray
    chance: FloatArray
    significant: NDArray[np.bool_]

    def summary(self) -> tuple[int, int]:
        """Pixels compared, and of those the significant ones."""
        return int(np.isfinite(self.change).sum()), int(self.significant.sum())


def compare_fields(
    before: Layer,
    after: Layer,
    *,
    observed_s: tuple[float, float],
    stationary_speed_px_per_s: float,
    min_count: int = MIN_COUNT,
) -> dict[str, Change]:
    """Changes of ``direction`` (rad), ``speed`` (px/s, of the median) and ``volume`` (passages an hour).

    Parameters
    ----------
    before, after
        Layers of two fields on one grid, named as in ``field.zarr``.
    observed_s
        How long each field watched, s.
    stationary_speed_px_per_s
        A modal speed below this has no direction.
    min_count
        Passages that either field must have for its direction and speed to be compared: of fewer, another turn taken
        looks like another direction of all.
    """
    enough = np.minimum(_numbers(before, "count"), _numbers(after, "count")) >= min_count
    return {
        "direction": _direction(before, after, stationary_speed_px_per_s, enough),
        "speed": _speed(before, after, enough),
        "volume": _volume(before, after, observed_s),
    }


def significant(chance: FloatArray, false_share: float = FALSE_SHARE) -> NDArray[np.bool_]:
    """Benjamini and Hochberg's rule: which of many tests hold, NaN never.

    Examples
    --------
    >>> significant(np.array([0.001, 0.9, 0.02, np.nan, 0.8])).tolist()
    [True, False, True, False, False]
    """
    known = np.sort(chance[np.isfinite(chance)])
    if not known.size:
        return np.zeros(chance.shape, bool)
    below = np.flatnonzero(known <= false_share * np.arange(1, known.size + 1) / known.size)
    limit = known[below[-1]] if below.size else -1.0
    return np.asarray(np.nan_to_num(chance, nan=2.0) <= limit)


def _change(change: FloatArray, chance: FloatArray) -> Change:
    chance = np.where(np.isfinite(change), chance, np.nan)
    return Change(np.where(np.isfinite(chance), change, np.nan), chance, significant(chance))


def _two_sided(z: FloatArray) -> FloatArray:
    return np.asarray(2.0 * ndtr(-np.abs(z)), np.float64)


def _numbers(layer: Layer, name: str) -> FloatArray:
    return np.asarray(layer(name), np.float64)


def _direction(before: Layer, after: Layer, stationary_speed_px_per_s: float, enough: NDArray[np.bool_]) -> Change:
    angle, half = [], []
    for layer in (before, after):
        vx, vy = _numbers(layer, "modal_vx"), _numbers(layer, "modal_vy")
        moves = np.hypot(vx, vy) > stationary_speed_px_per_s
        angle.append(np.where(moves, np.arctan2(vy, vx), np.nan))
        half.append(_numbers(layer, "direction_half90"))
    turn = np.where(enough, np.angle(np.exp(1j * (angle[1] - angle[0]))), np.nan)
    return _change(turn, _two_sided(turn * _Z90 / np.hypot(half[0], half[1])))


def _speed(before: Layer, after: Layer, enough: NDArray[np.bool_]) -> Change:
    change = np.where(enough, _numbers(after, "speed_p50") - _numbers(before, "speed_p50"), np.nan)
    # The ends that face each other: of the slower its upper end, of the faster its lower one.
    up = change > 0
    slower = np.where(
        up,
        _numbers(before, "speed_p50_high90") - _numbers(before, "speed_p50"),
        _numbers(after, "speed_p50_high90") - _numbers(after, "speed_p50"),
    )
    faster = np.where(
        up,
        _numbers(after, "speed_p50") - _numbers(after, "speed_p50_low90"),
        _numbers(before, "speed_p50") - _numbers(before, "speed_p50_low90"),
    )
    return _change(change, _two_sided(change * _Z90 / np.maximum(np.hypot(slower, faster), 1e-9)))


def _volume(before: Layer, after: Layer, observed_s: tuple[float, float]) -> Change:
    n, m = _numbers(before, "count"), _numbers(after, "count")
    hours = observed_s[0] / 3600, observed_s[1] / 3600
    seen = (n + m > 0) & (min(hours) > 0)
    change = np.where(seen, m / max(hours[1], 1e-9) - n / max(hours[0], 1e-9), np.nan)
    # Of n + m passages the later field should have its share by time; the normal law of that binomial.
    share = hours[1] / max(hours[0] + hours[1], 1e-9)
    spread = np.sqrt(np.maximum((n + m) * share * (1 - share), 1e-9))
    off = np.maximum(np.abs(m - (n + m) * share) - 0.5, 0.0)
    return _change(change, _two_sided(off / spread))
