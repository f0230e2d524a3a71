"""Tracklets of a unit of frames, exact across its border."""

import numpy as np
import pandas as pd

from schemas.tables import DETECTION_COLUMNS, TRACKLET_COLUMNS
from velfield.pipeline.plan import Plan
from velfield.pipeline.progress import advance
from velfield.pipeline.result import StageResult
from velfield.pipeline.stages.registration import MAP_PARAMETERS, usable_frames
from velfield.run.grid import read_grid
from velfield.run.stores import open_frames, open_registration
from velfield.run.tables import Patches, read_patches, read_tables, write_table
from velfield.tracking.tracklets import FrameTable, link_windows, window_frames


def link_unit(plan: Plan, frames: range) -> StageResult:
    """Tracklets of all windows that start in ``frames``; reads the detections of as many frames after as they need."""
    times_s = open_frames(plan.layout.frames).column("time_s")
    usable = usable_frames(plan)
    window = window_frames(list(usable), list(times_s), frames, plan.config.tracking.max_interval_s)
    tables = _frame_tables(plan, window, times_s, usable)
    tracklets, log = link_windows(tables, plan.config.tracking, gsd_m=read_grid(plan.layout).gsd_m, starts=frames)
    path = plan.layout.unit_file(plan.layout.tracklets, frames.start // plan.unit_frames, ".parquet")
    write_table(path, tracklets, TRACKLET_COLUMNS)
    advance("tracklets", len(frames))
    counts = {f"gate_{name}": float(count) for name, count in log.items()}
    return StageResult([path], {"frames": len(frames), "tracklets": len(tracklets), **counts})


def _frame_tables(plan: Plan, window: range, times_s: np.ndarray, usable: np.ndarray) -> list[FrameTable]:
    store = open_registration(plan.layout.registration)
    heldout = store.column("heldout_px", window.start, window.stop).astype(np.float64)
    kept = store.column("n_inliers", window.start, window.stop).astype(np.float64)
    tables: list[FrameTable] = []
    for unit in range(window.start // plan.unit_frames, (window.stop - 1) // plan.unit_frames + 1):
        path = plan.layout.unit_file(plan.layout.detections, unit, ".parquet")
        table = read_tables([path], DETECTION_COLUMNS)
        patches = read_patches(path.with_suffix(".patches.npz"))
        first, last = unit * plan.unit_frames, min((unit + 1) * plan.unit_frames, window.stop)
        for frame in range(max(first, window.start), last):
            k = frame - window.start
            residual = float(np.nan_to_num(heldout[k]))
            tables.append(
                _frame_table(
                    table,
                    patches,
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
    patches: Patches,
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
        patches=patches["patches"][rows],
        crops=patches["chips"][rows],
        x_work=patches["xy_work"][rows, 0],
        y_work=patches["xy_work"][rows, 1],
        working_scale=float(patches["working_scale"]),
        registration_sd_px=map_sd_px,
        **column,
    )
