"""Stage `detections`: cars of each frame; a table a unit, in base px, and their image patches beside it.

Detections of another program in place of ours (`--detections`): later stages do not know the difference.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from schemas.arrays import FloatArray, GreyImage, Points
from schemas.tables import DETECTION_COLUMNS
from velfield.detection.detect import FrameDetections, attach_crops, detect_frame
from velfield.detection.detector import Detections, Detector, load_detector
from velfield.detection.orientation import CAR_ASPECT, axial_difference, fill_missing_orientation
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import StageResult, advance
from velfield.pipeline.stages.rectified_frames import WorkingFrame, WorkingGrid, read_background
from velfield.pipeline.stages.registration import external_boxes, usable_frames
from velfield.registration.transforms import FrameMap
from velfield.run.frame_transforms import read_working
from velfield.run.stores import open_frames
from velfield.run.tables import write_patches, write_table

_AXIS_SD_RAD = 0.1


def external_detections(plan: Plan, rectified: WorkingFrame, transform: FrameMap, frame: int) -> FrameDetections:
    """The boxes of a frame, mapped from raw to working px; orientations that they lack are estimated."""
    table = external_boxes(plan)
    boxes = table[table["source_index"] == plan.indices[frame]]
    raw = boxes[["x_px", "y_px"]].to_numpy(np.float64)
    xy = rectified.to_work(transform.to_base(raw))
    axis = _axes_to_base(transform, raw, boxes["orientation_rad"].to_numpy(np.float64))
    unknown = ~np.isfinite(axis)
    axis[unknown] = _estimate_missing_axes(rectified, xy[unknown], transform, boxes[unknown])
    length = plan.config.detection.working_car_length_px
    area = np.full(len(xy), length * length * CAR_ASPECT)
    score, axis_sd = boxes["score"].to_numpy(np.float64), np.full(len(xy), _AXIS_SD_RAD)
    cars = np.column_stack([xy, np.mod(axis, np.pi), score, axis_sd])
    finite = np.isfinite(xy).all(axis=1)
    return attach_crops(rectified.image, Detections.from_rows(cars[finite], area[finite]))


def _estimate_missing_axes(rectified: WorkingFrame, xy: Points, transform: FrameMap, boxes: pd.DataFrame) -> FloatArray:
    """Axes (n,) of boxes without orientation: from the image, or the nearer of the two that an upright box allows."""
    unlabelled = np.column_stack([np.nan_to_num(xy), np.full((len(xy), 3), np.nan)])
    estimated = fill_missing_orientation(rectified.image, unlabelled)[:, 2]
    raw, angle = boxes[["x_px", "y_px"]].to_numpy(np.float64), boxes["abs_box_angle_rad"].to_numpy(np.float64)
    positive, negative = (_axes_to_base(transform, raw, sign * angle) for sign in (1, -1))
    is_positive = axial_difference(positive, estimated) <= axial_difference(negative, estimated)
    nearer = np.where(is_positive, positive, negative)
    return np.where(np.isfinite(nearer), nearer, estimated)


def _axes_to_base(transform: FrameMap, raw: Points, axis_raw: FloatArray) -> FloatArray:
    """Axes (n,) at raw positions (n, 2), mapped to base px by a step along them; NaN stays NaN."""
    step = np.column_stack([np.cos(axis_raw), np.sin(axis_raw)])
    along = transform.to_base(raw + np.nan_to_num(step)) - transform.to_base(raw)
    mapped = np.arctan2(along[:, 1], along[:, 0])
    return np.where(np.isfinite(axis_raw), mapped, np.nan)


ID_STEP = 1 << 20
"""Detections of a frame are numbered from ``frame * ID_STEP``: unique, and the same however the flight is cut."""


@dataclass(frozen=True)
class BlockDetections:
    """Cars of a block of frames: the table, their patches, and their positions on the working grid."""

    table: pd.DataFrame
    patches: GreyImage
    chips: GreyImage
    xy_work: Points


def detect_block(plan: Plan, frames: range) -> BlockDetections:
    """Detect the cars of the registered frames of a block."""
    record = read_working(plan.layout)
    working = WorkingGrid.open(plan, record.scale)
    times_s = open_frames(plan.layout.frames).column("time_s")
    usable = usable_frames(plan)
    parts = []
    for frame in frames:
        rectified = working.frame(frame) if usable[frame] else None
        if rectified is not None:
            detections = _detect(
                plan, rectified, working.maps.transform(frame), frame, has_background=record.has_background
            )
            parts.append(_tabulate(detections, rectified, frame, float(times_s[frame])))
        advance("detections")
    return _concatenate(parts)


def _detect(
    plan: Plan, rectified: WorkingFrame, transform: FrameMap | None, frame: int, *, has_background: bool
) -> FrameDetections:
    if plan.job.inputs.detections and transform is not None:
        return external_detections(plan, rectified, transform, frame)
    detector = _detector(plan.layout.detector, plan.keys["detector"])
    background = _background_of(plan, rectified) if has_background else None
    return detect_frame(
        rectified.image, rectified.valid, detector, background, threshold=plan.config.detection.threshold
    )


@lru_cache(maxsize=2)
def _detector(path: Path, _key: str) -> Detector:
    return load_detector(path)


@lru_cache(maxsize=2)
def _background(plan_root: Path, _key: str) -> GreyImage:
    from velfield.run.layout import RunLayout

    return read_background(RunLayout(plan_root)).median


def _background_of(plan: Plan, rectified: WorkingFrame) -> GreyImage:
    """The background in a frame's window, whose corner is not aligned with the pixels of the whole working grid."""
    whole = _background(plan.layout.root, plan.keys["detector"])
    shift = np.array(rectified.window[:2]) * rectified.scale
    matrix = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]]])
    size = (rectified.image.shape[1], rectified.image.shape[0])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(whole, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def _tabulate(detections: FrameDetections, rectified: WorkingFrame, frame: int, time_s: float) -> BlockDetections:
    xy = rectified.to_base(detections.xy)
    table = pd.DataFrame(
        {
            "detection_id": frame * ID_STEP + np.arange(len(xy), dtype=np.int64),
            "frame": frame,
            "time_s": time_s,
            "x_px": xy[:, 0],
            "y_px": xy[:, 1],
            "orientation_rad": detections.orientation_rad,
            "orientation_sd_rad": detections.orientation_sd_rad,
            "area_px": detections.area_px / rectified.scale**2,
            "score": detections.score,
        }
    ).astype(DETECTION_COLUMNS)
    return BlockDetections(table, detections.patches, detections.chips, detections.xy)


def _concatenate(parts: Sequence[BlockDetections]) -> BlockDetections:
    if not parts:
        table = pd.DataFrame({name: np.empty(0, dtype) for name, dtype in DETECTION_COLUMNS.items()})
        return BlockDetections(table, np.empty((0, 16, 8), np.uint8), np.empty((0, 32, 32), np.uint8), np.empty((0, 2)))
    return BlockDetections(
        pd.concat([part.table for part in parts], ignore_index=True),
        np.concatenate([part.patches for part in parts]),
        np.concatenate([part.chips for part in parts]),
        np.concatenate([part.xy_work for part in parts]),
    )


def write_detections(plan: Plan, frames: range, blocks: Sequence[BlockDetections]) -> StageResult:
    """Write the table of a unit, and its patches."""
    whole = _concatenate([block for block in blocks if len(block.table)])
    unit = frames.start // plan.unit_frames
    path = plan.layout.unit_file(plan.layout.detections, unit, ".parquet")
    patches = plan.layout.unit_file(plan.layout.detections, unit, ".patches.npz")
    scale = np.array(read_working(plan.layout).scale)
    write_patches(
        patches,
        {"patches": whole.patches, "chips": whole.chips, "xy_work": whole.xy_work, "working_scale": scale},
    )
    write_table(path, whole.table, DETECTION_COLUMNS)
    used = int(usable_frames(plan)[frames.start : frames.stop].sum())
    return StageResult([path, patches], {"frames": used, "cars": len(whole.table)})
