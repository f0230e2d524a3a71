"""Precision and recall of a detector without labels, from how its detections move over three frames.

A detection in the middle one of three frames is *moving* (at constant velocity along its orientation: almost surely a
car), *stationary* (a parked car or a chimney: no evidence either way), or *isolated* (without a counterpart in the
other frames: a false positive, or a car that was missed there). Moving and isolated detections give precision and
recall at every score threshold; the rate of missed detections is estimated from those of highest score.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from schemas.arrays import FloatArray, GreyImage, IntArray
from schemas.flight import TrackingConfig
from velfield.detection.detect import detect_frame
from velfield.detection.detector import Detector
from velfield.detection.evaluation import f_measure_plateau
from velfield.detection.motion.boxes import MAX_AXIS_OFFSET_RAD
from velfield.detection.motion.difference import MotionFrame
from velfield.detection.motion.links import MAX_LENGTHS_PER_S
from velfield.parallel import count_steps, parallel_map

MIN_SCORE = -0.3
"""Detections below this are noise whatever the detector."""
_STATIONARY_LENGTHS = 0.12
_MOVING_LENGTHS = 0.35
"""Displacement between two frames, in car lengths: below the first a detection is stationary, above the second
moving."""
_TOLERANCE_LENGTHS = 0.3  # a detection is accurate to a pixel or two, a blob of motion to less
_TOLERANCE_FRACTION = 0.08
_MIN_MOVING = 20
_MAX_INTERVAL_S = TrackingConfig().max_interval_s
_RELIABLE_FRACTION = 0.5
"""This fraction of the moving detections, those of highest score, are almost surely cars, and so are the isolated ones
among them."""
_MIN_PRECISION_RECALL = 0.85
_FEW_STATIONARY, _MIN_CAR_LIKE_FRACTION = 0.3, 0.15
"""Stationary detections are ignored where they are fewer than this fraction of the moving ones; else this fraction of
them must score as high as the median moving car. On a simulated city a third did, on a clip of cars 5 px wide 1 of
40."""


class MotionState(IntEnum):
    """Motion of a detection over three frames."""

    ISOLATED = 0
    STATIONARY = 1
    MOVING = 2


@dataclass(frozen=True)
class TimedDetections:
    """Detections of a frame at a low threshold.

    Attributes
    ----------
    xy : float64 (n, 2)
        Working px.
    orientation_rad, score : float64 (n,)
    time_s : float
    """

    xy: FloatArray
    orientation_rad: FloatArray
    score: FloatArray
    time_s: float


@dataclass(frozen=True)
class MotionEvaluation:
    """Precision-recall curve estimated from motion.

    Attributes
    ----------
    thresholds : float64 (m,)
        Descending.
    precision : float64 (m,)
        Fraction of cars among the moving and isolated detections above the threshold.
    recall : float64 (m,)
        Fraction of the moving detections that are above the threshold.
    operating_threshold : float
        Centre of the plateau of the F1 score; NaN where too few detections move.
    stationary_scores : float64 (k,)
        Scores of the stationary detections.
    """

    thresholds: FloatArray
    precision: FloatArray
    recall: FloatArray
    operating_threshold: float
    stationary_scores: FloatArray

    @property
    def operating_index(self) -> int:
        """Index of the curve's point nearest to the operating threshold."""
        return int(np.argmin(np.abs(self.thresholds - self.operating_threshold)))

    def appearance_is_sufficient(self, median_car_score: float) -> bool:
        """Whether the detector separates cars from everything else, so that stationary detections are cars as well.

        Precision and recall do not count stationary detections. Where cars are small and resemble many other things,
        there are thousands of stationary detections, almost none of which scores as high as the median car.

        Parameters
        ----------
        median_car_score
            Of held-out moving cars.
        """
        if not self.operating_threshold >= 0:  # also where it is NaN
            return False
        index = self.operating_index
        stationary = self.stationary_scores[self.stationary_scores > self.operating_threshold]
        few = len(stationary) < _FEW_STATIONARY * index
        car_like = few or float((stationary > median_car_score).mean()) > _MIN_CAR_LIKE_FRACTION
        return car_like and min(self.precision[index], self.recall[index]) > _MIN_PRECISION_RECALL


def classify_motion(
    before: TimedDetections, middle: TimedDetections, after: TimedDetections, *, car_length_px: float
) -> NDArray[np.int8]:
    """`MotionState` of each detection of the middle frame, (n,)."""
    first, second = middle.time_s - before.time_s, after.time_s - middle.time_s
    states = np.full(len(middle.xy), MotionState.ISOLATED, np.int8)
    stationary_px, moving_px = _STATIONARY_LENGTHS * car_length_px, _MOVING_LENGTHS * car_length_px
    for i, (sources, targets) in enumerate(_reachable(before, middle, after, first, second, car_length_px)):
        incoming, outgoing = middle.xy[i] - before.xy[sources], after.xy[targets] - middle.xy[i]
        total = incoming[:, None] + outgoing[None]
        distance = np.hypot(total[..., 0], total[..., 1])
        change = outgoing[None] / second - incoming[:, None] / first
        mismatch = np.hypot(change[..., 0], change[..., 1]) * (first + second) / 2
        constant = mismatch < _TOLERANCE_LENGTHS * car_length_px + _TOLERANCE_FRACTION * distance / 2
        angle = np.arctan2(total[..., 1], total[..., 0]) - middle.orientation_rad[i]
        along_axis = np.abs(np.mod(angle + np.pi / 2, np.pi) - np.pi / 2) < MAX_AXIS_OFFSET_RAD
        one_side = min(np.hypot(*step.T).min(initial=np.inf) for step in (incoming, outgoing)) < stationary_px
        if (constant & (distance < 2 * stationary_px)).any():
            states[i] = MotionState.STATIONARY
        elif (constant & along_axis & (distance > moving_px)).any():
            states[i] = MotionState.MOVING
        elif one_side:  # missed in the other frame
            states[i] = MotionState.STATIONARY
    return states


