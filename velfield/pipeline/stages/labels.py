"""Labelled images to train on: raw frames, rescaled to the working grid, with their labels.

A labelled frame need not be among the processed frames, nor be registered: a car looks the same in its raw frame. So
the raw frame is rescaled by the local scale of the map raw -> base.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from schemas.arrays import FloatArray, GreyImage
from schemas.scale import ScaleEstimate
from velfield.analysis.vehicle_scale import estimate_vehicle_scale
from velfield.detection.orientation import contradict_axes, outline_axes
from velfield.detection.samples import LabelledImage
from velfield.errors import InputError
from velfield.pipeline.plan import Plan
from velfield.run.frame_transforms import FrameTransforms
from velfield.run.stores import RegistrationStore
from velfield.sources.frames import SourceInfo
from velfield.sources.labels.labels import Labels, read_labels
from velfield.sources.quality import UNUSABLE
from velfield.sources.scale import choose_scale
from velfield.sources.source import iter_frames

_MIN_LENGTH_M, _USUAL_LENGTH_M, _MAX_LENGTH_M = 3.3, 4.4, 6.0
"""Range of the median length of labelled cars, and what it usually is."""
_LABEL_SD = 0.03
"""Relative error that all lengths drawn by one person may have in common."""


def labels_of_run(plan: Plan) -> Labels:
    """The labels of ``--labels``.

    Raises
    ------
    InputError
        The labels cannot be read, or hold no car.
    """
    labels = read_labels(Path(str(plan.job.inputs.labels)), plan.info)
    if labels.cars.empty:
        raise InputError(f"--labels {plan.job.inputs.labels}: no car in it; label the cars of one frame")
    return labels


def base_px_per_raw_px(plan: Plan) -> float:
    """Local scale of the map raw -> base at the frames' centre: the median over registered frames."""
    maps = FrameTransforms.open(plan.layout, plan.config)
    statuses = RegistrationStore(plan.layout.registration).statuses()
    registered = [k for k, status in enumerate(statuses) if status == "ok"]
    if not registered:
        raise InputError("no frame could be registered; the video must show one place from above")
    cross = np.array([[-0.5, 0], [0.5, 0], [0, -0.5], [0, 0.5]]) * 64 + np.array([[maps.width, maps.height]]) / 2
    scales = []
    for k in registered[:: max(1, len(registered) // 15)]:
        transform = maps.transform(k)
        if transform is not None:
            base = transform.to_base(cross) / 64
            a, b = base[1] - base[0], base[3] - base[2]
            scales.append(np.sqrt(abs(a[0] * b[1] - a[1] * b[0])))
    return float(np.median(scales))


def median_car_length_raw_px(labels: pd.DataFrame) -> float:
    """Median length of the labelled cars, raw px; NaN where no label has one."""
    longest = labels[["length_px", "width_px"]].max(axis=1).dropna()
    return float(longest.median()) if len(longest) else float("nan")


def check_vehicle_length(length_px: float, gsd_m: float | None) -> list[str]:
    """A warning where the median length of labelled cars, px of ``gsd_m``, is not that of cars; else none."""
    if gsd_m is None or not np.isfinite(length_px):
        return []
    length_m = length_px * gsd_m
    if _MIN_LENGTH_M <= length_m <= _MAX_LENGTH_M:
        return []
    return [
        f"the labelled cars are {length_m:.1f} m long, expected {_MIN_LENGTH_M:g} to {_MAX_LENGTH_M:g}: --gsd-m is "
        f"metres a pixel of the base image; give {gsd_m * _USUAL_LENGTH_M / length_m:.2g} if they are cars, or correct "
        "the labels' lengths"
    ]


def check_label_scale(cars: pd.DataFrame, base_per_raw: float, gsd_m: float | None) -> list[str]:
    """A warning where the lengths of labelled cars (`LABEL_COLUMNS`) contradict the ground sample distance; else none.

    Sides of upright boxes are no lengths; by them, or by too few for an interval, only an impossible one is reported.
    """
    oriented = cars[cars["abs_box_angle_rad"].isna() & cars["orientation_rad"].notna()]
    lengths_px = oriented[["length_px", "width_px"]].max(axis=1).to_numpy(np.float64) * base_per_raw
    found = estimate_vehicle_scale(lengths_px, measurement_sd=_LABEL_SD)
    if gsd_m is None or found is None:
        return check_vehicle_length(median_car_length_raw_px(cars) * base_per_raw, gsd_m)
    given = ScaleEstimate(gsd_m=gsd_m, low_m=gsd_m, high_m=gsd_m, source="given")
    return list(choose_scale([given, found]).disagreements)


def check_label_axes(samples: Sequence[LabelledImage]) -> list[str]:
    """A warning where the axes that labels give are not those of the cars in their images; else none."""
    known = [sample.cars[np.isfinite(sample.cars[:, 2])] for sample in samples]
    axes = [outline_axes(sample.image, cars) for sample, cars in zip(samples, known, strict=True)]
    return contradict_axes(np.concatenate(axes), np.concatenate([cars[:, 2] for cars in known])) if known else []


def labelled_images(source: Path, info: SourceInfo, labels: Labels, *, work_per_raw: float) -> Iterator[LabelledImage]:
    """Every labelled frame of a source at the working scale.

    Raises
    ------
    InputError
        A labelled frame cannot be read.
    """
    index_of = {name: index for index, name in enumerate(info.names)}
    for frame in iter_frames(source, info, np.array(sorted(index_of[name] for name in labels.frames), np.int64)):
        if frame.flags & UNUSABLE:
            raise InputError(f"--labels: the labelled frame {frame.name} cannot be used: {frame.reason}; label another")
        cars = labels.cars[labels.cars["frame"] == frame.name]
        yield LabelledImage(
            image=rescale(frame.grey, work_per_raw),
            cars=scale_boxes(cars, work_per_raw),
            ignore=ignore_circles(labels.ignored[labels.ignored["frame"] == frame.name], work_per_raw),
            abs_box_angle_rad=cars["abs_box_angle_rad"].to_numpy(np.float64),
        )


def ignore_circles(table: pd.DataFrame, work_per_raw: float) -> FloatArray:
    """Circles (k, 3) as x, y, radius, working px, about a frame's objects that are neither car nor background."""
    around = scale_boxes(table, work_per_raw)
    radius = np.nanmax(np.column_stack([around[:, 3:] / 2, np.full(len(around), 8.0)]), axis=1)
    return np.column_stack([around[:, :2], radius])


def scale_boxes(table: pd.DataFrame, work_per_raw: float) -> FloatArray:
    """A frame's boxes (n, 5) as x, y, orientation, length, width, working px."""
    columns = ["x_px", "y_px", "orientation_rad", "length_px", "width_px"]
    boxes = table[columns].to_numpy(np.float64, copy=True)
    boxes[:, :2] = (boxes[:, :2] + 0.5) * work_per_raw - 0.5
    boxes[:, 3:] *= work_per_raw
    return boxes


def rescale(grey: GreyImage, factor: float) -> GreyImage:
    """A grey image rescaled about its outer corner, by area averages where it shrinks."""
    height, width = grey.shape
    size = max(1, round(width * factor)), max(1, round(height * factor))
    interpolation = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(grey, size, interpolation=interpolation), np.uint8)
