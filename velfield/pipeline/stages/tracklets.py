"""Tracklets of a unit of frames, exact across its border."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from schemas.arrays import IntArray, Mask
from schemas.tables import DETECTION_COLUMNS, TRACKLET_COLUMNS
from velfield.detection.registry import ONNX_SUFFIX
from velfield.pipeline.plan import Plan, widen_interval
from velfield.pipeline.result import StageResult, advance
from velfield.pipeline.stages.registration import MAP_PARAMETERS, usable_frames
from velfield.pipeline.units import unit_name
from velfield.run.frame_transforms import read_tracking_gsd
from velfield.run.stores import FrameStore, RegistrationStore
from velfield.run.tables import Arrays, read_arrays, read_tables, write_table
from velfield.tracking.association import FrameTable, window_frames
from velfield.tracking.tracklets import link_windows

_READ = ["detection_id", "frame", "x_px", "y_px", "orientation_rad", "orientation_sd_rad", "score"]
_CROPS = ["chips", "xy_work", "working_scale"]


def tracklet_files(plan: Plan) -> list[Path]:
    """Tables of tracklets of the units that are finished, in order."""
    layout = plan.layout
    paths = [layout.unit_file(layout.tracklets, unit) for unit in range(len(plan.units))]
    return [path for path in paths if path.exists()]


def explain_no_tracklets(plan: Plan) -> str:
    """The reason why there are no tracklets, so that the maps are empty, and the remedy."""
    effect, near_s = "no tracklets, so the maps are empty", plan.config.tracking.max_interval_s
    times_s = FrameStore(plan.layout.frames).column("time_s")[usable_frames(plan)]
    if len(times_s) < 3:
        return f"{effect}: {len(times_s)} frames are registered well enough, 3 or more needed; see registration's notes"
    gaps = np.diff(times_s)
    near = gaps <= near_s
    if (near[1:] & near[:-1]).any():
        inputs = plan.job.inputs
        remedy = "label one frame and give it with --labels"
        if (inputs.detector or "").lower().endswith(ONNX_SUFFIX):
            remedy = "check the model's classes, threshold and input values (documentation: Another detector)"
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
    """Tracklets of all windows that start in ``frames``; reads the detections of as many frames after as they need.

    Frames whose detections are lost are passed over, as frames that are not registered are.
    """
    times_s = FrameStore(plan.layout.frames).column("time_s")
    usable = linkable_frames(plan)
    window = window_frames(list(usable), list(times_s), frames, plan.config.tracking.max_interval_s)
    tables, weak = (frame_tables(plan, window, times_s, usable, weak=which) for which in (False, True))
    config, gsd_m = plan.config.tracking, read_tracking_gsd(plan.layout)
    tracklets, log = link_windows(tables, config, gsd_m=gsd_m, starts=frames, weak=weak)
    path = plan.layout.unit_file(plan.layout.tracklets, frames.start // plan.unit_frames)
    write_table(path, tracklets, TRACKLET_COLUMNS)
    advance("tracklets", len(frames))
    counts = {f"gate_{name}": float(count) for name, count in log.items()}
    return StageResult([path], {"frames": len(frames), "tracklets": len(tracklets), **counts})


def frame_tables(plan: Plan, window: range, times_s: np.ndarray, usable: np.ndarray, *, weak: bool) -> list[FrameTable]:
    """Detections of a range of frames, or their weak candidates."""
    units = range(window.start // plan.unit_frames, (window.stop - 1) // plan.unit_frames + 1)
    read = {unit: read_unit(plan, unit, weak=weak) for unit in units if not has_lost_detections(plan, unit)}
    return tables_of_units(plan, window, times_s, usable, read)


def linkable_frames(plan: Plan) -> Mask:
    """Frames (frames,) that are registered, have no fault, and whose detections are not lost."""
    usable = usable_frames(plan)
    for unit, frames in enumerate(plan.units):
        if has_lost_detections(plan, unit):
            usable[frames.start : frames.stop] = False
    return usable


def has_lost_detections(plan: Plan, unit: int) -> bool:
    """Whether the detections of a unit, by its number, are lost."""
    return f"detections {unit_name(plan.units[unit])}" in plan.lost


@dataclass(frozen=True)
class UnitDetections:
    """Detections of a unit of frames: ``column``, their columns by name, (n,) each, and ``crops``, (n, ...) each."""

    column: dict[str, np.ndarray]
    crops: Arrays


def read_unit(plan: Plan, unit: int, *, weak: bool) -> UnitDetections:
    """Detections of a unit and their crops, or its weak candidates."""
    path = plan.layout.unit_file(plan.layout.weak_detections if weak else plan.layout.detections, unit)
    table = read_tables([path], DETECTION_COLUMNS, only=_READ)
    crops = read_arrays(path.with_suffix(".patches.npz"), only=_CROPS)
    return UnitDetections({name: table[name].to_numpy() for name in _READ}, crops)


def read_chosen(plan: Plan, unit: int, ids: IntArray) -> UnitDetections:
    """Read a unit's detections and weak candidates that have one of the given ids, with their crops.

    ``ids`` (n,) ascending. The weak ones come after the others.
    """
    layout, parts = plan.layout, []
    for folder in (layout.detections, layout.weak_detections):
        path = layout.unit_file(folder, unit)
        table = read_tables([path], DETECTION_COLUMNS, only=_READ)
        rows = np.flatnonzero(among(table["detection_id"].to_numpy(), ids))
        crops = read_arrays(path.with_suffix(".patches.npz"), only=_CROPS)
        column = {name: table[name].to_numpy()[rows] for name in _READ}
        parts.append((column, {name: crops[name][rows] for name in ("chips", "xy_work")}, crops["working_scale"]))
    column, crops = ({name: np.concatenate([part[k][name] for part in parts]) for name in parts[0][k]} for k in (0, 1))
    return UnitDetections(column, {**crops, "working_scale": parts[0][2]})


def among(values: IntArray, ascending: IntArray) -> Mask:
    """(n,) whether each of some values (n,) is among others (m,), which ascend."""
    if not len(ascending):
        return np.zeros(len(values), bool)
    at = np.minimum(np.searchsorted(ascending, values), len(ascending) - 1)
    return np.asarray(ascending[at] == values)


def tables_of_units(
    plan: Plan, window: range, times_s: np.ndarray, usable: np.ndarray, units: Mapping[int, UnitDetections]
) -> list[FrameTable]:
    """Detections of a range of frames, by the frames' units, which are read; frames of others are not usable."""
    none = next(iter(units.values()))  # it holds no detections of the frames of others
    store = RegistrationStore(plan.layout.registration)
    heldout = store.column("heldout_px", window.start, window.stop).astype(np.float64)
    kept = store.column("n_inliers", window.start, window.stop).astype(np.float64)
    tables: list[FrameTable] = []
    for k, frame in enumerate(window):
        residual = float(np.nan_to_num(heldout[k]))
        tables.append(
            _frame_table(
                units.get(frame // plan.unit_frames, none),
                frame,
                time_s=float(times_s[frame]),
                registered=bool(usable[frame]),
                residual_px=residual,
                map_sd_px=residual * float(np.sqrt(MAP_PARAMETERS / max(kept[k], MAP_PARAMETERS))),
            )
        )
    return tables


def _frame_table(
    unit: UnitDetections,
    frame: int,
    *,
    time_s: float,
    registered: bool,
    residual_px: float,
    map_sd_px: float,
) -> FrameTable:
    rows, crops = np.flatnonzero(unit.column["frame"] == frame), unit.crops
    return FrameTable(
        frame=frame,
        time_s=time_s,
        registered=registered,
        residual_px=residual_px,
        detection_id=unit.column["detection_id"][rows].astype(np.int64),
        x_px=unit.column["x_px"][rows].astype(np.float64),
        y_px=unit.column["y_px"][rows].astype(np.float64),
        orientation_rad=unit.column["orientation_rad"][rows].astype(np.float64),
        orientation_sd_rad=unit.column["orientation_sd_rad"][rows].astype(np.float64),
        score=unit.column["score"][rows].astype(np.float64),
        crops=crops["chips"][rows],
        x_work=crops["xy_work"][rows, 0],
        y_work=crops["xy_work"][rows, 1],
        working_scale=float(crops["working_scale"]),
        registration_sd_px=map_sd_px,
    )
