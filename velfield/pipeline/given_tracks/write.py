"""Tables and stores of the stages up to the tracks, written from given tracks (`velfield run --tracks`).

Tracks are interpolated at common times, some 0.2 s apart, where a track has a
position shortly before and after; three positions in a row are a tracklet, as in a run of a video.
"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from schemas.arrays import FloatArray, GreyImage
from schemas.flight import FlightConfig
from schemas.records import GridRecord, WorkingRecord
from schemas.tables import DETECTION_COLUMNS, DIMENSION_COLUMNS, JOIN_COLUMNS, TRACK_POSITION_COLUMNS, TRACKLET_COLUMNS
from velfield.errors import InputError
from velfield.pipeline.given_tracks.load import SIZE_SD_M, LoadedTracks, load_tracks, own_step_s
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import StageResult, advance
from velfield.pipeline.stage import STAGE, stages_before
from velfield.pipeline.stages.base_image import write_given_image
from velfield.pipeline.stages.frames import create_frame_store
from velfield.pipeline.stages.registration import create_registration_store
from velfield.run.commits import POSITION_SD_M, write_atomically, write_record
from velfield.run.layout import RunLayout
from velfield.run.stores import FrameStore
from velfield.run.tables import conform, empty_table, write_table, write_tracks
from velfield.sources.geo import BaseRaster
from velfield.sources.selection import select_frames

_STEP_S = 0.2
_GAPS = 2.5
"""A track is interpolated over no more than so many of the file's own steps."""
_CAR_M = (4.5, 1.8)
_FRAME_BITS = 20


def frame_times(table: pd.DataFrame, config: FlightConfig) -> FloatArray:
    """Times of the frames, s: the file's own, some 0.2 s apart, where its tracks share them; else every 0.2 s."""
    own = np.unique(table["time_s"].to_numpy(np.float64).round(4))
    duration = float(own[-1]) if len(own) else 0.0
    shared = len(own) <= 1.5 * duration / max(own_step_s(table), 1e-3) + 10
    times = own if shared else np.arange(0.0, duration + 1e-9, _STEP_S)
    return np.asarray(times[select_frames(times, config.frames)])


def at_frames(table: pd.DataFrame, times_s: FloatArray) -> pd.DataFrame:
    """Positions ``track_id, frame, time_s, x_px, y_px`` of tracks (sorted by track and time) at the frames' times."""
    track, time = table["track_id"].to_numpy(np.int64), table["time_s"].to_numpy(np.float64)
    starts = np.flatnonzero(np.r_[True, track[1:] != track[:-1]])
    ends = np.r_[starts[1:], len(track)] - 1
    first = np.searchsorted(times_s, time[starts] - 1e-4)
    count = np.maximum(np.searchsorted(times_s, time[ends] + 1e-4, side="right") - first, 0)
    owner = np.repeat(np.arange(len(starts)), count)
    frame = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count) + first[owner]
    asked = np.clip(times_s[frame], time[starts][owner], time[ends][owner])
    # one increasing key for all tracks: each has a stretch of its own
    span = float(time.max()) + 1.0 if len(time) else 1.0
    key, query = (
        np.repeat(np.arange(len(starts)), np.diff(np.r_[starts, len(track)])) * span + time,
        owner * span + asked,
    )
    after = np.clip(np.searchsorted(key, query - 1e-4), starts[owner], ends[owner])
    before = np.maximum(np.searchsorted(key, query + 1e-4, side="right") - 1, starts[owner])
    gap = time[after] - time[before]
    near = gap <= max(_GAPS * own_step_s(table), 2 * _STEP_S)
    f = np.clip((asked - time[before]) / np.where(gap > 0, gap, 1.0), 0.0, 1.0)
    out = {"track_id": track[starts][owner], "frame": frame, "time_s": times_s[frame]}
    for axis in ("x_px", "y_px"):
        value = table[axis].to_numpy(np.float64)
        out[axis] = value[before] + f * (value[after] - value[before])
    return pd.DataFrame({name: values[near] for name, values in out.items()})


