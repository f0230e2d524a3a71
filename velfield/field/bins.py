"""The velocity axes of the histogram, and the field's lengths in pixels (paper: velocity model)."""

from dataclasses import dataclass
from math import ceil

import numpy as np

from schemas.arrays import FloatArray
from schemas.flight import PAPER_GSD_M, FieldConfig


@dataclass(frozen=True)
class VelocityBins:
    """Square bins of velocity, the same on both axes, one of them centred on zero velocity.

    The outermost bins also hold all higher speeds.

    Attributes
    ----------
    width_px_per_s : float
        Width of a bin, px/s.
    reach : int
        Bins on either side of the central one; an axis has ``2 * reach + 1``.
    kernel_sigma_px_per_s : float
        Standard deviation of the Gaussian kernel that a segment adds, px/s.
    gsd_m : float or None
        Metres a base pixel; None where speeds are known in px/s only.

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
        """Bins of a configuration; without a ground sample distance its metres are converted by the paper's."""
        metres = gsd_m or PAPER_GSD_M
        return cls(
            width_px_per_s=config.bin_width_m_per_s / metres,
            reach=max(1, ceil(config.max_speed_m_per_s / config.bin_width_m_per_s - 1e-9)),
            kernel_sigma_px_per_s=config.kernel_sigma_m_per_s / metres,
            gsd_m=gsd_m,
        )

    @property
    def n(self) -> int:
        """Number of bins along an axis."""
        return 2 * self.reach + 1

    @property
    def centres_px_per_s(self) -> FloatArray:
        """(n,) centres of the bins, px/s, ascending."""
        return (np.arange(self.n, dtype=np.float64) - self.reach) * self.width_px_per_s

    @property
    def area_px2_per_s2(self) -> float:
        """Area of a bin, (px/s)^2: a density is a weight over it."""
        return self.width_px_per_s**2

    @property
    def kernel_sigma_bins(self) -> float:
        """Standard deviation of the kernel, bins."""
        return self.kernel_sigma_px_per_s / self.width_px_per_s

    @property
    def blur_bins2(self) -> float:
        """Variance that the kernel and the width of a bin add to a velocity component, bins^2."""
        return self.kernel_sigma_bins**2 + 1.0 / 12.0

    def to_bins(self, velocity_px_per_s: FloatArray) -> FloatArray:
        """Velocity components in units of bins, 0 being the centre of the first bin."""
        return velocity_px_per_s / self.width_px_per_s + self.reach

    def from_bins(self, position: FloatArray) -> FloatArray:
        """The inverse of `to_bins`: px/s."""
        return (position - self.reach) * self.width_px_per_s

    def grid_px_per_s(self, samples_per_bin: int) -> FloatArray:
        """(m, 2) velocities (vx, vy) on a square grid over all bins, px/s, ``samples_per_bin`` along a bin's width."""
        axis = self.from_bins(np.arange(samples_per_bin * (self.n - 1) + 1) / samples_per_bin)
        return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


def band_radius_px(config: FieldConfig, gsd_m: float | None) -> float | None:
    """Half the width of a segment's band, px: a quarter of a lane; None for the paper's line of one pixel."""
    if config.path_width == "pixel":
        return None
    # Below 0.71 px a path could pass between the pixel centres and touch no pixel.
    return max(config.lane_width_m / 4 / (gsd_m or PAPER_GSD_M), 0.75)


def stationary_speed_px_per_s(config: FieldConfig, gsd_m: float | None) -> float:
    """The speed below which a vehicle is stationary and has no direction, px/s."""
    return config.stationary_speed_m_per_s / (gsd_m or PAPER_GSD_M)
