"""The axis of a marked car whose label does not tell it: from the box's shape, whose side the picture decides."""

import numpy as np
from numpy.typing import NDArray

from velfield.detection.axis import at_places, axial_difference, structure_axis

Floats = NDArray[np.float64]

CAR_ASPECT = 0.45
"""A usual car's width over its length."""
_SHAPE_SD_RAD = 0.2
_TRIED = np.radians(np.arange(0, 180, 3.0))


def with_axes(image: NDArray[np.uint8], cars: Floats) -> Floats:
    """Cars (n, 5) with every axis finite.

    An upright box about a turned rectangle tells the angle but for its sign: w = L |cos| + W |sin|, and h = L |sin| +
    W |cos|. The structure tensor, alone wrong for one car in six among parked neighbours, tells the sign, and all where
    there is no box.
    """
    cars = cars.copy()
    unknown = np.flatnonzero(~np.isfinite(cars[:, 2]))
    if not unknown.size:
        return cars
    axes, coherences = structure_axis(image)
    axis, coherence = (at_places(values, cars[unknown]) for values in (axes, coherences))
    off_axis = axial_difference(_TRIED[None], axis[:, None])
    evidence = coherence[:, None] * np.cos(2 * off_axis)
    boxed = np.isfinite(cars[unknown, 3:]).all(axis=1) & (cars[unknown, 3:] > 0).all(axis=1)
    tilt = tilt_of_box(cars[unknown[boxed], 3], cars[unknown[boxed], 4])
    upright = np.minimum(_TRIED, np.pi - _TRIED)
    evidence[boxed] -= 0.5 * ((upright - tilt[:, None]) / _SHAPE_SD_RAD) ** 2
    cars[unknown, 2] = _TRIED[evidence.argmax(axis=1)]
    return cars


def tilt_of_box(width: Floats, height: Floats, *, aspect: float = CAR_ASPECT) -> Floats:
    """|angle| to the x axis, [0, pi / 2], of a rectangle whose upright box has these sides.

    Examples
    --------
    >>> tilt_of_box(np.array([20.0, 9.0, 10.0]), np.array([9.0, 20.0, 10.0])).round(2).tolist()
    [0.0, 1.57, 0.79]
    """
    ratio = height / width
    # h (c + a s) = w (s + a c) with c, s >= 0.
    tilt = np.arctan2(ratio - aspect, 1 - aspect * ratio)
    return np.asarray(np.clip(np.where(1 - aspect * ratio <= 0, np.pi / 2, tilt), 0, np.pi / 2))
