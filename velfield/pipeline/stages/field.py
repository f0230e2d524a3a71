"""The velocity histogram, a group of tiles at a time: each tile from the segments that reach it, written once."""

from collections.abc import Sequence
from functools import partial
from math import isfinite
from pathlib import Path

import numpy as np
import pandas as pd

from schemas.flight import FieldConfig
from schemas.tables import TRACKLET_COLUMNS
from velfield.field.accumulate import Weight, accumulate_tile
from velfield.field.segments import (
    SEGMENT_COLUMNS,
    SEGMENT_DTYPE,
    Segments,
    VelocityBins,
    band_radius_px,
    segment_table,
    segments_by_tile,
    tracks_in,
)
from velfield.field.time_intervals import TimeInterval, assign_intervals
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import StageResult, advance
from velfield.run.field_writer import Group, GroupWriter, create_field_store, tile_groups
from velfield.run.frame_transforms import read_grid
from velfield.run.layout import remove_tree
from velfield.run.stores import FIELD_BLOCK, FieldStore, store_key
from velfield.run.tables import read_tables

_PLACE_COLUMNS = ["track_id", *(f"{axis}_{k}_px" for k in range(3) for axis in "xy")]


def field_blocks(plan: Plan) -> list[Group]:
    """All units of the base image: blocks of two by two groups of tiles, (row, column) of each."""
    groups = tile_groups(read_grid(plan.layout), plan.config.field)
    return sorted({(row // FIELD_BLOCK, column // FIELD_BLOCK) for row, column in groups})


def _list_groups(plan: Plan, block: Group) -> list[Group]:
    groups = tile_groups(read_grid(plan.layout), plan.config.field)
    return [group for group in groups if (group[0] // FIELD_BLOCK, group[1] // FIELD_BLOCK) == block]


def field_weight(config: FieldConfig) -> Weight:
    """Weight that a track adds at a pixel: one in all, or one a segment as in the paper."""
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


def accumulate_block(plan: Plan, block: Group) -> StageResult:
    """Fill one block of groups of tiles, of the field and of its time intervals."""
    grid, config = read_grid(plan.layout), plan.config.field
    bins, weight = VelocityBins.from_config(config, grid.gsd_m), field_weight(config)
    make = partial(GroupWriter, grid=grid, config=config, bins=bins, zeros=[])
    store = FieldStore(plan.layout.field, "r+")
    writers = [make(store, group) for group in _list_groups(plan, block)]
    segments = _segments_near(plan, writers)
    for writer in writers:
        accumulate_into(writer, segments, weight=weight, time_weighted=config.time_weighted)
    parts = interval_stores(plan)
    number = assign_intervals(segments, [part for _, part in parts]) if parts else None
    interval_writers = []
    for k, (path, _) in enumerate(parts):
        store = FieldStore(path, "r+")
        for group in _list_groups(plan, block):
            interval_writers.append(make(store, group))
            accumulate_into(interval_writers[-1], segments[number == k], weight=weight, time_weighted=False)
    advance("field")
    files = [file for writer in (*writers, *interval_writers) for file in writer.files()]
    counts = [writer.layers["count"] for writer in writers]
    return StageResult(
        list(dict.fromkeys(files)),
        {
            "pixels": float(sum((count > 0).sum() for count in counts)),
            "pixels_5": float(sum((count >= 5).sum() for count in counts)),
            "tiles": float(sum(len(writer.touched) for writer in writers)),
        },
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
        timed = accumulate(weight="time", zeros=writer.zeros(row, column)) if time_weighted else None
        writer.put(row, column, accumulate(weight=weight, zeros=writer.zeros(row, column)), timed)
    writer.close()


def _segments_near(plan: Plan, writers: Sequence[GroupWriter]) -> Segments:
    """All segments of the tracks that come near groups: whole tracks, for one track adds one unit at a pixel."""
    config, gsd_m = plan.config.field, writers[0].bins.gsd_m
    margin = (band_radius_px(config, gsd_m) or 0.0) + 1
    low = min(writer.x0 for writer in writers) - margin, min(writer.y0 for writer in writers) - margin
    high = (
        max(writer.x0 + writer.width for writer in writers) + margin,
        max(writer.y0 + writer.height for writer in writers) + margin,
    )
    tracklets = _tracklets_near(plan, low, high)
    return segment_table(tracklets, config) if len(tracklets) else np.empty(0, SEGMENT_DTYPE)


def _tracklets_near(plan: Plan, low_xy: tuple[float, float], high_xy: tuple[float, float]) -> pd.DataFrame:
    """All tracklets of the tracks that come into a rectangle, table by table: of a long flight all at once would take
    gigabytes."""
    paths = plan.layout.unit_files(plan.layout.tracks)
    read = partial(read_tables, columns=TRACKLET_COLUMNS)
    if not paths:
        return read([], only=list(SEGMENT_COLUMNS))
    near = np.unique(np.concatenate([tracks_in(read([path], only=_PLACE_COLUMNS), low_xy, high_xy) for path in paths]))
    parts = []
    for path in paths:
        table = read([path], only=list(SEGMENT_COLUMNS))
        parts.append(table[np.isin(table["track_id"].to_numpy(), near)])
    return pd.concat(parts, ignore_index=True)
