"""Detections of another program in place of ours (`--detections`): later stages do not know the difference."""

from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from schemas.arrays import FloatArray, Mask, Points
from velfield.detection.detect import FrameDetections, attach_crops
from velfield.detection.detector import Detections
from velfield.detection.orientation import CAR_ASPECT, axial_difference, fill_missing_orientation
from velfield.pipeline.plan import Plan
from velfield.pipeline.stages.rectified_frames import WorkingFrame
from velfield.registration.transforms import FrameMap
from velfield.sources.labels.detections import read_detections

_AXIS_SD_RAD = 0.1
_BOXES: dict[str, pd.DataFrame] = {}


def external_boxes(plan: Plan) -> pd.DataFrame:
    """The boxes of the whole flight, read once a process."""
    key = f"{plan.job.inputs.source} {plan.inputs.detections}"
    if key not in _BOXES:
        _BOXES.clear()
        _BOXES[key] = read_detections(Path(str(plan.job.inputs.detections)), plan.info)
    return _BOXES[key]


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


def vehicle_free_mask(plan: Plan, frame: int, shape: tuple[int, int]) -> Mask | None:
    """Where a raw frame (h, w) shows no vehicle by the given boxes: key points are detected there only.

    None without given boxes. Boxes without a size mask nothing; key points on these vehicles are outliers of the fit.
    """
    if plan.job.inputs.detections is None:
        return None
    table = external_boxes(plan)
    sized = table[table["source_index"] == plan.indices[frame]].dropna(subset=["length_px", "width_px"])
    degrees = np.degrees(sized["orientation_rad"].fillna(sized["abs_box_angle_rad"]).fillna(0.0))
    boxes = np.column_stack([sized[["x_px", "y_px", "length_px", "width_px"]], degrees])
    mirrored = boxes[sized["orientation_rad"].isna()] * [1, 1, 1, 1, -1]  # an upright box leaves the sign open
    free = np.ones(shape, np.uint8)
    for x, y, length, width, angle in np.concatenate([boxes, mirrored]):
        corners = cv2.boxPoints(((x, y), (length, width), angle))
        cv2.fillPoly(free, [np.rint(corners).astype(np.int32)], (0,))
    return free.astype(np.bool_)


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
