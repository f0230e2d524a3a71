"""The velocity field of a run folder, read tile by tile; a tile that must be there and is not is an error."""

import numpy as np

from schemas.records import FlightRecord
from velfield.field.bins import VelocityBins, standing_px_per_s
from velfield.field.view import Tile, VelocityField
from velfield.layout import RunLayout
from velfield.steps.grid import read_grid_of
from velfield.stores import HISTOGRAM, FieldStore, StoreError, open_field


def open_velocity_field(layout: RunLayout) -> VelocityField:
    """The field of a run folder.

    Raises
    ------
    InputError
        The field was not built yet.
    """
    config = FlightRecord.model_validate_json(layout.flight.read_bytes()).config.field
    gsd_m = read_grid_of(layout).gsd_m
    store = open_field(layout.field)
    count, noise = store.layer("count"), store.layer("velocity_noise")
    return VelocityField(
        lambda row, column: _tile(store, count, noise, row, column),
        tiles=_known_tiles(count, store.tile),
        shape=store.shape,
        tile_size=store.tile,
        bins=VelocityBins.from_config(config, gsd_m),
        standing_px_per_s=standing_px_per_s(config, gsd_m),
        layers=store.layer,
    )


def _known_tiles(count: np.ndarray, side: int) -> list[tuple[int, int]]:
    """Tiles that hold a passage: these must be in the store."""
    rows, columns = np.nonzero(count)
    tiles = np.unique(np.column_stack([rows // side, columns // side]), axis=0)
    return [(int(row), int(column)) for row, column in tiles]


def _tile(store: FieldStore, count: np.ndarray, noise: np.ndarray, row: int, column: int) -> Tile:
    if not store.has_tile(row, column):
        raise StoreError(f"{store.path / HISTOGRAM}: the chunk of tile ({row}, {column}) is gone; run the flight again")
    y, x, side = row * store.tile, column * store.tile, store.tile
    place = np.s_[y : y + side, x : x + side]
    return store.read_tile(row, column), count[place], noise[place]
