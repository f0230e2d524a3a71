"""Training of the cascade's two classifiers: hard-negative mining, realignment of cars labelled without orientation.

Each classifier is boosted a few times. What it detects wrongly is added to the negatives before the next time
(bootstrapping, Sung and Poggio 1998). The orientation of a car whose label has none is a latent variable: after each
boosting it is set to the pose of the highest score.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from schemas.arrays import ByteArray, FloatArray, Mask
from schemas.detector import CascadeTraining, Round
from velfield.detection.boosting import BoostedStumps, draw_feature_pool
from velfield.detection.cascade.classifier import (
    PoseScorer,
    classify_proposals,
    offset_along_axis,
    offset_grid,
    propose_regions,
)
from velfield.detection.cascade.feature_image import COARSE, FINE, PatchScale
from velfield.detection.cascade.feature_matrix import FeatureBinner, fit_feature_binner
from velfield.detection.cascade.scenes import (
    Poses,
    TrainingScene,
    augment_poses,
    is_background,
    is_false_positive,
    sample_negatives,
)
from velfield.parallel import parallel_map

CONTRAST_FLOOR = 12.0
"""Grey levels a px added to the mean gradient that features are divided by, so that flat regions are not amplified."""
_PROPOSER_ROUNDS = 40
_PROPOSER_POOL = 1500
_PROPOSER_SIGMA_PX = (3.5, 2.5)
_PROPOSER_JITTER_PX, _PROPOSER_JITTER_RAD = 2.2, 0.28
"""Half the step between the positions and rotations of the proposals: a car displaced so must be proposed all the
same."""
_MINING_ROUNDS = (80, 160)
"""Rounds of the classifiers whose false positives are mined."""
_JITTER_SD_PX, _JITTER_SD_RAD = 0.6, 0.06
_SIGMA_FRACTION_XY = (0.6, 0.4)
"""Of the configured standard deviation of the corners: 6 px along and 4 across, where the paper's upright features have
10; measured best."""
_MAX_RECTANGLES = 2
_POSITIVES, _NEGATIVES, _MINED = 3000, 9000, 4000
_CAR_FRACTION = 0.3
_SHRINKAGE = 0.5
"""Leaves of half AdaBoost's: twice the rounds, and held-out cars are detected better."""
_AMBIGUOUS_QUANTILE = 0.25
"""Of the labelled cars' scores: above it an unlabelled detection may be a stationary car."""
_MINING_FACTOR = 6
"""So many times the false positives wanted are scored, the best proposals of each image: all of six images of 5 Mpx
took a quarter of an hour."""
_MINING_PER_MEGAPIXEL = 20_000.0
_REALIGN_ROTATIONS = np.radians(np.arange(-24.0, 25.0, 8.0))
_REALIGN_OFFSETS = offset_grid(1, 1)
_ROTATION_PRIOR_RAD = np.radians(20.0)
_ROTATION_PRIOR = 0.15


