"""Oriented non-maximum suppression, the stages of the cascade, and its region proposals."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from velfield.detection.boosting import BoostedStumps
from velfield.detection.cascade.classifier import (
    PoseScorer,
    classify_proposals,
    in_view,
    nms_oriented,
    offset_along_axis,
    offset_grid,
    propose_regions,
)
from velfield.detection.cascade.feature_image import COARSE, compute_features
from velfield.detection.orientation import axial_difference

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
@settings(max_examples=50, deadline=None)
def test_suppression_keeps_some_of_the_rows_the_best_first_and_is_idempotent(seed: int, count: int) -> None:
    cars = crowd(seed, count)
    kept = nms_oriented(cars, LENGTH)
    assert {tuple(row) for row in kept} <= {tuple(row) for row in cars}
    assert np.all(np.diff(kept[:, 3]) < 0)
    assert kept[0].tolist() == cars[cars[:, 3].argmax()].tolist()
    np.testing.assert_array_equal(nms_oriented(kept, LENGTH), kept)


@given(SEEDS, st.integers(1, 40))
@settings(max_examples=40, deadline=None)
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
@settings(max_examples=40, deadline=None)
def test_suppression_moves_with_the_image(seed: int, count: int, angle: float, shift: float) -> None:
    cars = crowd(seed, count)
    c, s = np.cos(angle), np.sin(angle)
    moved = cars.copy()
    moved[:, :2] = cars[:, :2] @ np.array([[c, s], [-s, c]]) + shift
    moved[:, 2] += angle
    kept, kept_moved = (set(nms_oriented(rows, LENGTH)[:, 3]) for rows in (cars, moved))
    assert len(kept ^ kept_moved) <= 2  # a sample point on an edge may fall to either side


@given(SEEDS)
@settings(max_examples=40, deadline=None)
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


@given(SEEDS)
@settings(max_examples=20, deadline=None)
def test_offsets_are_along_and_across_the_axis(seed: int) -> None:
    rng = np.random.default_rng(seed)
    xy, angles, offsets = rng.uniform(-9, 9, (6, 2)), rng.uniform(-4, 4, 6), rng.uniform(-9, 9, (6, 2))
    moved = offset_along_axis(xy, angles, offsets) - xy
    axis = np.column_stack([np.cos(angles), np.sin(angles)])
    np.testing.assert_allclose((moved * axis).sum(axis=1), offsets[:, 0], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), np.linalg.norm(offsets, axis=1), atol=1e-9)


def test_a_grid_of_offsets() -> None:
    assert len(offset_grid(4, 4, 2)) == 25
    assert offset_grid(1, 0).tolist() == [[-1, 0], [0, 0], [1, 0]]


def bright_bar(along: int = 14, across: int = 7) -> BoostedStumps:
    """A classifier of bright bars of 16 x 8 px along the axis: their middle brighter than their sides and ends."""
    half_a, half_b = along // 2, across // 2
    rectangles = [
        (1, -half_a, -half_b, half_a, half_b),
        (-1, -half_a, half_b + 1, half_a, half_b + 1 + across),
        (1, -half_a, -half_b, half_a, half_b),
        (-1, -half_a, -half_b - 1 - across, half_a, -half_b - 1),
        (1, 0, -half_b, half_a, half_b),
        (-1, half_a + 1, -half_b, half_a + 1 + half_a, half_b),
        (1, -half_a, -half_b, 0, half_b),
        (-1, -half_a - 1 - half_a, -half_b, -half_a - 1, half_b),
    ]
    rectangles = [tuple(np.clip(r, [-1, -14, -11, -14, -11], [1, 14, 11, 14, 11])) for r in rectangles]
    thresholds = np.repeat([30.0, 80.0, 150.0], 4).astype(np.float32)
    table = np.array(rectangles * 3, np.int32)
    starts = np.arange(0, 25, 2, dtype=np.int32)
    leaves = np.tile(np.array([[-1.0, 1.0]], np.float32), (12, 1))
    return BoostedStumps(table, starts, np.zeros(12, np.int32), thresholds, leaves)


def road(bars: list[tuple[float, float, float]]) -> np.ndarray:
    """Bright bars of 16 x 8 px, blurred, on grey."""
    y, x = np.mgrid[:120, :160].astype(float)
    image = np.full((120, 160), 70.0)
    for bx, by, angle in bars:
        u = (x - bx) * np.cos(angle) + (y - by) * np.sin(angle)
        v = (y - by) * np.cos(angle) - (x - bx) * np.sin(angle)
        image += 130 / (1 + np.exp(2 * (np.abs(u) - 8))) / (1 + np.exp(2 * (np.abs(v) - 4)))
    return image.astype(np.uint8)


BARS = [(40.0, 40.0, 0.0), (100.0, 40.0, 0.6), (50.0, 90.0, 1.4), (120.0, 85.0, 2.5)]


def test_the_stages_refine_a_displaced_and_rotated_proposal() -> None:
    scorer = PoseScorer(compute_features(road(BARS)), bright_bar(), 12.0)
    proposals = np.array([[x + 2.0, y - 2.0, angle + np.radians(12)] for x, y, angle in BARS])
    cars = nms_oriented(classify_proposals(scorer, proposals, min_score=0.0), LENGTH)
    assert len(cars) == 4
    for x, y, angle in BARS:
        nearest = np.hypot(cars[:, 0] - x, cars[:, 1] - y).argmin()
        assert np.hypot(*(cars[nearest, :2] - [x, y])) < 2.0
        assert axial_difference(cars[nearest, 2], angle) < np.radians(20)
    assert (cars[:, 4] > 0).all()


def test_stages_reject_what_scores_too_low() -> None:
    scorer = PoseScorer(compute_features(road(BARS)), bright_bar(), 12.0)
    proposals = np.array([[x, y, angle] for x, y, angle in BARS])
    assert classify_proposals(scorer, proposals[:0], min_score=0.0).shape == (0, 5)
    assert classify_proposals(scorer, proposals, min_score=0.0, min_stage1_score=99.0).shape == (0, 5)
    assert classify_proposals(scorer, proposals, min_score=99.0).shape == (0, 5)
    empty = np.array([[80.0, 65.0, 0.0]])
    assert classify_proposals(scorer, empty, min_score=0.0).shape == (0, 5)


def coarse_bar() -> BoostedStumps:
    """The same classifier at half the resolution."""
    fine = bright_bar(8, 4)
    table = fine.rectangles.copy()
    table[:, 1:] = np.clip(table[:, 1:], [-10, -8, -10, -8], [10, 8, 10, 8])
    return BoostedStumps(table, fine.starts, fine.channels, fine.thresholds / 4, fine.leaves)


def test_every_bar_is_proposed_and_no_two_proposals_of_a_rotation_lie_close() -> None:
    image = road(BARS)
    proposals = propose_regions(
        compute_features(image, None, COARSE), image.shape, None, coarse_bar(), contrast_floor=12.0, min_score=0.0
    )
    assert np.all(np.diff(proposals[:, 3]) <= 0)
    for x, y, angle in BARS:
        near = (np.hypot(proposals[:, 0] - x, proposals[:, 1] - y) < 5) & (
            axial_difference(proposals[:, 2], np.full(len(proposals), angle)) < np.radians(35)
        )
        assert near.any()
    for angle in np.unique(proposals[:, 2]):
        xy = proposals[proposals[:, 2] == angle, :2]
        gap = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1)) + 99 * np.eye(len(xy))
        assert gap.min(initial=99) > 3


def test_proposals_keep_to_the_valid_part_and_to_their_number() -> None:
    image = road(BARS)
    coarse = compute_features(image, None, COARSE)
    valid = np.zeros(image.shape, bool)
    valid[:, :80] = True
    inside = propose_regions(coarse, image.shape, valid, coarse_bar(), contrast_floor=12.0)
    assert len(inside) > 0
    assert inside[:, 0].max() < 80.5
    few = propose_regions(coarse, image.shape, None, coarse_bar(), contrast_floor=12.0, per_megapixel=0)
    assert len(few) == 8


@pytest.mark.parametrize(
    ("xy", "expected"),
    [((0.0, 0.0), True), ((-0.4, -0.4), True), ((-0.6, 3.0), False), ((9.4, 5.4), True), ((9.6, 3.0), False)],
)
def test_positions_in_view(xy: tuple[float, float], *, expected: bool) -> None:
    assert in_view(np.array([xy]), (6, 10), None).tolist() == [expected]
    assert in_view(np.array([xy]), (6, 10), np.zeros((6, 10), bool)).tolist() == [False]
