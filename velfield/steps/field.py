"""The velocity histogram, a group of tiles at a time: each tile from the segments that reach it, written once."""

import numpy as np
import pandas as pd

from schemas.flight import FieldConfig
from schemas.tables import TRACKLET_COLUMNS
from velfield.field.accumulate import UNIT, Weight, accumulate_tile
from velfield.field.bins import VelocityBins, band_radius_px
from velfield.field.segments import SEGMENT_DTYPE, segment_table, segments_by_tile
from velfield.plan import Plan
from velfield.progress import advance
from velfield.steps.field_layers import LAYERS, tile_layers
from velfield.steps.grid import read_grid
from velfield.steps.outcome import Outcome
from velfield.stores import create_field, open_field, store_key
from velfield.tables import read_tables

GROUP_TILES = 8
"""A group is so many tiles high and wide: 512 x 512 px, a unit of work and a chunk of the layers."""

_SEGMENT_COLUMNS = [
    "tracklet_id",
    "passage_id",
    *(f"detection_id_{k}" for k in range(3)),
    *(f"time_{k}_s" for k in range(3)),
    *(f"{axis}_{k}_px" for k in range(3) for axis in "xy"),
    *(f"v{axis}_{k}_px_per_s" for k in ("01", "12") for axis in "xy"),
    *(f"displacement_sd_{k}_px" for k in ("01", "12")),
]


def group_name(group: tuple[int, int]) -> str:
    """Name of a group of tiles, (row, column).

    Examples
    --------
    >>> group_name((0, 3))
    'group-000-003'
    """
    return f"group-{group[0]:03d}-{group[1]:03d}"


def field_groups(plan: Plan) -> list[tuple[int, int]]:
    """All groups of tiles of the base image, (row, column)."""
    grid = read_grid(plan)
    side = plan.config.field.tile_size_px * GROUP_TILES
    rows, columns = -(-grid.height_px // side), -(-grid.width_px // side)
    return [(row, column) for row in range(rows) for column in range(columns)]


def field_weight(config: FieldConfig) -> Weight:
    """What a passage adds at a pixel: one in all, or one a segment as in the paper."""
    return "segment" if config.weigh_shared_segments == "twice" else "passage"


def lay_out_field(plan: Plan) -> None:
    """Create ``field.zarr`` unless it stands as this plan wants it."""
    if store_key(plan.layout.field) == plan.keys["field"]:
        return
    grid = read_grid(plan)
    bins = VelocityBins.from_config(plan.config.field, grid.gsd_m)
    attributes = {
        "title": "velocity field",
        "weight_unit": UNIT,
        "weighted_by": field_weight(plan.config.field),
        "bin_width_px_per_s": bins.width_px_per_s,
        "kernel_sigma_px_per_s": bins.kernel_sigma_px_per_s,
        "gsd_m": grid.gsd_m,
        "crs_wkt": grid.crs_wkt,
        "geotransform": " ".join(repr(v) for v in grid.affine) if grid.affine else None,
    }
    create_field(
        plan.layout.field,
        key=plan.keys["field"],
        height=grid.height_px,
        width=grid.width_px,
        tile=plan.config.field.tile_size_px,
        group_tiles=GROUP_TILES,
        velocities_px_per_s=bins.centres_px_per_s,
        attributes={name: value for name, value in attributes.items() if value is not None},
        layers=LAYERS,
    )


def accumulate_group(plan: Plan, group: tuple[int, int]) -> Outcome:
    """Fill one group of tiles."""
    grid, config = read_grid(plan), plan.config.field
    bins = VelocityBins.from_config(config, grid.gsd_m)
    radius = band_radius_px(config, grid.gsd_m)
    side = config.tile_size_px * GROUP_TILES
    y0, x0 = group[0] * side, group[1] * side
    height, width = min(side, grid.height_px - y0), min(side, grid.width_px - x0)
    tracklets = _tracklets_near(plan, x0, y0, width, height, (radius or 0.0) + 1)
    segments = segment_table(tracklets, config) if len(tracklets) else np.empty(0, SEGMENT_DTYPE)
    layers = {
        name: np.full((height, width), _fill(attrs), attrs.get("dtype", "float32")) for name, attrs in LAYERS.items()
    }
    store = open_field(plan.layout.field, "r+")
    shape = (grid.height_px, grid.width_px)
    touched = 0
    for (row, column), rows in segments_by_tile(
        segments, shape=shape, tile_size=config.tile_size_px, radius_px=radius
    ).items():
        y, x = row * config.tile_size_px, column * config.tile_size_px
        if not (y0 <= y < y0 + height and x0 <= x < x0 + width):
            continue
        tile_shape = min(config.tile_size_px, grid.height_px - y), min(config.tile_size_px, grid.width_px - x)
        tile = accumulate_tile(
            segments[rows], origin_xy=(x, y), shape=tile_shape, bins=bins, radius_px=radius, weight=field_weight(config)
        )
        if not tile.count.any():
            continue
        store.write_tile(row, column, tile.histogram)
        touched += 1
        for name, values in tile_layers(tile, bins, config).items():
            layers[name][y - y0 : y - y0 + tile_shape[0], x - x0 : x - x0 + tile_shape[1]] = values
    for name, values in layers.items():
        store.write_layer(name, y0, x0, values)
    advance("field")
    count = layers["count"]
    return Outcome(
        [plan.layout.field],
        {"pixels": float((count > 0).sum()), "pixels_5": float((count >= 5).sum()), "tiles": touched},
    )


def _fill(attributes: dict[str, object]) -> float:
    return np.nan if str(attributes.get("dtype", "float32")).startswith("float") else 0


def _tracklets_near(plan: Plan, x0: int, y0: int, width: int, height: int, margin: float) -> pd.DataFrame:
    """All tracklets of the passages that come near the group: whole ones, for a passage shares one unit at a pixel."""
    paths = sorted(plan.layout.tracklets.glob("unit-*.parquet"))
    table = read_tables(paths, TRACKLET_COLUMNS, only=_SEGMENT_COLUMNS)
    xs = table[[f"x_{k}_px" for k in range(3)]].to_numpy()
    ys = table[[f"y_{k}_px" for k in range(3)]].to_numpy()
    near = (
        (xs.max(axis=1, initial=-np.inf) >= x0 - margin)
        & (xs.min(axis=1, initial=np.inf) <= x0 + width + margin)
        & (ys.max(axis=1, initial=-np.inf) >= y0 - margin)
        & (ys.min(axis=1, initial=np.inf) <= y0 + height + margin)
    )
    passages = table["passage_id"].to_numpy()
    return table[np.isin(passages, np.unique(passages[near]))]
