"""Evaluation on cars held out of training, in spatial folds: precision and recall, and the score threshold."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, Mask
from schemas.detector import PrecisionRecallCurve
from velfield.detection.samples import LabelledImage

FOLD_MIN_CARS = 16
"""With fewer marked cars none are left out to choose T."""
MATCH_PX = 8.0
"""A find this near to a car's middle is that car, working px: half its length."""
MIN_CURVE_SCORE = -0.25
"""Detections with a lower score are false at any precision that is of use."""
FOLDS_DESCRIPTION = "cars in held-out stripes of the images, detected by detectors trained on the other stripes"
_CURVE_POINTS = 400
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
    cars : how many cars there were to be found.
    complete : whether what is not marked is no car.
    """

    score: FloatArray
    right: Mask
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


def joined(parts: Sequence[Evidence]) -> Evidence:
    """Evidence of several parts together."""
    return Evidence(
        score=np.concatenate([part.score for part in parts]),
        right=np.concatenate([part.right for part in parts]),
        cars=sum(part.cars for part in parts),
        complete=all(part.complete for part in parts),
    )


def curve_of(evidence: Evidence, description: str) -> PrecisionRecallCurve | None:
    """Precision and recall against the threshold; the operating point is the middle of where they are best together.

    ``description``: which cars these are, for people.
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
    return thinned_curve(precision, recall, score, best, f"{evidence.cars} {description}")


def thinned_curve(
    precision: FloatArray, recall: FloatArray, threshold: FloatArray, chosen: int, description: str
) -> PrecisionRecallCurve:
    """For a detector file: some points of a curve (n,) by falling threshold, the chosen one among them."""
    kept = np.unique(np.r_[np.linspace(0, len(threshold) - 1, min(_CURVE_POINTS, len(threshold))).astype(int), chosen])
    return PrecisionRecallCurve(
        recall=tuple(np.round(recall[kept], 4).tolist()),
        precision=tuple(np.round(precision[kept], 4).tolist()),
        threshold=tuple(np.round(threshold[kept], 4).tolist()),
        operating_point=int(np.searchsorted(kept, chosen)),
        description=description,
    )


def nearly_best(precision: FloatArray, recall: FloatArray, *, beta: float) -> NDArray[np.int64]:
    """Where on a curve, by falling threshold, the F measure, recall weighed ``beta`` times, is all but greatest."""
    merit = (1 + beta**2) * precision * recall / np.maximum(beta**2 * precision + recall, 1e-9)
    return np.flatnonzero(merit > _AS_GOOD * merit.max())