def write_given_tracks(plan: Plan) -> StageResult:
    """Write base image and grid, empty stores of frames and registration, detections, tracklets and tracks."""
    base = plan.job.inputs.base
    given = load_tracks(Path(plan.job.inputs.source), plan.config, base=Path(base) if base else None)
    positions = at_frames(given.table, plan.info.times_s)
    positions = positions[positions.groupby("track_id")["frame"].transform("size") >= 3].reset_index(drop=True)
    if not len(positions):
        raise InputError(f"{plan.job.inputs.source}: found no track of three positions, expected tracks of vehicles")
    positions = _with_ids(positions)
    longest_s = _longest_step_s(plan, given.table)
    tracklets = make_tracklets(positions, longest_s, given.displacement_sd_m / given.gsd_m)
    written = [*_write_stores(plan), *_write_base(plan.layout, given, positions)]
    written += _write_tables(plan, given, positions, tracklets)
    advance("tracks")
    counts = {"tracklets": float(len(tracklets)), "tracks": float(tracklets["track_id"].nunique())}
    counts[POSITION_SD_M] = given.position_sd_m
    return StageResult(written, counts, list(given.notes))


def _longest_step_s(plan: Plan, table: pd.DataFrame) -> float:
    """Positions farther apart in time are not of one tracklet."""
    steps = np.diff(plan.info.times_s)
    own = float(np.median(steps)) if len(steps) else _STEP_S
    return max(plan.config.tracking.max_interval_s, 1.5 * own, 1.5 * own_step_s(table))


def _with_ids(positions: pd.DataFrame) -> pd.DataFrame:
    """With a ``detection_id`` and the axial ``orientation_rad`` of each position; ``track_id`` as in a run."""
    positions = positions.sort_values(["frame", "track_id"], kind="stable", ignore_index=True)
    number = positions.groupby("frame").cumcount().to_numpy(np.int64)
    positions["detection_id"] = (positions["frame"].to_numpy(np.int64) << _FRAME_BITS) + number
    positions["given_id"] = positions["track_id"]
    positions["track_id"] = positions.groupby("given_id")["detection_id"].transform("min")
    positions = positions.sort_values(["track_id", "frame"], kind="stable", ignore_index=True)
    ahead, behind = (positions.groupby("track_id")[["x_px", "y_px"]].shift(k) for k in (-1, 1))
    step = (ahead.fillna(positions[["x_px", "y_px"]]) - behind.fillna(positions[["x_px", "y_px"]])).to_numpy(np.float64)
    axis = pd.Series(np.where(np.hypot(*step.T) > 0.5, np.mod(np.arctan2(step[:, 1], step[:, 0]), np.pi), np.nan))
    positions["orientation_rad"] = axis.groupby(positions["track_id"]).ffill().groupby(positions["track_id"]).bfill()
    return positions


def make_tracklets(positions: pd.DataFrame, longest_s: float, displacement_sd_px: float) -> pd.DataFrame:
    """Tracklets (`TRACKLET_COLUMNS`) of positions sorted by track and frame: three in a row."""
    track, time = positions["track_id"].to_numpy(np.int64), positions["time_s"].to_numpy(np.float64)
    near = (np.diff(track) == 0) & (np.diff(time) <= longest_s + 1e-9)
    rows = np.flatnonzero(near[:-1] & near[1:])[:, None] + np.arange(3)
    columns: dict[str, object] = {"track_id": track[rows[:, 0]], "confidence": np.ones(len(rows))}
    for k in range(3):
        part = positions.iloc[rows[:, k]]
        columns |= {
            f"{name}_{k}{unit}": part[f"{name}{unit}"].to_numpy()
            for name, unit in (("frame", ""), ("detection_id", ""), ("time", "_s"), ("x", "_px"), ("y", "_px"))
        }
    for k, link in ((0, "01"), (1, "12")):
        duration = time[rows[:, k + 1]] - time[rows[:, k]]
        for axis in "xy":
            value = positions[f"{axis}_px"].to_numpy(np.float64)
            columns[f"v{axis}_{link}_px_per_s"] = (value[rows[:, k + 1]] - value[rows[:, k]]) / duration
        columns[f"displacement_sd_{link}_px"] = np.full(len(rows), displacement_sd_px)
        columns[f"sad_{link}"] = np.zeros(len(rows))
    table = pd.DataFrame(columns)
    return conform(table.assign(tracklet_id=table["detection_id_1"]), TRACKLET_COLUMNS)


def _write_stores(plan: Plan) -> list[Path]:
    """Stores of frames and registration with times and no images: `velfield.open_run` reads times from them."""
    of_images = [name for name in stages_before("tracks") if STAGE[name].store]
    stores = replace(plan, keys=plan.keys | dict.fromkeys(of_images, plan.keys["tracks"]))
    create_frame_store(stores)
    create_registration_store(stores)
    store, written = FrameStore(plan.layout.frames, "r+"), []
    for frames in plan.units:
        times_s = plan.info.times_s[frames.start : frames.stop]
        store.write_columns(frames.start, {"time_s": times_s, "source_index": plan.indices[frames.start : frames.stop]})
        written += [path for path in store.files(frames.start, frames.stop) if path not in written]
    return written


