"""The prior as a gate for another tracker: the highest-density region of the velocity distribution at a position."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from schemas.arrays import FloatArray, Mask
from velfield.errors import InputError
from velfield.field.segments import VelocityBins

Densities = Callable[[FloatArray, FloatArray], FloatArray]
"""Density per (px/s)^2 at a position (2,) of velocities (n, 2)."""

COVERAGE = 0.99
"""Probability mass of a gate's region: the fraction of vehicles that it accepts if traffic stays the same."""
_ROUNDING = 1e-9
"""A negative variance smaller than this fraction of the other one is rounding error of zero."""


@dataclass(frozen=True)
class VelocityGate:
    """The velocity distribution at a position with a covariance, and its highest-density region."""

    mean_px_per_s: FloatArray
    covariance: FloatArray
    """(2,) and (2, 2), (px/s)^2, of the velocity: an initial state for a filter."""
    expected_log_density: float
    """Mean log density of the distribution: its negative differential entropy, nats."""
    min_density: float
    """Threshold on the density per (px/s)^2: the region above it has the probability mass ``coverage``."""
    coverage: float
    """In (0, 1)."""
    _densities: Callable[[FloatArray], FloatArray]

    def log_density(self, v: FloatArray) -> FloatArray:
        """(n,) log density per (px/s)^2 of velocities (n, 2), px/s."""
        return np.log(np.maximum(self._densities(np.atleast_2d(np.asarray(v, np.float64))), 1e-300))

    def accepts(self, v: FloatArray) -> Mask:
        """(n,) whether velocities (n, 2), px/s, are in the region."""
        return np.asarray(self.log_density(v) >= np.log(self.min_density))


def make_gate(
    densities: Densities, xy: FloatArray, covariance: FloatArray, bins: VelocityBins, coverage: float
) -> VelocityGate:
    """The gate at a position; its covariance is represented by five sigma points (unscented transform).

    Parameters
    ----------
    densities
        The field's prior.
    xy, covariance
        (2,) base pixel and (2, 2) px^2.
    coverage
        In (0, 1).

    Raises
    ------
    InputError
        ``covariance`` is not a covariance matrix.
    """
    covariance = np.asarray(covariance, np.float64)
    if covariance.shape != (2, 2) or not np.allclose(covariance, covariance.T):
        raise InputError(f"gate needs a symmetric covariance (2, 2) in px^2, found {covariance.tolist()}")
    values, axes = np.linalg.eigh(covariance)
    if values[0] < -_ROUNDING * abs(values[1]):
        raise InputError(f"gate needs a positive semidefinite covariance, in px^2, found {covariance.tolist()}")
    steps = (np.sqrt(3.0 * np.maximum(values, 0.0)) * axes).T
    offsets = np.concatenate([np.zeros((1, 2)), steps, -steps])
    # Offsets below half a pixel stay within one pixel.
    points = (
        [(1.0, np.zeros(2))] if np.abs(offsets).max() < 0.5 else list(zip([1 / 3] + 4 * [1 / 6], offsets, strict=True))
    )

    def mixed(v: FloatArray) -> FloatArray:
        return np.asarray(sum(weight * densities(np.asarray(xy) + offset, v) for weight, offset in points), np.float64)

    # Modes may be half a bin wide: with one sample a bin their mass would be wrong.
    grid = bins.grid_px_per_s(samples_per_bin=2)
    density = mixed(grid)
    mass = density / density.sum()
    order = np.argsort(-density, kind="stable")
    last = min(int(np.searchsorted(np.cumsum(mass[order]), coverage)), len(order) - 1)
    mean = mass @ grid
    deviation = grid - mean
    return VelocityGate(
        mean_px_per_s=mean,
        covariance=(mass[:, None] * deviation).T @ deviation,
        expected_log_density=float(mass @ np.log(np.maximum(density, 1e-300))),
        min_density=float(density[order[last]]),
        coverage=coverage,
        _densities=mixed,
    )
