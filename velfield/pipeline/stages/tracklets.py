"""Tracklets of a unit of frames, exact across its border."""

from pathlib import Path

import numpy as np
import pandas as pd

from schemas.tables import DETECTION_COLUMNS, TRACKLET_COLUMNS
from velfield.detection.detector import ONNX_SUFFIX
from velfield.pipeline.plan import Plan, widen_interval
from velfield.pipeline.result import StageResult, advance
from velfield.pipeline.stages.registration import MAP_PARAMETERS, usable_frames
from velfield.run.frame_transforms import read_tracking_gsd
from velfield.run.stores import open_frames, open_registration
from velfield.run.tables import Patches, read_patches, read_tables, write_table
from velfield.tracking.association import FrameTable, window_frames
from velfield.tracking.tracklets import link_windows


def tracklet_files(plan: Plan) -> list[Path]:
    """Tables of tracklets of the units that are finished, in order."""
    layout = plan.layout
    paths = [layout.unit_file(layout.tracklets, unit, ".parquet") for unit in range(len(plan.units))]
    return [path for path in paths if path.exists()]


def explain_no_tracklets(plan: Plan) -> str:
    """The reason why there are no tracklets, so that the maps are empty, and the remedy."""
    effect, near_s = "no tracklets, so the maps are empty", plan.config.tracking.max_interval_s
    times_s = open_frames(plan.layout.frames).column("time_s")[usable_frames(plan)]
    if len(times_s) < 3:
        return f"{effect}: {len(times_s)} frames are registered well enough, 3 or more needed; see registration's notes"
    gaps = np.diff(times_s)
    near = gaps <= near_s
    if (near[1:] & near[:-1]).any():
        inputs = plan.job.inputs
        remedy = "label one frame and give it with --labels"
        if (inputs.detector or "").lower().endswith(ONNX_SUFFIX):
            remedy = "check the model's classes, threshold and input values (docs/detection.md#another-detector)"
        elif inputs.detections:
            remedy = "check the pixels and frames of --detections"
        return (
            f"{effect}: no detection can be linked over three frames as a vehicle; check on the page whether "
            f"detections are vehicles, and if not {remedy}"
        )
    return (
        f"{effect}: no three registered frames are within tracking.max_interval_s = {near_s:g} s of one another "
        f"(median {np.median(gaps):.2f} s); {widen_interval(gaps)}"
    )


def link_unit(plan: Plan, frames: range) -> StageResult:
    """Tracklets of all windows that start in ``frames``; reads the detections of as many frames after as they need."""
    times_s = open_frames(plan.layout.frames).column("time_s")
    usable = usable_frames(plan)
    window = window_frames(list(usable), list(times_s), frames, plan.config.tracking.max_interval_s)
    tables = frame_tables(plan, window, times_s, usable)
    tracklets, log = link_windows(tables, plan.config.tracking, gsd_m=read_tracking_gsd(plan.layout), starts=frames)
    path = plan.layout.unit_file(plan.layout.tracklets, frames.start // plan.unit_frames, ".parquet")
    write_table(path, tracklets, TRACKLET_COLUMNS)
    advance("tracklets", len(frames))
    counts = {f"gate_{name}": float(count) for name, count in log.items()}
    return StageResult([path], {"frames": len(frames), "tracklets": len(tracklets), **counts})


def frame_tables(
    plan: Plan, window: range, times_s: np.ndarray, usable: np.ndarray, *, weak: bool = False
) -> list[FrameTable]:
    """Detections of a range of frames, with the weak candidates after them where asked for."""
    store = open_registration(plan.layout.registration)
    heldout = store.column("heldout_px", window.start, window.stop).astype(np.float64)
    kept = store.column("n_inliers", window.start, window.stop).astype(np.float64)
    tables: list[FrameTable] = []
    for unit in range(window.start // plan.unit_frames, (window.stop - 1) // plan.unit_frames + 1):
        table, patches = _read_unit(plan, unit, weak=weak)
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


def _read_unit(plan: Plan, unit: int, *, weak: bool) -> tuple[pd.DataFrame, Patches]:
    """Detections of a unit and their patches; weak candidates after them, by frame in the order of their ids."""
    layout = plan.layout
    folders = (layout.detections, layout.weak_detections) if weak else (layout.detections,)
    paths = [layout.unit_file(folder, unit, ".parquet") for folder in folders]
    table = read_tables(paths, DETECTION_COLUMNS)
    parts = [read_patches(path.with_suffix(".patches.npz")) for path in paths]
    arrays = {name: np.concatenate([part[name] for part in parts]) for name in ("patches", "chips", "xy_work")}
    return table, {**arrays, "working_scale": parts[0]["working_scale"]}


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
