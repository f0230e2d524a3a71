"""Images with labelled cars on the working grid: what every detector is trained and evaluated on."""

from dataclasses import dataclass, field, replace

import numpy as np

from schemas.arrays import FloatArray, GreyImage, Mask


def _no_circles() -> FloatArray:
    return np.empty((0, 3))


@dataclass(frozen=True)
class LabelledImage:
    """An image on the working grid, and the cars that are known in it."""

    image: GreyImage
    """(h, w) uint8."""
    cars: FloatArray
    """(n, 5): x, y, orientation, length, width in working px; NaN where the label has none."""
    ignore: FloatArray = field(default_factory=_no_circles)
    """(k, 3): x, y, radius of objects that are neither car nor background."""
    valid: Mask | None = None
    """(h, w) bool, none: everywhere."""
    complete: bool = True
    """Whether every car is labelled, so that all else is background."""
    abs_box_angle_rad: FloatArray | None = None
    """(n,) of cars without an orientation |angle| to the rows, from an upright box; NaN without one."""


def restrict_to_region(sample: LabelledImage, region: Mask) -> LabelledImage:
    """The image with nothing known outside a region (h, w)."""
    valid, inside = region if sample.valid is None else region & sample.valid, in_region(region, sample.cars)
    angles = None if sample.abs_box_angle_rad is None else sample.abs_box_angle_rad[inside]
    return replace(sample, valid=valid, cars=sample.cars[inside], abs_box_angle_rad=angles)


def in_region(region: Mask, xy: FloatArray) -> Mask:
    """Whether positions (n, 2...) lie in a region (h, w)."""
    x, y = (np.clip(np.rint(xy[:, k]), 0, region.shape[1 - k] - 1).astype(np.int64) for k in (0, 1))
    return np.asarray(region[y, x])
