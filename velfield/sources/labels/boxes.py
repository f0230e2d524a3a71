"""What other programs draw around a car, as a car: a point, an upright box, or corners."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from velfield.errors import InputError
from velfield.sources.frames import SourceInfo
from velfield.sources.labels.yolo import Box, Shape, cars_among, shape_of_upright_box

Point = tuple[float, float]


@dataclass(frozen=True)
class Drawn:
    """Something drawn on a picture.

    Attributes
    ----------
    picture : the picture's name as the file has it.
    name : what it is called; empty where it is not.
    points : raw px, (0, 0) at the first pixel's centre: one, the centre; two, opposite corners of an upright box; more,
        corners around it.
    """

    picture: str
    name: str
    points: Sequence[Point]


def boxes_of(
    path: Path, drawn: Iterable[Drawn], pictures: Iterable[str], info: SourceInfo
) -> tuple[list[Box], list[str], list[str]]:
    """Boxes of what is drawn on this source's frames; the frames named; notes for people.

    Raises
    ------
    InputError
        No picture is a frame of the source, or nothing has a car's name.
    """
    drawn, pictures = list(drawn), list(dict.fromkeys(pictures))
    frame_of = {name: _frame(name, info) for name in pictures}
    frames = [frame for frame in frame_of.values() if frame is not None]
    if not frames:
        first = repr(pictures[0]) if pictures else "none"
        raise InputError(
            f"{path.name}: found labels of the pictures {first} and so on, none a frame of this source (such as "
            f"{info.names[0]!r}); rename them"
        )
    names = sorted({one.name for one in drawn if one.name})
    cars = cars_among(enumerate(names), path) if names else set()
    boxes = []
    for one in drawn:
        frame = frame_of.get(one.picture)
        if frame is not None:
            is_car = not one.name or names.index(one.name) in cars
            x, y, shape = shape_of(one.points)
            boxes.append(Box(frame, is_car, x, y, *shape, math.nan))
    strangers = len(pictures) - len(frames)
    notes = [f"{strangers} labelled pictures are no frames of this source and are not used"] if strangers else []
    return boxes, frames, notes


def _frame(name: str, info: SourceInfo) -> str | None:
    """The frame that a picture's name means: by file name, then by stem; of a video by number."""
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


def shape_of(points: Sequence[Point]) -> tuple[float, float, Shape]:
    """x, y and shape of points as `Drawn` has them.

    Examples
    --------
    >>> x, y, shape = shape_of([(0, 0), (20, 8)])
    >>> x, y, [round(v, 2) for v in shape]
    (10.0, 4.0, [0.0, 19.64, 8.84, nan])
    >>> shape_of([(0, 0), (20, 0), (20, 8), (0, 8)])[2].length_px
    20.0
    """
    if len(points) == 1:
        return points[0][0], points[0][1], Shape()
    if len(points) == 2:
        (x0, y0), (x1, y1) = points
        return (x0 + x1) / 2, (y0 + y1) / 2, shape_of_upright_box(abs(x1 - x0), abs(y1 - y0))
    (x, y), (width, height), degrees = cv2.minAreaRect(np.asarray(points, np.float32))
    angle = math.radians(degrees) + (0 if width >= height else math.pi / 2)
    turned = angle % math.pi
    near_zero = 0.0 if math.isclose(turned, math.pi, abs_tol=1e-6) else turned
    if min(width, height) <= 0:
        return x, y, Shape()
    return x, y, Shape(near_zero, max(width, height), min(width, height))
