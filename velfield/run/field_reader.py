"""Read the velocity field of a run folder tile by tile; a missing tile is an error."""

from dataclasses import dataclass
from math import inf

import numpy as np

from schemas.flight import FieldConfig
from schemas.records import GridRecord
from velfield.errors import InputError, StoreError
from velfield.field.accumulate import FieldTile
from velfield.field.segments import VelocityBins, stationary_speed_px_per_s
from velfield.field.view import TileSource, VelocityField
from velfield.run.flight_record import read_flight_record
from velfield.run.frame_transforms import read_grid
from velfield.run.layout import RunLayout
from velfield.run.stores import HISTOGRAM, HISTOGRAM_TIME_WEIGHTED, FieldStore


@dataclass(frozen=True)
class IntervalField:
    """The field of a time interval; the ends of ``rest``, of what lies in no configured interval, are infinite."""

    name: str
    start_s: float
    stop_s: float
    observed_s: float
    field: VelocityField


def open_velocity_field(layout: RunLayout, *, time_weighted: bool = False) -> VelocityField:
    """The field of a run folder, weighed by track or by time.

    Raises
    ------
    InputError
        The field was not built yet, or not with that weight.
    """
    config = read_flight_record(layout.root).config.field
    return field_from_store(FieldStore(layout.field), config, read_grid(layout), time_weighted=time_weighted)


def source_runs(layout: RunLayout) -> tuple[str, ...]:
    """The runs of whose fields this folder's was made by `velfield.run.field_algebra`; empty of a run of its own."""
    if not layout.field.exists():
        return ()
    about = FieldStore(layout.field).attributes
    return (
        *about.get("merged_from", ()),
        *(about[name] for name in ("subtracted_from", "subtracted") if name in about),
    )


def open_field_intervals(layout: RunLayout) -> list[IntervalField]:
    """The fields of the time intervals of a run folder, in their order; empty where none were configured."""
    config = read_flight_record(layout.root).config.field
    grid = read_grid(layout)
    fields = []
    for path in sorted(layout.intervals.glob("*.zarr")):
        store = FieldStore(path)
        about = store.attributes
        ends = float(about.get("start_s", -inf)), float(about.get("stop_s", inf))
        field = field_from_store(store, config, grid)
        fields.append(IntervalField(str(about["time_interval"]), *ends, float(about["observed_s"]), field))
    return fields


def field_from_store(
    store: FieldStore, config: FieldConfig, grid: GridRecord, *, time_weighted: bool = False
) -> VelocityField:
    """The field in a store that was created under a configuration."""
    path, histogram = store.path, HISTOGRAM_TIME_WEIGHTED if time_weighted else HISTOGRAM
    if histogram not in store.histogram_names():
        raise InputError(f"{path} holds no {histogram}: run the flight again with --set field.time_weighted=true")
    count = store.layer("count")
    return VelocityField(
        tile_reader(store, histogram),
        tiles=known_tiles(count, store.tile),
        shape=store.shape,
        tile_size=store.tile,
        bins=VelocityBins.from_config(config, grid.gsd_m),
        stationary_speed_px_per_s=stationary_speed_px_per_s(config, grid.gsd_m),
        layers=None if time_weighted else store.layer,
    )


def tile_reader(store: FieldStore, histogram: str) -> TileSource:
    """A reader of whole tiles: a histogram, and the layers that are sums."""
    sums = {name: store.layer(name) for name in ("count", "occupancy_ms", "velocity_variance_sum")}
    side = store.tile

    def read(row: int, column: int) -> FieldTile | None:
        window = np.s_[row * side : (row + 1) * side, column * side : (column + 1) * side]
        count, occupancy_ms, noise = (layer[window] for layer in sums.values())
        if not count.any():
            return None
        if not store.has_tile(row, column, histogram):
            raise StoreError(
                f"{store.path / histogram}: the chunk of tile ({row}, {column}) is missing; run the flight again"
            )
        return FieldTile(store.read_tile(row, column, histogram), count, occupancy_ms, noise)

    return read


def known_tiles(count: np.ndarray, side: int) -> list[tuple[int, int]]:
    """Tiles that hold a track: these must be in the store."""
    rows, columns = np.nonzero(count)
    tiles = np.unique(np.column_stack([rows // side, columns // side]), axis=0)
    return [(int(row), int(column)) for row, column in tiles]
