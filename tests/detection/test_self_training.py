"""Self-training on a flight without labels: thresholds from known mixtures of scores, and a simulated flight."""

from functools import cache

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import ValidationError

from schemas.arrays import FloatArray
from schemas.detector import CnnConfig, MotionRecord
from velfield.detection.cnn.fine_tuning import fine_tune_interpolated
from velfield.detection.cnn.model import background_difference_at, motion_score_bonus
from velfield.detection.cnn.self_training import fit_motion_thresholds, self_train_from_motion, stationary_threshold
from velfield.detection.detect import detect_frame
from velfield.detection.detector import shipped_detector
from velfield.detection.evaluation import match_greedy
from velfield.detection.motion.difference import MotionFrame, motion_background
from velfield.detection.motion.evaluation import MotionState
from velfield.detection.motion.labels import labels_from_motion
from velfield.detection.samples import LabelledImage
from velfield.synthetic import small_flight
from velfield.synthetic.cases import PINHOLE


def scores(cars: int, others: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """Scores of cars and of other objects."""
    rng = np.random.default_rng(seed)
    return rng.normal(0.2, 0.1, cars), rng.normal(-0.05, 0.08, others)


@pytest.mark.parametrize("seed", range(3))
def test_the_stationary_threshold_separates_cars_from_clutter(seed: int) -> None:
    moving, _ = scores(300, 0, seed)
    cars, clutter = scores(200, 3000, seed + 50)
    threshold = stationary_threshold(moving, np.concatenate([cars, clutter]))
    true_positives, false_positives = (cars > threshold).sum(), (clutter > threshold).sum()
    assert true_positives / (true_positives + false_positives) > 0.7
    assert true_positives / len(cars) > 0.5


def test_where_all_stationary_detections_are_cars_almost_all_pass() -> None:
    moving, _ = scores(300, 0, 1)
    cars, _ = scores(400, 0, 2)
    assert (cars > stationary_threshold(moving, cars)).mean() > 0.85
    assert stationary_threshold(moving, np.empty(0)) == moving.min()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.floats(-0.3, 0.3))
def test_the_stationary_threshold_shifts_with_the_scores(seed: int, shift: float) -> None:
    moving, _ = scores(100, 0, seed)
    stationary = np.concatenate(scores(50, 400, seed + 1))
    threshold = stationary_threshold(moving, stationary)
    assert moving.min() <= threshold <= moving.max()
    assert stationary_threshold(moving + shift, stationary + shift) == pytest.approx(threshold + shift, abs=1e-9)


