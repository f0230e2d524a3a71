"""Precision and recall of a detector without labels: motion states of detections, thresholds, choice of bursts."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.arrays import FloatArray
from velfield.detection.motion.evaluation import (
    MotionEvaluation,
    MotionState,
    TimedDetections,
    classify_bursts,
    classify_motion,
    evaluate_by_motion,
    select_bursts,
)

LENGTH = 16.0


def detections(
    xy: FloatArray, score: FloatArray | float = 1.0, time_s: float = 0.0, axis: float = 0.0
) -> TimedDetections:
    n = len(xy)
    return TimedDetections(xy, np.full(n, axis), np.broadcast_to(np.asarray(score, float), n).copy(), time_s)


def states(*positions: FloatArray, axis: float = 0.0) -> list[int]:
    """States of the middle frame's detections; frames 0.2 s apart."""
    frames = [detections(xy, time_s=0.2 * k, axis=axis) for k, xy in enumerate(positions)]
    return classify_motion(*frames, car_length_px=LENGTH).tolist()


def test_detections_are_moving_stationary_or_isolated() -> None:
    moving, stationary = np.array([[50.0, 50.0], [50.0, 90.0]]), np.array([[200.0, 50.0]])
    across = np.array([[120.0, 150.0]])
    frames = []
    for k in range(3):
        along, aside = np.array([9 * k, 0]), np.array([0, 9 * k])
        frames.append(np.concatenate([moving + along, stationary, across + aside]))
    expected = [MotionState.MOVING, MotionState.MOVING, MotionState.STATIONARY, MotionState.ISOLATED]
    assert states(*frames) == expected


@settings(max_examples=30, deadline=None)
@given(st.floats(0, 2 * np.pi), st.floats(6, 25), st.floats(-500, 500), st.floats(-500, 500))
def test_a_state_does_not_depend_on_position_and_direction(angle: float, step: float, x: float, y: float) -> None:
    along = step * np.array([np.cos(angle), np.sin(angle)])
    across = step * np.array([-np.sin(angle), np.cos(angle)])
    path = [np.array([[x, y]]) + k * along for k in (-1, 0, 1)]
    assert states(*path, axis=angle % np.pi) == [MotionState.MOVING]
    path = [np.array([[x, y]]) + k * across for k in (-1, 0, 1)]
    assert states(*path, axis=angle % np.pi) == [MotionState.ISOLATED]


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        (-9.0, 9.0, MotionState.MOVING),
        (-9.0, 19.0, MotionState.ISOLATED),  # twice as far
        (-9.0, -9.0, MotionState.ISOLATED),  # and back
        (-1.0, 1.0, MotionState.STATIONARY),
        (-2.4, 2.4, MotionState.ISOLATED),  # neither
        (-2.9, 2.9, MotionState.MOVING),
        (-26.0, 26.0, MotionState.MOVING),
        (-29.0, 29.0, MotionState.ISOLATED),  # beyond the speed limit
    ],
)
def test_the_limits_of_the_states(before: float, after: float, expected: MotionState) -> None:
    positions = (np.array([[x, 50.0]]) for x in (100 + before, 100.0, 100 + after))
    assert states(*positions) == [expected]


def test_intervals_may_differ() -> None:
    frames = [detections(np.array([[100 + 60 * t, 50]]), time_s=t) for t in (0.0, 0.2, 0.6)]
    assert classify_motion(*frames, car_length_px=LENGTH).tolist() == [MotionState.MOVING]


def test_a_stationary_detection_missed_in_one_frame_is_not_isolated() -> None:
    nothing, parked = np.empty((0, 2)), np.array([[200.0, 50.0]])
    for before, after in ((parked, nothing), (nothing, parked + 1.0)):
        assert states(before, parked, after) == [MotionState.STATIONARY]
    assert states(nothing, parked, nothing) == [MotionState.ISOLATED]
    assert states(parked, nothing, parked) == []


def test_only_frames_with_neighbours_in_time_are_classified() -> None:
    times = [0.0, 0.2, 0.4, 5.0, 5.2, 5.4]
    frames = [detections(np.array([[50.0, 50.0]]), time_s=t) for t in times]
    middles, kinds = classify_bursts(frames, car_length_px=LENGTH, max_interval_s=0.45)
    assert middles == [1, 4]
    assert [kind.tolist() for kind in kinds] == [[MotionState.STATIONARY]] * 2


