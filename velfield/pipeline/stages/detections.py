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
from velfield.detection.cnn.model import use_device
from velfield.detection.detect import ComparableFrame, FrameDetections, SearchedFrame, attach_crops, search_frame
from velfield.detection.detector import Detections, Detector, load_detector
from velfield.detection.orientation import CAR_ASPECT, axial_difference, fill_missing_orientation
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import StageResult, advance
from velfield.pipeline.stages.rectified_frames import Window, WorkingFrame, WorkingGrid, read_background
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
    """Cars of a block of frames: the table, their patches, and their positions on the working grid.

    ``searched`` (frames,) is the fraction of each frame that the detector was run on.
    """

    table: pd.DataFrame
    patches: GreyImage
    chips: GreyImage
    xy_work: Points
    searched: FloatArray


def detect_block(plan: Plan, frames: range) -> BlockDetections:
    """Detect the cars of the registered frames of a block."""
    record = read_working(plan.layout)
    working = WorkingGrid.open(plan, record.scale)
    times_s = open_frames(plan.layout.frames).column("time_s")
    usable = usable_frames(plan)
    search = None if plan.job.inputs.detections else _Search(plan, working, has_background=record.has_background)
    parts = []
    for frame in frames:
        if usable[frame]:
            part = _detect_external(plan, working, frame) if search is None else search.detect(frame)
            if part is not None:
                parts.append(_tabulate(*part, frame, float(times_s[frame])))
        advance("detections")
    return _concatenate(parts)


def _detect_external(plan: Plan, working: WorkingGrid, frame: int) -> "_Found | None":
    rectified, transform = working.frame(frame), working.maps.transform(frame)
    if rectified is None or transform is None:
        return None
    return external_detections(plan, rectified, transform, frame), rectified, np.nan


_Found = tuple[FrameDetections, WorkingFrame, float]
"""Cars of a frame, the frame, and the fraction of it that was searched."""


class _Search:
    """Searches frames in groups: the first that can be used whole, the others where they differ from it.

    Groups are counted from the start of the flight, so that results are the same however it is cut into units.
    """

    def __init__(self, plan: Plan, working: WorkingGrid, *, has_background: bool) -> None:
        self._plan, self._working, self._has_background = plan, working, has_background
        use_device(plan.config.work.device)
        self._detector = _detector(plan.layout.detector, plan.keys["detector"])
        self._usable = usable_frames(plan)
        self._group, self._first = range(0), -1
        self._window: Window | None = None
        self._reference: SearchedFrame | None = None

    def detect(self, frame: int) -> _Found | None:
        """The cars of a frame; none where it does not meet the base image."""
        if frame not in self._group:
            self._begin_group(frame)
        if self._window is None:
            return None
        rectified = self._working.frame(frame, self._window)
        if rectified is None:
            return None
        searched = self._search(rectified, None if frame == self._first else self._reference)
        if frame == self._first:
            self._reference = searched
        cars = searched.detections
        order = np.lexsort((cars.xy[:, 0], cars.xy[:, 1]))
        return attach_crops(rectified.image, cars, order), rectified, searched.searched

    def _begin_group(self, frame: int) -> None:
        every = self._plan.config.detection.full_frame_every
        start = frame // every * every
        self._group = range(start, min(start + every, len(self._usable)))
        members = [one for one in self._group if self._usable[one] and self._working.maps.transform(one) is not None]
        self._window, self._reference = self._working.common_window(members), None
        self._first = next((one for one in members if self._working.common_window([one]) is not None), frame)
        if self._first < frame and self._window is not None:  # it belongs to another block
            first = self._working.frame(self._first, self._window)
            self._reference = None if first is None else self._search(first, None)

    def _search(self, rectified: WorkingFrame, reference: SearchedFrame | None) -> SearchedFrame:
        return search_frame(
            self._detector,
            ComparableFrame(rectified.image, rectified.valid),
            _background_of(self._plan, rectified) if self._has_background else None,
            reference=reference,
            threshold=self._plan.config.detection.threshold,
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


def _tabulate(
    detections: FrameDetections, rectified: WorkingFrame, searched: float, frame: int, time_s: float
) -> BlockDetections:
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
    return BlockDetections(table, detections.patches, detections.chips, detections.xy, np.array([searched]))


def _concatenate(parts: Sequence[BlockDetections]) -> BlockDetections:
    if not parts:
        table = pd.DataFrame({name: np.empty(0, dtype) for name, dtype in DETECTION_COLUMNS.items()})
        crops = np.empty((0, 16, 8), np.uint8), np.empty((0, 32, 32), np.uint8)
        return BlockDetections(table, *crops, np.empty((0, 2)), np.empty(0))
    return BlockDetections(
        pd.concat([part.table for part in parts], ignore_index=True),
        np.concatenate([part.patches for part in parts]),
        np.concatenate([part.chips for part in parts]),
        np.concatenate([part.xy_work for part in parts]),
        np.concatenate([part.searched for part in parts]),
    )


def write_detections(plan: Plan, frames: range, blocks: Sequence[BlockDetections]) -> StageResult:
    """Write the table of a unit, and its patches."""
    whole = _concatenate([block for block in blocks if len(block.searched)])
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
    counts = {"frames": float(used), "cars": float(len(whole.table))}
    if np.isfinite(whole.searched).any():
        counts["searched"] = float(np.nanmean(whole.searched))
    return StageResult([path, patches], counts)
