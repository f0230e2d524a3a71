"""Lorries and buses brought to their middle: a classifier of cars finds them by their load or their cab.

A second classifier of the same family looks at half the resolution, so far that both ends of a bus lie in its window,
and says how much a place looks like the middle of something long. It ships: one frame's labels hold too few lorries.
"""

from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np

from schemas.arrays import Float32Array, FloatArray, GreyImage, Mask
from schemas.detector import LongVehicleRecord
from velfield.detection.boosting import BoostedSums, sums_of
from velfield.detection.cascade.classifier import moved
from velfield.detection.cascade.feature_image import Grain, Picture, picture_of, scores_at
from velfield.detection.cascade.proposals import in_sight

LONG = Grain(2, (16, 7))
LEAST_LENGTH = 1.4
"""What is this many times as long as a car is long."""
OFFSETS = np.array([(u, 0) for u in range(-11, 12)], np.int64)
"""Coarse px along the axis: from a load's middle to that of an articulated bus."""
_BODY_ALONG, _BODY_ACROSS = 1.0, 0.35
"""Car lengths from the middle of something long within which nothing else has its place."""


@dataclass(frozen=True)
class LongVehicles:
    """The classifier, in use."""

    record: LongVehicleRecord
    sums: BoostedSums

    def scores(self, picture: Picture, xy: FloatArray, axes: FloatArray) -> Float32Array:
        """How much places (n, 2), moved by `OFFSETS` along their axes (n,), look like a middle: (n, offsets)."""
        return scores_at(self.sums, picture, xy, axes, OFFSETS, contrast_floor=self.record.contrast_floor)

    def centred(self, picture: Picture, cars: FloatArray, seen: Mask) -> FloatArray:
        """Distinct cars (n, 2...) as x, y, axis, the best first, what is long at its middle and once.

        Parameters
        ----------
        picture
            Packed at `LONG`.
        seen
            (h, w): where the frame covers the picture; what has its middle elsewhere stays where it was found.
        """
        if not len(cars):
            return cars
        scores = self.scores(picture, cars[:, :2], cars[:, 2])
        offsets = OFFSETS[scores.argmax(axis=1)].astype(np.float64) * picture.grain.step
        middles = moved(cars[:, :2], cars[:, 2], offsets)
        long = (scores.max(axis=1) > self.record.threshold) & in_sight(middles, seen.shape, seen)
        cars = np.column_stack([np.where(long[:, None], middles, cars[:, :2]), cars[:, 2:]])
        return np.asarray(cars[~self._on_another(cars, long)])

    def _on_another(self, cars: FloatArray, long: Mask) -> Mask:
        """Whether each car lies on something long: of two that are long the better one stays."""
        on_another = np.zeros(len(cars), np.bool_)
        along, across = (share * self.record.working_car_length_px for share in (_BODY_ALONG, _BODY_ACROSS))
        for k in np.flatnonzero(long):
            if on_another[k]:
                continue
            c, s = np.cos(cars[k, 2]), np.sin(cars[k, 2])
            x, y = (cars[:, :2] - cars[k, :2]).T
            inside = (np.abs(x * c + y * s) < along) & (np.abs(y * c - x * s) < across)
            inside[k] = False
            on_another |= inside
        return on_another


@cache
def shipped_long_vehicles() -> LongVehicles:
    """The classifier that comes with velfield."""
    data = files("velfield.detection.cascade").joinpath("shipped_long_vehicles.json").read_bytes()
    record = LongVehicleRecord.model_validate_json(data)
    return LongVehicles(record, sums_of(record.rounds))


def centre_long_vehicles(image: GreyImage, valid: Mask | None, cars: FloatArray, car_length_px: float) -> FloatArray:
    """Distinct cars (n, 2...) with the long vehicles among them at their centre, where cars are as long as it knows."""
    long = shipped_long_vehicles()
    if car_length_px != long.record.working_car_length_px:
        return cars
    return long.centred(picture_of(image, None, LONG), cars, np.ones(image.shape, bool) if valid is None else valid)
