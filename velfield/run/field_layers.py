"""The (y, x) layers beside the histogram in ``field.zarr``: computed with the tiles, so that maps and viewers need not
read the histogram."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.flight import FieldConfig
from velfield.field.accumulate import VARIANCE_UNIT, FieldTile
from velfield.field.bins import VelocityBins, stationary_speed_px_per_s
from velfield.field.statistics import tile_statistics

_SPEED = {"units": "px s-1"}

LAYERS: dict[str, dict[str, Any]] = {
    "count": {"dtype": "int32", "units": "1", "long_name": "number of vehicle tracks"},
    "occupancy_ms": {"dtype": "int32", "units": "ms", "long_name": "total time that vehicles spent at the pixel"},
    "velocity_variance_sum": {
        "dtype": "int32",
        "units": "1",
        "long_name": f"sum over tracks of the variance of a velocity component, in bins squared times {VARIANCE_UNIT}",
    },
    "modal_vx": {**_SPEED, "long_name": "x component of the modal velocity"},
    "modal_vy": {**_SPEED, "long_name": "y component of the modal velocity, down"},
    "mode_fraction": {"units": "1", "long_name": "fraction of the weight at the mode"},
    "mean_vx": {**_SPEED, "long_name": "x component of the mean velocity"},
    "mean_vy": {**_SPEED, "long_name": "y component of the mean velocity, down"},
    "speed_p15": {**_SPEED, "long_name": "15th percentile of speed"},
    "speed_p50": {**_SPEED, "long_name": "median speed"},
    "speed_p85": {**_SPEED, "long_name": "85th percentile of speed"},
    "stationary_fraction": {"units": "1", "long_name": "fraction of stationary vehicles"},
    "circular_variance": {"units": "1", "long_name": "circular variance of the direction of moving vehicles"},
    "entropy": {"units": "1", "long_name": "entropy of the velocity distribution, nats"},
    "direction_se": {"units": "rad", "long_name": "standard error of the mean direction of moving vehicles"},
    "speed_se": {**_SPEED, "long_name": "standard error of the median speed"},
    "direction_ci90_half_width": {
        "units": "rad",
        "long_name": "half the width of the 90 % confidence interval of the modal direction",
    },
    "speed_p50_ci90_lower": {**_SPEED, "long_name": "lower bound of the 90 % confidence interval of the median speed"},
    "speed_p50_ci90_upper": {**_SPEED, "long_name": "upper bound of the 90 % confidence interval of the median speed"},
}
"""Layer -> attributes in the store; ``dtype`` where it is not float32."""


def tile_layers(tile: FieldTile, bins: VelocityBins, config: FieldConfig) -> dict[str, NDArray[Any]]:
    """All layers of one tile, each (ty, tx)."""
    limit = stationary_speed_px_per_s(config, bins.gsd_m)
    s = tile_statistics(tile.histogram, tile.count, tile.variance_sum, bins=bins, stationary_speed_px_per_s=limit)
    values: dict[str, NDArray[Any]] = {
        "count": tile.count,
        "occupancy_ms": tile.occupancy_ms,
        "velocity_variance_sum": tile.variance_sum,
        "modal_vx": s.modal_velocity_px_per_s[..., 0],
        "modal_vy": s.modal_velocity_px_per_s[..., 1],
        "mode_fraction": s.mode_fraction,
        "mean_vx": s.mean_velocity_px_per_s[..., 0],
        "mean_vy": s.mean_velocity_px_per_s[..., 1],
        "speed_p15": s.speed_percentiles_px_per_s[..., 0],
        "speed_p50": s.speed_percentiles_px_per_s[..., 1],
        "speed_p85": s.speed_percentiles_px_per_s[..., 2],
        "stationary_fraction": s.stationary_fraction,
        "circular_variance": s.circular_variance,
        "entropy": s.entropy_nats,
        "direction_se": s.direction_se_rad,
        "speed_se": s.speed_se_px_per_s,
        "direction_ci90_half_width": s.direction_half_width_rad,
        "speed_p50_ci90_lower": s.median_speed_low_px_per_s,
        "speed_p50_ci90_upper": s.median_speed_high_px_per_s,
    }
    return {name: np.asarray(value, LAYERS[name].get("dtype", "float32")) for name, value in values.items()}