def train_proposer(
    scenes: Sequence[TrainingScene], config: CascadeTraining, channels: int, rng: np.random.Generator
) -> tuple[Round, ...]:
    """The coarse classifier of the region proposals."""
    positives = [_proposer_positives(scene, _copies(scenes), rng) for scene in scenes]
    negatives = []
    for scene in scenes:
        poses = sample_negatives(scene, _NEGATIVES // len(scenes), rng)
        negatives.append(poses.where(is_background(poses.rows, scene)))
    pool_size = min(config.feature_pool, _PROPOSER_POOL)
    binner = _fit_binner(scenes, COARSE, positives, negatives, pool_size, _PROPOSER_SIGMA_PX, channels, rng)
    images = [scene.coarse for scene in scenes]
    positive_bins = binner.bins_of_images(zip(images, positives, strict=True))
    negative_bins = binner.bins_of_images(zip(images, negatives, strict=True))
    max_count = _MINED // len(scenes)
    for _ in range(2):
        stumps = BoostedStumps.from_rounds(_boost(binner, positive_bins, negative_bins, _PROPOSER_ROUNDS, rng))
        mine = partial(_mine_false_proposals, stumps=stumps, max_count=max_count)
        mined = [augment_poses(false, rng) for false in parallel_map(mine, scenes)]
        negative_bins = np.hstack([negative_bins, binner.bins_of_images(zip(images, mined, strict=True))])
    return _boost(binner, positive_bins, negative_bins, _PROPOSER_ROUNDS, rng)


def train_classifier(
    scenes: Sequence[TrainingScene], config: CascadeTraining, channels: int, rng: np.random.Generator
) -> tuple[tuple[Round, ...], tuple[TrainingScene, ...]]:
    """The classifier of the proposals, and the scenes with their cars realigned by it."""
    scenes = tuple(scenes)
    positives = [_classifier_positives(scene, _copies(scenes), rng) for scene in scenes]
    negatives = [sample_negatives(scene, _NEGATIVES // len(scenes), rng) for scene in scenes]
    sigma = config.corner_sigma_px * _SIGMA_FRACTION_XY[0], config.corner_sigma_px * _SIGMA_FRACTION_XY[1]
    binner = _fit_binner(scenes, FINE, positives, negatives, config.feature_pool, sigma, channels, rng)
    images = [scene.fine for scene in scenes]
    negative_bins = binner.bins_of_images(zip(images, negatives, strict=True))
    max_count = _MINED // len(scenes)
    for rounds in _MINING_ROUNDS:
        positive_bins = binner.bins_of_images(zip(images, positives, strict=True))
        stumps = BoostedStumps.from_rounds(_boost(binner, positive_bins, negative_bins, rounds, rng))
        scenes = tuple(parallel_map(partial(realign_positives, stumps=stumps), scenes))
        mine = partial(mine_hard_negatives, stumps=stumps, max_count=max_count)
        mined = [augment_poses(false, rng) for false in parallel_map(mine, scenes)]
        negative_bins = np.hstack([negative_bins, binner.bins_of_images(zip(images, mined, strict=True))])
        positives = [_classifier_positives(scene, _copies(scenes), rng) for scene in scenes]
    positive_bins = binner.bins_of_images(zip(images, positives, strict=True))
    return _boost(binner, positive_bins, negative_bins, config.rounds, rng), scenes


def _copies(scenes: Sequence[TrainingScene]) -> int:
    """Augmented copies of each car."""
    return max(4, _POSITIVES // max(1, sum(len(scene.cars) for scene in scenes)))


def _fit_binner(
    scenes: Sequence[TrainingScene],
    scale: PatchScale,
    positives: Sequence[Poses],
    negatives: Sequence[Poses],
    pool_size: int,
    sigma_xy_px: tuple[float, float],
    channels: int,
    rng: np.random.Generator,
) -> FeatureBinner:
    pool = draw_feature_pool(
        pool_size,
        channels=channels,
        sigma_xy_px=sigma_xy_px,
        reach_xy_px=scale.reach,
        max_rectangles=_MAX_RECTANGLES,
        rng=rng,
    )
    images = [scene.fine if scale is FINE else scene.coarse for scene in scenes]
    parts = [*zip(images, positives, strict=True), *zip(images, negatives, strict=True)]
    return fit_feature_binner(pool, CONTRAST_FLOOR, parts, rng)


def _boost(
    binner: FeatureBinner, positives: ByteArray, negatives: ByteArray, rounds: int, rng: np.random.Generator
) -> tuple[Round, ...]:
    return binner.train(positives, negatives, rounds=rounds, fraction=_CAR_FRACTION, shrinkage=_SHRINKAGE, rng=rng)


def _classifier_positives(scene: TrainingScene, copies: int, rng: np.random.Generator) -> Poses:
    """Cars with a little jitter in position and axis."""
    rows = np.repeat(scene.cars, copies, axis=0)
    noise = rng.normal(0, 1, (len(rows), 3)) * [_JITTER_SD_PX, _JITTER_SD_PX, _JITTER_SD_RAD]
    return augment_poses(rows + noise, rng)


def _proposer_positives(scene: TrainingScene, copies: int, rng: np.random.Generator) -> Poses:
    """Cars displaced and rotated by up to half a step of the proposals."""
    rows = np.repeat(scene.cars, copies, axis=0)
    jitter = [_PROPOSER_JITTER_PX, _PROPOSER_JITTER_PX, _PROPOSER_JITTER_RAD]
    return augment_poses(rows + rng.uniform(-1, 1, (len(rows), 3)) * jitter, rng)


def _mine_false_proposals(scene: TrainingScene, stumps: BoostedStumps, max_count: int) -> FloatArray:
    """Proposals of the highest score on the background."""
    proposals = propose_regions(
        scene.coarse,
        scene.sample.image.shape,
        scene.sample.valid,
        stumps,
        contrast_floor=CONTRAST_FLOOR,
        per_megapixel=_MINING_PER_MEGAPIXEL,
    )
    scorer = PoseScorer(scene.coarse, stumps, CONTRAST_FLOOR)
    return filter_ambiguous_negatives(proposals, is_background(proposals, scene), scene, scorer)[:max_count]


def mine_hard_negatives(scene: TrainingScene, stumps: BoostedStumps, max_count: int) -> FloatArray:
    """False positives of the highest score among the best proposals."""
    scorer = PoseScorer(scene.fine, stumps, CONTRAST_FLOOR)
    detections = classify_proposals(scorer, scene.proposals[: _MINING_FACTOR * max_count], min_score=-1.0)
    detections = detections[np.argsort(-detections[:, 3], kind="stable")]
    return filter_ambiguous_negatives(detections, is_false_positive(detections, scene), scene, scorer)[:max_count]


def filter_ambiguous_negatives(
    detections: FloatArray, false: Mask, scene: TrainingScene, scorer: PoseScorer
) -> FloatArray:
    """The false ones; of an incompletely labelled image only those that score less than most labelled cars, since the
    others may be stationary cars."""
    if not scene.sample.complete and len(scene.cars):
        scores = scorer.scores(scene.cars[:, :2], scene.cars[:, 2], np.zeros(1), np.zeros((1, 2), np.int64))
        false = false & (detections[:, 3] < np.quantile(scores, _AMBIGUOUS_QUANTILE))
    return np.asarray(detections[false])


def realign_positives(scene: TrainingScene, stumps: BoostedStumps) -> TrainingScene:
    """Cars labelled without orientation in the pose of the highest score, with a prior on the present one.

    An orientation from the outline is some ten degrees off; a classifier trained on many of them corrects each.
    """
    if scene.has_orientation.all():
        return scene
    latent = ~scene.has_orientation
    cars, scorer = scene.cars[latent], PoseScorer(scene.fine, stumps, CONTRAST_FLOOR)
    scores = scorer.scores(cars[:, :2], cars[:, 2], _REALIGN_ROTATIONS, _REALIGN_OFFSETS)
    deviation = (_REALIGN_ROTATIONS / _ROTATION_PRIOR_RAD)[:, None].astype(np.float32)
    scores = scores - np.float32(_ROTATION_PRIOR) * deviation**2
    best = scores.reshape(len(cars), -1).argmax(axis=1)
    rotation, offset = np.unravel_index(best, scores.shape[1:])
    axes = cars[:, 2] + _REALIGN_ROTATIONS[rotation]
    half_way = np.asarray(0.5 * _REALIGN_OFFSETS[offset], np.float64)
    aligned = scene.cars.copy()
    aligned[latent, :2] = offset_along_axis(cars[:, :2], axes, half_way)
    aligned[latent, 2] = np.mod(axes, np.pi)
    return replace(scene, cars=aligned)
