"""Stage `detections`: cars of each frame; a table a unit, in base px, and their image patches beside it.

Detections of another program in place of ours (`--detections`): later stages do not know the difference.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from schemas.arrays import FloatArray, Mask, Points
from schemas.tables import DETECTION_COLUMNS
from velfield.detection.detect import FrameDetections, SearchedFrame, attach_crops, search_frame, with_sizes
from velfield.detection.interface import Detections, Detector, concatenate
from velfield.detection.orientation import CAR_ASPECT, axial_difference, fill_missing_orientation
from velfield.detection.registry import load_detector
from velfield.detection.runtime import use_device
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import StageResult, advance
from velfield.pipeline.stages.rectified_frames import Window, WorkingFrame, WorkingGrid
from velfield.pipeline.stages.registration import external_boxes, usable_frames
from velfield.registration.transforms import FrameMap
from velfield.run.frame_transforms import read_working
from velfield.run.stores import FrameStore
from velfield.run.tables import write_arrays, write_table

_AXIS_SD_RAD = 0.1


def external_detections(
    plan: Plan, rectified: WorkingFrame, transform: FrameMap, boxes: pd.DataFrame
) -> FrameDetections:
    """The boxes of a frame, mapped from raw to working px; orientations that they lack are estimated."""
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
    return attach_crops(rectified.image, with_sizes(rectified.image, Detections.from_rows(cars[finite], area[finite])))


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
class Cars:
    """Cars of a block of frames, one after the other."""

    column: dict[str, NDArray[Any]]
    """Of the table, (n,) each, by name."""
    crops: dict[str, list[NDArray[Any]]]
    """Patches, chips and strips, positions on the working grid and sizes, by name: a part a frame, after an empty one;
    of weak candidates `_WEAK_CROPS`. They are not put together, as what is written is most of all that a block
    gives."""

    def __len__(self) -> int:
        return len(self.column["frame"])


@dataclass(frozen=True)
class BlockDetections:
    """Cars of a block of frames, and its weak candidates.

    ``searched`` (frames,) is the fraction of each frame that the detector was run on.
    """

    cars: Cars
    weak: Cars
    searched: FloatArray


def detect_block(plan: Plan, frames: range) -> BlockDetections:
    """Detect the cars of the registered frames of a block."""
    record = read_working(plan.layout)
    working = WorkingGrid.open(plan, record.scale)
    times_s = FrameStore(plan.layout.frames).column("time_s")
    usable = usable_frames(plan)
    search = _searcher(plan, working, usable)
    parts = []
    for frame in frames:
        found = search(frame) if usable[frame] else None
        if found is not None:
            parts.append((frame, float(times_s[frame]), found.keep(_supported(working, found, frame))))
        advance("detections")
    return _tabulate(parts)


def _supported(working: WorkingGrid, found: "_Found", frame: int) -> Mask:
    """Mask (n,) of the cars and candidates that lie where control points support the frame's map."""
    transform = working.maps.transform(frame)
    assert transform is not None, "a frame that was searched is registered"
    raw = transform.to_raw(found.xy_base)
    return np.asarray(np.isfinite(working.maps.position_sd_px(frame, raw)))


def _searcher(plan: Plan, working: WorkingGrid, usable: Mask) -> "Callable[[int], _Found | None]":
    """Function that finds the cars of a frame: given boxes, a detector of raw frames, or one of the working grid."""
    if plan.job.inputs.detections:
        table = external_boxes(plan)
        return lambda frame: _from_boxes(plan, working, frame, table[table["source_index"] == plan.indices[frame]])
    use_device(plan.config.work.device)
    detector = _detector(plan.layout.detector, plan.keys["detector"])
    if not detector.reads_raw_frames:
        return _Search(plan, working, usable, detector).detect
    store, threshold = FrameStore(plan.layout.frames), plan.config.detection.threshold

    def search(frame: int) -> "_Found | None":
        found = _from_boxes(plan, working, frame, detector.detect_raw(store.read(frame), threshold=threshold))
        return found and replace(found, searched=1.0)

    return search


