"""Trains the classifier of long vehicles (see `long_vehicles`) by boosting with hard-negative mining."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import numpy as np
from velfield.detection.cascade.classifier import (
    LONG,
    MIN_LENGTH_RATIO,
    OFFSETS,
    LongVehicleClassifier,
    offset_along_axis,
)
from velfield.detection.cascade.feature_image import FeatureImage, compute_features, score_poses
from velfield.detection.cascade.feature_matrix import FeatureBinner, fit_feature_binner
from velfield.detection.cascade.scenes import Poses, augment_poses
from velfield.detection.cascade.training import CONTRAST_FLOOR

from schemas.arrays import ByteArray, FloatArray
from schemas.detector import DetectorConfig, LongVehicleRecord, Round
from velfield.detection.boosting import BoostedStumps, draw_feature_pool
from velfield.detection.samples import LabelledImage
from velfield.parallel import parallel_map

ROUNDS = 800
_MINING_ROUNDS = (80, 160)
"""Rounds of boosting before each mining of hard negatives."""
_POOL_SIZE, _MAX_RECTANGLES = 4000, 2
_CORNER_SIGMA_PX = (7.0, 3.0)
_SHRINKAGE, _FRACTION = 0.5, 0.3
_POSITIVE_COPIES, _OFF_CENTRE_COPIES, _CAR_SAMPLES = 6, 10, 27_000
_ACROSS_SD_PX, _ROTATION_SD_RAD = 1.3, 0.08
"""Error of a detection of the first classifier: across the vehicle's axis, and in orientation."""
_CENTRE_SD_PX, _OFF_CENTRE_PX, _OFF_CAR_PX = 1.2, (4.0, 20.0), (2.0, 20.0)
_DETECTION_REACH_PX, _CAR_DETECTION_REACH_PX = 9.0, 2.0
"""How far along its axis a long vehicle, or a car, may be detected off its centre."""
_MINING_MIN_SCORE, _MINING_MIN_DISTANCE_PX = -0.05, 4.0
_FALSE_POSITIVE_RATE = 0.0005
"""Maximum fraction of held-out cars that are taken for part of a long vehicle."""


_Detections: TypeAlias = tuple[FloatArray, FloatArray]
"""Poses, and the pose of the vehicle each belongs to."""


@dataclass(frozen=True)
class _Scene:
    image: FeatureImage
    long: FloatArray
    cars: FloatArray


def train_long_vehicles(
    samples: Sequence[LabelledImage],
    held_out: Sequence[LabelledImage],
    config: DetectorConfig,
    attribution: tuple[str, ...] = (),
) -> LongVehicleRecord:
    """Train the classifier.

    Parameters
    ----------
    samples
        Labelled images with the orientation and length of each vehicle; vehicles of more than `MIN_LENGTH_RATIO` car
        lengths are positives.
    held_out
        Further ones, on which the threshold is chosen.
    """
    rng = np.random.default_rng(config.seed)
    scenes = [_make_scene(sample, config.working_car_length_px) for sample in samples]
    images = [scene.image for scene in scenes]
    copies = _CAR_SAMPLES / max(1, sum(len(scene.cars) for scene in scenes))
    positive_poses = [_sample_positives(scene, rng) for scene in scenes]
    negative_poses = [_sample_negatives(scene, copies, rng) for scene in scenes]
    pool = draw_feature_pool(
        _POOL_SIZE,
        channels=3,
        sigma_xy_px=_CORNER_SIGMA_PX,
        reach_xy_px=LONG.reach,
        max_rectangles=_MAX_RECTANGLES,
        rng=rng,
    )
    poses = [*zip(images, positive_poses, strict=True), *zip(images, negative_poses, strict=True)]
    binner = fit_feature_binner(pool, CONTRAST_FLOOR, poses, rng)
    positives = binner.bins_of_images(zip(images, positive_poses, strict=True))
    negatives = binner.bins_of_images(zip(images, negative_poses, strict=True))
    for rounds in _MINING_ROUNDS:
        boosted = _boost(binner, positives, negatives, rounds, rng)
        detections = [
            (
                scene,
                _simulate_detections(scene.long, _DETECTION_REACH_PX, rng),
                _simulate_detections(scene.cars, _CAR_DETECTION_REACH_PX, rng),
            )
            for scene in scenes
        ]
        mined = parallel_map(partial(_mine_hard_negatives, stumps=BoostedStumps.from_rounds(boosted)), detections)
        hard = [augment_poses(poses, rng) for poses in mined]
        negatives = np.hstack([negatives, binner.bins_of_images(zip(images, hard, strict=True))])
    boosted = _boost(binner, positives, negatives, ROUNDS, rng)
    held_out_scenes = [_make_scene(sample, config.working_car_length_px) for sample in held_out]
    return LongVehicleRecord(
        working_car_length_px=config.working_car_length_px,
        rounds=boosted,
        threshold=_choose_threshold(boosted, held_out_scenes, rng),
        contrast_floor=CONTRAST_FLOOR,
        attribution=attribution,
    )


