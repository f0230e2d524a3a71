"""Write groups of tiles into ``field.zarr``: the histogram tile by tile, the layers of a group at once.

The (y, x) layers beside the histogram in ``field.zarr``: computed with the tiles, so that maps and viewers need not
read the histogram.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.flight import FieldConfig
from schemas.records import GridRecord
from velfield.field.accumulate import UNIT, VARIANCE_UNIT, FieldTile, Weight
from velfield.field.segments import VelocityBins, band_radius_px, stationary_speed_px_per_s
from velfield.field.statistics import TileStatistics, tile_statistics
from velfield.run.stores import GROUP_TILES, HISTOGRAM, HISTOGRAM_TIME_WEIGHTED, FieldStore, create_field, fill_value


@dataclass(frozen=True)
class _Layer:
    """A layer: units and name of what it holds, its value (ty, tx) of a tile and the tile's statistics, its type."""

    units: str
    long_name: str
    value: Callable[[FieldTile, TileStatistics], NDArray[Any]]
    dtype: str = "float32"


_SPEED = "px s-1"
LAYERS = {
    "count": _Layer("1", "number of vehicle tracks", lambda t, _: t.count, "int32"),
    "occupancy_ms": _Layer("ms", "total time that vehicles spent at the pixel", lambda t, _: t.occupancy_ms, "int32"),
    "velocity_variance_sum": _Layer(
        "1",
        f"sum over tracks of the variance of a velocity component, in bins squared times {VARIANCE_UNIT}",
        lambda t, _: t.variance_sum,
        "int32",
    ),
    "modal_vx": _Layer(_SPEED, "x component of the modal velocity", lambda _, s: s.modal_velocity_px_per_s[..., 0]),
    "modal_vy": _Layer(
        _SPEED, "y component of the modal velocity, down", lambda _, s: s.modal_velocity_px_per_s[..., 1]
    ),
    "mode_fraction": _Layer("1", "fraction of the weight at the mode", lambda _, s: s.mode_fraction),
    "mean_vx": _Layer(_SPEED, "x component of the mean velocity", lambda _, s: s.mean_velocity_px_per_s[..., 0]),
    "mean_vy": _Layer(_SPEED, "y component of the mean velocity, down", lambda _, s: s.mean_velocity_px_per_s[..., 1]),
    "speed_p15": _Layer(_SPEED, "15th percentile of speed", lambda _, s: s.speed_percentiles_px_per_s[..., 0]),
    "speed_p50": _Layer(_SPEED, "median speed", lambda _, s: s.speed_percentiles_px_per_s[..., 1]),
    "speed_p85": _Layer(_SPEED, "85th percentile of speed", lambda _, s: s.speed_percentiles_px_per_s[..., 2]),
    "stationary_fraction": _Layer("1", "fraction of stationary vehicles", lambda _, s: s.stationary_fraction),
    "circular_variance": _Layer(
        "1", "circular variance of the direction of moving vehicles", lambda _, s: s.circular_variance
    ),
    "entropy": _Layer("1", "entropy of the velocity distribution, nats", lambda _, s: s.entropy_nats),
    "direction_se": _Layer(
        "rad", "standard error of the mean direction of moving vehicles", lambda _, s: s.direction_se_rad
    ),
    "speed_se": _Layer(_SPEED, "standard error of the median speed", lambda _, s: s.speed_se_px_per_s),
    "direction_ci90_half_width": _Layer(
        "rad",
        "half the width of the 90 % confidence interval of the modal direction",
        lambda _, s: s.direction_half_width_rad,
    ),
    "speed_p50_ci90_lower": _Layer(
        _SPEED,
        "lower bound of the 90 % confidence interval of the median speed",
        lambda _, s: s.median_speed_low_px_per_s,
    ),
    "speed_p50_ci90_upper": _Layer(
        _SPEED,
        "upper bound of the 90 % confidence interval of the median speed",
        lambda _, s: s.median_speed_high_px_per_s,
    ),
}
"""Layers by their names in the store."""


def tile_layers(tile: FieldTile, bins: VelocityBins, config: FieldConfig) -> dict[str, NDArray[Any]]:
    """All layers of one tile, each (ty, tx)."""
    limit = stationary_speed_px_per_s(config, bins.gsd_m)
    found = tile_statistics(tile.histogram, tile.count, tile.variance_sum, bins=bins, stationary_speed_px_per_s=limit)
    return {name: np.asarray(layer.value(tile, found), layer.dtype) for name, layer in LAYERS.items()}


Group = tuple[int, int]
"""(row, column)."""

_KEPT = 2
"""Histograms of 22 MB that are used again once they are written: clearing new ones took a quarter of the time."""