def _from_boxes(plan: Plan, working: WorkingGrid, frame: int, boxes: pd.DataFrame) -> "_Found | None":
    rectified, transform = working.frame(frame), working.maps.transform(frame)
    if rectified is None or transform is None:
        return None
    cars = external_detections(plan, rectified, transform, boxes)
    return _Found.in_frame(cars, len(cars), rectified, np.nan)


@dataclass(frozen=True)
class _Found:
    """Cars and candidates found in a frame."""

    detections: FrameDetections
    """Cars first, then weak candidates."""
    cars: int
    """Number of cars among them."""
    xy_base: Points
    """Their positions (n, 2), base px."""
    scale: float
    """Working px a base px."""
    searched: float
    """The fraction of the frame that was searched."""

    @classmethod
    def in_frame(cls, detections: FrameDetections, cars: int, rectified: WorkingFrame, searched: float) -> "_Found":
        """Cars and candidates of a frame; the frame itself is not kept, as a block's frames together are large."""
        return cls(detections, cars, rectified.to_base(detections.xy), rectified.scale, searched)

    def keep(self, rows: Mask) -> "_Found":
        """Some of the cars and candidates."""
        if rows.all():
            return self
        detections, cars = self.detections.select(rows), int(rows[: self.cars].sum())
        return replace(self, detections=detections, cars=cars, xy_base=self.xy_base[rows])


_FrameCars = tuple[int, float, _Found]
"""A frame's number, its time, s, and its cars and candidates."""


class _Search:
    """Searches frames in groups: the first that can be used whole, the others where they differ from it.

    Groups are counted from the start of the flight, so that results are the same however it is cut into units.
    """

    def __init__(self, plan: Plan, working: WorkingGrid, usable: Mask, detector: Detector) -> None:
        self._plan, self._working = plan, working
        self._detector = detector
        self._usable = usable
        self._group, self._first = range(0), -1
        self._window: Window | None = None
        self._reference: SearchedFrame | None = None

    def detect(self, frame: int) -> _Found | None:
        """The cars of a frame; none where it does not meet the base image."""
        if frame not in self._group:
            self._begin_group(frame)
        if self._window is None:
            return None
        result = self._search(frame, None if frame == self._first else self._reference)
        if result is None:
            return None
        searched, rectified = result
        if frame == self._first:
            self._reference = searched
        cars = searched.detections
        found = concatenate([cars, searched.weak])
        order = np.lexsort((found.xy[:, 0], found.xy[:, 1], np.arange(len(found)) >= len(cars)))
        crops = attach_crops(rectified.image, found, order, half_image=searched.frame.half_image)
        return _Found.in_frame(crops, len(cars), rectified, searched.searched)

    def _begin_group(self, frame: int) -> None:
        every = self._plan.config.detection.full_frame_every
        start = frame // every * every
        self._group = range(start, min(start + every, len(self._usable)))
        members = [one for one in self._group if self._usable[one] and self._working.maps.transform(one) is not None]
        self._window, self._reference = self._working.common_window(members), None
        self._first = next((one for one in members if self._working.common_window([one]) is not None), frame)
        if self._first < frame and self._window is not None:  # it belongs to another block
            first = self._search(self._first, None)
            self._reference = None if first is None else first[0]

    def _search(self, frame: int, reference: SearchedFrame | None) -> tuple[SearchedFrame, WorkingFrame] | None:
        assert self._window is not None, "its frames meet the base image"
        image = self._working.rectification(frame, self._window)
        if image is None:
            return None
        rectified = WorkingFrame(image.image, image.valid, self._window, self._working.scale)
        searched = search_frame(
            self._detector,
            image,
            reference=reference,
            threshold=self._plan.config.detection.threshold,
        )
        return searched, rectified


@lru_cache(maxsize=2)
def _detector(path: Path, _key: str) -> Detector:
    return load_detector(path)


