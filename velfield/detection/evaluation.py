"""Evaluation on labelled cars held out of training: precision, recall, and the score threshold."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.arrays import FloatArray, IntArray, Mask
from schemas.detector import PrecisionRecallCurve
from velfield.detection.samples import LabelledImage

MIN_CARS_TO_HOLD_OUT = 16
"""With fewer labelled cars none are held out to choose the score threshold."""
MATCH_PX = 8.0
"""A detection this near to a car's centre is that car, working px: half its length."""
MIN_CURVE_SCORE = -0.25
"""Detections with a lower score are false at any precision that is of use."""
HELD_OUT_DESCRIPTION = (
    "labelled cars in stripes of the images, detected after half of the training, which left these stripes out"
)
_CURVE_POINTS = 400
_RECALL_FRACTION = 0.95
"""Fraction of the recall at the lowest score: the operating point if labels are incomplete (precision unknown)."""
_BETA = 0.8
"""Recall counts less than precision, since false tracks harm the field more than missed ones; and not by more, since
detectors that were trained without the held-out cars are worse than the one trained on all of them."""
_PLATEAU = 0.985
"""Fraction of the best F measure that is nearly as good: of a few dozen cars one more or less moves the peak far."""


@dataclass(frozen=True)
class HeldOutScores:
    """Detections on images, or regions of them, that a detector was not trained on."""

    score: FloatArray
    """(n,) of each detection."""
    correct: Mask
    """(n,) whether it is matched to a labelled car."""
    car_count: int
    """Labelled cars there."""
    complete: bool
    """Whether every car is labelled, so that an unmatched detection is a false positive."""


def held_out_half(sample: LabelledImage) -> Mask:
    """Region (h, w) to hold out: every other of four stripes across the longer side with as many cars each."""
    height, width = sample.image.shape
    axis = 0 if width >= height else 1
    borders = np.quantile(sample.cars[:, axis], (0.25, 0.5, 0.75)) if len(sample.cars) else np.empty(0)
    inside = np.searchsorted(borders, np.arange(max(width, height))) % 2 == 0
    return np.broadcast_to(inside if axis == 0 else inside[:, None], (height, width))


def match_greedy(detections: FloatArray, cars: FloatArray) -> Mask:
    """Whether each detection (n, 2...), the best first, is a true positive: each takes the nearest car that is free."""
    taken = np.zeros(len(cars), bool)
    correct = np.zeros(len(detections), bool)
    for k in range(len(detections)):
        gap = np.hypot(cars[:, 0] - detections[k, 0], cars[:, 1] - detections[k, 1])
        gap[taken] = np.inf
        if len(cars) and gap.min() < MATCH_PX:
            taken[gap.argmin()] = correct[k] = True
    return correct


def match_labels(detections: FloatArray, cars: FloatArray, ignore: FloatArray) -> tuple[Mask, Mask]:
    """Whether each detection (n, 2...), the best first, is a true positive, and whether it counts: one that is none
    does not count within an ignored circle (k, 3) as x, y, radius."""
    correct = match_greedy(detections, cars)
    counted = np.ones(len(detections), bool)
    for x, y, radius in ignore:
        counted &= correct | (np.hypot(detections[:, 0] - x, detections[:, 1] - y) > radius)
    return correct, counted


def merge_scores(parts: Sequence[HeldOutScores]) -> HeldOutScores:
    """The detections of several images together."""
    return HeldOutScores(
        score=np.concatenate([part.score for part in parts]),
        correct=np.concatenate([part.correct for part in parts]),
        car_count=sum(part.car_count for part in parts),
        complete=all(part.complete for part in parts),
    )


def precision_recall_curve(scores: HeldOutScores, description: str) -> PrecisionRecallCurve | None:
    """Precision and recall against the score threshold; the operating point is the median of the plateau of F0.8.

    Parameters
    ----------
    description
        Which cars these are, for people.

    Returns
    -------
    None where no car was detected.
    """
    if not scores.correct.any():
        return None
    order = np.argsort(-scores.score, kind="stable")
    threshold, correct = scores.score[order], scores.correct[order]
    true_positives = np.cumsum(correct)
    precision = true_positives / np.arange(1, len(true_positives) + 1)
    recall = true_positives / scores.car_count
    best = int(np.median(f_measure_plateau(precision, recall, beta=_BETA)))
    if not scores.complete:
        best = int(np.searchsorted(recall, _RECALL_FRACTION * recall[-1]))
    return to_curve_record(precision, recall, threshold, best, f"{scores.car_count} {description}")


def to_curve_record(
    precision: FloatArray, recall: FloatArray, threshold: FloatArray, operating_point: int, description: str
) -> PrecisionRecallCurve:
    """For a detector file: a subset of the points of a curve (n,) by falling threshold, the operating point in it."""
    points = np.linspace(0, len(threshold) - 1, min(_CURVE_POINTS, len(threshold))).astype(int)
    kept = np.unique(np.r_[points, operating_point])
    return PrecisionRecallCurve(
        recall=tuple(np.round(recall[kept], 4).tolist()),
        precision=tuple(np.round(precision[kept], 4).tolist()),
        threshold=tuple(np.round(threshold[kept], 4).tolist()),
        operating_point=int(np.searchsorted(kept, operating_point)),
        description=description,
    )


def f_measure(precision: FloatArray, recall: FloatArray, *, beta: float = 1.0) -> FloatArray:
    """F measure of precisions and recalls (n,), recall weighted by ``beta``."""
    return (1 + beta**2) * precision * recall / np.maximum(beta**2 * precision + recall, 1e-9)


def f_measure_plateau(precision: FloatArray, recall: FloatArray, *, beta: float) -> IntArray:
    """Indices of a curve at which the F measure, recall weighted by ``beta``, is nearly its maximum."""
    measure = f_measure(precision, recall, beta=beta)
    return np.flatnonzero(measure > _PLATEAU * measure.max())
