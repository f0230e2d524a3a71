"""Lorries and buses centred: detections of cars on their load or cab are moved to the centre of the vehicle.

A boosted classifier at half the resolution, with a window that holds both ends of a bus, scores positions along the
axis of a detection as the centre of a long vehicle. It ships: the labels of one frame hold too few lorries to train it.
"""

from dataclasses import dataclass
from functools import cache, cached_property
from importlib.resources import files
from weakref import WeakKeyDictionary

import numpy as np

from schemas.arrays import Float32Array, FloatArray, Mask
from schemas.detector import LongVehicleRecord
from velfield.detection.frame import SearchableFrame
from velfield.detection.interface import Detections, concatenate
from velfield.detection.long_vehicles.feature_image import FeatureImage, OffsetScorer, PatchScale, features_of_reduced
from velfield.detection.nms import in_view, nms_oriented, offset_along_axis
from velfield.detection.stumps import BoostedStumps

LONG = PatchScale(2, (16, 7))
MIN_LENGTH_RATIO = 1.4
"""A vehicle this many times as long as a car is long."""
OFFSETS = np.array([(u, 0) for u in range(-11, 12)], np.int64)
"""Coarse px along the axis: from the centre of a load to that of an articulated bus."""
_FIRST_ROUNDS, _FIRST_MIN_SCORE = 100, -0.02
"""A car that scores no higher by the first rounds is not part of a long vehicle, which is true of nine of ten. In four
simulated cities those that were part of one scored 0.047 and more."""
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

    @cached_property
    def scorer(self) -> OffsetScorer:
        """These at `OFFSETS`."""
        return OffsetScorer(self.stumps, OFFSETS, LONG)

    def scores(
        self, features: FeatureImage, xy: FloatArray, axes: FloatArray, rounds: int | None = None
    ) -> Float32Array:
        """Scores (n, offsets) of positions (n, 2), displaced by `OFFSETS` along their axes (n,), as a centre.

        By the first rounds alone where a number of them is given.
        """
        n = len(self.stumps) if rounds is None else min(rounds, len(self.stumps))
        return self.scorer.scores(features, xy, axes, contrast_floor=self.record.contrast_floor, rounds=n)

    def centre(self, features: FeatureImage, cars: FloatArray, valid: Mask, settled: Mask | None = None) -> FloatArray:
        """Cars (n, 2...) as x, y, axis, the best first: long vehicles at their centre, one detection each.

        Parameters
        ----------
        features
            Features of the image, at the scale `LONG`.
        valid
            (h, w) at that scale: where the frame covers the image; a vehicle whose centre is elsewhere stays where it
            was detected.
        settled
            (n,): cars that stay where they are.
        """
        tested = np.arange(len(cars)) if settled is None else np.flatnonzero(~settled)
        if not len(tested):
            return cars
        tested = tested[self._may_be_long(features, cars[tested])]
        if not len(tested):
            return cars
        scores = self.scores(features, cars[tested, :2], cars[tested, 2])
        offsets = OFFSETS[scores.argmax(axis=1)].astype(np.float64) * features.scale.step
        centres = cars[:, :2].copy()
        centres[tested] = offset_along_axis(cars[tested, :2], cars[tested, 2], offsets)
        long = np.zeros(len(cars), bool)
        step = features.scale.step
        inside = in_view((centres[tested] + 0.5) / step - 0.5, valid.shape, valid)
        long[tested] = (scores.max(axis=1) > self.record.threshold) & inside
        cars = np.column_stack([np.where(long[:, None], centres, cars[:, :2]), cars[:, 2:]])
        return np.asarray(cars[~self._is_covered(cars, long)])

    def confirm(self, features: FeatureImage, weak: FloatArray, valid: Mask) -> FloatArray:
        """Candidates (n, 4...) of x, y, axis, score that lie on a long vehicle, moved to its centre, one detection
        each; ``features`` and ``valid`` as of `centre`."""
        weak = weak[self._may_be_long(features, weak)]
        if not len(weak):
            return weak
        scores = self.scores(features, weak[:, :2], weak[:, 2])
        step = features.scale.step
        offsets = OFFSETS[scores.argmax(axis=1)].astype(np.float64) * step
        centres = offset_along_axis(weak[:, :2], weak[:, 2], offsets)
        best = scores.max(axis=1)
        inside = in_view((centres + 0.5) / step - 0.5, valid.shape, valid)
        long = (best > self.record.threshold) & inside
        rows = np.flatnonzero(long)[np.argsort(-best[long], kind="stable")]
        found = np.column_stack([centres[rows], weak[rows, 2:]])
        return np.asarray(found[~self._is_covered(found, np.ones(len(found), bool))])

    def _may_be_long(self, features: FeatureImage, cars: FloatArray) -> Mask:
        """Whether the first rounds leave it open that each car (n, 3...) is part of a long vehicle."""
        first = self.scores(features, cars[:, :2], cars[:, 2], rounds=_FIRST_ROUNDS)
        return np.asarray(first.max(axis=1) > min(_FIRST_MIN_SCORE, self.record.threshold))

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
    data = files("velfield.detection.long_vehicles").joinpath("shipped_long_vehicles.json").read_bytes()
    return LongVehicleClassifier(LongVehicleRecord.model_validate_json(data))


