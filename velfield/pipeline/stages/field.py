"""The velocity histogram, a group of tiles at a time: each tile from the segments that reach it, written once."""

from functools import partial
from math import isfinite
from pathlib import Path

import numpy as np
import pandas as pd

from schemas.flight import FieldConfig
from schemas.tables import TRACKLET_COLUMNS
from velfield.field.accumulate import Weight, accumulate_tile
from velfield.field.segments import (
    SEGMENT_DTYPE,
    Segments,
    VelocityBins,
    band_radius_px,
    segment_table,
    segments_by_tile,
)
from velfield.field.time_intervals import TimeInterval, assign_intervals
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import StageResult, advance
from velfield.run.field_writer import Group, GroupWriter, create_field_store, tile_groups
from velfield.run.frame_transforms import read_grid
from velfield.run.layout import remove_tree
from velfield.run.stores import open_field, store_key
from velfield.run.tables import read_tables

_SEGMENT_COLUMNS = [
    "tracklet_id",
    "track_id",
    *(f"detection_id_{k}" for k in range(3)),
    *(f"time_{k}_s" for k in range(3)),
    *(f"{axis}_{k}_px" for k in range(3) for axis in "xy"),
    *(f"v{axis}_{k}_px_per_s" for k in ("01", "12") for axis in "xy"),
    *(f"displacement_sd_{k}_px" for k in ("01", "12")),
]


def field_groups(plan: Plan) -> list[Group]:
    """All groups of tiles of the base image, (row, column)."""
    return tile_groups(read_grid(plan.layout), plan.config.field)


def field_weight(config: FieldConfig) -> Weight:
    """What a track adds at a pixel: one in all, or one a segment as in the paper."""
    return "segment" if config.shared_segment_weight == 2 else "track"


def create_field_stores(plan: Plan) -> None:
    """Create ``field.zarr``, and a store for each time interval, unless they exist under this plan's key."""
    if store_key(plan.layout.field) == plan.keys["field"]:
        return
    times_s = plan.info.times_s[plan.indices]
    first_s, last_s = float(times_s[0]), float(times_s[-1])
    remove_tree(plan.layout.intervals)
    config = plan.config.field
    create = partial(
        create_field_store,
        key=plan.keys["field"],
        grid=read_grid(plan.layout),
        config=config,
        weighted_by=field_weight(config),
    )
    for path, part in interval_stores(plan):
        watched_s = max(min(part.stop_s, last_s) - max(part.start_s, first_s), 0.0)
        ends = {name: value for name, value in (("start_s", part.start_s), ("stop_s", part.stop_s)) if isfinite(value)}
        create(path, observed_s=watched_s, time_weighted=False, more={"time_interval": part.name, **ends})
    create(
        plan.layout.field, observed_s=last_s - first_s, time_weighted=config.time_weighted
    )  # last: its key marks all as created


def interval_stores(plan: Plan) -> list[tuple[Path, TimeInterval]]:
    """Stores of the time intervals, in their order; empty where none are set."""
    return [(plan.layout.intervals / f"{k:03d}.zarr", part) for k, part in enumerate(plan.time_intervals)]


def accumulate_group(plan: Plan, group: Group) -> StageResult:
    """Fill one group of tiles, of the field and of its time intervals."""
    grid, config = read_grid(plan.layout), plan.config.field
    bins = VelocityBins.from_config(config, grid.gsd_m)
    writer = GroupWriter(open_field(plan.layout.field, "r+"), group, grid=grid, config=config, bins=bins)
    segments = _segments_near(plan, writer)
    weight = field_weight(config)
    accumulate_into(writer, segments, weight=weight, time_weighted=config.time_weighted)
    files = writer.files()
    stores = interval_stores(plan)
    number = assign_intervals(segments, [part for _, part in stores]) if stores else None
    for k, (path, _) in enumerate(stores):
        part = GroupWriter(open_field(path, "r+"), group, grid=grid, config=config, bins=bins)
        accumulate_into(part, segments[number == k], weight=weight, time_weighted=False)
        files += part.files()
    advance("field")
    count = writer.layers["count"]
    return StageResult(
        files,
        {"pixels": float((count > 0).sum()), "pixels_5": float((count >= 5).sum()), "tiles": len(writer.touched)},
    )


def accumulate_into(writer: GroupWriter, segments: Segments, *, weight: Weight, time_weighted: bool) -> None:
    """Fill a group from the segments that come near it."""
    config, radius = writer.config, band_radius_px(writer.config, writer.bins.gsd_m)
    mine = set(writer.tiles())
    by_tile = segments_by_tile(segments, shape=writer.store.shape, tile_size=config.tile_size_px, radius_px=radius)
    for (row, column), rows in by_tile.items():
        if (row, column) not in mine:
            continue
        accumulate = partial(
            accumulate_tile,
            segments[rows],
            origin_xy=writer.origin_xy(row, column),
            shape=writer.tile_shape(row, column),
            bins=writer.bins,
            radius_px=radius,
        )
        timed = accumulate(weight="time").histogram if time_weighted else None
        writer.put(row, column, accumulate(weight=weight), timed)
    writer.close()


def _segments_near(plan: Plan, writer: GroupWriter) -> Segments:
    """All segments of the tracks that come near the group: whole tracks, for one track adds one unit at a pixel."""
    margin = (band_radius_px(writer.config, writer.bins.gsd_m) or 0.0) + 1
    tracklets = _tracklets_near(plan, writer.x0, writer.y0, writer.width, writer.height, margin)
    return segment_table(tracklets, writer.config) if len(tracklets) else np.empty(0, SEGMENT_DTYPE)


def _tracklets_near(plan: Plan, x0: int, y0: int, width: int, height: int, margin: float) -> pd.DataFrame:
    """All tracklets of the tracks that come near the group: whole tracks, for one track adds one unit at a pixel."""
    paths = sorted(plan.layout.tracks.glob("unit-*.parquet"))
    table = read_tables(paths, TRACKLET_COLUMNS, only=_SEGMENT_COLUMNS)
    xs = table[[f"x_{k}_px" for k in range(3)]].to_numpy()
    ys = table[[f"y_{k}_px" for k in range(3)]].to_numpy()
    near = (
        (xs.max(axis=1, initial=-np.inf) >= x0 - margin)
        & (xs.min(axis=1, initial=np.inf) <= x0 + width + margin)
        & (ys.max(axis=1, initial=-np.inf) >= y0 - margin)
        & (ys.min(axis=1, initial=np.inf) <= y0 + height + margin)
    )
    tracks = table["track_id"].to_numpy()
    return table[np.isin(tracks, np.unique(tracks[near]))]
