"""Lorries and buses brought to their middle: in a simulated city that was not trained on, and the rules of a place."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from tools.shipped_detector import LORRY_SEEDS, LORRY_SEEDS_HELD_OUT
from velfield.bench.scenes import simulated_image
from velfield.detection.cascade.classifier import moved
from velfield.detection.cascade.feature_image import Picture, picture_of
from velfield.detection.cascade.long_vehicles import LONG, OFFSETS, LongVehicles, shipped_long_vehicles
from velfield.detection.samples import LabelledImage

SEED = 40
assert SEED not in LORRY_SEEDS
assert SEED not in LORRY_SEEDS_HELD_OUT


@cache
def city() -> LabelledImage:
    return simulated_image(SEED, (1280, 960), 0.5)


def rows(xy: FloatArray, axes: FloatArray) -> FloatArray:
    """Finds, the best first."""
    return np.column_stack([xy, axes, np.linspace(0.9, 0.3, len(xy)), np.full(len(xy), 0.05)])


def alone(cars: FloatArray) -> FloatArray:
    """Vehicles that lie well within the picture, and so far from all others that finds on them are theirs."""
    gap = np.hypot(*(cars[:, None, :2] - cars[None, :, :2]).transpose(2, 0, 1)) + 1e9 * np.eye(len(cars))
    size = np.array(city().image.shape[::-1])
    within = (cars[:, :2] > 30).all(axis=1) & (cars[:, :2] < size - 30).all(axis=1)
    return np.asarray(cars[within & (gap.min(axis=1) > 30)])


@pytest.mark.parametrize("off_px", [-10.0, 0.0, 10.0])
def test_a_lorry_found_at_its_load_or_cab_is_told_at_its_middle(off_px: float) -> None:
    cars = alone(city().cars)
    lorries = cars[cars[:, 3] > 26]
    assert len(lorries) >= 6
    xy = moved(lorries[:, :2], lorries[:, 2], np.tile([off_px, 1.0], (len(lorries), 1)))
    told = shipped_long_vehicles().centred(
        picture_of(city().image, None, LONG), rows(xy, lorries[:, 2]), everywhere(city())
    )
    assert len(told) == len(lorries)
    assert np.mean(np.hypot(*(told[:, :2] - lorries[:, :2]).T) < 5) >= (1.0 if off_px == 0 else 0.7)


def test_cars_stay_where_they_were_found() -> None:
    plain = simulated_image(SEED + 1, (960, 720))
    cars = plain.cars[plain.cars[:, 3] < 22]
    assert len(cars) >= 30
    found = rows(cars[:, :2], cars[:, 2])
    told = shipped_long_vehicles().centred(picture_of(plain.image, None, LONG), found, everywhere(plain))
    kept = {tuple(row) for row in told[:, :2]}
    assert sum(tuple(row) not in kept for row in found[:, :2]) <= 0.02 * len(found)


def liking(places_px: FloatArray) -> LongVehicles:
    """A classifier that sees a middle at these places (n, 2), and nowhere else."""
    known = shipped_long_vehicles()

    class Told(LongVehicles):
        def scores(self, picture: Picture, xy: FloatArray, axes: FloatArray) -> NDArray[np.float32]:
            there = np.stack([moved(xy, axes, np.tile(offset * 2.0, (len(xy), 1))) for offset in OFFSETS], axis=1)
            gap = np.hypot(*(there[:, :, None] - places_px).transpose(3, 0, 1, 2)).min(axis=2)
            return np.where(gap < 1, 1.0, -1.0).astype(np.float32)

    return Told(known.record, known.sums)


SEEN = np.ones((400, 400), bool)


def everywhere(sample: LabelledImage) -> NDArray[np.bool_]:
    return np.ones(sample.image.shape, bool)


def picture() -> Picture:
    return picture_of(np.zeros((8, 8), np.uint8), None, LONG)


def test_two_finds_on_a_bus_are_one_and_a_car_behind_it_stays() -> None:
    xy = np.array([[90.0, 50.0], [108.0, 50.0], [60.0, 50.0], [100.0, 58.0]])  # load, cab, a car behind, one beside
    told = liking(np.array([[100.0, 50.0]])).centred(picture(), rows(xy, np.zeros(4)), SEEN)
    assert told[:, :2].tolist() == [[100.0, 50.0], [60.0, 50.0], [100.0, 58.0]]
    assert told[0, 3] == pytest.approx(0.9)


def test_what_is_not_long_is_not_moved_and_nothing_gives_nothing() -> None:
    xy = np.array([[90.0, 50.0], [100.0, 50.0]])
    told = liking(np.array([[300.0, 300.0]])).centred(picture(), rows(xy, np.zeros(2)), SEEN)
    assert told[:, :2].tolist() == xy.tolist()
    assert shipped_long_vehicles().centred(picture(), np.empty((0, 5)), SEEN).shape == (0, 5)


def test_a_middle_is_looked_for_along_the_axis_whichever_way_it_points() -> None:
    axes = np.array([np.pi / 2, np.radians(210)])
    middles = np.array([[50.0, 62.0], [300.0, 300.0]])
    xy = moved(middles, axes, np.array([[-12.0, 0.0], [8.0, 0.0]]))
    told = liking(middles).centred(picture(), rows(xy, axes), SEEN)
    np.testing.assert_allclose(told[:, :2], middles, atol=1e-9)


@pytest.mark.parametrize("middle", [(-7.0, 50.0), (50.0, 405.0), (150.0, 50.0)])
def test_what_has_its_middle_out_of_sight_stays_where_it_was_found(middle: tuple[float, float]) -> None:
    axis = np.array([0.0 if middle[1] == 50 else np.pi / 2])
    seen = SEEN.copy()
    seen[:, 150:] = False
    xy = np.array([middle]) + (12.0 if middle[0] < 0 else -12.0) * np.array([[np.cos(axis[0]), np.sin(axis[0])]])
    told = liking(np.array([middle])).centred(picture(), rows(xy, axis), seen)
    np.testing.assert_array_equal(told[:, :2], xy)
