"""Tracklets of a unit of frames, exact across its border; then passages over all units."""

from pathlib import Path

import numpy as np
import pandas as pd

from schemas.tables import DETECTION_COLUMNS, TRACKLET_COLUMNS
from velfield.pipeline.plan import Plan, widen_interval
from velfield.pipeline.progress import advance
from velfield.pipeline.result import Outcome
from velfield.pipeline.stages.registration import MAP_PARAMETERS, usable_frames
from velfield.run.grid import read_grid
from velfield.run.stores import open_frames, open_registration
from velfield.run.tables import Patches, read_patches, read_tables, write_table
from velfield.tracking.gap_closing import END_COLUMNS, GapLimits, reconnect_tracks
from velfield.tracking.tracklets import FrameTable, link_windows, window_frames
from velfield.tracking.tracks import assign_tracks


def link_unit(plan: Plan, frames: range) -> Outcome:
    """Tracklets of all windows that start in ``frames``; reads the detections of as many frames after as they need."""
    times_s = open_frames(plan.layout.frames).column("time_s")
    usable = usable_frames(plan)
    wanted = window_frames(list(usable), list(times_s), frames, plan.config.tracking.max_interval_s)
    tables = _frame_tables(plan, wanted, times_s, usable)
    tracklets, log = link_windows(tables, plan.config.tracking, gsd_m=read_grid(plan.layout).gsd_m, starts=frames)
    path = plan.layout.unit_file(plan.layout.links, frames.start // plan.unit_frames, ".parquet")
    write_table(path, tracklets, TRACKLET_COLUMNS)
    advance("links", len(frames))
    counts = {f"gate_{name}": float(count) for name, count in log.items()}
    return Outcome([path], {"frames": len(frames), "tracklets": len(tracklets), **counts})


def _frame_tables(plan: Plan, wanted: range, times_s: np.ndarray, usable: np.ndarray) -> list[FrameTable]:
    store = open_registration(plan.layout.registration)
    heldout = store.column("heldout_px", wanted.start, wanted.stop).astype(np.float64)
    kept = store.column("count_kept", wanted.start, wanted.stop).astype(np.float64)
    tables: list[FrameTable] = []
    for unit in range(wanted.start // plan.unit_frames, (wanted.stop - 1) // plan.unit_frames + 1):
        path = plan.layout.unit_file(plan.layout.detections, unit, ".parquet")
        table = read_tables([path], DETECTION_COLUMNS)
        pictures = read_patches(path.with_suffix(".patches.npz"))
        first, last = unit * plan.unit_frames, min((unit + 1) * plan.unit_frames, wanted.stop)
        for frame in range(max(first, wanted.start), last):
            k = frame - wanted.start
            residual = float(np.nan_to_num(heldout[k]))
            tables.append(
                _frame_table(
                    table,
                    pictures,
                    frame,
                    time_s=float(times_s[frame]),
                    registered=bool(usable[frame]),
                    residual_px=residual,
                    map_sd_px=residual * float(np.sqrt(MAP_PARAMETERS / max(kept[k], MAP_PARAMETERS))),
                )
            )
    return tables


def _frame_table(
    table: pd.DataFrame,
    pictures: Patches,
    frame: int,
    *,
    time_s: float,
    registered: bool,
    residual_px: float,
    map_sd_px: float,
) -> FrameTable:
    rows = np.flatnonzero(table["frame"].to_numpy() == frame)
    mine = table.iloc[rows]
    column = {
        name: mine[name].to_numpy(np.float64)
        for name in ("x_px", "y_px", "orientation_rad", "orientation_sd_rad", "score")
    }
    return FrameTable(
        frame=frame,
        time_s=time_s,
        registered=registered,
        residual_px=residual_px,
        detection_id=mine["detection_id"].to_numpy(np.int64),
        patches=pictures["patches"][rows],
        crops=pictures["chips"][rows],
        x_work=pictures["place_work"][rows, 0],
        y_work=pictures["place_work"][rows, 1],
        working_scale=float(pictures["working_scale"]),
        registration_sd_px=map_sd_px,
        **column,
    )


def link_files(plan: Plan, units: list[range]) -> list[Path]:
    """Tables of the units that are there, in order."""
    paths = [plan.layout.unit_file(plan.layout.links, frames.start // plan.unit_frames, ".parquet") for frames in units]
    return [path for path in paths if path.exists()]


def chain_passages(plan: Plan, units: list[range]) -> Outcome:
    """Give every tracklet the passage that it belongs to: reads a few columns of all units, writes unit by unit."""
    ids = [f"detection_id_{k}" for k in range(3)]
    sources = link_files(plan, units)
    tracklets = read_tables(sources, TRACKLET_COLUMNS, only=[*ids, *END_COLUMNS])
    tracks = assign_tracks(tracklets[ids].to_numpy(np.int64))
    config = plan.config.tracking
    gaps = GapLimits(config.join_gap_s, config.join_standing_gap_s, config.slow_m_per_s)
    tracks = reconnect_tracks(tracklets, tracks, gaps, gsd_m=read_grid(plan.layout).gsd_m)
    written, start = [], 0
    for path in sources:
        table = read_tables([path], TRACKLET_COLUMNS)
        table["passage_id"] = tracks[start : start + len(table)]
        start += len(table)
        target = plan.layout.tracklets / path.name
        write_table(target, table, TRACKLET_COLUMNS)
        written.append(target)
    advance("tracklets")
    warnings = [] if len(tracks) else [_why_none(plan)]
    return Outcome(written, {"tracklets": len(tracks), "passages": len(np.unique(tracks))}, warnings=warnings)


def _why_none(plan: Plan) -> str:
    """Why no car was followed, so that the maps stay empty, and what to do."""
    told, near_s = "no tracklets, so the maps stay empty", plan.config.tracking.max_interval_s
    times_s = open_frames(plan.layout.frames).column("time_s")[usable_frames(plan)]
    if len(times_s) < 3:
        return f"{told}: {len(times_s)} frames are registered well enough, 3 or more needed; see registration's notes"
    gaps = np.diff(times_s)
    near = gaps <= near_s
    if (near[1:] & near[:-1]).any():
        return (
            f"{told}: no find goes on over three frames as a car does; see in the page whether what is found is cars, "
            "and else mark one frame and give it with --labels"
        )
    return (
        f"{told}: no three registered frames come within tracking.max_interval_s = {near_s:g} s of one another (median "
        f"{np.median(gaps):.2f} s); {widen_interval(gaps)}"
    )
