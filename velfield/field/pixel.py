"""The distribution over velocity at one pixel, with its statistics."""

from dataclasses import dataclass, field

import numpy as np

from schemas.arrays import FloatArray
from velfield.field.accumulate import FieldTile
from velfield.field.modes import velocity_modes
from velfield.field.segments import VelocityBins
from velfield.field.statistics import TileStatistics


@dataclass(frozen=True)
class PixelDistribution:
    """The distribution over velocity at a pixel.

    Attributes
    ----------
    x, y
        The pixel.
    n
        Number of tracks.
    bins
        Its velocity bins.
    weights
        (nvy, nvx) weights of the bins, summing to one; all zero where empty.
    modes
        (k, 3) as (vx, vy) px/s and weight, the largest weight first.
    modal_velocity_px_per_s, mean_velocity_px_per_s
        (2,) as (vx, vy) px/s, NaN where empty.
    percentiles_px_per_s
        Speed by percentage: 15, 50, 85; px/s.
    stationary_fraction, circular_variance, entropy_nats, direction_se_rad, speed_se_px_per_s
        As in `TileStatistics`.
    direction_interval_rad
        90 % interval of the modal direction: lower and upper end, rad; one of them may lie outside (-pi, pi].
    median_speed_interval_px_per_s
        90 % interval of the median speed: lower and upper end, px/s.
    """

    x: int
    y: int
    n: int
    bins: VelocityBins = field(repr=False)
    weights: FloatArray = field(repr=False)
    modes: FloatArray
    modal_velocity_px_per_s: FloatArray
    mean_velocity_px_per_s: FloatArray
    percentiles_px_per_s: dict[int, float]
    stationary_fraction: float
    circular_variance: float
    entropy_nats: float
    direction_se_rad: float
    speed_se_px_per_s: float
    direction_interval_rad: tuple[float, float]
    median_speed_interval_px_per_s: tuple[float, float]

    @property
    def modal_velocity_km_per_h(self) -> FloatArray:
        """(2,) as (vx, vy) km/h, NaN where empty. This and the other speeds in km/h raise InputError where the ground
        sample distance is not known."""
        return self.modal_velocity_px_per_s * self.bins.km_per_h_per_px_per_s

    @property
    def modal_speed_km_per_h(self) -> float:
        """Speed of the highest mode, km/h, NaN where empty."""
        return float(np.hypot(*self.modal_velocity_km_per_h))

    @property
    def percentiles_km_per_h(self) -> dict[int, float]:
        """Speed by percentage: 15, 50, 85; km/h."""
        return {share: speed * self.bins.km_per_h_per_px_per_s for share, speed in self.percentiles_px_per_s.items()}

    @property
    def median_speed_interval_km_per_h(self) -> tuple[float, float]:
        """90 % interval of the median speed: lower and upper end, km/h."""
        low, high = self.median_speed_interval_px_per_s
        return low * self.bins.km_per_h_per_px_per_s, high * self.bins.km_per_h_per_px_per_s


def describe_pixel(
    x: int, y: int, pixel: FieldTile, bins: VelocityBins, statistics: TileStatistics
) -> PixelDistribution:
    """The distribution of a tile of one pixel, with given statistics."""
    modes = velocity_modes(pixel.histogram, pixel.count, bins=bins)[0, 0]
    modal, half = statistics.modal_velocity_px_per_s[0, 0], float(statistics.direction_half_width_rad[0, 0])
    direction = float(np.arctan2(modal[1], modal[0]))
    return PixelDistribution(
        x=x,
        y=y,
        n=int(pixel.count[0, 0]),
        bins=bins,
        weights=pixel.histogram[0, 0] / max(int(pixel.histogram.sum(dtype=np.int64)), 1),
        modes=modes[np.isfinite(modes[:, 2])],
        modal_velocity_px_per_s=modal,
        mean_velocity_px_per_s=statistics.mean_velocity_px_per_s[0, 0],
        percentiles_px_per_s=dict(
            zip((15, 50, 85), map(float, statistics.speed_percentiles_px_per_s[0, 0]), strict=True)
        ),
        stationary_fraction=float(statistics.stationary_fraction[0, 0]),
        circular_variance=float(statistics.circular_variance[0, 0]),
        entropy_nats=float(statistics.entropy_nats[0, 0]),
        direction_se_rad=float(statistics.direction_se_rad[0, 0]),
        speed_se_px_per_s=float(statistics.speed_se_px_per_s[0, 0]),
        direction_interval_rad=(direction - half, direction + half),
        median_speed_interval_px_per_s=(
            float(statistics.median_speed_low_px_per_s[0, 0]),
            float(statistics.median_speed_high_px_per_s[0, 0]),
        ),
    )