def classify_bursts(
    frames: Sequence[TimedDetections], *, car_length_px: float, max_interval_s: float = _MAX_INTERVAL_S
) -> tuple[list[int], list[NDArray[np.int8]]]:
    """Indices of the frames that have a neighbour in time on both sides, and the `MotionState` of their detections."""
    middles = [
        k
        for k in range(1, len(frames) - 1)
        if max(frames[k].time_s - frames[k - 1].time_s, frames[k + 1].time_s - frames[k].time_s) <= max_interval_s
    ]
    return middles, [classify_motion(*frames[k - 1 : k + 2], car_length_px=car_length_px) for k in middles]


def select_bursts(times_s: Sequence[float], count: int, max_interval_s: float = _MAX_INTERVAL_S) -> IntArray:
    """Indices of the frames of up to ``count`` bursts of three neighbours in time, spread evenly.

    Frames farther apart than ``max_interval_s`` are not neighbours.

    Examples
    --------
    >>> select_bursts([0.0, 0.2, 0.4, 4.0, 4.2, 4.4, 8.0, 8.2, 8.4], 2).tolist()
    [0, 1, 2, 6, 7, 8]
    """
    gaps = np.diff(np.asarray(times_s, np.float64))
    starts = np.flatnonzero(np.maximum(gaps[:-1], gaps[1:]) <= max_interval_s)
    chosen = starts[np.unique(np.linspace(0, len(starts) - 1, min(count, len(starts))).round().astype(int))]
    return np.unique((chosen[:, None] + np.arange(3)).ravel())


def evaluate_by_motion(
    frames: Sequence[TimedDetections], *, car_length_px: float, max_interval_s: float = _MAX_INTERVAL_S
) -> MotionEvaluation:
    """Precision and recall of a detector from the motion of its detections.

    Parameters
    ----------
    frames : sequence of TimedDetections
        In time order; bursts of three or more suffice.
    car_length_px : float
        A car's length, working px.
    max_interval_s : float
        Frames farther apart than this are not neighbours.
    """
    middles, states = classify_bursts(frames, car_length_px=car_length_px, max_interval_s=max_interval_s)
    score = np.concatenate([np.empty(0), *(frames[k].score for k in middles)])
    state = np.concatenate([np.empty(0, np.int8), *states])
    counted = state != MotionState.STATIONARY
    order = np.argsort(-score[counted], kind="stable")
    thresholds, moving = score[counted][order], state[counted][order] == MotionState.MOVING
    if moving.sum() < _MIN_MOVING:
        return MotionEvaluation(np.empty(0), np.empty(0), np.empty(0), float("nan"), np.empty(0))
    true_positives = np.cumsum(moving)
    isolated = np.arange(1, len(true_positives) + 1) - true_positives
    reliable = int(np.searchsorted(true_positives, _RELIABLE_FRACTION * true_positives[-1]))
    missed_rate = isolated[reliable] / true_positives[reliable]
    false_positives = np.maximum(isolated - true_positives * missed_rate, 0.0)
    precision = 1 - false_positives / (true_positives + isolated)
    recall = true_positives / true_positives[-1]
    plateau = f_measure_plateau(precision, recall, beta=1.0)
    # A tracklet needs three detections in a row, and linking drops false positives: that asks for a low threshold.
    # False positives that are stationary are not in these figures: that asks for one not at the plateau's lower end.
    operating = float(thresholds[plateau[0]] + thresholds[plateau[-1]]) / 2
    return MotionEvaluation(thresholds, precision, recall, operating, score[~counted])


def evaluate_detector(
    detector: Detector,
    frames: Sequence[MotionFrame],
    background: GreyImage | None,
    *,
    min_score: float = MIN_SCORE,
    max_interval_s: float = _MAX_INTERVAL_S,
) -> MotionEvaluation:
    """Precision and recall of a detector on registered frames without labels.

    Parameters
    ----------
    detector : Detector
    frames : sequence of MotionFrame
        Bursts of three (`select_bursts`); six suffice.
    background : uint8 (h, w) or None
        Temporal median, for a detector that uses the difference to it.
    min_score : float
        Detections below this are dropped.
    max_interval_s : float
        Frames farther apart than this are not neighbours.
    """

    def detect(frame: MotionFrame) -> TimedDetections:
        cars = detect_frame(frame.image, frame.valid, detector, background, threshold=min_score)
        count_steps(1)
        return TimedDetections(cars.xy, cars.orientation_rad, np.asarray(cars.score, np.float64), frame.time_s)

    length = detector.record.working_car_length_px
    count_steps(0, announced=len(frames))
    return evaluate_by_motion(parallel_map(detect, frames), car_length_px=length, max_interval_s=max_interval_s)


def _reachable(
    before: TimedDetections,
    middle: TimedDetections,
    after: TimedDetections,
    first_s: float,
    second_s: float,
    car_length_px: float,
) -> list[tuple[IntArray, IntArray]]:
    """For each detection of the middle frame, those before and after within the distance that the speed limit
    allows."""
    reachable: list[list[IntArray]] = []
    for other, interval in ((before, first_s), (after, second_s)):
        radius = MAX_LENGTHS_PER_S * interval * car_length_px
        tree = KDTree(other.xy.reshape(-1, 2))
        reachable.append([np.array(tree.query_ball_point(position, radius), np.int64) for position in middle.xy])
    return list(zip(reachable[0], reachable[1], strict=True))
