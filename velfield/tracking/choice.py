"""Which of the possible tracklets are believed.

The paper links frame to frame: each detection to the one that looks most like it, where the two choose each other. In a
platoon that is not enough. Cars 25 px apart that drive 12 px a frame may as well be linked each to the one behind, at
-13 px a frame: speed, axis, turn and acceleration all agree, and one look-alike neighbour makes a wrong velocity. So
the two links of a window are chosen together. A triple costs what its looks (all three pairs of patches) and its motion
(departure from constant velocity, sideways motion) say against it, as half a chi square or so:

- it must be the cheapest of all triples through each of its three detections (mutual best, over three frames);
- its confidence is its share of the likelihood among its rivals, that is all triples through any of its detections, and
  chance, so that a platoon of perfect look-alikes yields no tracklet rather than a wrong one.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from schemas.arrays import FloatArray, IntArray

LOOKS_EXPONENT = 4.0
"""Likelihood of a pair of patches falls as this power of (1 + difference / usual difference of one car to itself)."""
CHANCE_COST = 19.0
"""Cost at which a triple is as likely chance as a car; the usual triple costs half of that."""
HOPELESS_COST = CHANCE_COST + 5.0
"""Above this a triple neither is believed nor takes a per cent from another's confidence."""
MIN_USUAL_DIFFERENCE = 2.0
"""Grey levels below which a difference of patches is noise of the camera."""


@dataclass(frozen=True)
class Triples:
    """Possible tracklets of one window.

    Attributes
    ----------
    detections
        (m, 3) index of the detection in each of the three frames.
    cost
        (m,) what looks and motion say against it.
    """

    detections: IntArray
    cost: FloatArray


def usual_difference(differences: FloatArray, first: IntArray) -> float:
    """Difference of patches that one car usually has to itself: the median over detections of their best link's.

    Parameters
    ----------
    differences, first
        (m,) of each candidate link: difference of its patches, and its earlier detection. NaN: no patches.
    """
    known = np.isfinite(differences)
    if not known.any():
        return MIN_USUAL_DIFFERENCE
    best = np.full(int(first.max()) + 1, np.inf)
    np.minimum.at(best, first[known], differences[known])
    return max(float(np.median(best[np.isfinite(best)])), MIN_USUAL_DIFFERENCE)


def looks_cost(differences: FloatArray, usual: float) -> FloatArray:
    """What a difference of patches says against a pair being one car; zero where there are no patches."""
    return np.where(np.isfinite(differences), LOOKS_EXPONENT * np.log1p(differences / usual), 0.0)


def best_triples(triples: Triples, counts: tuple[int, int, int]) -> tuple[NDArray[np.bool_], FloatArray]:
    """Which triples are mutually best, and the confidence of each.

    Parameters
    ----------
    triples
        Possible tracklets of one window.
    counts
        Number of detections in each of the three frames.

    Returns
    -------
    (m,) bool, (m,) float64
        Mutually best: no triple through any of its detections is cheaper (nor as cheap). Confidence in [0, 1]: the
        share of its likelihood among its rivals' and chance's.
    """
    best, confidence = _best(triples.detections, triples.cost, np.array(counts), CHANCE_COST)
    return best.astype(np.bool_), confidence


@njit(cache=True, nogil=True)
def _best(detections, cost, counts, chance_cost):  # type: ignore[no-untyped-def]
    m = cost.size
    largest = counts.max()
    least = np.full((3, largest), np.inf)
    ties = np.zeros((3, largest), np.int64)
    total = np.zeros((3, largest), np.float64)
    likelihood = np.exp(-cost)
    for t in range(m):
        for k in range(3):
            d = detections[t, k]
            total[k, d] += likelihood[t]
            if cost[t] < least[k, d]:
                least[k, d] = cost[t]
                ties[k, d] = 1
            elif cost[t] == least[k, d]:
                ties[k, d] += 1
    chance = np.exp(-chance_cost)
    best = np.empty(m, np.uint8)
    confidence = np.empty(m, np.float64)
    for t in range(m):
        mutual = True
        rivals = 0.0
        for k in range(3):
            d = detections[t, k]
            mutual = mutual and cost[t] == least[k, d] and ties[k, d] == 1
            rivals += max(total[k, d] - likelihood[t], 0.0)
        best[t] = mutual
        confidence[t] = likelihood[t] / (likelihood[t] + rivals + chance)
    return best, confidence


def mutual_best_links(differences: FloatArray, first: IntArray, second: IntArray) -> NDArray[np.bool_]:
    """The paper's choice: links whose two detections each look most like the other.

    Parameters
    ----------
    differences, first, second
        (m,) of each candidate link: difference of its patches, its earlier and its later detection.
    """
    if not differences.size:
        return np.zeros(0, np.bool_)
    of_first = np.full(int(first.max()) + 1, np.inf)
    of_second = np.full(int(second.max()) + 1, np.inf)
    np.minimum.at(of_first, first, differences)
    np.minimum.at(of_second, second, differences)
    best = (differences == of_first[first]) & (differences == of_second[second])
    # Two detections that look equally alike are no best: neither is taken.
    alone_first = np.bincount(first[best], minlength=of_first.size)[first] == 1
    alone_second = np.bincount(second[best], minlength=of_second.size)[second] == 1
    return np.asarray(best & alone_first & alone_second)
