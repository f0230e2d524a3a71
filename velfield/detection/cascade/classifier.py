"""The classifier of the cascade on region proposals: boosted stumps on oriented crops, in three stages; oriented NMS.

A classifier of upright crops would have to learn cars of every orientation. This one is trained on crops rotated so
that the car lies horizontally: it learns one orientation, and the rotation of the best crop is the car's. Scoring every
rotation at every pixel would take a minute a frame. So it scores region proposals (`proposals`), in stages of 60, 150
and all rounds, at ever finer offsets and rotations; each stage rejects candidates whose score nearly all held-out cars
exceed, as an attentional cascade does.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from schemas.arrays import Float32Array, FloatArray, IntArray
from velfield.detection.boosting import BoostedStumps
from velfield.detection.cascade.feature_image import FeatureImage, score_poses
from velfield.detection.orientation import CAR_ASPECT

STAGE1_ROUNDS, STAGE2_ROUNDS = 60, 150
_STAGE1_ROTATIONS = np.radians([-18.0, 0.0, 18.0])
_STAGE2_ROTATIONS = np.radians([-12.0, 0.0, 12.0])
_STAGE3_ROTATIONS = np.radians([-8.0, 0.0, 8.0])
_STAGE2_MARGIN = 0.15
"""A candidate this far below the score threshold after stage 2 is rejected: few recover from there."""
_NMS_ALONG, _NMS_ACROSS = 0.66, 0.4
"""Semi-axes, in car lengths, of the ellipse about a detection in which others are suppressed."""
_MAX_OVERLAP = 0.25
"""A detection is suppressed where better ones cover more than this fraction of its rectangle."""
_SPOTS_ALONG, _SPOTS_ACROSS = 12, 5
"""Sample points of a rectangle."""
_SOFTMAX_SHARPNESS = 15.0
"""Of the scores about a peak, by which offset and rotation are averaged."""
_MIN_SD_RAD = 0.02


def offset_grid(along: int, across: int, step: int = 1) -> IntArray:
    """Whole-pixel offsets (m, 2)."""
    return np.array(
        [(u, v) for u in range(-along, along + 1, step) for v in range(-across, across + 1, step)], np.int64
    )


_STAGE1_OFFSETS, _STAGE2_OFFSETS, _STAGE3_OFFSETS = offset_grid(4, 4, 2), offset_grid(2, 2), offset_grid(1, 1)


@dataclass(frozen=True)
class PoseScorer:
    """A classifier bound to an image: it scores poses, that is a position and a rotation."""

    features: FeatureImage
    stumps: BoostedStumps
    contrast_floor: float

    def scores(
        self, xy: FloatArray, axes: FloatArray, rotations: FloatArray, offsets: IntArray, rounds: int | None = None
    ) -> Float32Array:
        """Scores (n, rotations, offsets) about positions (n, 2) and axes (n,), offsets along and across the axis."""
        scores = score_poses(
            self.stumps,
            self.features,
            np.repeat(xy, len(rotations), axis=0),
            (axes[:, None] + rotations).ravel(),
            offsets,
            contrast_floor=self.contrast_floor,
            rounds=rounds,
        )
        return scores.reshape(len(xy), len(rotations), len(offsets))

    def best_poses(
        self, xy: FloatArray, axes: FloatArray, rotations: FloatArray, offsets: IntArray, rounds: int | None = None
    ) -> tuple[FloatArray, FloatArray, Float32Array]:
        """Position, axis and score of the best pose about each position, by the first rounds."""
        scores = self.scores(xy, axes, rotations, offsets, rounds)
        flat = scores.reshape(len(xy), -1)
        best = flat.argmax(axis=1)
        rotation, offset = np.unravel_index(best, scores.shape[1:])
        axes = axes + rotations[rotation]
        xy = offset_along_axis(xy, axes, offsets[offset].astype(np.float64))
        return xy, axes, flat[np.arange(len(xy)), best]


def classify_proposals(
    scorer: PoseScorer, proposals: FloatArray, *, min_score: float, min_stage1_score: float = -np.inf
) -> FloatArray:
    """Detections at region proposals; a car may be detected several times, see `nms_oriented`.

    Parameters
    ----------
    proposals
        (n, 3...): x, y, axis, as `proposals.propose_regions` gives them.
    min_score
        Score threshold.
    min_stage1_score
        Candidates with at most this score are rejected by stage 1.

    Returns
    -------
    (n, 5): x, y, axis, score, standard deviation of the axis.
    """
    xy, axes = proposals[:, :2], proposals[:, 2]
    if not len(xy):
        return np.empty((0, 5))
    xy, axes, score = scorer.best_poses(xy, axes, _STAGE1_ROTATIONS, _STAGE1_OFFSETS, STAGE1_ROUNDS)
    kept = np.flatnonzero(score > min_stage1_score)
    kept = kept[_deduplicate(xy[kept], axes[kept], score[kept])]
    if not len(kept):
        return np.empty((0, 5))
    xy, axes, score = scorer.best_poses(xy[kept], axes[kept], _STAGE2_ROTATIONS, _STAGE2_OFFSETS, STAGE2_ROUNDS)
    kept = np.flatnonzero(score > min_score - _STAGE2_MARGIN)
    return _refine_poses(scorer, xy[kept], axes[kept], min_score)


def _deduplicate(xy: FloatArray, axes: FloatArray, score: Float32Array) -> IntArray:
    """The best of the candidates that came to lie in one cell of 2 px and 20 degrees."""
    order = np.argsort(-score, kind="stable")
    key = np.column_stack([np.rint(xy / 2), np.rint(np.mod(axes, np.pi) * (9 / np.pi)) % 9])[order]
    _, first = np.unique(key, axis=0, return_index=True)
    return np.asarray(np.sort(order[first]), np.int64)


def _refine_poses(scorer: PoseScorer, xy: FloatArray, axes: FloatArray, min_score: float) -> FloatArray:
    """Stage 3, all rounds: position and axis below the step, as the softmax-weighted mean of the poses about a peak."""
    scores = scorer.scores(xy, axes, _STAGE3_ROTATIONS, _STAGE3_OFFSETS) if len(xy) else np.empty((0, 1, 1), np.float32)
    kept = scores.max(axis=(1, 2), initial=-np.inf) > min_score
    xy, axes, scores = xy[kept], axes[kept], scores[kept]
    if not len(xy):
        return np.empty((0, 5))
    peak = scores.max(axis=(1, 2))
    weights = np.exp(_SOFTMAX_SHARPNESS * (scores - peak[:, None, None]).astype(np.float64))
    weights /= weights.sum(axis=(1, 2), keepdims=True)
    by_rotation = weights.sum(axis=2)
    rotation = by_rotation @ _STAGE3_ROTATIONS
    sd = np.sqrt(np.maximum(by_rotation @ _STAGE3_ROTATIONS**2 - rotation**2, 0.0))
    xy = offset_along_axis(xy, axes + rotation, weights.sum(axis=1) @ _STAGE3_OFFSETS.astype(np.float64))
    return np.column_stack([xy, np.mod(axes + rotation, np.pi), peak, np.maximum(sd, _MIN_SD_RAD)])


def offset_along_axis(xy: FloatArray, angles: FloatArray, offsets: FloatArray) -> FloatArray:
    """Positions (n, 2) displaced by offsets (n, 2) along and across their axes (n,)."""
    c, s = np.cos(angles), np.sin(angles)
    u, v = offsets[:, 0], offsets[:, 1]
    return xy + np.column_stack([u * c - v * s, u * s + v * c])


def nms_oriented(cars: FloatArray, car_length_px: float) -> FloatArray:
    """Non-maximum suppression of oriented rectangles (n, 4...) as x, y, axis, score; the best first.

    A detection is suppressed by a better one whose centre is near, or by several that cover it together. In a queue the
    classifier detects the gap between two cars as well, a boot and a bonnet: such a detection overlaps both, and is too
    far from each to be suppressed by its centre.
    """
    cars = np.ascontiguousarray(cars[np.argsort(-cars[:, 3], kind="stable")])
    return np.asarray(cars[_survivors(cars, car_length_px, CAR_ASPECT * car_length_px)])


@njit(cache=True, nogil=True)
def _survivors(cars, length, width):  # type: ignore[no-untyped-def]
    """Which cars, the best first, are not suppressed."""
    kept = np.zeros(len(cars), np.bool_)
    covered = np.empty(_SPOTS_ALONG * _SPOTS_ACROSS, np.bool_)
    for i in range(len(cars)):
        c, s = np.cos(cars[i, 2]), np.sin(cars[i, 2])
        covered[:] = False
        alone = True
        for j in range(i):
            dx, dy = cars[i, 0] - cars[j, 0], cars[i, 1] - cars[j, 1]
            if not kept[j] or dx * dx + dy * dy > (length + width) ** 2:
                continue
            cj, sj = np.cos(cars[j, 2]), np.sin(cars[j, 2])
            u, v = dx * cj + dy * sj, dy * cj - dx * sj
            if (u / (_NMS_ALONG * length)) ** 2 + (v / (_NMS_ACROSS * length)) ** 2 < 1:
                alone = False
                break
            for k in range(len(covered)):
                a = ((k // _SPOTS_ACROSS + 0.5) / _SPOTS_ALONG - 0.5) * length
                b = ((k % _SPOTS_ACROSS + 0.5) / _SPOTS_ACROSS - 0.5) * width
                x, y = dx + a * c - b * s, dy + a * s + b * c
                if abs(x * cj + y * sj) < length / 2 and abs(y * cj - x * sj) < width / 2:
                    covered[k] = True
        kept[i] = alone and covered.mean() < _MAX_OVERLAP
    return kept
