"""Oriented non-maximum suppression."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from velfield.detection.nms import nms_oriented

LENGTH = 16.0
SEEDS = st.integers(0, 2**32 - 1)


def crowd(seed: int, count: int, side: float = 80.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack(
        [rng.uniform(0, side, (count, 2)), rng.uniform(0, np.pi, count), rng.permutation(count), np.full(count, 0.1)]
    )


def test_the_gap_between_two_cars_of_a_queue_is_suppressed() -> None:
    queue = np.array([[20.0, 40.0, 0.0, 0.9, 0.1], [38.0, 40.0, 0.0, 0.8, 0.1], [29.0, 40.5, 0.0, 0.7, 0.1]])
    beside = np.array([[20.0, 49.0, 0.0, 0.5, 0.1], [56.0, 40.0, 0.1, 0.4, 0.1]])
    assert nms_oriented(np.concatenate([queue, beside]), LENGTH)[:, 3].tolist() == [0.9, 0.8, 0.5, 0.4]


def test_of_two_detections_of_a_car_the_better_one_stays() -> None:
    cars = np.array([[20.0, 40.0, 0.0, 0.3, 0.1], [23.0, 41.0, 0.2, 0.8, 0.1]])
    assert nms_oriented(cars, LENGTH)[:, 3].tolist() == [0.8]
    assert nms_oriented(np.empty((0, 5)), LENGTH).shape == (0, 5)


@given(SEEDS, st.integers(1, 60))
@settings(max_examples=50)
def test_suppression_keeps_some_of_the_rows_the_best_first_and_is_idempotent(seed: int, count: int) -> None:
    cars = crowd(seed, count)
    kept = nms_oriented(cars, LENGTH)
    assert {tuple(row) for row in kept} <= {tuple(row) for row in cars}
    assert np.all(np.diff(kept[:, 3]) < 0)
    assert kept[0].tolist() == cars[cars[:, 3].argmax()].tolist()
    np.testing.assert_array_equal(nms_oriented(kept, LENGTH), kept)


@given(SEEDS, st.integers(1, 40))
@settings(max_examples=40)
def test_suppression_does_not_depend_on_the_order_of_rows_or_the_direction_along_the_axis(
    seed: int, count: int
) -> None:
    cars = crowd(seed, count)
    rng = np.random.default_rng(seed)
    kept = nms_oriented(cars, LENGTH)
    np.testing.assert_array_equal(nms_oriented(rng.permutation(cars), LENGTH), kept)
    reversed_axes = cars + np.where(rng.random(count) < 0.5, np.pi, 0)[:, None] * [0, 0, 1, 0, 0]
    assert nms_oriented(reversed_axes, LENGTH)[:, 3].tolist() == kept[:, 3].tolist()


@given(SEEDS, st.integers(1, 40), st.floats(0, 2 * np.pi), st.floats(-50, 50))
@settings(max_examples=40)
def test_suppression_moves_with_the_image(seed: int, count: int, angle: float, shift: float) -> None:
    cars = crowd(seed, count)
    c, s = np.cos(angle), np.sin(angle)
    moved = cars.copy()
    moved[:, :2] = cars[:, :2] @ np.array([[c, s], [-s, c]]) + shift
    moved[:, 2] += angle
    kept, kept_moved = (set(nms_oriented(rows, LENGTH)[:, 3]) for rows in (cars, moved))
    assert len(kept ^ kept_moved) <= 2  # a sample point on an edge may fall to either side


@given(SEEDS)
@settings(max_examples=40)
def test_no_two_kept_centres_lie_within_the_ellipse_of_the_better_one(seed: int) -> None:
    kept = nms_oriented(crowd(seed, 60), LENGTH)
    for j in range(len(kept)):
        d = kept[j + 1 :, :2] - kept[j, :2]
        c, s = np.cos(kept[j, 2]), np.sin(kept[j, 2])
        u, v = d[:, 0] * c + d[:, 1] * s, d[:, 1] * c - d[:, 0] * s
        assert ((u / (0.66 * LENGTH)) ** 2 + (v / (0.4 * LENGTH)) ** 2 >= 1).all()


def test_cars_that_do_not_touch_are_all_kept() -> None:
    grid = np.stack(np.meshgrid(np.arange(5) * 20.0, np.arange(5) * 12.0), axis=-1).reshape(-1, 2)
    cars = np.column_stack([grid, np.zeros(25), np.linspace(1, 0.1, 25), np.full(25, 0.1)])
    assert len(nms_oriented(cars, LENGTH)) == 25
