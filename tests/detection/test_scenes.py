"""Training samples of the cascade: negatives that are none of the cars, mining, realignment."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from schemas.detector import CascadeTraining
from velfield.detection.boosting import BoostedStumps
from velfield.detection.cascade.classifier import PoseScorer
from velfield.detection.cascade.scenes import (
    BACKGROUND_PX,
    OFF_CENTRE_PX,
    WRONG_ROTATION_RAD,
    TrainingScene,
    augment_poses,
    dog_extrema,
    is_background,
    is_false_positive,
    make_scene,
    restrict_scene,
    sample_negatives,
)
from velfield.detection.cascade.training import (
    CONTRAST_FLOOR,
    filter_ambiguous_negatives,
    mine_hard_negatives,
    realign_positives,
    train_classifier,
)
from velfield.detection.orientation import axial_difference
from velfield.detection.samples import LabelledImage, distance_to_nearest_car

ANGLES = np.radians([0.0, 30.0, 60.0, 90.0, 120.0, 150.0])


@cache
def sample() -> LabelledImage:
    """Bright bars in rows on a noisy ground, each row at an angle."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:220, :260].astype(float)
    image, cars = rng.normal(80, 6, (220, 260)), []
    for row, angle in enumerate(ANGLES):
        for column in range(6):
            cx, cy = 25.0 + 40 * column, 20.0 + 35 * row
            u = (x - cx) * np.cos(angle) + (y - cy) * np.sin(angle)
            v = (y - cy) * np.cos(angle) - (x - cx) * np.sin(angle)
            image += 110 / (1 + np.exp(2 * (np.abs(u) - 8))) / (1 + np.exp(2 * (np.abs(v) - 3.6)))
            cars.append([cx, cy, angle, 16.0, 7.2])
    return LabelledImage(image=np.clip(image, 0, 255).astype(np.uint8), cars=np.array(cars))


@cache
def scene() -> TrainingScene:
    return make_scene(sample(), has_background=False)


@cache
def classifier() -> BoostedStumps:
    config = CascadeTraining(rounds=40, feature_pool=200)
    rounds, _ = train_classifier([scene()], config, 3, np.random.default_rng(0))
    return BoostedStumps.from_rounds(rounds)


def test_negatives_are_no_cars_in_the_right_pose() -> None:
    poses = sample_negatives(scene(), 2000, np.random.default_rng(1))
    assert 1000 < len(poses) <= 2000
    cars = scene().cars
    gap = np.hypot(poses.rows[:, None, 0] - cars[:, 0], poses.rows[:, None, 1] - cars[:, 1])
    nearest = gap.argmin(axis=1)
    turned = axial_difference(poses.rows[:, 2], cars[nearest, 2])
    on_a_car = gap.min(axis=1) < OFF_CENTRE_PX[0]
    # Rotated cars: hardly displaced, and off by more than the limit; all others away from every centre.
    assert (turned[on_a_car] > WRONG_ROTATION_RAD - 1e-9).all()
    assert on_a_car.mean() > 0.05
    assert (~on_a_car).mean() > 0.5


def test_negatives_of_a_scene_without_cars_lie_anywhere() -> None:
    empty = restrict_scene(scene(), np.zeros((220, 260), bool))
    assert len(empty.cars) == len(empty.proposals) == 0
    blank = replace(empty, sample=replace(empty.sample, valid=None))
    assert len(sample_negatives(blank, 100, np.random.default_rng(0))) == 15


def test_background_is_away_from_cars_and_from_what_is_ignored() -> None:
    rng = np.random.default_rng(2)
    circles = np.array([[60.0, 60.0, 12.0], [200.0, 150.0, 4.0]])
    ignoring = replace(scene(), sample=replace(sample(), ignore=circles))
    xy = rng.uniform([0, 0], [259, 219], (600, 2))
    expected = [
        distance_to_nearest_car(row[None], ignoring.cars)[0] > BACKGROUND_PX
        and all(np.hypot(row[0] - x, row[1] - y) - radius > BACKGROUND_PX / 2 for x, y, radius in circles)
        for row in xy
    ]
    assert is_background(xy, ignoring).tolist() == expected
    assert is_background(xy, scene()).sum() > sum(expected)


