"""Matches between key points: everywhere, for a prior, and guided, within a window about a prediction.

Paper: registration; a match is searched within 50 x 50 px of where the prior says.
"""

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from velfield.errors import Failure
from velfield.registration.keypoints import KeyPoints
from velfield.registration.transforms import HomographyTransform

Pairs = NDArray[np.int64]
"""(m, 2) indices: of the moving, of the reference key points."""

PRIOR_POINTS = 1200
"""Key points of the frame that the prior is found from."""
_RATIO = 0.85
"""A match is taken where its descriptor is this much nearer than the second nearest."""
_GUIDED_RATIO = 0.9
_GUIDED_LIMIT = 350
"""Largest distance of descriptors of a guided match; SIFT's are some 512 long."""
_PRIOR_ERROR_PX = 6.0
"""Within this a match supports the prior: row wobble and lens are not in it yet."""
_MIN_PRIOR_MATCHES = 16
_MAX_STRETCH = 6.0


def match_everywhere(moving: NDArray[np.uint8], reference: NDArray[np.uint8]) -> Pairs:
    """Mutually best matches of descriptors (n, 128) and (m, 128) that pass the ratio test."""
    if len(moving) < 2 or len(reference) < 2:
        return np.zeros((0, 2), np.int64)
    a, b = moving.astype(np.float32), reference.astype(np.float32)
    distance = np.square(b).sum(axis=1) - 2.0 * (a @ b.T) + np.square(a).sum(axis=1)[:, None]
    best = distance.argmin(axis=1)
    rows = np.arange(len(a))
    nearest = distance[rows, best]
    mutual = distance.argmin(axis=0)[best] == rows
    distance[rows, best] = np.inf
    distinct = nearest < _RATIO**2 * distance.min(axis=1)
    chosen = np.flatnonzero(mutual & distinct)
    return np.stack([chosen, best[chosen]], axis=1)


def homography_prior(
    undistorted: FloatArray, descriptors: NDArray[np.uint8], reference: KeyPoints
) -> HomographyTransform | Failure:
    """Homography by MAGSAC from a frame's key points, undistorted (n, 2), to reference key points in base pixels.

    Needs no other frame. A failure says how many matches there were.
    """
    pairs = match_everywhere(descriptors[:PRIOR_POINTS], reference.descriptors)
    if len(pairs) < _MIN_PRIOR_MATCHES:
        return Failure(f"{len(pairs)} matches, {_MIN_PRIOR_MATCHES} needed")
    source, target = undistorted[pairs[:, 0]], reference.xy[pairs[:, 1]]
    matrix, inliers = cv2.findHomography(
        source, target, cv2.USAC_MAGSAC, _PRIOR_ERROR_PX, maxIters=4000, confidence=0.9999
    )
    agreeing = 0 if inliers is None else int(inliers.sum())
    if matrix is None or agreeing < _MIN_PRIOR_MATCHES:
        return Failure(f"{agreeing} of {len(pairs)} matches agree, {_MIN_PRIOR_MATCHES} needed")
    prior = HomographyTransform(np.asarray(matrix / matrix[2, 2], dtype=np.float64))
    kept = inliers.ravel() > 0
    if not _is_plausible(prior, source[kept]):
        return Failure(f"the {agreeing} matches that agree mirror, fold or stretch the frame")
    return prior


def _is_plausible(prior: HomographyTransform, xy: FloatArray) -> bool:
    """Whether the map keeps its handedness and a sane scale at the points that found it."""
    step = 1.0
    here = prior(xy)
    along_x, along_y = prior(xy + np.array([step, 0.0])) - here, prior(xy + np.array([0.0, step])) - here
    area = along_x[:, 0] * along_y[:, 1] - along_x[:, 1] * along_y[:, 0]
    longest = np.maximum(np.linalg.norm(along_x, axis=1), np.linalg.norm(along_y, axis=1))
    with np.errstate(invalid="ignore"):
        return bool((area > _MAX_STRETCH**-2).all() and (longest < _MAX_STRETCH).all())


def match_guided(
    predicted: FloatArray, descriptors: NDArray[np.uint8], reference: KeyPoints, *, search_px: float
) -> Pairs:
    """Mutually best matches within a square of side ``search_px`` about the predicted places (n, 2) in base pixels."""
    if not len(predicted) or not len(reference):
        return np.zeros((0, 2), np.int64)
    cell = search_px / 2
    finite: NDArray[np.bool_] = np.asarray(np.isfinite(predicted).all(axis=1))
    origin = reference.xy.min(axis=0)
    key = np.floor((reference.xy - origin) / cell).astype(np.int64)
    shape = key.max(axis=0) + 1
    flat = key[:, 1] * shape[0] + key[:, 0]
    order = np.argsort(flat, kind="stable")
    starts = np.searchsorted(flat[order], np.arange(shape[0] * shape[1] + 1))
    best, back = _best_in_window(
        np.where(finite[:, None], predicted, -1e9),
        descriptors,
        reference.xy,
        reference.descriptors,
        order,
        starts,
        shape,
        origin,
        cell,
        _GUIDED_RATIO**2,
        _GUIDED_LIMIT**2,
    )
    rows = np.flatnonzero(best >= 0)
    rows = rows[back[best[rows]] == rows]
    return np.stack([rows, best[rows]], axis=1)


@njit(cache=True, nogil=True)
def _best_in_window(predicted, moving, places, reference, order, starts, shape, origin, cell, ratio, limit):  # type: ignore[no-untyped-def]
    """Best reference index for each prediction (-1: none), and best prediction for each reference."""
    best = np.full(predicted.shape[0], -1, np.int64)
    back = np.full(places.shape[0], -1, np.int64)
    back_distance = np.full(places.shape[0], 1 << 40, np.int64)
    for i in range(predicted.shape[0]):
        column = int(np.floor((predicted[i, 0] - origin[0]) / cell))
        row = int(np.floor((predicted[i, 1] - origin[1]) / cell))
        first, second, found = 1 << 40, 1 << 40, -1
        for r in range(max(row - 1, 0), min(row + 2, shape[1])):
            for c in range(max(column - 1, 0), min(column + 2, shape[0])):
                for k in range(starts[r * shape[0] + c], starts[r * shape[0] + c + 1]):
                    j = order[k]
                    if abs(places[j, 0] - predicted[i, 0]) > cell or abs(places[j, 1] - predicted[i, 1]) > cell:
                        continue
                    distance = 0
                    for d in range(128):
                        difference = int(moving[i, d]) - int(reference[j, d])
                        distance += difference * difference
                    if distance < back_distance[j]:
                        back_distance[j] = distance
                        back[j] = i
                    if distance < first:
                        # two orientations of one place are no rivals
                        if found < 0 or abs(places[j, 0] - places[found, 0]) + abs(places[j, 1] - places[found, 1]) > 2:
                            second = first
                        first, found = distance, j
                    elif (
                        distance < second
                        and abs(places[j, 0] - places[found, 0]) + abs(places[j, 1] - places[found, 1]) > 2
                    ):
                        second = distance
        if found >= 0 and first < limit and first < ratio * second:
            best[i] = found
    return best, back
