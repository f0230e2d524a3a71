"""How good a detector will be, from cars left out of its training; T and the cascade's cuts follow from it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, Mask
from schemas.detector import PrecisionRecallCurve
from velfield.detection.cascade.classifier import FIRST_ROUNDS, Look, distinct, find_cars
from velfield.detection.cascade.proposals import propose
from velfield.detection.cascade.training import CONTRAST_FLOOR
from velfield.detection.detector import BoostedSums
from velfield.detection.samples import LabelledImage, Scene, distance, is_far, lies_in

FOLD_MIN_CARS = 16
"""With fewer marked cars none are left out to choose T."""
MATCH_PX = 8.0
"""A find this near to a car's middle is that car, working px: half its length."""
_NEAR_PX = 6.0
_CURVE_FROM = -0.25
"""Scores below this are no cars at any precision that is of use."""
_CURVE_POINTS = 400
_LOST, _MARGIN = 0.02, 0.1
"""The cascade's cuts: the share of held-out cars that they would lose, and a margin for sites that look otherwise."""
_KEPT_RECALL = 0.95
_BETA = 0.8
"""Precision counts half as much again: the field wants few wrong tracks; but detectors tried on cars that were left out
are worse than the one that learnt from all."""
_AS_GOOD = 0.985


@dataclass(frozen=True)
class Evidence:
    """What a detector said where it was not trained.

    Attributes
    ----------
    score, right : (n,) of each find, and whether it is a marked car.
    proposed, first : (n,) how much the proposer, and the first rounds, liked each find.
    cars : how many cars there were to be found.
    complete : whether what is not marked is no car.
    """

    score: FloatArray
    right: Mask
    proposed: FloatArray
    first: FloatArray
    cars: int
    complete: bool


def stripes(sample: LabelledImage, fold: int, folds: int) -> Mask:
    """(h, w) the two stripes across the longer side that a fold leaves out: with as many cars in each."""
    height, width = sample.image.shape
    axis, count = 0 if width >= height else 1, 2 * folds
    borders = np.quantile(sample.cars[:, axis], np.arange(1, count) / count) if len(sample.cars) else np.empty(0)
    stripe = np.searchsorted(borders, np.arange(max(width, height)))
    inside = stripe % folds == fold
    return np.broadcast_to(inside if axis == 0 else inside[:, None], (height, width))


def evidence_of_part(
    scene: Scene, region: Mask, proposer: BoostedSums, sums: BoostedSums, *, members: int = 1
) -> Evidence:
    """Try a detector on a part (h, w) of a scene that it was not trained on; one of so many of a committee."""
    places = propose(
        scene.coarse, scene.sample.image.shape, scene.sample.valid, proposer, contrast_floor=CONTRAST_FLOOR
    )
    places = places[lies_in(region, places)]
    look = Look(scene.fine, sums, CONTRAST_FLOOR)
    found = distinct(find_cars(look, places, least_score=_CURVE_FROM), 16.0)
    cars = scene.cars[lies_in(region, scene.cars)]
    counted = is_far(found, scene) | (distance(found, cars) < MATCH_PX)
    found = found[counted]
    right, first = matched(found, cars), _first_scores(look, found, max(FIRST_ROUNDS // members, 1))
    return Evidence(found[:, 3], right, _best_near(places, found), first, len(cars), scene.sample.complete)


def matched(found: FloatArray, cars: FloatArray) -> Mask:
    """Whether each find, the best first, is the first on a car."""
    taken = np.zeros(len(cars), bool)
    right = np.zeros(len(found), bool)
    for k in range(len(found)):
        gap = np.hypot(cars[:, 0] - found[k, 0], cars[:, 1] - found[k, 1])
        gap[taken] = np.inf
        if len(cars) and gap.min() < MATCH_PX:
            taken[gap.argmin()] = right[k] = True
    return right


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


def joined(parts: Sequence[Evidence]) -> Evidence:
    """Evidence of several parts together."""
    return Evidence(
        score=np.concatenate([part.score for part in parts]),
        right=np.concatenate([part.right for part in parts]),
        proposed=np.concatenate([part.proposed for part in parts]),
        first=np.concatenate([part.first for part in parts]),
        cars=sum(part.cars for part in parts),
        complete=all(part.complete for part in parts),
    )


def cut_of(scores: FloatArray) -> float:
    """A score that nearly all of these exceed."""
    known = scores[np.isfinite(scores)]
    return float(np.quantile(known, _LOST) - _MARGIN) if len(known) else -1.0


def curve_of(evidence: Evidence, told: str) -> PrecisionRecallCurve | None:
    """Precision and recall against the threshold; ``chosen`` is the middle of where they are best together.

    ``told``: which cars these are, for people.
    """
    if not evidence.right.any():
        return None
    order = np.argsort(-evidence.score, kind="stable")
    score, right = evidence.score[order], evidence.right[order]
    found = np.cumsum(right)
    precision, recall = found / np.arange(1, len(found) + 1), found / evidence.cars
    # Of a few dozen cars one more or less moves the peak far; the middle of all that is nearly as good stays.
    best = int(np.median(nearly_best(precision, recall, beta=_BETA)))
    if not evidence.complete:
        best = int(np.searchsorted(recall, _KEPT_RECALL * recall[-1]))
    return thinned_curve(precision, recall, score, best, f"{evidence.cars} {told}")


def thinned_curve(
    precision: FloatArray, recall: FloatArray, threshold: FloatArray, chosen: int, evidence: str
) -> PrecisionRecallCurve:
    """For a detector file: some points of a curve (n,) by falling threshold, the chosen one among them."""
    kept = np.unique(np.r_[np.linspace(0, len(threshold) - 1, min(_CURVE_POINTS, len(threshold))).astype(int), chosen])
    return PrecisionRecallCurve(
        recall=tuple(np.round(recall[kept], 4).tolist()),
        precision=tuple(np.round(precision[kept], 4).tolist()),
        threshold=tuple(np.round(threshold[kept], 4).tolist()),
        chosen=int(np.searchsorted(kept, chosen)),
        evidence=evidence,
    )


def nearly_best(precision: FloatArray, recall: FloatArray, *, beta: float) -> NDArray[np.int64]:
    """Where on a curve, by falling threshold, the F measure, recall weighed ``beta`` times, is all but greatest."""
    merit = (1 + beta**2) * precision * recall / np.maximum(beta**2 * precision + recall, 1e-9)
    return np.flatnonzero(merit > _AS_GOOD * merit.max())
