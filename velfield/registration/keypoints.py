"""SIFT keypoints of a frame, detected on a downscaled image and distributed evenly over it, and their matches.

Paper: registration (SIFT). Keypoints register a frame to about a pixel; `alignment` refines to subpixel accuracy. All
are matched for a prior homography; guided matches are searched within 50 x 50 px of the predicted position.
"""

from dataclasses import dataclass
from itertools import chain
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree

from schemas.arrays import ByteArray, Float32Array, FloatArray, GreyImage, IntArray, Mask
from schemas.flight import RegistrationConfig
from velfield.errors import Failure
from velfield.registration.transforms import HomographyTransform

_CELLS_ALONG_SIDE = 12
"""Cells along the frame's longer side; the strongest keypoint of every cell comes before the second of any."""
_CONTRAST = 0.02
"""SIFT's contrast threshold, below OpenCV's 0.04: asphalt has little contrast."""
_CANDIDATES_PER_KEYPOINT = 3


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints and descriptors."""

    xy: FloatArray
    """(n, 2) px of the full image, ordered so that the first are the strongest of each cell."""
    descriptors: ByteArray
    """(n, 128) uint8, SIFT."""

    def __len__(self) -> int:
        return len(self.xy)


def detect_keypoints(
    grey: GreyImage, config: RegistrationConfig, mask: Mask | None = None, *, count: int | None = None
) -> Keypoints:
    """Detect SIFT keypoints of an image (h, w) uint8, the strongest of each cell first.

    They lie where ``mask`` (h, w) bool allows it, None: everywhere; ``count`` replaces ``config.max_keypoints``.
    """
    n_keypoints = config.max_keypoints if count is None else count
    height, width = grey.shape
    size = max(8, round(width * config.keypoint_scale)), max(8, round(height * config.keypoint_scale))
    small = grey if size == (width, height) else cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    small_mask = None
    if mask is not None:
        small_mask = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    n_candidates = _CANDIDATES_PER_KEYPOINT * n_keypoints
    sift = cv2.SIFT.create(nfeatures=n_candidates, contrastThreshold=_CONTRAST, enable_precise_upscale=True)
    detected = sift.detect(small, small_mask)
    if not detected:
        return Keypoints(np.zeros((0, 2)), np.zeros((0, 128), np.uint8))
    xy = np.array([point.pt for point in detected])
    response = np.array([point.response for point in detected])
    order = _order_by_cell(xy, response, max(size) / _CELLS_ALONG_SIDE)[:n_keypoints]
    kept, descriptors = sift.compute(small, [detected[k] for k in order])
    if descriptors is None:
        return Keypoints(np.zeros((0, 2)), np.zeros((0, 128), np.uint8))
    xy = (np.array([point.pt for point in kept]) + 0.5) * (width / size[0], height / size[1]) - 0.5
    return Keypoints(xy, np.clip(np.rint(descriptors), 0, 255).astype(np.uint8))


def _order_by_cell(xy: FloatArray, response: FloatArray, cell_px: float) -> IntArray:
    """Order (n,): the strongest of every cell, then the second strongest of every cell, ..."""
    cell = np.floor(xy / cell_px).astype(np.int64)
    key = cell[:, 1] * 10_000 + cell[:, 0]
    by_cell = np.lexsort((-response, key))
    starts = np.flatnonzero(np.r_[True, np.diff(key[by_cell]) != 0])
    rank = np.arange(len(xy)) - np.repeat(starts, np.diff(np.r_[starts, len(xy)]))
    return np.asarray(by_cell[np.lexsort((-response[by_cell], rank))])


Pairs = IntArray
"""(m, 2) indices into the moving and the reference keypoints."""

PRIOR_POINTS = 1200
"""Keypoints of the frame that the prior is estimated from."""
_RATIO = 0.85
"""Ratio test: largest distance to the nearest descriptor over that to the second nearest."""
_GUIDED_RATIO = 0.9
_SAME_PX = 2.0
_MAX_GUIDED_DISTANCE = 350
"""Largest descriptor distance of a guided match; OpenCV's SIFT descriptors have a norm of about 512."""
_PRIOR_THRESHOLD_PX = 6.0
"""Inlier threshold of the prior: it models neither rolling shutter nor relief."""
_MIN_PRIOR_MATCHES = 16
_MAX_STRETCH = 6.0


