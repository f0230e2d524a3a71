"""Annotations of other programs as boxes of cars: a point, an upright box, or corners."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from velfield.errors import InputError
from velfield.sources.frames import SourceInfo
from velfield.sources.labels.yolo import Box, CarShape, car_class_numbers, car_in_upright_box

Point = tuple[float, float]


@dataclass(frozen=True)
class Annotation:
    """A shape annotated on an image.

    Attributes
    ----------
    image : the image's name in the file.
    name : its class; empty where it has none.
    points : raw px, (0, 0) at the first pixel's centre: one, the centre; two, opposite corners of an upright box; more,
        corners around it.
    """

    image: str
    name: str
    points: Sequence[Point]


def boxes_from_annotations(
    path: Path, annotations: Iterable[Annotation], images: Iterable[str], info: SourceInfo
) -> tuple[list[Box], list[str], list[str]]:
    """Boxes of the annotations on this source's frames; the frames that are named; notes for the user.

    Raises
    ------
    InputError
        No image is a frame of the source, or nothing has a car's name.
    """
    annotations, images = list(annotations), list(dict.fromkeys(images))
    frame_of = {name: _frame(name, info) for name in images}
    frames = [frame for frame in frame_of.values() if frame is not None]
    if not frames:
        first = repr(images[0]) if images else "none"
        raise InputError(
            f"{path.name}: found labels of the images {first} and so on, none a frame of this source (such as "
            f"{info.names[0]!r}); rename them"
        )
    names = sorted({one.name for one in annotations if one.name})
    cars = car_class_numbers(enumerate(names), path) if names else set()
    boxes = []
    for one in annotations:
        frame = frame_of.get(one.image)
        if frame is not None:
            is_car = not one.name or names.index(one.name) in cars
            x, y, shape = car_shape(one.points)
            boxes.append(Box(frame, is_car, x, y, *shape, math.nan))
    unmatched = len(images) - len(frames)
    notes = [f"{unmatched} labelled images are no frames of this source: not used"] if unmatched else []
    return boxes, frames, notes


def _frame(name: str, info: SourceInfo) -> str | None:
    """The frame that an image's name refers to: by file name, then by stem; of a video by number."""
    known = set(info.names)
    file = name.replace("\\", "/").rsplit("/", 1)[-1]
    stem = file.rsplit(".", 1)[0]
    if info.kind == "video":
        digits = "".join(c for c in stem if c.isdecimal())
        number = str(int(digits)) if digits else ""
        return number if number in known else None
    if file in known:
        return file
    alike = [frame for frame in info.names if frame.rsplit(".", 1)[0] == stem]
    return alike[0] if len(alike) == 1 else None


def car_shape(points: Sequence[Point]) -> tuple[float, float, CarShape]:
    """Centre and shape of the car that an annotation's points outline.

    Examples
    --------
    >>> x, y, shape = car_shape([(0, 0), (20, 8)])
    >>> x, y, [round(v, 2) for v in shape]
    (10.0, 4.0, [0.0, 19.64, 8.84, nan])
    >>> car_shape([(0, 0), (20, 0), (20, 8), (0, 8)])[2].length_px
    20.0
    """
    if len(points) == 1:
        return points[0][0], points[0][1], CarShape()
    if len(points) == 2:
        (x0, y0), (x1, y1) = points
        return (x0 + x1) / 2, (y0 + y1) / 2, car_in_upright_box(abs(x1 - x0), abs(y1 - y0))
    (x, y), (width, height), degrees = cv2.minAreaRect(np.asarray(points, np.float32))
    angle = math.radians(degrees) + (0 if width >= height else math.pi / 2)
    axial = angle % math.pi
    near_zero = 0.0 if math.isclose(axial, math.pi, abs_tol=1e-6) else axial
    if min(width, height) <= 0:
        return x, y, CarShape()
    return x, y, CarShape(near_zero, max(width, height), min(width, height))
