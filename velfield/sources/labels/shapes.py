"""Shapes that annotations draw around cars: a point, an upright box, a rotated box, an outline."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

CAR_ASPECT = 0.45
"""Width by length of a typical car: gives the length of a rotated car from its upright box."""
_UPRIGHT_ASPECT = 2.0  # an upright box this long was drawn around a car within some 5 degrees of an axis
_SQUARE_TOLERANCE = 0.02

Point = tuple[float, float]


class CarShape(NamedTuple):
    """Orientation and size of the car in a shape; NaN where unknown.

    ``abs_box_angle_rad``: |angle| to the image's rows, where the box is upright and the axis therefore ambiguous.
    """

    orientation_rad: float = math.nan
    length_px: float = math.nan
    width_px: float = math.nan
    abs_box_angle_rad: float = math.nan


def car_shape(points: Sequence[Point]) -> tuple[float, float, CarShape]:
    """Centre and shape of the car that points outline: one is its centre, two are opposite corners of an upright box.

    Examples
    --------
    >>> x, y, shape = car_shape([(0, 0), (20, 8)])
    >>> x, y, [round(v, 2) for v in shape]
    (10.0, 4.0, [0.0, 19.64, 8.84, nan])
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


def rotated_corners(x: float, y: float, width: float, height: float, clockwise_rad: float) -> list[Point]:
    """Corners of a box of a width and a height about (x, y), turned clockwise (from +x towards +y) about its centre."""
    c, s = math.cos(clockwise_rad), math.sin(clockwise_rad)
    half = [(-width / 2, -height / 2), (width / 2, -height / 2), (width / 2, height / 2), (-width / 2, height / 2)]
    return [(x + u * c - v * s, y + u * s + v * c) for u, v in half]


def is_upright_rectangle(points: Sequence[Point]) -> bool:
    """Whether four points are the corners of a rectangle whose sides are rows and columns of the image.

    Examples
    --------
    >>> [is_upright_rectangle([(0, y), (20, 0), (20, 8), (0, 8)]) for y in (0, 3)]
    [True, False]
    """
    if len(points) != 4:
        return False
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    off = np.minimum(np.abs(np.asarray(points) - low), np.abs(np.asarray(points) - high))
    return bool((off <= _SQUARE_TOLERANCE * max(float((high - low).max()), 1e-9)).all())


def car_in_upright_box(w: float, h: float) -> CarShape:
    """Shape of the car in an upright box of w x h, px."""
    if min(w, h) <= 0:
        return CarShape()
    length = length_from_upright_box(w, h)
    if max(w, h) >= _UPRIGHT_ASPECT * min(w, h):
        return CarShape(0.0 if w > h else math.pi / 2, length, CAR_ASPECT * length)
    return CarShape(length_px=length, width_px=CAR_ASPECT * length, abs_box_angle_rad=tilt_of_upright_box(w, h))


def tilt_of_upright_box(w: float, h: float, *, aspect: float = CAR_ASPECT) -> float:
    """|angle| to the x axis, [0, pi / 2], of a car of a known aspect in an upright box of w x h.

    With c, s >= 0 the cosine and the sine, h (c + r s) = w (s + r c).
    """
    tilt = math.atan2(h - aspect * w, w - aspect * h)
    return min(max(tilt, 0.0), math.pi / 2)


def length_from_upright_box(w: float, h: float) -> float:
    """Length of a rotated car of `CAR_ASPECT` in its upright box of w x h, px.

    With L the length, r the aspect, S = |sin 2 theta|: w h = L^2 (r + (1 + r^2) S / 2) and
    w^2 + h^2 = L^2 (1 + r^2 + 2 r S); their quotient gives S, then either gives L.
    """
    aspect, squares = CAR_ASPECT, w * w + h * h
    quotient = w * h / squares
    sine = (quotient * (1 + aspect**2) - aspect) / ((1 + aspect**2) / 2 - 2 * aspect * quotient)
    sine = min(max(sine, 0.0), 1.0)
    return math.sqrt(squares / (1 + aspect**2 + 2 * aspect * sine))