def mixture(moving: int, isolated: int, grey: float = 40.0) -> tuple[FloatArray, NDArray[np.int8], FloatArray]:
    """Scores, states and differences to the background: moving and isolated detections differ by ``grey``, others by
    5."""
    rng = np.random.default_rng(7)
    cars, false = scores(moving, isolated, 3)
    parked, clutter = scores(moving // 2, 10 * moving, 4)
    score = np.concatenate([cars, false, parked, clutter])
    counts = [moving, isolated, len(parked) + len(clutter)]
    state = np.repeat([MotionState.MOVING, MotionState.ISOLATED, MotionState.STATIONARY], counts)
    difference = np.repeat([grey, grey, 5.0], counts) * rng.uniform(0.8, 1.2, len(score))
    return score, state.astype(np.int8), difference


def test_foreground_detections_need_a_lower_score() -> None:
    score, state, difference = mixture(200, 60)
    fitted = fit_motion_thresholds(score, state, difference)
    assert fitted is not None
    threshold, motion, curve = fitted
    with_bonus = score + motion_score_bonus(motion, difference)
    assert (with_bonus > threshold)[state == MotionState.MOVING].mean() > 0.95
    assert motion.max_score_bonus > 0.05
    assert 5 < motion.bonus_ramp_start < motion.bonus_ramp_end < 40
    assert curve.threshold[curve.operating_point or 0] == pytest.approx(threshold, abs=0.02)
    assert curve.recall[curve.operating_point or 0] > 0.95


@pytest.mark.parametrize(("moving", "grey"), [(39, 40.0), (200, 5.5)])
def test_too_little_motion_or_contrast_gives_no_thresholds(moving: int, grey: float) -> None:
    assert fit_motion_thresholds(*mixture(moving, 10, grey)) is None


def test_thresholds_do_not_depend_on_the_order_of_detections() -> None:
    parts = mixture(100, 30)
    order = np.random.default_rng(0).permutation(len(parts[0]))
    fitted, shuffled = (fit_motion_thresholds(*rows) for rows in (parts, [part[order] for part in parts]))
    assert fitted is not None
    assert shuffled is not None
    assert shuffled[0] == pytest.approx(fitted[0])
    assert shuffled[1] == fitted[1]


def test_a_ramp_ends_above_its_start() -> None:
    with pytest.raises(ValidationError, match="the ramp ends at 9 and starts at 10"):
        MotionRecord(bonus_ramp_start=10, bonus_ramp_end=9, max_score_bonus=0.2)


STATIC_CAMERA = PINHOLE.model_copy(update={"drift_m": 0.0, "climb_share": 0.0, "turn_deg": 0.0, "tilt_deg": 0.0})


@cache
def flight() -> tuple[list[MotionFrame], list[FloatArray], NDArray[np.uint8]]:
    """Frames of a static camera on the working grid, the cars in them, and the background."""
    made = small_flight(frames=15, width=960, height=720, seed=9601, camera=STATIC_CAMERA)
    factor = 16.0 * made.config.gsd_m / CnnConfig().car_length_m
    frames, cars = [], []
    for k in range(15):
        image = np.asarray(
            cv2.resize(made.frame(k), None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA), np.uint8
        )
        frames.append(MotionFrame(image, np.ones(image.shape, bool), 0.2 * k))
        truth = made.labels(k)[["x_px", "y_px", "orientation_rad", "length_px", "width_px"]].to_numpy(copy=True)
        truth[:, :2] = (truth[:, :2] + 0.5) * factor - 0.5
        cars.append(truth)
    return frames, cars, motion_background(frames).median


@cache
def samples() -> list[LabelledImage]:
    frames, _, background = flight()
    labels = labels_from_motion(frames, motion_background(frames), car_length_px=16.0)
    return [
        LabelledImage(image=frame.image, background=background, cars=label.cars, ignore=label.ignore, complete=False)
        for frame, label in list(zip(frames, labels.frames, strict=True))[2:14:4]
        if label.labelled
    ]


def test_stationary_cars_are_detected_after_training_on_moving_ones() -> None:
    frames, cars, background = flight()
    config = CnnConfig(fine_tune_steps=6)
    adapted = self_train_from_motion(
        samples(), shipped_detector(), frames[3:12], background, config, max_interval_s=0.45
    )
    assert adapted is not None
    assert adapted.uses_background
    assert adapted.record.attribution == shipped_detector().record.attribution
    frame, truth = frames[7], cars[7]
    found = detect_frame(frame.image, frame.valid, adapted, background)
    order = np.argsort(-found.score)
    correct = match_greedy(np.column_stack([found.xy, found.orientation_rad, found.score])[order], truth)
    assert correct.mean() > 0.9
    difference = background_difference_at(frame.image, background, truth[:, :2], 16.0)
    stationary = difference < 0.3 * np.median(difference[difference > 15])
    detected = np.hypot(*(truth[:, None, :2] - found.xy[None]).transpose(2, 0, 1)).min(axis=1) < 8
    assert detected[~stationary].mean() > 0.9
    assert detected[stationary].mean() > 0.2


def test_interpolated_weights_lie_between_those_before_and_after_fine_tuning() -> None:
    pretrained, config = shipped_detector(), CnnConfig(fine_tune_steps=2)
    before, half, after = (
        fine_tune_interpolated(samples()[:1], pretrained, config, fraction=fraction) for fraction in (0.0, 0.5, 1.0)
    )
    for name, weights in pretrained.network.weights.items():
        np.testing.assert_array_equal(before.weights[name], weights)
        assert not np.array_equal(after.weights[name], weights)
        np.testing.assert_allclose(half.weights[name], (before.weights[name] + after.weights[name]) / 2, atol=1e-7)
        np.testing.assert_allclose(half.biases[name], (before.biases[name] + after.biases[name]) / 2, atol=1e-7)