def match_descriptors(moving: ByteArray | Float32Array, reference: ByteArray | Float32Array) -> Pairs:
    """Cross-checked matches of descriptors (n, 128) and (m, 128) that pass the ratio test."""
    if len(moving) < 2 or len(reference) < 2:
        return np.zeros((0, 2), np.int64)
    a, b = moving.astype(np.float32), reference.astype(np.float32)
    distance = np.square(b).sum(axis=1) - 2.0 * (a @ b.T) + np.square(a).sum(axis=1)[:, None]
    best = distance.argmin(axis=1)
    rows = np.arange(len(a))
    nearest = distance[rows, best]
    mutual = distance.argmin(axis=0)[best] == rows
    distance[rows, best] = np.inf
    unambiguous = nearest < _RATIO**2 * distance.min(axis=1)
    matched = np.flatnonzero(mutual & unambiguous)
    return np.stack([matched, best[matched]], axis=1)


def estimate_homography_prior(
    undistorted: FloatArray, descriptors: ByteArray, reference: Keypoints
) -> HomographyTransform | Failure:
    """Homography by MAGSAC from a frame's keypoints, undistorted px (n, 2), to reference keypoints, base px.

    A failure gives the number of matches and inliers.
    """
    pairs = match_descriptors(descriptors[:PRIOR_POINTS], reference.descriptors)
    return fit_homography(undistorted[pairs[:, 0]], reference.xy[pairs[:, 1]])


def fit_homography(source: FloatArray, target: FloatArray) -> HomographyTransform | Failure:
    """Homography by MAGSAC from points (n, 2), undistorted px, to points (n, 2), base px; up to half may be wrong."""
    if len(source) < _MIN_PRIOR_MATCHES:
        return Failure(f"{len(source)} matches, {_MIN_PRIOR_MATCHES} needed")
    matrix, inliers = cv2.findHomography(
        source, target, cv2.USAC_MAGSAC, _PRIOR_THRESHOLD_PX, maxIters=4000, confidence=0.9999
    )
    n_inliers = 0 if inliers is None else int(inliers.sum())
    if matrix is None or n_inliers < _MIN_PRIOR_MATCHES:
        return Failure(f"{n_inliers} inliers of {len(source)} matches, {_MIN_PRIOR_MATCHES} needed")
    prior = HomographyTransform(np.asarray(matrix / matrix[2, 2], dtype=np.float64))
    if not is_plausible(prior, source[inliers.ravel() > 0]):
        return Failure(f"the homography of {n_inliers} inliers mirrors, folds or stretches the frame")
    return prior


def is_plausible(prior: HomographyTransform, xy: FloatArray) -> bool:
    """Whether the map preserves handedness, with a scale within 6-fold, at points (n, 2)."""
    here = prior(xy)
    along_x, along_y = prior(xy + np.array([1.0, 0.0])) - here, prior(xy + np.array([0.0, 1.0])) - here
    area = along_x[:, 0] * along_y[:, 1] - along_x[:, 1] * along_y[:, 0]
    longest = np.maximum(np.linalg.norm(along_x, axis=1), np.linalg.norm(along_y, axis=1))
    with np.errstate(invalid="ignore"):
        return bool((area > _MAX_STRETCH**-2).all() and (longest < _MAX_STRETCH).all())


def match_guided(predicted: FloatArray, descriptors: ByteArray, reference: Keypoints, *, search_px: float) -> Pairs:
    """Cross-checked matches about the predicted positions (n, 2), base px, in squares of a side of ``search_px``."""
    if not len(predicted) or not len(reference):
        return np.zeros((0, 2), np.int64)
    finite = np.flatnonzero(np.isfinite(predicted).all(axis=1))
    tree = cKDTree(reference.xy)
    near: Any = tree.query_ball_point(predicted[finite], search_px / 2, p=np.inf, return_sorted=True)
    row = np.repeat(finite, [len(each) for each in near])
    column = np.fromiter(chain.from_iterable(near), np.int64, len(row))
    difference = descriptors[row].astype(np.int32) - reference.descriptors[column]
    distance = np.einsum("nk,nk->n", difference, difference)
    first = _first_of_each(row, distance)
    best = np.full(len(predicted), -1)
    best[row[first]] = column[first]
    # SIFT gives one keypoint per dominant orientation: those of one position do not compete
    apart = np.abs(reference.xy[column] - reference.xy[best[row]]).sum(axis=1) > _SAME_PX
    second = np.full(len(predicted), np.iinfo(np.int32).max)
    np.minimum.at(second, row[apart], distance[apart])
    mutual = np.isin(first, _first_of_each(column, distance))
    good = mutual & (distance[first] < np.minimum(_MAX_GUIDED_DISTANCE**2, _GUIDED_RATIO**2 * second[row[first]]))
    return np.stack([row[first[good]], column[first[good]]], axis=1)


def _first_of_each(group: IntArray, distance: IntArray) -> IntArray:
    """Places, in the order of the groups, of the smallest distance of each group (n,)."""
    order = np.lexsort((distance, group))
    return order[np.unique(group[order], return_index=True)[1]]