_features: WeakKeyDictionary[SearchableFrame, FeatureImage] = WeakKeyDictionary()


def _long_features(frame: SearchableFrame) -> FeatureImage:
    """Features of a frame at the scale `LONG`, made once: they are asked for twice."""
    found = _features.get(frame)
    if found is None:
        found = _features[frame] = features_of_reduced(frame.half_image, LONG)
    return found


def centre_long_vehicles(
    frame: SearchableFrame, cars: FloatArray, car_length_px: float, settled: Mask | None = None
) -> FloatArray:
    """Cars (n, 2...), suppressed already, with long vehicles at their centre; unchanged for cars of another length.

    Rows that are ``settled`` (n,) stay unchanged.
    """
    long = shipped_long_vehicles()
    if car_length_px != long.record.working_car_length_px or (settled is not None and settled.all()):
        return cars
    return long.centre(_long_features(frame), cars, frame.half_valid, settled)


def confirm_long_vehicles(
    frame: SearchableFrame, weak: Detections, cars: Detections, car_length_px: float
) -> Detections:
    """Lorries and buses among candidates that the detector is not sure of, at their centres; none on a car.

    A detector trained on cars scores a load, or a cab, below its threshold; the classifier of long vehicles sees the
    whole.
    """
    long = shipped_long_vehicles()
    if car_length_px != long.record.working_car_length_px or not len(weak):
        return weak.take(np.empty(0, np.int64))
    rows = long.confirm(_long_features(frame), weak.to_rows(), frame.half_valid)
    found = Detections.from_rows(rows[:, :5], rows[:, 5])
    on_car = np.zeros(len(found), bool)
    for k in range(len(found)):
        offset = cars.xy - found.xy[k]
        c, s = np.cos(found.orientation_rad[k]), np.sin(found.orientation_rad[k])
        along, across = np.abs(offset[:, 0] * c + offset[:, 1] * s), np.abs(offset[:, 1] * c - offset[:, 0] * s)
        on_car[k] = ((along < _BODY_ALONG * car_length_px) & (across < _BODY_ACROSS * car_length_px)).any()
    return found.take(np.flatnonzero(~on_car))


def suppress_and_centre(
    frame: SearchableFrame, found: Detections, kept: Detections | None, car_length_px: float
) -> Detections:
    """Non-maximum suppression of candidates and of detections kept from an earlier call; new long vehicles centred."""
    parts = [found] if kept is None else [found, kept]
    settled = np.arange(sum(map(len, parts))) >= len(found)
    rows = nms_oriented(np.column_stack([concatenate(parts).to_rows(), settled]), car_length_px)
    rows = centre_long_vehicles(frame, rows, car_length_px, rows[:, -1] > 0)
    return Detections.from_rows(rows[:, :5], rows[:, 5])