def tile_groups(grid: GridRecord, config: FieldConfig) -> list[Group]:
    """All groups of tiles of a base image."""
    side = config.tile_size_px * GROUP_TILES
    rows, columns = -(-grid.height_px // side), -(-grid.width_px // side)
    return [(row, column) for row in range(rows) for column in range(columns)]


class GroupWriter:
    """Writes one group of tiles: each tile when it is put, the layers when the group is closed."""

    def __init__(
        self,
        store: FieldStore,
        group: Group,
        *,
        grid: GridRecord,
        config: FieldConfig,
        bins: VelocityBins,
        zeros: list[NDArray[np.int32]],
    ) -> None:
        """``zeros``: histograms of zeros, kept from one writer to the next."""
        self.store, self.group, self.config, self.bins = store, group, config, bins
        self.side = config.tile_size_px * GROUP_TILES
        self.y0, self.x0 = group[0] * self.side, group[1] * self.side
        self.height, self.width = min(self.side, grid.height_px - self.y0), min(self.side, grid.width_px - self.x0)
        self.touched: list[tuple[int, int]] = []
        self._zeros = zeros
        self.layers: dict[str, NDArray[Any]] = {
            name: np.full((self.height, self.width), fill_value(layer.dtype), layer.dtype)
            for name, layer in LAYERS.items()
        }

    def tiles(self) -> list[tuple[int, int]]:
        """Tiles (row, column) of the group."""
        size = self.config.tile_size_px
        rows = range(self.y0 // size, -(-(self.y0 + self.height) // size))
        columns = range(self.x0 // size, -(-(self.x0 + self.width) // size))
        return [(row, column) for row in rows for column in columns]

    def origin_xy(self, row: int, column: int) -> tuple[int, int]:
        """Base pixel (x, y) of a tile's first pixel."""
        return column * self.config.tile_size_px, row * self.config.tile_size_px

    def tile_shape(self, row: int, column: int) -> tuple[int, int]:
        """(height, width) of a tile: smaller at the map's edge."""
        x, y = self.origin_xy(row, column)
        size = self.config.tile_size_px
        return min(size, self.y0 + self.height - y), min(size, self.x0 + self.width - x)

    def zeros(self, row: int, column: int) -> NDArray[np.int32]:
        """A histogram of zeros for a tile, (ty, tx, nvy, nvx), which `put` takes back once it is written."""
        shape = (*self.tile_shape(row, column), self.bins.n, self.bins.n)
        for k, histogram in enumerate(self._zeros):
            if histogram.shape == shape:
                return self._zeros.pop(k)
        self._zeros.clear()  # of another shape, as at the map's edge
        return np.zeros(shape, np.int32)

    def put(self, row: int, column: int, tile: FieldTile, time_weighted: FieldTile | None = None) -> None:
        """Write one tile, with the histogram weighted by time if any; skip a tile that no vehicle passed.

        The histograms belong to the writer from now on.
        """
        histograms = [(HISTOGRAM, tile)] + ([] if time_weighted is None else [(HISTOGRAM_TIME_WEIGHTED, time_weighted)])
        if not tile.count.any():
            self._keep(histograms)
            return
        self.touched.append((row, column))
        x, y = self.origin_xy(row, column)
        height, width = tile.count.shape
        window = np.s_[y - self.y0 : y - self.y0 + height, x - self.x0 : x - self.x0 + width]
        for name, values in tile_layers(tile, self.bins, self.config).items():
            self.layers[name][window] = values
        passed = tile.count > 0
        y, x = np.argwhere(passed)[0]
        for name, one in histograms:
            if one.histogram[y, x].any() or one.histogram[passed].any():  # weights of milliseconds may all be zero
                self.store.write_tile(row, column, one.histogram, one.count, name)
                one.histogram[passed] = 0
        self._keep(histograms)

    def _keep(self, histograms: list[tuple[str, FieldTile]]) -> None:
        self._zeros += [one.histogram for _, one in histograms[: _KEPT - len(self._zeros)]]

    def close(self) -> None:
        """Write the layers."""
        for name, one in self.layers.items():
            self.store.write_layer(name, self.group, one)

    def files(self) -> list[Path]:
        """The files written, once closed, and the store's metadata."""
        return self.store.files(self.touched, self.group)


def create_field_store(
    path: Path,
    *,
    key: str,
    grid: GridRecord,
    config: FieldConfig,
    weighted_by: Weight,
    observed_s: float,
    time_weighted: bool,
    more: Mapping[str, object] | None = None,
) -> None:
    """Create a field's store; ``more`` are attributes beside those that a reader needs.

    Parameters
    ----------
    weighted_by
        Weight of a track at a pixel.
    observed_s
        Duration of the observation, s, for comparing counts.
    time_weighted
        Whether the histogram weighed by time is kept too.
    """
    bins = VelocityBins.from_config(config, grid.gsd_m)
    attributes = {
        "title": "velocity field",
        "weight_unit": UNIT,
        "weighted_by": weighted_by,
        "bin_width_px_per_s": bins.width_px_per_s,
        "kernel_sigma_px_per_s": bins.kernel_sigma_px_per_s,
        "band_radius_px": band_radius_px(config, grid.gsd_m),
        "velocity_span_s": config.velocity_span_s,
        "observed_s": observed_s,
        "gsd_m": grid.gsd_m,
        "crs_wkt": grid.crs_wkt,
        "geotransform": " ".join(repr(v) for v in grid.affine) if grid.affine else None,
        **(more or {}),
    }
    create_field(
        path,
        key=key,
        height=grid.height_px,
        width=grid.width_px,
        tile=config.tile_size_px,
        group_tiles=GROUP_TILES,
        velocities_px_per_s=bins.centres_px_per_s,
        attributes={name: value for name, value in attributes.items() if value is not None},
        histograms=_histograms(weighted_by, time_weighted),
        layers={
            name: (layer.dtype, {"units": layer.units, "long_name": layer.long_name}) for name, layer in LAYERS.items()
        },
    )


def _histograms(weighted_by: Weight, time_weighted: bool) -> dict[str, dict[str, str]]:
    """Attributes of the histograms kept, by name."""
    found = {
        HISTOGRAM: {
            "long_name": f"velocity histogram, weighted by {weighted_by}",
            "units": f"1/{UNIT} {weighted_by}",
            "weighted_by": weighted_by,
        }
    }
    if time_weighted:
        found[HISTOGRAM_TIME_WEIGHTED] = {
            "long_name": "velocity histogram, weighted by time",
            "units": f"1/{UNIT} s",
            "weighted_by": "time",
        }
    return found