def _write_base(layout: RunLayout, given: LoadedTracks, positions: pd.DataFrame) -> list[Path]:
    """The base image: as given, else the paths of all tracks, drawn; and its grid."""
    raster = given.base or BaseRaster(draw_paths(positions, given.shape))
    written = write_given_image(layout, raster)
    height, width = given.shape
    grid = GridRecord(
        width_px=width,
        height_px=height,
        gsd_m=given.gsd_m,
        crs_wkt=given.crs_wkt,
        affine=given.affine,
        north_rad=None if given.crs_wkt else given.north_rad,
        origin_x_px=given.origin_px[0] if given.origin_px else 0.0,
        origin_y_px=given.origin_px[1] if given.origin_px else 0.0,
        base_source="tracks" if given.origin_px else "given",
        registered_to="given",
        reference_frame=0,
    )
    working = WorkingRecord(scale=1.0, training_source="tracks", vehicle_gsd_m=given.gsd_m)
    for path, record in ((layout.grid, grid), (layout.working, working)):
        write_record(path, record)
        written.append(path)
    return written


def draw_paths(positions: pd.DataFrame, shape: tuple[int, int]) -> GreyImage:
    """An image (h, w) of the paths, brighter where more vehicles drove."""
    height, width = shape
    x, y = (
        np.clip(positions[f"{a}_px"].to_numpy(np.float64).round().astype(np.int64), 0, n - 1)
        for a, n in (("x", width), ("y", height))
    )
    same = positions["track_id"].to_numpy()[1:] == positions["track_id"].to_numpy()[:-1]
    image = np.full(shape, 40, np.uint8)
    lines = np.stack([np.column_stack([x[:-1], y[:-1]]), np.column_stack([x[1:], y[1:]])], axis=1)[same]
    cv2.polylines(image, [line.reshape(-1, 1, 2).astype(np.int32) for line in lines], False, 110, 1)
    return image


def _write_tables(plan: Plan, given: LoadedTracks, positions: pd.DataFrame, tracklets: pd.DataFrame) -> list[Path]:
    layout, written = plan.layout, []
    length_m, width_m = given.sizes_m(positions["given_id"].to_numpy(np.int64)).T
    area = np.nan_to_num(length_m, nan=_CAR_M[0]) * np.nan_to_num(width_m, nan=_CAR_M[1]) / given.gsd_m**2
    known = positions.assign(area_px=area, orientation_sd_rad=0.05, score=1.0, source=0)
    known["orientation_rad"] = known["orientation_rad"].astype(np.float64)
    for unit, frames in enumerate(plan.units):
        here = known[(known["frame"] >= frames.start) & (known["frame"] < frames.stop)]
        here = here.sort_values(["frame", "detection_id"], kind="stable")
        part = tracklets[(tracklets["frame_0"] >= frames.start) & (tracklets["frame_0"] < frames.stop)]
        part = part.sort_values(["frame_0", "tracklet_id"], kind="stable", ignore_index=True)
        for folder, columns in (
            (layout.detections, DETECTION_COLUMNS),
            (layout.track_positions, TRACK_POSITION_COLUMNS),
        ):
            written.append(layout.unit_file(folder, unit))
            write_table(written[-1], here, columns)
        written.append(layout.unit_file(layout.tracks, unit))
        write_tracks(written[-1], part)
    first = positions.assign(length_m=length_m, width_m=width_m).drop_duplicates("track_id")
    sizes = {f"{a}_px": first[f"{a}_m"] / given.gsd_m for a in ("length", "width")}
    sd = {f"{a}_sd_px": first[f"{a}_m"] * 0.0 + SIZE_SD_M / given.gsd_m for a in ("length", "width")}
    dimensions = first[["track_id"]].assign(**sizes, **sd, strips=0)
    for path, table, columns in (
        (layout.dimensions, dimensions, DIMENSION_COLUMNS),
        (layout.joins, empty_table(JOIN_COLUMNS), JOIN_COLUMNS),
    ):
        write_table(path, table, columns)
        written.append(path)
    listed = first[["track_id", "given_id"]].assign(source_id=given.names.reindex(first["given_id"]).to_numpy())
    written.append(layout.source_ids)
    write_atomically(written[-1], listed[["track_id", "source_id"]].to_csv(index=False, lineterminator="\n").encode())
    return written
