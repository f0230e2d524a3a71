"""The network on a flight that nobody marked: what it asks of what moves and of what stands, against known mixtures."""

from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from schemas.arrays import FloatArray
from schemas.detector import CnnConfig, MotionRecord
from velfield.detection.cnn.inference import background_difference_at, motion_score_bonus
from velfield.detection.cnn.self_training import fit_motion_thresholds, self_train_from_motion, stationary_threshold
from velfield.detection.detect import detect_frame
from velfield.detection.evaluation import match_greedy
from velfield.detection.files import shipped_detector
from velfield.detection.motion.difference import MotionFrame, motion_background
from velfield.detection.motion.evaluation import MotionState
from velfield.detection.motion.labels import labels_from_motion
from velfield.detection.samples import LabelledImage
from velfield.synthetic import small_flight
from velfield.synthetic.cases import PINHOLE


def liked(cars: int, others: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """Scores of cars and of what is none, of one kind of scene."""
    rng = np.random.default_rng(seed)
    return rng.normal(0.2, 0.1, cars), rng.normal(-0.05, 0.08, others)


@pytest.mark.parametrize("seed", range(3))
def test_what_stands_is_held_to_what_tells_it_from_clutter(seed: int) -> None:
    moving, _ = liked(300, 0, seed)
    cars, clutter = liked(200, 3000, seed + 50)
    threshold = stationary_threshold(moving, np.concatenate([cars, clutter]))
    right, wrong = (cars > threshold).sum(), (clutter > threshold).sum()
    assert right / (right + wrong) > 0.7
    assert right / len(cars) > 0.5


def test_where_all_that_stands_is_cars_nearly_all_of_it_is_taken() -> None:
    moving, _ = liked(300, 0, 1)
    cars, _ = liked(400, 0, 2)
    assert (cars > stationary_threshold(moving, cars)).mean() > 0.85


def told(moves: int, alone: int, off: float = 40.0) -> tuple[FloatArray, NDArray[np.int8], FloatArray]:
    """Scores, conduct and difference to the background: what moves differs by ``off``, what stands by 5."""
    rng = np.random.default_rng(7)
    moving, false = liked(moves, alone, 3)
    cars, clutter = liked(moves // 2, 10 * moves, 4)
    score = np.concatenate([moving, false, cars, clutter])
    kind = np.repeat(
        [MotionState.MOVING, MotionState.ISOLATED, MotionState.STATIONARY], [moves, alone, len(cars) + len(clutter)]
    )
    differs = np.repeat([off, off, 5.0], [moves, alone, len(cars) + len(clutter)]) * rng.uniform(0.8, 1.2, len(score))
    return score, kind.astype(np.int8), differs


def test_what_moves_needs_to_be_liked_less() -> None:
    score, kind, differs = told(200, 60)
    chosen = fit_motion_thresholds(score, kind, differs)
    assert chosen is not None
    threshold, motion, curve = chosen
    lifted = score + motion_score_bonus(motion, differs)
    assert (lifted > threshold)[kind == MotionState.MOVING].mean() > 0.95
    assert motion.max_score_bonus > 0.05
    assert 5 < motion.bonus_ramp_start < motion.bonus_ramp_end < 40
    assert curve.threshold[curve.operating_point or 0] == pytest.approx(threshold, abs=0.02)
    assert curve.recall[curve.operating_point or 0] > 0.95


@pytest.mark.parametrize(("moves", "off"), [(39, 40.0), (200, 5.5)])
def test_without_enough_that_moves_and_differs_nothing_is_chosen(moves: int, off: float) -> None:
    assert fit_motion_thresholds(*told(moves, 10, off)) is None


def test_a_lift_grows_between_what_stands_and_what_moves() -> None:
    motion = MotionRecord(bonus_ramp_start=10, bonus_ramp_end=30, max_score_bonus=0.2)
    np.testing.assert_allclose(motion_score_bonus(motion, np.array([0.0, 10, 20, 30, 90])), [0, 0, 0.1, 0.2, 0.2])
    with pytest.raises(ValidationError, match="the ramp ends at 9 and starts at 10"):
        MotionRecord(bonus_ramp_start=10, bonus_ramp_end=9, max_score_bonus=0.2)


def test_the_difference_is_that_about_a_place() -> None:
    background = np.full((60, 80), 100, np.uint8)
    image = background.copy()
    image[20:41, 30:51] = 140
    near, far = background_difference_at(image, background, np.array([[40.0, 30.0], [5.0, 5.0]]), 16.0)
    assert near == pytest.approx(40, abs=0.5)
    assert far == pytest.approx(0, abs=0.1)


STILL = PINHOLE.model_copy(update={"drift_m": 0.0, "climb_share": 0.0, "turn_deg": 0.0, "tilt_deg": 0.0})


@cache
def flight() -> tuple[list[MotionFrame], list[FloatArray], NDArray[np.uint8]]:
    """Frames of a camera that hangs still, on the working grid, the cars in them, and the background."""
    made = small_flight(frames=15, width=960, height=720, seed=9601, camera=STILL)
    factor = 16.0 * made.config.gsd_m / CnnConfig().car_length_m
    frames, cars = [], []
    for k in range(15):
        image = np.asarray(
            cv2.resize(made.frame(k), None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA), np.uint8
        )
        frames.append(MotionFrame(image, np.ones(image.shape, bool), 0.2 * k))
        marked = made.labels(k)[["x_px", "y_px", "orientation_rad", "length_px", "width_px"]].to_numpy(copy=True)
        marked[:, :2] = (marked[:, :2] + 0.5) * factor - 0.5
        cars.append(marked)
    return frames, cars, motion_background(frames).median


def test_cars_that_stand_are_found_by_a_network_that_learnt_from_those_that_move() -> None:
    frames, cars, background = flight()
    labels = labels_from_motion(frames, motion_background(frames), car_length_px=16.0)
    samples = [
        LabelledImage(image=frame.image, background=background, cars=found.cars, ignore=found.ignore, complete=False)
        for frame, found in list(zip(frames, labels.frames, strict=True))[2:14:4]
        if found.labelled
    ]
    config = CnnConfig(fine_tune_steps=6)
    learnt = self_train_from_motion(samples, shipped_detector(), frames[3:12], background, config, max_interval_s=0.45)
    assert learnt is not None
    assert learnt.uses_background
    assert learnt.record.attribution == shipped_detector().record.attribution
    frame, known = frames[7], cars[7]
    found = detect_frame(frame.image, frame.valid, learnt, config, background)
    order = np.argsort(-found.score)
    right = match_greedy(np.column_stack([found.xy, found.orientation_rad, found.score])[order], known)
    assert right.mean() > 0.9
    differs = background_difference_at(frame.image, background, known[:, :2], 16.0)
    stands = differs < 0.3 * np.median(differs[differs > 15])
    near = np.hypot(*(known[:, None, :2] - found.xy[None]).transpose(2, 0, 1)).min(axis=1) < 8
    assert near[~stands].mean() > 0.9
    assert near[stands].mean() > 0.2