_NO_CROPS: dict[str, NDArray[Any]] = {
    "chips": np.empty((0, 32, 32), np.uint8),
    "strips": np.empty((0, 32, 10), np.uint8),
    "xy_work": np.empty((0, 2)),
    "sizes": np.empty((0, 4), np.float32),
}


def _tabulate(parts: Sequence[_FrameCars]) -> BlockDetections:
    """Frames as two tables, of the cars and of the weak candidates."""
    cars = _select_rows(parts, [slice(0, found.cars) for *_, found in parts])
    weak = _select_rows(parts, [slice(found.cars, None) for *_, found in parts])
    return BlockDetections(cars, weak, np.array([found.searched for *_, found in parts]))


def _select_rows(parts: Sequence[_FrameCars], rows: Sequence[slice]) -> Cars:
    """Some rows of each frame, as one table, and their crops: a table a frame cost 4 ms a frame."""
    all_found = [found for *_, found in parts]
    detections = [one.detections for one in all_found]
    number = [np.arange(len(one))[some] for one, some in zip(detections, rows, strict=True)]
    counts = [len(one) for one in number]

    def repeat(values: Sequence[float], dtype: str) -> NDArray[Any]:
        return np.repeat(np.array(values, dtype), counts)

    def join(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
        return np.concatenate([np.empty(0), *(array[some] for array, some in zip(arrays, rows, strict=True))])

    frame = repeat([frame for frame, *_ in parts], "int64")
    column = {
        "detection_id": frame * ID_STEP + np.concatenate([np.empty(0, np.int64), *number]),
        "frame": frame,
        "time_s": repeat([time_s for _, time_s, _ in parts], "float64"),
        "x_px": join([one.xy_base[:, 0] for one in all_found]),
        "y_px": join([one.xy_base[:, 1] for one in all_found]),
        "orientation_rad": join([one.orientation_rad for one in detections]),
        "orientation_sd_rad": join([one.orientation_sd_rad for one in detections]),
        "area_px": join([one.area_px for one in detections]) / repeat([one.scale for one in all_found], "float64") ** 2,
        "score": join([one.score for one in detections]),
    }
    crops: dict[str, list[NDArray[Any]]] = {name: [none] for name, none in _NO_CROPS.items()}
    for one, some in zip(detections, rows, strict=True):
        for name in crops:
            values = one.xy if name == "xy_work" else getattr(one, name)
            crops[name].append(values[some].astype(_NO_CROPS[name].dtype, copy=False))
    return Cars(column, crops)


def write_detections(plan: Plan, frames: range, blocks: Sequence[BlockDetections]) -> StageResult:
    """Write the table of a unit, that of its weak candidates, and the crops of both."""
    unit = frames.start // plan.unit_frames
    scale = read_working(plan.layout).scale
    cars, weak = [block.cars for block in blocks], [block.weak for block in blocks]
    written = _write_part(plan.layout.unit_file(plan.layout.detections, unit), cars, scale)
    path = plan.layout.unit_file(plan.layout.weak_detections, unit)
    written += _write_part(path, weak, scale)
    used = int(usable_frames(plan)[frames.start : frames.stop].sum())
    counts = {"frames": float(used), "cars": float(sum(map(len, cars))), "weak": float(sum(map(len, weak)))}
    searched = np.concatenate([block.searched for block in blocks])
    if np.isfinite(searched).any():
        counts["searched"] = float(np.nanmean(searched))
    return StageResult(written, counts)


def _write_part(path: Path, parts: Sequence[Cars], scale: float) -> list[Path]:
    """Write the table of a unit's blocks, and those of their crops."""
    arrays = {name: [array for part in parts for array in part.crops[name]] for name in _NO_CROPS}
    patches = path.with_suffix(".patches.npz")
    write_arrays(patches, {**arrays, "working_scale": np.array(scale)})
    columns = {name: np.concatenate([part.column[name] for part in parts]) for name in DETECTION_COLUMNS}
    write_table(path, pd.DataFrame(columns), DETECTION_COLUMNS)
    return [path, patches]
