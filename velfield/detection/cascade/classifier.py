"""The classifier of the cascade on region proposals: boosted stumps on oriented crops, in three stages; oriented NMS.

A classifier of upright crops would have to learn cars of every orientation. This one is trained on crops rotated so
that the car lies horizontally: it learns one orientation, and the rotation of the best crop is the car's. Scoring every
rotation at every pixel would take a minute a frame. So it scores region proposals (`proposals`), in stages of 60, 150
and all rounds, at ever finer offsets and rotations; each stage rejects candidates whose score nearly all held-out cars
exceed, as an attentional cascade does.

Region proposals: a coarse boosted classifier, dense over the image at six rotations, and its local maxima.

It works at half the resolution and every fourth pixel, and is trained on cars displaced and rotated by up to half a
step. Extrema of a difference of Gaussians would need three times as many proposals, and lie on bonnets and boots.

Lorries and buses centred: detections of cars on their load or cab are moved to the centre of the vehicle.

A second boosted classifier of the same kind, at half the resolution and with a window that holds both ends of a bus,
scores positions along the axis of a detection as the centre of a long vehicle. It ships: one frame's labels hold too
few lorries to train it.
"""

from dataclasses import dataclass
from functools import cache, cached_property
from importlib.resources import files
from weakref import WeakKeyDictionary

import cv2
import numpy as np
from numba import njit

from schemas.arrays import Float32Array, FloatArray, IntArray, Mask
from schemas.detector import LongVehicleRecord
from velfield.detection.boosting import BoostedStumps
from velfield.detection.cascade.feature_image import (
    FeatureImage,
    OffsetScorer,
    PatchScale,
    features_of_reduced,
    score_poses,
)
from velfield.detection.detector import Detections, concatenate
from velfield.detection.frame import SearchableFrame
from velfield.detection.orientation import CAR_ASPECT

ROTATIONS = np.arange(6) * (np.pi / 6)
PER_MEGAPIXEL = 4000
"""The best proposals, so many, are classified."""
_TILE = 6
"""Positions in a tile, along and across: one patch serves them all."""
_STEP = 2
"""Coarse px between positions."""
_POSITIONS = [_STEP * k - (_TILE - 1) for k in range(_TILE)]
_OFFSETS = np.array([(u, v) for v in _POSITIONS for u in _POSITIONS], np.int64)
_NMS_RADIUS_PX = 5.0
_CELL_PX = 2