def test_a_detection_across_a_car_is_a_false_positive_and_one_along_it_is_not() -> None:
    x, y, angle = scene().cars[0]
    rows = np.array([[x, y, angle], [x, y, angle + np.pi / 2], [x + 2, y, angle + 0.2], [x + 20, y, angle]])
    assert is_false_positive(rows, scene()).tolist() == [False, True, False, True]
    assert is_false_positive(rows[:0], scene()).tolist() == []


def test_augmentation_keeps_position_and_axis() -> None:
    rows = scene().cars
    poses = augment_poses(rows, np.random.default_rng(0))
    np.testing.assert_array_equal(poses.rows[:, :2], rows[:, :2])
    assert axial_difference(poses.rows[:, 2], rows[:, 2]).max() < 1e-9
    assert 0 < poses.mirrored.sum() < len(rows)
    assert 0.7 < poses.sizes.min() < poses.sizes.max() < 1.4
    assert len(poses[:3]) == len(poses.where(np.arange(len(rows)) < 3)) == 3


def test_extrema_of_the_difference_of_gaussians_lie_on_bars_bright_or_dark() -> None:
    for image in (sample().image, 255 - sample().image):
        strongest = dog_extrema(np.asarray(image, np.uint8))[:30]
        assert np.median(distance_to_nearest_car(strongest, scene().cars)) < 8
    assert len(dog_extrema(sample().image, per_megapixel=200)) == int(200 * 220 * 260 / 1e6) + 1
    nowhere = dog_extrema(sample().image, np.zeros((220, 260), bool))
    assert nowhere.shape == (0, 2)


def test_missing_orientations_are_filled_and_remembered_as_missing() -> None:
    cars = sample().cars.copy()
    cars[::2, 2] = np.nan
    filled = make_scene(replace(sample(), cars=cars), has_background=False)
    assert filled.has_orientation.tolist() == [bool(k % 2) for k in range(36)]
    assert np.degrees(axial_difference(filled.cars[:, 2], sample().cars[:, 2])).max() < 12


@pytest.mark.parametrize("off_deg", [-16.0, 16.0])
def test_a_trained_classifier_realigns_cars_labelled_without_orientation(off_deg: float) -> None:
    cars = scene().cars.copy()
    cars[:, 2] += np.radians(off_deg)
    latent = replace(scene(), cars=cars, has_orientation=np.zeros(36, bool))
    aligned = realign_positives(latent, classifier())
    before, after = (np.degrees(axial_difference(of.cars[:, 2], scene().cars[:, 2])) for of in (latent, aligned))
    assert np.median(after) < 0.6 * np.median(before)
    assert np.hypot(*(aligned.cars[:, :2] - scene().cars[:, :2]).T).max() < 2
    assert realign_positives(scene(), classifier()) is scene()  # labelled orientations stay


def test_mined_negatives_are_false_positives_the_hardest_first() -> None:
    mined = mine_hard_negatives(scene(), classifier(), 50)
    assert len(mined) <= 50
    assert is_false_positive(mined, scene()).all()
    assert np.all(np.diff(mined[:, 3]) <= 0)


def test_of_an_incompletely_labelled_image_what_scores_like_a_car_is_no_negative() -> None:
    """Every second bar is not labelled; the classifier gives it a car's score."""
    half = replace(scene(), cars=scene().cars[::2], sample=replace(sample(), cars=sample().cars[::2], complete=False))
    scorer = PoseScorer(half.fine, classifier(), CONTRAST_FLOOR)
    unlabelled = scene().cars[1::2]
    zero = np.zeros((1, 2), np.int64)
    score = scorer.scores(unlabelled[:, :2], unlabelled[:, 2], np.zeros(1), zero)[:, 0, 0]
    rows = np.column_stack([unlabelled, score.astype(np.float64)])
    false = is_false_positive(rows, half)
    assert false.all()
    kept = filter_ambiguous_negatives(rows, false, half, scorer)
    assert len(kept) < 0.5 * len(rows)
    complete = replace(half, sample=replace(half.sample, complete=True))
    assert len(filter_ambiguous_negatives(rows, false, complete, scorer)) == len(rows)
