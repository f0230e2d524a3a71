"""The velocity axes of the histogram, and the field's lengths in pixels (paper: velocity model)."""

from dataclasses import dataclass
from math import ceil

import numpy as np
from numpy.typing import NDArray

from schemas.flight import PAPER_GSD_M, FieldConfig


@dataclass(frozen=True)
class VelocityBins:
    """Square bins of velocity, the same on both axes, with one bin centred on standing still.

    The outermost bins also hold what is faster than they are.

    Attributes
    ----------
    width_px_per_s : float
        Width of a bin, px/s.
    reach : int
        Bins on either side of the central one; an axis has ``2 * reach + 1``.
    kernel_sigma_px_per_s : float
        Standard deviation of the blob that a segment adds, px/s.
    gsd_m : float or None
        Metres a base pixel; None where speeds are known in px/s alone.

    Examples
    --------
    >>> bins = VelocityBins(width_px_per_s=10.0, reach=2, kernel_sigma_px_per_s=3.5)
    >>> bins.centres_px_per_s
    array([-20., -10.,   0.,  10.,  20.])
    """

    width_px_per_s: float
    reach: int
    kernel_sigma_px_per_s: float
    gsd_m: float | None = None

    def __post_init__(self) -> None:
        if not (self.width_px_per_s > 0 and self.kernel_sigma_px_per_s > 0 and self.reach >= 1):
            raise ValueError(f"bins need a positive width and kernel and at least 3 bins, found {self}")

    @classmethod
    def from_config(cls, config: FieldConfig, gsd_m: float | None) -> "VelocityBins":
        """Bins of a configuration; with no ground sample distance its metres become pixels by the paper's."""
        metres = gsd_m or PAPER_GSD_M
        return cls(
            width_px_per_s=config.bin_width_m_per_s / metres,
            reach=max(1, ceil(config.max_speed_m_per_s / config.bin_width_m_per_s - 1e-9)),
            kernel_sigma_px_per_s=config.kernel_sigma_m_per_s / metres,
            gsd_m=gsd_m,
        )

    @property
    def n(self) -> int:
        """Bins an axis."""
        return 2 * self.reach + 1

    @property
    def centres_px_per_s(self) -> NDArray[np.float64]:
        """(n,) centres of the bins, px/s, rising."""
        return (np.arange(self.n, dtype=np.float64) - self.reach) * self.width_px_per_s

    @property
    def centres_m_per_s(self) -> NDArray[np.float64] | None:
        """(n,) centres of the bins, m/s; None where metres are not known."""
        return None if self.gsd_m is None else self.centres_px_per_s * self.gsd_m

    def to_bins(self, velocity_px_per_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Velocity components in units of bins, 0 being the centre of the first bin."""
        return velocity_px_per_s / self.width_px_per_s + self.reach

    def from_bins(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """The inverse of `to_bins`: px/s."""
        return (position - self.reach) * self.width_px_per_s


def band_radius_px(config: FieldConfig, gsd_m: float | None) -> float | None:
    """How far from its path a segment counts, px: a quarter of a lane on either side; None for the paper's line."""
    if config.path_width == "pixel":
        return None
    # Below 0.71 px a path could slip between the pixel centres and leave no trace.
    return max(config.lane_width_m / 4 / (gsd_m or PAPER_GSD_M), 0.75)


def stationary_speed_px_per_s(config: FieldConfig, gsd_m: float | None) -> float:
    """The speed below which a vehicle stands and has no direction, px/s."""
    return config.stationary_speed_m_per_s / (gsd_m or PAPER_GSD_M)
