"""Stage `detector`: loads or trains the detector of a flight, and sets the scale of the working grid.

The detector comes from, in this order: other boxes (`--detections`, none is needed), a file (`--detector`), fine-tuning
or training on the given labels (`--labels`), or the shipped weights as they are.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from schemas.arrays import GreyImage
from schemas.detector import CnnConfig
from schemas.records import WorkingRecord
from schemas.scale import CAR_LENGTH_M
from velfield.detection.interface import Detector
from velfield.detection.registry import load_detector, shipped_detector, train_detector
from velfield.detection.runtime import use_device
from velfield.detection.scale_search import working_scale
from velfield.errors import InputError
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import StageResult, advance
from velfield.pipeline.stages.car_size import in_light_of_flight, search_scale
from velfield.pipeline.stages.labels import (
    base_px_per_raw_px,
    check_label_axes,
    check_label_scale,
    labelled_images,
    labels_of_run,
    median_car_length_raw_px,
)
from velfield.pipeline.stages.rectified_frames import WorkingGrid
from velfield.pipeline.stages.registration import external_boxes, spread_usable_frames
from velfield.run.commits import write_atomically, write_record
from velfield.run.frame_transforms import read_first_grid
from velfield.run.stores import FrameStore

_MIN_CAR_PX = 5.0
"""The shipped network finds next to nothing of shorter cars, and searches images a hundred times as large for them."""
_FRAMES_TO_MEASURE = 4
_FRAMES_TO_CALIBRATE = 3
_MIN_FRAMES_WITH_BOXES = 0.5
"""Fraction of the frames in which another program's boxes are expected."""


def make_detector(plan: Plan) -> StageResult:
    """Set the scale of the working grid, and load or train the detector."""
    use_device(plan.config.work.device)
    if plan.job.inputs.detections:
        return _from_detections(plan)
    if plan.job.inputs.detector:
        return _from_file(plan)
    if plan.job.inputs.labels:
        return _from_labels(plan)
    return _shipped(plan)


def _from_file(plan: Plan) -> StageResult:
    """Load a detector file."""
    detector = in_light_of_flight(plan, load_detector(Path(plan.job.inputs.detector or "")))
    scale = _scale_of_boxes(plan, detector) if detector.reads_raw_frames else _known_scale(plan)
    return _finish(plan, detector, scale, "file")


def _scale_of_boxes(plan: Plan, detector: Detector) -> float:
    """By the ground sample distance, else by the boxes of some frames where they have a length."""
    known = _scale_of_gsd(plan)
    if known is not None:
        return known
    store, chosen = FrameStore(plan.layout.frames), spread_usable_frames(plan, _FRAMES_TO_MEASURE)
    threshold = plan.config.detection.threshold
    boxes = pd.concat([detector.detect_raw(store.read(frame), threshold=threshold) for frame in chosen])
    if boxes.empty:
        raise InputError(
            f"the detector found no vehicle in {len(chosen)} frames, expected some, as the scale of the map comes from "
            "their size; check its classes, its threshold and the values that its input takes "
            "(documentation: Another detector), or give --gsd-m"
        )
    scale = _scale_of_length(plan, float(boxes["length_px"].median()), base_px_per_raw_px(plan))
    if scale is None:
        raise InputError(
            f"found {len(boxes)} boxes without a length in {len(chosen)} frames, and no scale of the map: the size of "
            "a car is not known; give --gsd-m"
        )
    return scale


def _from_detections(plan: Plan) -> StageResult:
    """Take another program's boxes; their median length gives the working scale where ``--gsd-m`` does not."""
    boxes, scale = external_boxes(plan), _scale_of_gsd(plan)
    if scale is None:
        scale = _scale_of_length(plan, median_car_length_raw_px(boxes), base_px_per_raw_px(plan))
    outcome = _finish(plan, None, scale, "detections")
    warnings: list[str] = []
    if scale is None:
        assumed_px = plan.config.detection.working_car_length_px
        warnings.append(
            "the size of a car is not known: found no --gsd-m and boxes without a length; "
            f"{assumed_px:g} px assumed, give one of them"
        )
    with_boxes = int(np.isin(plan.indices, boxes["source_index"]).sum())
    if with_boxes < _MIN_FRAMES_WITH_BOXES * plan.frame_count:
        warnings.append(
            f"--detections has boxes in {with_boxes} of the {plan.frame_count} frames processed: the others count as "
            "empty; give boxes of all frames, or use it as --labels"
        )
    unused = [f"--{name}" for name in ("labels", "detector") if getattr(plan.job.inputs, name)]
    if unused:
        warnings.append(f"--detections is given, so no detector is trained or run: {' and '.join(unused)} not used")
    return StageResult(outcome.outputs, outcome.counts, outcome.notes, warnings)


