"""Images with labelled cars on the working grid: what every detector is trained and evaluated on."""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import KDTree

from schemas.arrays import FloatArray, GreyImage, Mask


def _no_circles() -> FloatArray:
    return np.empty((0, 3))


@dataclass(frozen=True)
class LabelledImage:
    """A picture on the working grid and what is known to be a car in it.

    Attributes
    ----------
    image : (h, w) uint8.
    cars : (n, 5): x, y, orientation, length, width in working px; NaN where it is not told.
    tilts : (n,) of cars whose orientation is not told |angle| to the rows, NaN where that is not either; none: of none.
    ignore : (k, 3): x, y, radius of what is neither car nor background.
    valid : (h, w) bool, none: everywhere.
    background : (h, w) uint8, none: not known.
    complete : whether every car is marked, so that all else is background; else what looks like a car may be one.
    """

    image: GreyImage
    cars: FloatArray
    ignore: FloatArray = field(default_factory=_no_circles)
    valid: Mask | None = None
    background: GreyImage | None = None
    complete: bool = True
    tilts: FloatArray | None = None


def within(sample: LabelledImage, region: Mask) -> LabelledImage:
    """The picture with nothing known outside a region (h, w)."""
    valid, inside = region if sample.valid is None else region & sample.valid, lies_in(region, sample.cars)
    tilts = None if sample.tilts is None else sample.tilts[inside]
    return replace(sample, valid=valid, cars=sample.cars[inside], tilts=tilts)


def lies_in(region: Mask, xy: FloatArray) -> Mask:
    """Whether places (n, 2...) lie in a region (h, w)."""
    x, y = (np.clip(np.rint(xy[:, k]), 0, region.shape[1 - k] - 1).astype(np.int64) for k in (0, 1))
    return np.asarray(region[y, x])


def distance(xy: FloatArray, cars: FloatArray) -> FloatArray:
    """From places (n, 2...) to the nearest car."""
    if not len(cars):
        return np.full(len(xy), np.inf)
    return np.asarray(KDTree(cars[:, :2]).query(xy[:, :2])[0])
