"""Lorries and buses centred: in a simulated city that was not trained on, and the rules of suppression."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from velfield.bench.scenes import simulated_image
from velfield.detection.frame import half_resolution
from velfield.detection.long_vehicles.classifier import (
    LONG,
    OFFSETS,
    LongVehicleClassifier,
    shipped_long_vehicles,
)
from velfield.detection.long_vehicles.feature_image import FeatureImage, features_of_reduced
from velfield.detection.nms import offset_along_axis
from velfield.detection.samples import LabelledImage

SEED = 40
"""Not among those that the classifier was trained on: 9101 to 9224."""


@cache
def city() -> LabelledImage:
    return simulated_image(SEED, (1280, 960), 0.5)


def rows(xy: FloatArray, axes: FloatArray) -> FloatArray:
    """Detections, the best first."""
    return np.column_stack([xy, axes, np.linspace(0.9, 0.3, len(xy)), np.full(len(xy), 0.05)])


def alone(cars: FloatArray) -> FloatArray:
    """Vehicles well within the image, and so far from all others that detections on them are theirs."""
    gap = np.hypot(*(cars[:, None, :2] - cars[None, :, :2]).transpose(2, 0, 1)) + 1e9 * np.eye(len(cars))
    size = np.array(city().image.shape[::-1])
    within = (cars[:, :2] > 30).all(axis=1) & (cars[:, :2] < size - 30).all(axis=1)
    return np.asarray(cars[within & (gap.min(axis=1) > 30)])


@pytest.mark.parametrize("off_px", [-10.0, 0.0, 10.0])
def test_a_lorry_detected_at_its_load_or_cab_is_centred(off_px: float) -> None:
    cars = alone(city().cars)
    lorries = cars[cars[:, 3] > 26]
    assert len(lorries) >= 6
    xy = offset_along_axis(lorries[:, :2], lorries[:, 2], np.tile([off_px, 1.0], (len(lorries), 1)))
    centred = shipped_long_vehicles().centre(
        features_of_reduced(half_resolution(city().image), LONG), rows(xy, lorries[:, 2]), everywhere(city())
    )
    assert len(centred) == len(lorries)
    assert np.mean(np.hypot(*(centred[:, :2] - lorries[:, :2]).T) < 5) >= (1.0 if off_px == 0 else 0.7)


def test_cars_stay_where_they_were_detected() -> None:
    plain = simulated_image(SEED + 1, (960, 720))
    cars = plain.cars[plain.cars[:, 3] < 22]
    assert len(cars) >= 30
    found = rows(cars[:, :2], cars[:, 2])
    features = features_of_reduced(half_resolution(plain.image), LONG)
    centred = shipped_long_vehicles().centre(features, found, everywhere(plain))
    kept = {tuple(row) for row in centred[:, :2]}
    assert sum(tuple(row) not in kept for row in found[:, :2]) <= 0.02 * len(found)


def classifier_of(centres_px: FloatArray) -> LongVehicleClassifier:
    """A classifier that scores these positions (n, 2) as centres, and nothing else."""
    known = shipped_long_vehicles()

    class Given(LongVehicleClassifier):
        def scores(
            self, features: FeatureImage, xy: FloatArray, axes: FloatArray, rounds: int | None = None
        ) -> NDArray[np.float32]:
            there = np.stack(
                [offset_along_axis(xy, axes, np.tile(offset * 2.0, (len(xy), 1))) for offset in OFFSETS], axis=1
            )
            gap = np.hypot(*(there[:, :, None] - centres_px).transpose(3, 0, 1, 2)).min(axis=2)
            return np.where(gap < 1, 1.0, -1.0).astype(np.float32)

    return Given(known.record)


EVERYWHERE = np.ones((200, 200), bool)
"""At half the resolution, as the features are."""


def everywhere(sample: LabelledImage) -> NDArray[np.bool_]:
    return np.ones([-(-side // 2) for side in sample.image.shape], bool)


def blank() -> FeatureImage:
    return features_of_reduced(np.zeros((4, 4), np.uint8), LONG)


def test_two_detections_on_a_bus_become_one_and_a_car_behind_it_stays() -> None:
    xy = np.array([[90.0, 50.0], [108.0, 50.0], [60.0, 50.0], [100.0, 58.0]])  # load, cab, a car behind, one beside
    centred = classifier_of(np.array([[100.0, 50.0]])).centre(blank(), rows(xy, np.zeros(4)), EVERYWHERE)
    assert centred[:, :2].tolist() == [[100.0, 50.0], [60.0, 50.0], [100.0, 58.0]]
    assert centred[0, 3] == pytest.approx(0.9)


def test_a_car_is_not_moved_and_no_detections_give_none() -> None:
    xy = np.array([[90.0, 50.0], [100.0, 50.0]])
    centred = classifier_of(np.array([[300.0, 300.0]])).centre(blank(), rows(xy, np.zeros(2)), EVERYWHERE)
    assert centred[:, :2].tolist() == xy.tolist()
    assert shipped_long_vehicles().centre(blank(), np.empty((0, 5)), EVERYWHERE).shape == (0, 5)


def test_centres_are_searched_along_the_axis_in_both_directions() -> None:
    axes = np.array([np.pi / 2, np.radians(210)])
    centres = np.array([[50.0, 62.0], [300.0, 300.0]])
    xy = offset_along_axis(centres, axes, np.array([[-12.0, 0.0], [8.0, 0.0]]))
    centred = classifier_of(centres).centre(blank(), rows(xy, axes), EVERYWHERE)
    np.testing.assert_allclose(centred[:, :2], centres, atol=1e-9)


@pytest.mark.parametrize("centre", [(-7.0, 50.0), (50.0, 405.0), (150.0, 50.0)])
def test_a_vehicle_whose_centre_is_out_of_view_stays_where_it_was_detected(centre: tuple[float, float]) -> None:
    axis = np.array([0.0 if centre[1] == 50 else np.pi / 2])
    valid = EVERYWHERE.copy()
    valid[:, 75:] = False
    xy = np.array([centre]) + (12.0 if centre[0] < 0 else -12.0) * np.array([[np.cos(axis[0]), np.sin(axis[0])]])
    centred = classifier_of(np.array([centre])).centre(blank(), rows(xy, axis), valid)
    np.testing.assert_array_equal(centred[:, :2], xy)
