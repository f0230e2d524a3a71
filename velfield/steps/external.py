"""Another detector's boxes in place of ours: the rest of the work does not know the difference."""

from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from velfield.detection.axis import at_places, structure_axis
from velfield.detection.detect import FrameDetections, pictured
from velfield.detection.label_axis import CAR_ASPECT
from velfield.plan import Plan
from velfield.sources.detections import read_detections
from velfield.steps.frame_maps import FrameMap
from velfield.steps.working import WorkingFrame

_AXIS_SD_RAD = 0.1
_BOXES: dict[str, pd.DataFrame] = {}


def _boxes(plan: Plan) -> pd.DataFrame:
    """The boxes of the whole flight, read once a process."""
    key = f"{plan.job.inputs.source} {plan.inputs.detections}"
    if key not in _BOXES:
        _BOXES.clear()
        _BOXES[key] = read_detections(Path(str(plan.job.inputs.detections)), plan.info)
    return _BOXES[key]


def external_detections(plan: Plan, seen: WorkingFrame, transform: FrameMap, frame: int) -> FrameDetections:
    """The given boxes of a frame, raw pixels, on its working picture; an axis that is not told is looked for there."""
    table = _boxes(plan)
    mine = table[table["source_index"] == plan.indices[frame]]
    raw = mine[["x_px", "y_px"]].to_numpy(np.float64)
    xy = seen.to_work(transform.to_base(raw))
    axis = _turned(transform, raw, mine["orientation_rad"].to_numpy(np.float64))
    unknown = ~np.isfinite(axis)
    axis[unknown] = at_places(structure_axis(seen.image)[0], xy[unknown]) if unknown.any() else axis[unknown]
    length = plan.config.detection.working_car_length_px
    area = np.full(len(xy), length * length * CAR_ASPECT)
    cars = np.column_stack(
        [xy, np.mod(axis, np.pi), mine["score"].to_numpy(np.float64), np.full(len(xy), _AXIS_SD_RAD)]
    )
    good = np.isfinite(xy).all(axis=1)
    return pictured(seen.image, cars[good], area[good])


def free_of_vehicles(plan: Plan, frame: int, shape: tuple[int, int]) -> NDArray[np.bool_] | None:
    """Where a raw frame (h, w) shows no vehicle, as far as given detections tell: key points are looked for there.

    None where no detections are given. Boxes without a size mask nothing; the robust fit keeps those out.
    """
    if plan.job.inputs.detections is None:
        return None
    table = _boxes(plan)
    mine = table[table["source_index"] == plan.indices[frame]]
    length, width = mine["length_px"].to_numpy(np.float64), mine["width_px"].to_numpy(np.float64)
    axis = np.nan_to_num(mine["orientation_rad"].to_numpy(np.float64))
    free = np.ones(shape, np.uint8)
    for x, y, a, b, turn in zip(mine["x_px"], mine["y_px"], length, width, axis, strict=True):
        if np.isfinite(a) and np.isfinite(b):
            rectangle = ((float(x), float(y)), (float(a), float(b)), float(np.degrees(turn)))
            cv2.fillPoly(free, [np.rint(cv2.boxPoints(rectangle)).astype(np.int32)], (0,))
    return free.astype(np.bool_)


def _turned(transform: FrameMap, raw: NDArray[np.float64], axis_raw: NDArray[np.float64]) -> NDArray[np.float64]:
    """Axes in the raw frame as they lie on the base image."""
    step = np.column_stack([np.cos(axis_raw), np.sin(axis_raw)])
    along = transform.to_base(raw + np.nan_to_num(step)) - transform.to_base(raw)
    turned = np.arctan2(along[:, 1], along[:, 0])
    return np.where(np.isfinite(axis_raw), turned, np.nan)
