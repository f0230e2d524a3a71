"""Data association over three frames: which candidate triples of detections become tracklets.

The paper links frame to frame: each detection to the one of most similar appearance, where the two are each other's
best (cross-check). In a platoon that is not enough. Cars 25 px apart that drive 12 px a frame can also be linked each
to the one behind, at -13 px a frame: speed, axis, turn and acceleration are all consistent, and one neighbour of
similar appearance gives a wrong velocity. So the two links of a window are selected jointly. The cost of a triple is
the sum of an appearance term (all three pairs of crops) and a motion term (deviation from constant velocity, sideways
motion), each about half a chi square, i.e. a negative log-likelihood:

- a triple is accepted only as the cheapest of all triples through each of its three detections (mutual best);
- its confidence is its likelihood over the sum of the likelihoods of its competitors (all triples through any of its
  detections) and of a false alarm, so that a platoon of identical cars gives no tracklet rather than a wrong one.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from schemas.arrays import FloatArray, IntArray, Mask

APPEARANCE_EXPONENT = 4.0
"""Likelihood of a pair falls as this power of (1 + difference / typical difference of a car to itself)."""
FALSE_ALARM_COST = 19.0
"""Cost at which a triple is as likely a false alarm as a car; a typical correct triple costs half of that."""
MAX_COST = FALSE_ALARM_COST + 5.0
"""Above this a triple cannot be accepted, and lowers no other's confidence by more than one per cent."""
MIN_TYPICAL_DIFFERENCE = 2.0
"""Appearance difference of camera noise alone, grey levels."""


@dataclass(frozen=True)
class Triples:
    """Candidate tracklets of one window.

    Attributes
    ----------
    detections
        (m, 3) index of the detection in each of the three frames.
    cost
        (m,) negative log-likelihood of appearance and motion, up to a constant.
    """

    detections: IntArray
    cost: FloatArray


def typical_difference(differences: FloatArray, first: IntArray) -> float:
    """Typical appearance difference of a car to itself: the median over detections of the smallest of their links'.

    Parameters
    ----------
    differences, first
        (m,) of each candidate link: appearance difference (NaN: unknown), and its earlier detection.
    """
    known = np.isfinite(differences)
    if not known.any():
        return MIN_TYPICAL_DIFFERENCE
    best = np.full(int(first.max()) + 1, np.inf)
    np.minimum.at(best, first[known], differences[known])
    return max(float(np.median(best[np.isfinite(best)])), MIN_TYPICAL_DIFFERENCE)


def appearance_cost(differences: FloatArray, typical: float) -> FloatArray:
    """Negative log-likelihood that pairs with these appearance differences are one car each; zero where unknown."""
    return np.where(np.isfinite(differences), APPEARANCE_EXPONENT * np.log1p(differences / typical), 0.0)


def best_triples(triples: Triples, counts: tuple[int, int, int]) -> tuple[Mask, FloatArray]:
    """Which triples are mutual best, and the confidence of each.

    Parameters
    ----------
    triples
        Candidate tracklets of one window.
    counts
        Number of detections in each of the three frames.

    Returns
    -------
    (m,) bool, (m,) float64
        Mutual best: no other triple through any of its detections is as cheap. Confidence in [0, 1]: its likelihood
        over the sum of its own, its competitors' and a false alarm's.
    """
    best, confidence = _best(triples.detections, triples.cost, np.array(counts), FALSE_ALARM_COST)
    return best.astype(np.bool_), confidence


@njit(cache=True, nogil=True)
def _best(detections, cost, counts, false_alarm_cost):  # type: ignore[no-untyped-def]
    m = cost.size
    largest = counts.max()
    minimum = np.full((3, largest), np.inf)
    ties = np.zeros((3, largest), np.int64)
    total = np.zeros((3, largest), np.float64)
    likelihood = np.exp(-cost)
    for t in range(m):
        for k in range(3):
            d = detections[t, k]
            total[k, d] += likelihood[t]
            if cost[t] < minimum[k, d]:
                minimum[k, d] = cost[t]
                ties[k, d] = 1
            elif cost[t] == minimum[k, d]:
                ties[k, d] += 1
    false_alarm = np.exp(-false_alarm_cost)
    best = np.empty(m, np.uint8)
    confidence = np.empty(m, np.float64)
    for t in range(m):
        mutual = True
        competitors = 0.0
        for k in range(3):
            d = detections[t, k]
            mutual = mutual and cost[t] == minimum[k, d] and ties[k, d] == 1
            competitors += max(total[k, d] - likelihood[t], 0.0)
        best[t] = mutual
        confidence[t] = likelihood[t] / (likelihood[t] + competitors + false_alarm)
    return best, confidence


def mutual_best_links(differences: FloatArray, first: IntArray, second: IntArray) -> Mask:
    """Cross-check (paper: tracking): links whose two detections are each most similar in appearance to the other.

    Parameters
    ----------
    differences, first, second
        (m,) of each candidate link: appearance difference, its earlier and its later detection.
    """
    if not differences.size:
        return np.zeros(0, np.bool_)
    of_first = np.full(int(first.max()) + 1, np.inf)
    of_second = np.full(int(second.max()) + 1, np.inf)
    np.minimum.at(of_first, first, differences)
    np.minimum.at(of_second, second, differences)
    best = (differences == of_first[first]) & (differences == of_second[second])
    # Of two equal differences neither is the best.
    alone_first = np.bincount(first[best], minlength=of_first.size)[first] == 1
    alone_second = np.bincount(second[best], minlength=of_second.size)[second] == 1
    return np.asarray(best & alone_first & alone_second)
