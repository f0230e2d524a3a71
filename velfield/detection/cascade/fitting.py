"""Training of the cascade as a whole: both stages, spatial folds for the score threshold, the ensemble of the folds."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from schemas.arrays import FloatArray, Mask
from schemas.detector import CascadeConfig, CascadeRecord, PrecisionRecallCurve, Proposer, Round
from velfield.detection.boosting import BoostedSums, sums_of
from velfield.detection.cascade.classifier import FIRST_ROUNDS, Look, distinct, find_cars
from velfield.detection.cascade.ensemble import committee_of
from velfield.detection.cascade.proposals import propose
from velfield.detection.cascade.scenes import Scene, is_far, part_of, scene_of
from velfield.detection.cascade.training import CONTRAST_FLOOR, learn_classifier, learn_proposer
from velfield.detection.evaluation import (
    FOLD_MIN_CARS,
    FOLDS_DESCRIPTION,
    MATCH_PX,
    MIN_CURVE_SCORE,
    Evidence,
    curve_of,
    matched,
    stripes,
)
from velfield.detection.samples import LabelledImage, distance, lies_in
from velfield.parallel import parallel_map

_FOLD_SCENES = 3
"""Images that the folds are evaluated on, spread over those that there are."""
_UNTRIED_THRESHOLD = 0.15
"""Score threshold where too few cars are labelled to hold some out: what it came to on most sites."""
_UNTRIED_CUT = -0.4
_COMMITTEE_MIN_CARS = 20
"""With fewer labelled cars the detectors of the folds know too little to be members of an ensemble."""
_OF_ITS_OWN = 0.56
"""Fraction of a member's score of a detection held out of its training that is its own error: the mean of an ensemble
keeps the less of it, the more members it has. Measured on KIT AIS and simulated cities by the threshold."""
_EARLIER_SAYS = 4
"""Votes of an earlier detector beside the one of the new: trained on many cars, it is less sure of each."""
_LOST, _MARGIN = 0.02, 0.1
"""The rejection thresholds: the fraction of held-out cars that they would lose, and a margin for sites that look
otherwise."""
_NEAR_PX = 6.0


@dataclass(frozen=True)
class Steps:
    """Both stages, trained, and the scenes with the cars' axes as the classifier realigned them."""

    proposer: tuple[Round, ...]
    classifier: tuple[Round, ...]
    scenes: tuple[Scene, ...]


@dataclass(frozen=True)
class StageEvidence(Evidence):
    """What a cascade scored where it was not trained, by stage.

    Attributes
    ----------
    proposed, first : (n,) score of each detection by the proposer, and by the first rounds of the classifier.
    """

    proposed: FloatArray
    first: FloatArray


def train_cascade(
    samples: Sequence[LabelledImage], config: CascadeConfig, earlier: CascadeRecord | None, *, has_background: bool
) -> CascadeRecord:
    """Train a cascade; ``earlier`` votes together with it."""
    count, channels = sum(len(sample.cars) for sample in samples), 4 if has_background else 3
    prior = () if earlier is None else earlier.rounds
    steps = trained([scene_of(sample, has_background) for sample in samples], config, channels, config.seed, prior)
    evidence = None
    if count >= FOLD_MIN_CARS:
        complete = all(sample.complete for sample in samples)
        folds = config.folds if complete else 2  # else motion gives the score threshold
        together = complete and not prior and count >= _COMMITTEE_MIN_CARS
        others, evidence = _folds(steps.scenes, config, channels, prior, folds=folds, together=together)
        if together:
            steps = replace(steps, classifier=committee_of([steps.classifier, *(one.classifier for one in others)]))
    record = record_of(steps, evidence, config, count)
    return record if earlier is None else _continuing(record, earlier, config, tried=evidence is not None)


def trained(
    scenes: Sequence[Scene], config: CascadeConfig, channels: int, seed: int, prior: tuple[Round, ...] = ()
) -> Steps:
    """Both stages, trained on scenes; ``prior``: the classifier of an earlier cascade, which votes as well."""
    rng = np.random.default_rng(seed)
    proposer = learn_proposer(scenes, config, channels, rng)
    sums = sums_of(proposer)

    def looked_at(scene: Scene) -> Scene:
        shape, valid = scene.sample.image.shape, scene.sample.valid
        places = propose(scene.coarse, shape, valid, sums, contrast_floor=CONTRAST_FLOOR)
        return replace(scene, places=places[:, :3])

    classifier, aligned = learn_classifier(parallel_map(looked_at, scenes), config, channels, rng)
    if prior:
        classifier = committee_of([classifier, *[prior] * _EARLIER_SAYS])
    return Steps(proposer, classifier, aligned)