def propose_regions(
    coarse: FeatureImage,
    shape: tuple[int, int],
    valid: Mask | None,
    stumps: BoostedStumps,
    *,
    contrast_floor: float,
    min_score: float = -np.inf,
    per_megapixel: float = PER_MEGAPIXEL,
) -> FloatArray:
    """Local maxima of the coarse classifier over position and rotation.

    Parameters
    ----------
    coarse
        Features of the image at the scale `feature_image.COARSE`.
    shape
        Height and width of the image itself.

    Returns
    -------
    (n, 4): x, y in px of the image, axis, score; the best first.
    """
    rows = np.concatenate([_local_maxima(coarse, shape, stumps, float(angle), contrast_floor) for angle in ROTATIONS])
    rows = rows[in_view(rows, shape, valid) & (rows[:, 3] > min_score)]
    rows = rows[np.argsort(-rows[:, 3], kind="stable")]
    max_count = int(per_megapixel * shape[0] * shape[1] / 1e6) + 8
    rotation = np.rint(rows[:, 2] / ROTATIONS[1]).astype(np.int64)
    taken = np.zeros((len(ROTATIONS), shape[0] // _CELL_PX + 1, shape[1] // _CELL_PX + 1), np.bool_)
    return np.asarray(rows[_suppress(rows[:, :2].copy(), rotation, taken, _NMS_RADIUS_PX, _CELL_PX, max_count)])


def in_view(xy: FloatArray, shape: tuple[int, int], valid: Mask | None) -> Mask:
    """Whether positions (n, 2...) lie in an image (h, w), and where it is ``valid``."""
    x, y = (np.clip(np.rint(xy[:, k]), 0, shape[1 - k] - 1).astype(np.int64) for k in (0, 1))
    inside = (np.abs(xy[:, 0] - x) <= 0.5) & (np.abs(xy[:, 1] - y) <= 0.5)
    return np.asarray(inside if valid is None else inside & valid[y, x])


def _local_maxima(
    coarse: FeatureImage, shape: tuple[int, int], stumps: BoostedStumps, angle: float, contrast_floor: float
) -> FloatArray:
    """Local maxima (n, 4) at one rotation, on a grid rotated likewise, so that its tiles lie side by side."""
    step = coarse.scale.step
    pitch = float(_TILE * _STEP * step)
    centre = np.array([shape[1], shape[0]]) / 2
    reach = np.arange(-np.hypot(*shape) / 2 - pitch, np.hypot(*shape) / 2 + pitch, pitch)
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, s], [-s, c]])
    tiles = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    xy = centre + tiles @ rotation
    margin = 0.75 * pitch
    chosen = np.flatnonzero(((xy > -margin) & (xy < [shape[1] + margin, shape[0] + margin])).all(axis=1))
    axes = np.full(len(chosen), angle)
    scores = score_poses(stumps, coarse, xy[chosen], axes, _OFFSETS, contrast_floor=contrast_floor)
    n = len(reach)
    tiled = np.full((n, _TILE, n, _TILE), -np.inf, np.float32)
    tiled[chosen // n, :, chosen % n, :] = scores.reshape(-1, _TILE, _TILE)
    score = tiled.reshape(n * _TILE, n * _TILE)
    row, column = np.nonzero((score >= cv2.dilate(score, np.ones((3, 3), np.uint8))) & np.isfinite(score))
    positions = reach[0] + (np.stack([column, row], axis=1) * _STEP - (_TILE - 1)) * float(step)
    return np.column_stack([centre + positions @ rotation, np.full(len(row), angle), score[row, column]])


@njit(cache=True, nogil=True)
def _suppress(xy, rotation, taken, radius, cell, max_count):  # type: ignore[no-untyped-def]
    """Non-maximum suppression: rows, the best first, with no better one near of the same or a neighbouring rotation."""
    chosen = np.empty(min(max_count, len(xy)), np.int64)
    rotations, height, width = taken.shape
    reach, n = int(radius / cell) + 1, 0
    for k in range(len(xy)):
        if n == len(chosen):
            break
        x, y = int(xy[k, 0] / cell), int(xy[k, 1] / cell)
        if taken[rotation[k], y, x]:
            continue
        chosen[n] = k
        n += 1
        for i in range(max(0, y - reach), min(height, y + reach + 1)):
            for j in range(max(0, x - reach), min(width, x + reach + 1)):
                dx, dy = cell * (j + 0.5) - xy[k, 0], cell * (i + 0.5) - xy[k, 1]
                if dx * dx + dy * dy < radius * radius:
                    for d in range(-1, 2):
                        taken[(rotation[k] + d) % rotations, i, j] = True
    return chosen[:n]


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


LONG = PatchScale(2, (16, 7))
MIN_LENGTH_RATIO = 1.4
"""A vehicle this many times as long as a car is long."""
OFFSETS = np.array([(u, 0) for u in range(-11, 12)], np.int64)
"""Coarse px along the axis: from the centre of a load to that of an articulated bus."""
_FIRST_ROUNDS, _FIRST_MIN_SCORE = 100, -0.02
"""A car that scores no higher by the first rounds is not part of a long vehicle, which is true of nine of ten. In four
simulated cities those that were part of one scored 0.047 and more."""
_BODY_ALONG, _BODY_ACROSS = 1.0, 0.35
"""Half the rectangle, in car lengths, about the centre of a long vehicle in which other detections are suppressed."""


@dataclass(frozen=True)
class LongVehicleClassifier:
    """The classifier, in use."""

    record: LongVehicleRecord

    @cached_property
    def stumps(self) -> BoostedStumps:
        """Its rounds."""
        return BoostedStumps.from_rounds(self.record.rounds)

    @cached_property
    def scorer(self) -> OffsetScorer:
        """These at `OFFSETS`: they read no background."""
        return OffsetScorer(self.stumps, OFFSETS, 3, LONG)

    def scores(
        self, features: FeatureImage, xy: FloatArray, axes: FloatArray, rounds: int | None = None
    ) -> Float32Array:
        """Scores (n, offsets) of positions (n, 2), displaced by `OFFSETS` along their axes (n,), as a centre.

        By the first rounds alone where a number of them is given.
        """
        n = len(self.stumps) if rounds is None else min(rounds, len(self.stumps))
        return self.scorer.scores(features, xy, axes, contrast_floor=self.record.contrast_floor, rounds=n)

    def centre(self, features: FeatureImage, cars: FloatArray, valid: Mask, settled: Mask | None = None) -> FloatArray:
        """Cars (n, 2...) as x, y, axis, the best first: long vehicles at their centre, one detection each.

        Parameters
        ----------
        features
            Of the image, at the scale `LONG`.
        valid
            (h, w) at that scale: where the frame covers the image; a vehicle whose centre is elsewhere stays where it
            was detected.
        settled
            (n,): cars that stay where they are.
        """
        tested = np.arange(len(cars)) if settled is None else np.flatnonzero(~settled)
        if not len(tested):
            return cars
        tested = tested[self._may_be_long(features, cars[tested])]
        if not len(tested):
            return cars
        scores = self.scores(features, cars[tested, :2], cars[tested, 2])
        offsets = OFFSETS[scores.argmax(axis=1)].astype(np.float64) * features.scale.step
        centres = cars[:, :2].copy()
        centres[tested] = offset_along_axis(cars[tested, :2], cars[tested, 2], offsets)
        long = np.zeros(len(cars), bool)
        step = features.scale.step
        inside = in_view((centres[tested] + 0.5) / step - 0.5, valid.shape, valid)
        long[tested] = (scores.max(axis=1) > self.record.threshold) & inside
        cars = np.column_stack([np.where(long[:, None], centres, cars[:, :2]), cars[:, 2:]])
        return np.asarray(cars[~self._is_covered(cars, long)])

    def confirm(self, features: FeatureImage, weak: FloatArray, valid: Mask) -> FloatArray:
        """Of candidates (n, 4...) as x, y, axis, score those on a long vehicle, moved to its centre, one detection
        each; ``features`` and ``valid`` as of `centre`."""
        weak = weak[self._may_be_long(features, weak)]
        if not len(weak):
            return weak
        scores = self.scores(features, weak[:, :2], weak[:, 2])
        step = features.scale.step
        offsets = OFFSETS[scores.argmax(axis=1)].astype(np.float64) * step
        centres = offset_along_axis(weak[:, :2], weak[:, 2], offsets)
        best = scores.max(axis=1)
        inside = in_view((centres + 0.5) / step - 0.5, valid.shape, valid)
        long = (best > self.record.threshold) & inside
        rows = np.flatnonzero(long)[np.argsort(-best[long], kind="stable")]
        found = np.column_stack([centres[rows], weak[rows, 2:]])
        return np.asarray(found[~self._is_covered(found, np.ones(len(found), bool))])

    def _may_be_long(self, features: FeatureImage, cars: FloatArray) -> Mask:
        """Whether the first rounds leave it open that each car (n, 3...) is part of a long vehicle."""
        first = self.scores(features, cars[:, :2], cars[:, 2], rounds=_FIRST_ROUNDS)
        return np.asarray(first.max(axis=1) > min(_FIRST_MIN_SCORE, self.record.threshold))

    def _is_covered(self, cars: FloatArray, long: Mask) -> Mask:
        """Whether each car lies on a long vehicle: of two long ones the better one stays."""
        covered = np.zeros(len(cars), np.bool_)
        along, across = (half * self.record.working_car_length_px for half in (_BODY_ALONG, _BODY_ACROSS))
        for k in np.flatnonzero(long):
            if covered[k]:
                continue
            c, s = np.cos(cars[k, 2]), np.sin(cars[k, 2])
            x, y = (cars[:, :2] - cars[k, :2]).T
            inside = (np.abs(x * c + y * s) < along) & (np.abs(y * c - x * s) < across)
            inside[k] = False
            covered |= inside
        return covered


@cache
def shipped_long_vehicles() -> LongVehicleClassifier:
    """The classifier that comes with velfield."""
    data = files("velfield.detection.cascade").joinpath("shipped_long_vehicles.json").read_bytes()
    return LongVehicleClassifier(LongVehicleRecord.model_validate_json(data))


_features: WeakKeyDictionary[SearchableFrame, FeatureImage] = WeakKeyDictionary()


def _long_features(frame: SearchableFrame) -> FeatureImage:
    """Features of a frame at the scale `LONG`, made once: they are asked for twice."""
    found = _features.get(frame)
    if found is None:
        found = _features[frame] = features_of_reduced(frame.half_image, None, LONG)
    return found


def centre_long_vehicles(
    frame: SearchableFrame, cars: FloatArray, car_length_px: float, settled: Mask | None = None
) -> FloatArray:
    """Cars (n, 2...), suppressed already, with long vehicles at their centre; unchanged for cars of another length.

    Those that are ``settled`` (n,) stay where they are.
    """
    long = shipped_long_vehicles()
    if car_length_px != long.record.working_car_length_px or (settled is not None and settled.all()):
        return cars
    return long.centre(_long_features(frame), cars, frame.half_valid, settled)


def confirm_long_vehicles(
    frame: SearchableFrame, weak: Detections, cars: Detections, car_length_px: float
) -> Detections:
    """Lorries and buses among candidates that the detector is not sure of, at their centres; none on a car.

    A detector trained on cars scores a load, or a cab, below its threshold; the classifier of long vehicles sees the
    whole.
    """
    long = shipped_long_vehicles()
    if car_length_px != long.record.working_car_length_px or not len(weak):
        return weak.take(np.empty(0, np.int64))
    rows = long.confirm(_long_features(frame), weak.to_rows(), frame.half_valid)
    found = Detections.from_rows(rows[:, :5], rows[:, 5])
    on_car = np.zeros(len(found), bool)
    for k in range(len(found)):
        offset = cars.xy - found.xy[k]
        c, s = np.cos(found.orientation_rad[k]), np.sin(found.orientation_rad[k])
        along, across = np.abs(offset[:, 0] * c + offset[:, 1] * s), np.abs(offset[:, 1] * c - offset[:, 0] * s)
        on_car[k] = ((along < _BODY_ALONG * car_length_px) & (across < _BODY_ACROSS * car_length_px)).any()
    return found.take(np.flatnonzero(~on_car))


def suppress_and_centre(
    frame: SearchableFrame, found: Detections, kept: Detections | None, car_length_px: float
) -> Detections:
    """Non-maximum suppression of candidates and of detections kept from an earlier call; new long vehicles centred."""
    parts = [found] if kept is None else [found, kept]
    settled = np.arange(sum(map(len, parts))) >= len(found)
    rows = nms_oriented(np.column_stack([concatenate(parts).to_rows(), settled]), car_length_px)
    rows = centre_long_vehicles(frame, rows, car_length_px, rows[:, -1] > 0)
    return Detections.from_rows(rows[:, :5], rows[:, 5])
