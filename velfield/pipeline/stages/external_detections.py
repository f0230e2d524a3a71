"""Another detector's boxes in place of ours: the rest of the work does not know the difference."""

from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from velfield.detection.detect import FrameDetections, attach_crops
from velfield.detection.detector import Detections
from velfield.detection.orientation import CAR_ASPECT, axial_difference, fill_missing_orientation
from velfield.pipeline.plan import Plan
from velfield.pipeline.stages.rectified_frames import WorkingFrame
from velfield.registration.transforms import FrameMap
from velfield.sources.labels.detections import read_detections

_AXIS_SD_RAD = 0.1
_BOXES: dict[str, pd.DataFrame] = {}


def given_boxes(plan: Plan) -> pd.DataFrame:
    """The boxes of the whole flight, read once a process."""
    key = f"{plan.job.inputs.source} {plan.inputs.detections}"
    if key not in _BOXES:
        _BOXES.clear()
        _BOXES[key] = read_detections(Path(str(plan.job.inputs.detections)), plan.info)
    return _BOXES[key]


def external_detections(plan: Plan, seen: WorkingFrame, transform: FrameMap, frame: int) -> FrameDetections:
    """The given boxes of a frame, raw pixels, on its working picture; an axis that is not told is looked for there."""
    table = given_boxes(plan)
    mine = table[table["source_index"] == plan.indices[frame]]
    raw = mine[["x_px", "y_px"]].to_numpy(np.float64)
    xy = seen.to_work(transform.to_base(raw))
    axis = _turned(transform, raw, mine["orientation_rad"].to_numpy(np.float64))
    unknown = ~np.isfinite(axis)
    axis[unknown] = _looked_for(seen, xy[unknown], transform, mine[unknown])
    length = plan.config.detection.working_car_length_px
    area = np.full(len(xy), length * length * CAR_ASPECT)
    cars = np.column_stack(
        [xy, np.mod(axis, np.pi), mine["score"].to_numpy(np.float64), np.full(len(xy), _AXIS_SD_RAD)]
    )
    good = np.isfinite(xy).all(axis=1)
    return attach_crops(seen.image, Detections.from_rows(cars[good], area[good]))


def free_of_vehicles(plan: Plan, frame: int, shape: tuple[int, int]) -> NDArray[np.bool_] | None:
    """Where a raw frame (h, w) shows no vehicle, as far as given detections tell: key points are looked for there.

    None where no detections are given. Boxes without a size mask nothing; the robust fit keeps those out.
    """
    if plan.job.inputs.detections is None:
        return None
    table = given_boxes(plan)
    mine = table[table["source_index"] == plan.indices[frame]].dropna(subset=["length_px", "width_px"])
    turns = np.degrees(mine["orientation_rad"].fillna(mine["abs_box_angle_rad"]).fillna(0.0))
    boxes = np.column_stack([mine[["x_px", "y_px", "length_px", "width_px"]], turns])
    other_way = boxes[mine["orientation_rad"].isna()] * [1, 1, 1, 1, -1]  # a car in an upright box lies either way
    free = np.ones(shape, np.uint8)
    for x, y, length, width, turn in np.concatenate([boxes, other_way]):
        corners = cv2.boxPoints(((x, y), (length, width), turn))
        cv2.fillPoly(free, [np.rint(corners).astype(np.int32)], (0,))
    return free.astype(np.bool_)


def _looked_for(
    seen: WorkingFrame, xy: NDArray[np.float64], transform: FrameMap, boxes: pd.DataFrame
) -> NDArray[np.float64]:
    """Axes (n,) of boxes that do not tell them: the picture's, or of the two that an upright box leaves the nearer."""
    untold = np.full((len(xy), 3), np.nan)
    own = fill_missing_orientation(seen.image, np.column_stack([np.nan_to_num(xy), untold]))[:, 2]
    raw, tilt = boxes[["x_px", "y_px"]].to_numpy(np.float64), boxes["abs_box_angle_rad"].to_numpy(np.float64)
    one, other = (_turned(transform, raw, sign * tilt) for sign in (1, -1))
    nearer = np.where(axial_difference(one, own) <= axial_difference(other, own), one, other)
    return np.where(np.isfinite(nearer), nearer, own)


def _turned(transform: FrameMap, raw: NDArray[np.float64], axis_raw: NDArray[np.float64]) -> NDArray[np.float64]:
    """Axes in the raw frame as they lie on the base image."""
    step = np.column_stack([np.cos(axis_raw), np.sin(axis_raw)])
    along = transform.to_base(raw + np.nan_to_num(step)) - transform.to_base(raw)
    turned = np.arctan2(along[:, 1], along[:, 0])
    return np.where(np.isfinite(axis_raw), turned, np.nan)
