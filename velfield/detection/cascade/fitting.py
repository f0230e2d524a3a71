"""Training of the whole cascade: both classifiers, cross-validation by spatial folds for the thresholds, the ensemble.

The cascades of the folds, each trained without some stripes of the images, are evaluated there: precision and recall
give the score threshold, the scores of the true positives the thresholds at which each stage rejects. Together with the
cascade of all stripes they then form an ensemble.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from schemas.arrays import FloatArray, Mask
from schemas.detector import CascadeConfig, CascadeRecord, PrecisionRecallCurve, Proposer, Round
from velfield.detection.boosting import BoostedStumps
from velfield.detection.cascade.classifier import (
    STAGE1_ROUNDS,
    PoseScorer,
    classify_proposals,
    nms_oriented,
    propose_regions,
)
from velfield.detection.cascade.ensemble import build_ensemble
from velfield.detection.cascade.scenes import TrainingScene, is_background, make_scene, restrict_scene
from velfield.detection.cascade.training import CONTRAST_FLOOR, train_classifier, train_proposer
from velfield.detection.evaluation import (
    FOLDS_DESCRIPTION,
    MATCH_PX,
    MIN_CARS_FOR_FOLDS,
    MIN_CURVE_SCORE,
    HeldOutScores,
    match_greedy,
    precision_recall_curve,
    spatial_fold,
)
from velfield.detection.samples import LabelledImage, distance_to_nearest_car, in_region
from velfield.parallel import parallel_map

_MAX_EVALUATED = 3
"""Images that the folds are evaluated on, spread over those that there are."""
_DEFAULT_THRESHOLD = 0.15
"""Score threshold where too few cars are labelled to hold some out: what it came to on most sites."""
_DEFAULT_REJECTION = -0.4
_ENSEMBLE_MIN_CARS = 20
"""With fewer labelled cars the detectors of the folds are too weak to be members of an ensemble."""
_OWN_ERROR_FRACTION = 0.56
"""Fraction of a member's score on held-out images that is its own error, of which the mean of an ensemble keeps the
less, the more members it has. Measured by the score threshold on KIT AIS and simulated cities."""
_BASE_VOTES = 4
"""Weight of an earlier cascade in an ensemble with the new one: trained on many cars, its scores are lower."""
_LOST_FRACTION, _REJECTION_MARGIN = 0.02, 0.1
"""The thresholds of the stages: fraction of held-out cars that they lose, and a margin for sites that differ."""
_NMS_LENGTH_PX = 16.0
_NEAR_PX = 6.0


@dataclass(frozen=True)
class CascadeClassifiers:
    """The proposer and the classifier, trained, and the scenes with their cars realigned."""

    proposer: tuple[Round, ...]
    classifier: tuple[Round, ...]
    scenes: tuple[TrainingScene, ...]


@dataclass(frozen=True)
class StageScores(HeldOutScores):
    """The same, with the scores that the cascade's thresholds are compared to.

    Attributes
    ----------
    proposal, stage1 : (n,) of each detection by the proposer, and by the first rounds of the classifier.
    """

    proposal: FloatArray
    stage1: FloatArray


def train_cascade(
    samples: Sequence[LabelledImage], config: CascadeConfig, base: CascadeRecord | None, *, has_background: bool
) -> CascadeRecord:
    """Train a cascade; with a ``base`` the ensemble of both classifiers."""
    count, channels = sum(len(sample.cars) for sample in samples), 4 if has_background else 3
    votes = () if base is None else base.rounds
    scenes = [make_scene(sample, has_background) for sample in samples]
    cascade = train_stages(scenes, config, channels, config.seed, votes)
    scores = None
    if count >= MIN_CARS_FOR_FOLDS:
        complete = all(sample.complete for sample in samples)
        folds = config.folds if complete else 2  # else motion gives the score threshold
        as_ensemble = complete and not votes and count >= _ENSEMBLE_MIN_CARS
        others, scores = _cross_validate(cascade.scenes, config, channels, votes, folds=folds, as_ensemble=as_ensemble)
        if as_ensemble:
            members = [cascade.classifier, *(other.classifier for other in others)]
            cascade = replace(cascade, classifier=build_ensemble(members))
    record = make_record(cascade, scores, config, count)
    return record if base is None else _with_base(record, base, config, is_validated=scores is not None)


def train_stages(
    scenes: Sequence[TrainingScene], config: CascadeConfig, channels: int, seed: int, votes: tuple[Round, ...] = ()
) -> CascadeClassifiers:
    """Train the proposer and the classifier; ``votes``: the classifier of an earlier cascade, for an ensemble."""
    rng = np.random.default_rng(seed)
    proposer = train_proposer(scenes, config, channels, rng)
    stumps = BoostedStumps.from_rounds(proposer)

    def with_proposals(scene: TrainingScene) -> TrainingScene:
        shape, valid = scene.sample.image.shape, scene.sample.valid
        proposals = propose_regions(scene.coarse, shape, valid, stumps, contrast_floor=CONTRAST_FLOOR)
        return replace(scene, proposals=proposals[:, :3])

    classifier, aligned = train_classifier(parallel_map(with_proposals, scenes), config, channels, rng)
    if votes:
        classifier = build_ensemble([classifier, *[votes] * _BASE_VOTES])
    return CascadeClassifiers(proposer, classifier, aligned)


def _cross_validate(
    scenes: Sequence[TrainingScene],
    config: CascadeConfig,
    channels: int,
    votes: tuple[Round, ...],
    *,
    folds: int,
    as_ensemble: bool,
) -> tuple[list[CascadeClassifiers], StageScores]:
    """The cascades of the folds, and their detections on the stripes held out.

    As members of an ensemble they have half of the rounds each, and their scores are reduced to those of the ensemble.

    The fewer cars are held out at once, the nearer the score threshold is to the best one of the cascade of all
    stripes: those of half of 47 cars gave other objects higher scores, and the threshold came out so high that a fifth
    of the cars was lost.
    """
    members = folds + 1 if as_ensemble else 1
    config = config.model_copy(update={"rounds": max(config.rounds // 2, 1)}) if as_ensemble else config
    evaluated = np.unique(np.linspace(0, len(scenes) - 1, min(_MAX_EVALUATED, len(scenes))).round().astype(int))

    def train_fold(fold: int) -> tuple[CascadeClassifiers, list[StageScores]]:
        training = [restrict_scene(scene, ~spatial_fold(scene.sample, fold, folds)) for scene in scenes]
        cascade = train_stages(training, config, channels, config.seed + 1 + fold, votes)
        return cascade, [
            evaluate_region(scenes[k], spatial_fold(scenes[k].sample, fold, folds), cascade, members=members)
            for k in evaluated
        ]

    trained = parallel_map(train_fold, range(folds))
    scores = _merge([part for _, parts in trained for part in parts])
    kept = 1 - _OWN_ERROR_FRACTION * (1 - 1 / members)
    reduced = np.where(scores.score > 0, kept * scores.score, scores.score)
    return [cascade for cascade, _ in trained], replace(scores, score=reduced)


def evaluate_region(
    scene: TrainingScene, region: Mask, cascade: CascadeClassifiers, *, members: int = 1
) -> StageScores:
    """Detections of a cascade on a region (h, w) held out of its training; one of so many members of an ensemble."""
    shape, valid = scene.sample.image.shape, scene.sample.valid
    proposer = BoostedStumps.from_rounds(cascade.proposer)
    proposals = propose_regions(scene.coarse, shape, valid, proposer, contrast_floor=CONTRAST_FLOOR)
    proposals = proposals[in_region(region, proposals)]
    scorer = PoseScorer(scene.fine, BoostedStumps.from_rounds(cascade.classifier), CONTRAST_FLOOR)
    detections = nms_oriented(classify_proposals(scorer, proposals, min_score=MIN_CURVE_SCORE), _NMS_LENGTH_PX)
    cars = scene.cars[in_region(region, scene.cars)]
    counted = is_background(detections, scene) | (distance_to_nearest_car(detections, cars) < MATCH_PX)
    detections = detections[counted]
    return StageScores(
        score=detections[:, 3],
        correct=match_greedy(detections, cars),
        car_count=len(cars),
        complete=scene.sample.complete,
        proposal=_best_proposal_scores(proposals, detections),
        stage1=_stage1_scores(scorer, detections, max(STAGE1_ROUNDS // members, 1)),
    )


def _merge(parts: Sequence[StageScores]) -> StageScores:
    return StageScores(
        score=np.concatenate([part.score for part in parts]),
        correct=np.concatenate([part.correct for part in parts]),
        car_count=sum(part.car_count for part in parts),
        complete=all(part.complete for part in parts),
        proposal=np.concatenate([part.proposal for part in parts]),
        stage1=np.concatenate([part.stage1 for part in parts]),
    )


def _best_proposal_scores(proposals: FloatArray, detections: FloatArray) -> FloatArray:
    if not len(detections):
        return np.empty(0)
    gap = np.hypot(detections[:, None, 0] - proposals[:, 0], detections[:, None, 1] - proposals[:, 1])
    return np.asarray(np.where(gap < _NEAR_PX, proposals[:, 3], -np.inf).max(axis=1), np.float64)


def _stage1_scores(scorer: PoseScorer, detections: FloatArray, rounds: int) -> FloatArray:
    if not len(detections):
        return np.empty(0)
    scores = scorer.scores(detections[:, :2], detections[:, 2], np.zeros(1), np.zeros((1, 2), np.int64), rounds)
    return np.asarray(scores[:, 0, 0], np.float64)


def rejection_threshold(scores: FloatArray) -> float:
    """A score that nearly all of these exceed, by a margin."""
    known = scores[np.isfinite(scores)]
    return float(np.quantile(known, _LOST_FRACTION) - _REJECTION_MARGIN) if len(known) else -1.0


def make_record(
    cascade: CascadeClassifiers, scores: StageScores | None, config: CascadeConfig, count: int
) -> CascadeRecord:
    """Content of the detector file; the thresholds follow from held-out scores."""
    curve: PrecisionRecallCurve | None = None
    threshold, min_score, min_stage1_score = _DEFAULT_THRESHOLD, _DEFAULT_REJECTION, _DEFAULT_REJECTION
    if scores is not None:
        curve = precision_recall_curve(scores, FOLDS_DESCRIPTION)
        if curve is not None and curve.operating_point is not None:
            threshold = curve.threshold[curve.operating_point]
        detected = scores.correct & (scores.score >= threshold)
        min_score = rejection_threshold(scores.proposal[detected])
        min_stage1_score = rejection_threshold(scores.stage1[detected])
    return CascadeRecord(
        working_car_length_px=config.working_car_length_px,
        rounds=cascade.classifier,
        threshold=float(threshold if config.threshold is None else config.threshold),
        contrast_floor=CONTRAST_FLOOR,
        proposer=Proposer(rounds=cascade.proposer, min_score=min_score, min_stage1_score=min_stage1_score),
        curve=curve,
        cars=count,
    )


def _with_base(
    record: CascadeRecord, base: CascadeRecord, config: CascadeConfig, *, is_validated: bool
) -> CascadeRecord:
    """The record with the base's attribution; where no car was held out, the mean threshold by votes."""
    update: dict[str, object] = {"attribution": base.attribution}
    if not is_validated and config.threshold is None:
        update["threshold"] = (_DEFAULT_THRESHOLD + _BASE_VOTES * base.threshold) / (1 + _BASE_VOTES)
    return record.model_copy(update=update)