def _make_scene(sample: LabelledImage, car_length_px: float) -> _Scene:
    long = sample.cars[:, 3] > MIN_LENGTH_RATIO * car_length_px
    return _Scene(compute_features(sample.image, None, LONG), sample.cars[long, :3], sample.cars[~long, :3])


def _jitter(poses: FloatArray, copies: int, along: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Copies of poses (n * copies, 3), shifted along their axes, and jittered across them and in orientation."""
    poses = np.repeat(poses, copies, axis=0)
    across = rng.normal(0, _ACROSS_SD_PX, len(poses))
    poses[:, :2] = offset_along_axis(poses[:, :2], poses[:, 2], np.column_stack([along, across]))
    poses[:, 2] += rng.normal(0, _ROTATION_SD_RAD, len(poses))
    return poses


def _signed_uniform(count: int, limits: tuple[float, float], rng: np.random.Generator) -> FloatArray:
    """Uniform between two limits, of either sign."""
    return rng.uniform(*limits, count) * np.where(rng.random(count) < 0.5, -1, 1)


def _simulate_detections(poses: FloatArray, reach_px: float, rng: np.random.Generator) -> _Detections:
    """Two detections of each vehicle, off its centre along the axis by no more than ``reach_px``."""
    along = rng.uniform(-reach_px, reach_px, 2 * len(poses))
    return _jitter(poses, 2, along, rng), np.repeat(poses, 2, axis=0)


def _sample_positives(scene: _Scene, rng: np.random.Generator) -> Poses:
    along = rng.normal(0, _CENTRE_SD_PX, _POSITIVE_COPIES * len(scene.long))
    return augment_poses(_jitter(scene.long, _POSITIVE_COPIES, along, rng), rng)


def _sample_negatives(scene: _Scene, samples_per_car: float, rng: np.random.Generator) -> Poses:
    """Poses off the centre of long vehicles, on cars, and in front of and behind cars."""
    copies = max(1, round(samples_per_car / 3))
    off_centre = _signed_uniform(_OFF_CENTRE_COPIES * len(scene.long), _OFF_CENTRE_PX, rng)
    on_car = rng.normal(0, _CENTRE_SD_PX, copies * len(scene.cars))
    off_car = _signed_uniform(2 * copies * len(scene.cars), _OFF_CAR_PX, rng)
    parts = [
        _jitter(scene.long, _OFF_CENTRE_COPIES, off_centre, rng),
        _jitter(scene.cars, copies, on_car, rng),
        _jitter(scene.cars, 2 * copies, off_car, rng),
    ]
    return augment_poses(np.concatenate(parts), rng)


def _boost(
    binner: FeatureBinner, positives: ByteArray, negatives: ByteArray, rounds: int, rng: np.random.Generator
) -> tuple[Round, ...]:
    return binner.train(positives, negatives, rounds=rounds, fraction=_FRACTION, shrinkage=_SHRINKAGE, rng=rng)


def _mine_hard_negatives(detections: tuple[_Scene, _Detections, _Detections], stumps: BoostedStumps) -> FloatArray:
    """The two poses of highest score along each detection's axis, where they are not a long vehicle's centre."""
    scene, long, cars = detections
    hard = [np.empty((0, 3))]
    for (poses, vehicles), min_distance_px in ((long, _MINING_MIN_DISTANCE_PX), (cars, -1.0)):
        if not len(poses):
            continue
        scores = score_poses(stumps, scene.image, poses[:, :2], poses[:, 2], OFFSETS, contrast_floor=CONTRAST_FLOOR)
        rows = np.arange(len(poses))
        for _ in range(2):
            best = scores.argmax(axis=1)
            xy = offset_along_axis(poses[:, :2], poses[:, 2], OFFSETS[best].astype(np.float64) * LONG.step)
            wrong = np.hypot(*(xy - vehicles[:, :2]).T) > min_distance_px
            chosen = wrong & (scores[rows, best] > _MINING_MIN_SCORE)
            hard.append(np.column_stack([xy, poses[:, 2]])[chosen])
            for neighbour in range(-2, 3):
                scores[rows, np.clip(best + neighbour, 0, len(OFFSETS) - 1)] = -np.inf
    return np.concatenate(hard)


def _choose_threshold(boosted: tuple[Round, ...], scenes: Sequence[_Scene], rng: np.random.Generator) -> float:
    """Score that all but a small fraction of held-out cars stay below."""
    record = LongVehicleRecord(working_car_length_px=1.0, rounds=boosted, threshold=0.0, contrast_floor=CONTRAST_FLOOR)
    classifier = LongVehicleClassifier(record)
    highest = [np.empty(0)]
    for scene in scenes:
        poses, _ = _simulate_detections(scene.cars, _CAR_DETECTION_REACH_PX, rng)
        scores = classifier.scores(scene.image, poses[:, :2], poses[:, 2])
        highest.append(scores.max(axis=1, initial=-1.0))
    return float(np.quantile(np.concatenate(highest), 1 - _FALSE_POSITIVE_RATE))