def _folds(
    scenes: Sequence[Scene],
    config: CascadeConfig,
    channels: int,
    prior: tuple[Round, ...],
    *,
    folds: int,
    together: bool,
) -> tuple[list[Steps], StageEvidence]:
    """Cascades each trained without the stripes of one fold, and their detections there; ``together``: as members of an
    ensemble with the one of all stripes, each of half the rounds.

    The fewer cars are held out at once, the nearer the score threshold is to the best one of the detector of all
    stripes: detectors of half of 47 cars gave higher scores to what is no car, and the threshold came out so high that
    a fifth of the cars was lost.
    """
    members = folds + 1 if together else 1
    config = config.model_copy(update={"rounds": max(config.rounds // 2, 1)}) if together else config
    tried = np.unique(np.linspace(0, len(scenes) - 1, min(_FOLD_SCENES, len(scenes))).round().astype(int))

    def of_fold(fold: int) -> tuple[Steps, list[StageEvidence]]:
        seen = [part_of(scene, ~stripes(scene.sample, fold, folds)) for scene in scenes]
        steps = trained(seen, config, channels, config.seed + 1 + fold, prior)
        proposer, sums = sums_of(steps.proposer), sums_of(steps.classifier)
        return steps, [
            evidence_of_part(scenes[k], stripes(scenes[k].sample, fold, folds), proposer, sums, members=members)
            for k in tried
        ]

    found = parallel_map(of_fold, range(folds))
    evidence = _joined([part for _, parts in found for part in parts])
    left = 1 - _OF_ITS_OWN * (1 - 1 / members)
    said = np.where(evidence.score > 0, left * evidence.score, evidence.score)
    return [steps for steps, _ in found], replace(evidence, score=said)


def evidence_of_part(
    scene: Scene, region: Mask, proposer: BoostedSums, sums: BoostedSums, *, members: int = 1
) -> StageEvidence:
    """Evaluate a cascade on a region (h, w) of a scene that it was not trained on; one of so many members."""
    places = propose(
        scene.coarse, scene.sample.image.shape, scene.sample.valid, proposer, contrast_floor=CONTRAST_FLOOR
    )
    places = places[lies_in(region, places)]
    look = Look(scene.fine, sums, CONTRAST_FLOOR)
    found = distinct(find_cars(look, places, min_score=MIN_CURVE_SCORE), 16.0)
    cars = scene.cars[lies_in(region, scene.cars)]
    counted = is_far(found, scene) | (distance(found, cars) < MATCH_PX)
    found = found[counted]
    first = _first_scores(look, found, max(FIRST_ROUNDS // members, 1))
    return StageEvidence(
        score=found[:, 3],
        right=matched(found, cars),
        cars=len(cars),
        complete=scene.sample.complete,
        proposed=_best_near(places, found),
        first=first,
    )


def _joined(parts: Sequence[StageEvidence]) -> StageEvidence:
    return StageEvidence(
        score=np.concatenate([part.score for part in parts]),
        right=np.concatenate([part.right for part in parts]),
        cars=sum(part.cars for part in parts),
        complete=all(part.complete for part in parts),
        proposed=np.concatenate([part.proposed for part in parts]),
        first=np.concatenate([part.first for part in parts]),
    )


def _best_near(places: FloatArray, found: FloatArray) -> FloatArray:
    if not len(found):
        return np.empty(0)
    near = np.hypot(found[:, None, 0] - places[:, 0], found[:, None, 1] - places[:, 1]) < _NEAR_PX
    return np.asarray(np.where(near, places[:, 3], -np.inf).max(axis=1), np.float64)


def _first_scores(look: Look, found: FloatArray, rounds: int) -> FloatArray:
    if not len(found):
        return np.empty(0)
    first = look.scores(found[:, :2], found[:, 2], np.zeros(1), np.zeros((1, 2), np.int64), rounds)
    return np.asarray(first[:, 0, 0], np.float64)


def cut_of(scores: FloatArray) -> float:
    """A score that nearly all of these exceed."""
    known = scores[np.isfinite(scores)]
    return float(np.quantile(known, _LOST) - _MARGIN) if len(known) else -1.0


def record_of(steps: Steps, evidence: StageEvidence | None, config: CascadeConfig, count: int) -> CascadeRecord:
    """The detector's record; the thresholds follow from cars held out of training."""
    curve: PrecisionRecallCurve | None = None
    threshold, cuts = _UNTRIED_THRESHOLD, (_UNTRIED_CUT, _UNTRIED_CUT)
    if evidence is not None:
        curve = curve_of(evidence, FOLDS_DESCRIPTION)
        if curve is not None and curve.operating_point is not None:
            threshold = curve.threshold[curve.operating_point]
        surely = evidence.right & (evidence.score >= threshold)
        cuts = cut_of(evidence.proposed[surely]), cut_of(evidence.first[surely])
    return CascadeRecord(
        working_car_length_px=config.working_car_length_px,
        rounds=steps.classifier,
        threshold=float(threshold if config.threshold is None else config.threshold),
        contrast_floor=CONTRAST_FLOOR,
        proposer=Proposer(rounds=steps.proposer, min_score=cuts[0], min_stage1_score=cuts[1]),
        curve=curve,
        cars=count,
    )


def _continuing(record: CascadeRecord, earlier: CascadeRecord, config: CascadeConfig, *, tried: bool) -> CascadeRecord:
    """The record with the earlier one's attribution; where nothing was held out, the mean threshold by votes."""
    update: dict[str, object] = {"attribution": earlier.attribution}
    if not tried and config.threshold is None:
        update["threshold"] = (_UNTRIED_THRESHOLD + _EARLIER_SAYS * earlier.threshold) / (1 + _EARLIER_SAYS)
    return record.model_copy(update=update)
