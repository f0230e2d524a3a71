"""The prior as a gate for another tracker, and as a judge of tracks: where its velocities are, how usual one is."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from velfield.errors import InputError
from velfield.field.bins import VelocityBins

Densities = Callable[[FloatArray, FloatArray], FloatArray]
"""Density per (px/s)^2 at a place (2,) of velocities (n, 2)."""

SHARE = 0.99
"""Share of the vehicles that a gate lets pass, if they drive as those before them did."""
_ROUNDING = 1e-9
"""A variance this far below nothing, as a share of the other, is one of nothing."""


@dataclass(frozen=True)
class VelocityGate:
    """What velocities are to be expected at a place that is known to within a covariance.

    Attributes
    ----------
    mean_px_per_s, covariance
        (2,) and (2, 2) of the expected velocity: where a filter may start.
    expected_log_density
        Mean log density of a vehicle there: minus the entropy.
    least_density
        Density per (px/s)^2 that the gate asks for: the region of higher density holds ``share`` of the vehicles.
    share
        That share.
    """

    mean_px_per_s: FloatArray
    covariance: FloatArray
    expected_log_density: float
    least_density: float
    share: float
    _densities: Callable[[FloatArray], FloatArray]

    def log_density(self, v: FloatArray) -> FloatArray:
        """(n,) log density per (px/s)^2 of velocities (n, 2), px/s."""
        return np.log(np.maximum(self._densities(np.atleast_2d(np.asarray(v, np.float64))), 1e-300))

    def accepts(self, v: FloatArray) -> NDArray[np.bool_]:
        """(n,) whether velocities (n, 2), px/s, lie in the region."""
        return np.asarray(self.log_density(v) >= np.log(self.least_density))


def make_gate(
    densities: Densities, xy: FloatArray, covariance: FloatArray, bins: VelocityBins, share: float
) -> VelocityGate:
    """The gate at a place, its uncertainty taken in by five points of the ellipse (unscented transform).

    Parameters
    ----------
    densities
        The field's prior.
    xy, covariance
        (2,) base pixel and (2, 2) px^2.
    share
        In (0, 1).

    Raises
    ------
    InputError
        What is given as a covariance is none.
    """
    covariance = np.asarray(covariance, np.float64)
    if covariance.shape != (2, 2) or not np.allclose(covariance, covariance.T):
        raise InputError(f"gate needs a symmetric covariance (2, 2) in px^2, found {covariance.tolist()}")
    values, axes = np.linalg.eigh(covariance)
    if values[0] < -_ROUNDING * abs(values[1]):
        raise InputError(f"gate needs a covariance of no negative variance, in px^2, found {covariance.tolist()}")
    steps = (np.sqrt(3.0 * np.maximum(values, 0.0)) * axes).T
    offsets = np.concatenate([np.zeros((1, 2)), steps, -steps])
    # A place known to within half a pixel is one pixel.
    points = (
        [(1.0, np.zeros(2))] if np.abs(offsets).max() < 0.5 else list(zip([1 / 3] + 4 * [1 / 6], offsets, strict=True))
    )

    def mixed(v: FloatArray) -> FloatArray:
        return np.asarray(sum(weight * densities(np.asarray(xy) + offset, v) for weight, offset in points), np.float64)

    # Modes may be half a bin wide: at steps of a whole one their mass would be found wrong.
    steps_px_per_s = bins.from_bins(np.arange(2 * bins.n - 1) / 2)
    grid = np.stack(np.meshgrid(steps_px_per_s, steps_px_per_s), axis=-1).reshape(-1, 2)
    density = mixed(grid)
    mass = density / density.sum()
    order = np.argsort(-density, kind="stable")
    last = min(int(np.searchsorted(np.cumsum(mass[order]), share)), len(order) - 1)
    mean = mass @ grid
    around = grid - mean
    return VelocityGate(
        mean_px_per_s=mean,
        covariance=(mass[:, None] * around).T @ around,
        expected_log_density=float(mass @ np.log(np.maximum(density, 1e-300))),
        least_density=float(density[order[last]]),
        share=share,
        _densities=mixed,
    )