def _scale_of_length(plan: Plan, length_raw_px: float, base_per_raw: float) -> float | None:
    """Working px a base px, from a car's median length in raw px; None where that is not known."""
    if not np.isfinite(length_raw_px):
        return None
    return plan.config.detection.working_car_length_px / (length_raw_px * base_per_raw)


def _scale_of_gsd(plan: Plan) -> float | None:
    """Working px a base px where the scale of the map is known.

    Raises
    ------
    InputError
        At that scale a car would be too short to be seen.
    """
    gsd_m, car_m = read_first_grid(plan.layout).gsd_m, plan.config.detection.car_length_m
    if gsd_m is None:
        return None
    length_px = car_m / (gsd_m * base_px_per_raw_px(plan))
    if length_px < _MIN_CAR_PX:
        raise InputError(
            f"found a scale of {gsd_m:g} m a pixel of the map, at which a car is {length_px:.2g} px long in a frame; "
            f"expected {_MIN_CAR_PX:g} px or more; give metres a pixel with --gsd-m, as 0.23"
        )
    return working_scale(plan.config.detection, gsd_m)


def _known_scale(plan: Plan) -> float:
    scale = _scale_of_gsd(plan)
    if scale is None:
        raise InputError("the size of a car is not known: a detector file needs --gsd-m (metres a base pixel)")
    return scale


def _from_labels(plan: Plan) -> StageResult:
    labels = labels_of_run(plan)
    base_per_raw = base_px_per_raw_px(plan)
    length_px = median_car_length_raw_px(labels.cars)
    scale = _scale_of_gsd(plan) or _scale_of_length(plan, length_px, base_per_raw)
    if scale is None:
        raise InputError(
            "the size of a car is not known: the labels have no length_px and --gsd-m is not given; give either"
        )
    source, work_per_raw = Path(plan.job.inputs.source), scale * base_per_raw
    samples = list(labelled_images(source, plan.info, labels, work_per_raw=work_per_raw))
    detector = in_light_of_flight(plan, train_detector(samples, plan.config.detection))
    outcome = _finish(plan, detector, scale, "labels", count=len(labels.cars))
    found = check_label_axes(samples) or check_label_scale(
        labels.cars, base_per_raw, read_first_grid(plan.layout).gsd_m
    )
    return replace(outcome, notes=[*labels.notes, *outcome.notes], warnings=[*outcome.warnings, *found])


def _shipped(plan: Plan) -> StageResult:
    """Use the shipped detector as it is, at the scale of ``--gsd-m``, else at the one at which it finds cars."""
    config = plan.config.detection
    if config.method != CnnConfig.model_fields["method"].default:
        raise InputError(f"detection.method={config.method} needs labelled cars: found none; give --labels")
    detector = in_light_of_flight(plan, shipped_detector())
    detector.check_car_length(config.working_car_length_px)
    scale = _scale_of_gsd(plan) or search_scale(plan, detector)
    if scale is None:
        raise InputError(
            "the size of a car is not known: the detector finds cars at no scale of the image, or at several; give "
            "--gsd-m (metres a base pixel), or label the cars of one frame (--labels)"
        )
    return _finish(plan, detector, scale, "shipped")


def _finish(
    plan: Plan,
    detector: Detector | None,
    scale: float | None,
    training_source: str,
    *,
    count: int = 0,
) -> StageResult:
    """Write the detector and the working grid.

    ``scale``: working px a base px; None: the size of a car is not known, and working px are base px.
    """
    layout, outputs, notes = plan.layout, [plan.layout.working], []
    warnings: list[str] = []
    if detector is not None:
        if not detector.reads_raw_frames:
            detector = detector.for_flight(
                _images_to_calibrate(plan, 1.0 if scale is None else scale), plan.config.detection
            )
        warnings += detector.limitations
        write_atomically(layout.detector, detector.to_json().encode())
        outputs.append(layout.detector)
        if plan.job.inputs.detector:
            notes.append(f"detector: {detector.method}, of the file {Path(plan.job.inputs.detector).name}")
        notes += detector.notes
    by_vehicles = None if _scale_of_gsd(plan) is not None else scale
    car_px = plan.config.detection.working_car_length_px
    record = WorkingRecord(
        scale=scale or 1.0,
        vehicle_gsd_m=None if by_vehicles is None else CAR_LENGTH_M * by_vehicles / car_px,
        training_source=training_source,
        labels=count,
    )
    write_record(layout.working, record)
    advance("detector")
    counts = {"labels": float(count), "working_scale": record.scale}
    if detector is not None:
        counts["threshold"] = detector.threshold
    return StageResult(outputs, counts, notes, warnings)


def _images_to_calibrate(plan: Plan, scale: float) -> list[GreyImage]:
    """Some frames on the working grid, spread over the flight."""
    working = WorkingGrid.open(plan, scale)
    frames = (working.frame(frame) for frame in spread_usable_frames(plan, _FRAMES_TO_CALIBRATE))
    return [frame.image for frame in frames if frame is not None]