def test_the_threshold_keeps_the_cars_and_drops_chance_detections() -> None:
    rng = np.random.default_rng(4)
    cars = np.column_stack([rng.uniform(0, 900, 60), np.arange(60) * 16.0])
    frames = []
    for k in range(6):
        chance = rng.uniform(0, 960, (200, 2))
        score = np.concatenate([rng.normal(1.0, 0.2, 60), rng.normal(0.0, 0.2, 200)])
        frames.append(detections(np.concatenate([cars + np.array([11.0 * k, 0]), chance]), score, 0.2 * k))
    evaluation = evaluate_by_motion(frames, car_length_px=LENGTH)
    assert 0.35 < evaluation.operating_threshold < 0.75
    index = evaluation.operating_index
    assert abs(evaluation.thresholds[index] - evaluation.operating_threshold) < 0.02
    assert evaluation.precision[index] > 0.9
    assert evaluation.recall[index] > 0.85
    assert (np.diff(evaluation.thresholds) <= 0).all()
    assert (np.diff(evaluation.recall) >= 0).all()
    assert evaluation.recall[-1] == 1


def test_cars_missed_in_a_neighbouring_frame_are_no_false_positives() -> None:
    """One car in ten is missed in each frame: the rate among the detections of highest score is subtracted."""
    rng = np.random.default_rng(5)
    cars = np.column_stack([rng.uniform(0, 900, 60), np.arange(60) * 16.0])
    frames = []
    for k in range(9):
        kept = rng.random(60) < 0.9
        positions = cars[kept] + np.array([11.0 * k, 0])
        frames.append(detections(positions, rng.normal(1.0, 0.2, len(positions)), 0.2 * k))
    evaluation = evaluate_by_motion(frames, car_length_px=LENGTH)
    assert evaluation.precision[-1] > 0.93  # 0.79 of the moving and isolated detections move
    assert evaluation.operating_threshold < 0.9


def moving_and_stationary(stationary_scores: FloatArray) -> MotionEvaluation:
    """Sixty moving cars, with scores of about 0.3, among stationary detections of given scores."""
    rng = np.random.default_rng(6)
    cars = np.column_stack([rng.uniform(0, 900, 60), np.arange(60) * 16.0])
    n = len(stationary_scores)
    parked = np.column_stack([np.full(n, 2000.0), np.arange(n) * 30.0])
    score = np.concatenate([rng.normal(0.3, 0.05, 60), stationary_scores])
    frames = [detections(np.concatenate([cars + np.array([11.0 * k, 0]), parked]), score, 0.2 * k) for k in range(6)]
    return evaluate_by_motion(frames, car_length_px=LENGTH)


def test_appearance_is_sufficient_where_stationary_detections_score_as_high_as_moving_cars() -> None:
    rng = np.random.default_rng(7)
    assert moving_and_stationary(rng.normal(0.3, 0.05, 120)).appearance_is_sufficient(0.3)
    assert moving_and_stationary(np.empty(0)).appearance_is_sufficient(0.3)
    assert not moving_and_stationary(rng.uniform(0.15, 0.29, 3000)).appearance_is_sufficient(0.3)


def test_appearance_is_not_sufficient_below_a_score_of_zero_or_at_low_precision() -> None:
    good = moving_and_stationary(np.empty(0))
    assert not replace(good, operating_threshold=-0.01).appearance_is_sufficient(0.3)
    assert not replace(good, operating_threshold=float("nan")).appearance_is_sufficient(0.3)
    assert not replace(good, precision=0.84 * good.precision).appearance_is_sufficient(0.3)
    assert not replace(good, recall=0.84 * good.recall).appearance_is_sufficient(0.3)


def test_stationary_scores_are_those_of_the_stationary_detections() -> None:
    evaluation = moving_and_stationary(np.array([0.7, 0.8]))
    assert sorted(set(evaluation.stationary_scores)) == [0.7, 0.8]
    assert len(evaluation.stationary_scores) == 4 * 2


def test_without_motion_there_is_no_evaluation() -> None:
    frames = [detections(np.array([[50.0, 50.0]]), time_s=0.2 * k) for k in range(4)]
    assert np.isnan(evaluate_by_motion(frames, car_length_px=LENGTH).operating_threshold)
    empty = [detections(np.empty((0, 2)), time_s=0.2 * k) for k in range(3)]
    assert np.isnan(evaluate_by_motion(empty, car_length_px=LENGTH).operating_threshold)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.sampled_from([0.2, 0.4, 3.0]), min_size=3, max_size=40), st.integers(1, 8))
def test_bursts_are_three_neighbours_each(gaps: list[float], count: int) -> None:
    times = np.cumsum([0.0, *gaps])
    chosen = select_bursts(times.tolist(), count)
    possible = {k for k in range(len(gaps) - 1) if max(gaps[k], gaps[k + 1]) <= 0.45}
    assert len(chosen) <= 3 * count
    assert (len(chosen) > 0) == bool(possible)
    assert set(chosen.tolist()) <= {k + j for k in possible for j in range(3)}
    for frame in chosen:
        assert any({k, k + 1, k + 2} <= set(chosen.tolist()) for k in possible if k <= frame <= k + 2)
