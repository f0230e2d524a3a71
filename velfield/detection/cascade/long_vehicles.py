"""Lorries and buses centred: detections of cars on their load or cab are moved to the centre of the vehicle.

A second boosted classifier of the same kind, at half the resolution and with a window that holds both ends of a bus,
scores positions along the axis of a detection as the centre of a long vehicle. It ships: one frame's labels hold too
few lorries to train it.
"""

from dataclasses import dataclass
from functools import cache, cached_property
from importlib.resources import files

import numpy as np

from schemas.arrays import Float32Array, FloatArray, GreyImage, Mask
from schemas.detector import LongVehicleRecord
from velfield.detection.boosting import BoostedStumps
from velfield.detection.cascade.classifier import offset_along_axis
from velfield.detection.cascade.feature_image import FeatureImage, PatchScale, compute_features, score_poses
from velfield.detection.cascade.proposals import in_view

LONG = PatchScale(2, (16, 7))
MIN_LENGTH_RATIO = 1.4
"""A vehicle this many times as long as a car is long."""
OFFSETS = np.array([(u, 0) for u in range(-11, 12)], np.int64)
"""Coarse px along the axis: from the centre of a load to that of an articulated bus."""
_BODY_ALONG, _BODY_ACROSS = 1.0, 0.35
"""Half the rectangle, in car lengths, about the centre of a long vehicle in which other detections are suppressed."""


@dataclass(frozen=True)
class LongVehicleClassifier:
    """The classifier, in use."""

    record: LongVehicleRecord

    @cached_property
    def stumps(self) -> BoostedStumps:
        """Its rounds."""
        return BoostedStumps.from_rounds(self.record.rounds)

    def scores(self, features: FeatureImage, xy: FloatArray, axes: FloatArray) -> Float32Array:
        """Scores (n, offsets) of positions (n, 2), displaced by `OFFSETS` along their axes (n,), as a centre."""
        return score_poses(self.stumps, features, xy, axes, OFFSETS, contrast_floor=self.record.contrast_floor)

    def centre(self, features: FeatureImage, cars: FloatArray, valid: Mask) -> FloatArray:
        """Cars (n, 2...) as x, y, axis, the best first: long vehicles at their centre, one detection each.

        Parameters
        ----------
        features
            Of the image, at the scale `LONG`.
        valid
            (h, w): where the frame covers the image; a vehicle whose centre is elsewhere stays where it was detected.
        """
        if not len(cars):
            return cars
        scores = self.scores(features, cars[:, :2], cars[:, 2])
        offsets = OFFSETS[scores.argmax(axis=1)].astype(np.float64) * features.scale.step
        centres = offset_along_axis(cars[:, :2], cars[:, 2], offsets)
        long = (scores.max(axis=1) > self.record.threshold) & in_view(centres, valid.shape, valid)
        cars = np.column_stack([np.where(long[:, None], centres, cars[:, :2]), cars[:, 2:]])
        return np.asarray(cars[~self._is_covered(cars, long)])

    def _is_covered(self, cars: FloatArray, long: Mask) -> Mask:
        """Whether each car lies on a long vehicle: of two long ones the better one stays."""
        covered = np.zeros(len(cars), np.bool_)
        along, across = (half * self.record.working_car_length_px for half in (_BODY_ALONG, _BODY_ACROSS))
        for k in np.flatnonzero(long):
            if covered[k]:
                continue
            c, s = np.cos(cars[k, 2]), np.sin(cars[k, 2])
            x, y = (cars[:, :2] - cars[k, :2]).T
            inside = (np.abs(x * c + y * s) < along) & (np.abs(y * c - x * s) < across)
            inside[k] = False
            covered |= inside
        return covered


@cache
def shipped_long_vehicles() -> LongVehicleClassifier:
    """The classifier that comes with velfield."""
    data = files("velfield.detection.cascade").joinpath("shipped_long_vehicles.json").read_bytes()
    return LongVehicleClassifier(LongVehicleRecord.model_validate_json(data))


def centre_long_vehicles(image: GreyImage, valid: Mask | None, cars: FloatArray, car_length_px: float) -> FloatArray:
    """Cars (n, 2...), suppressed already, with long vehicles at their centre; unchanged for cars of another length."""
    long = shipped_long_vehicles()
    if car_length_px != long.record.working_car_length_px:
        return cars
    everywhere = np.ones(image.shape, bool)
    return long.centre(compute_features(image, None, LONG), cars, everywhere if valid is None else valid)
