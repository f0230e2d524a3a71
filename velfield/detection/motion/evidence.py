"""How many detections move as cars do: the evidence on a detector where nobody marked a car.

A detection in the middle one of three frames either goes on at one velocity along its axis (a car, all but surely),
stands (a parked car or a chimney: no evidence either way), or has no partners (a false find, or a car that was missed
beside). From the first and the last kind follow precision and recall against the threshold; how often a car is missed
beside, the detections that are liked best tell.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from schemas.arrays import FloatArray, GreyImage, IntArray
from schemas.flight import DetectionConfig, TrackingConfig
from velfield.detection.detect import detect_frame
from velfield.detection.detector import Detector
from velfield.detection.evaluation import nearly_best
from velfield.detection.motion.boxes import MAX_AXIS_OFFSET_RAD
from velfield.detection.motion.difference import MotionFrame
from velfield.detection.motion.links import MAX_LENGTHS_PER_S
from velfield.parallel import each

LEAST_SCORE = -0.3
"""Detections below this are noise whatever the detector."""
_STANDS_LENGTHS = 0.12
_MOVES_LENGTHS = 0.35
_MISMATCH_LENGTHS = 0.3  # a detection lies within a pixel or two; regions of motion within less
_MISMATCH_SHARE = 0.08
_MIN_MOVING = 20
_MAX_INTERVAL_S = TrackingConfig().max_interval_s
_SUREST = 0.5
"""This share of the moving detections, those liked best, are cars all but surely, and so are those alone among them."""


_TELLING = 0.85
_FEW_STANDING, _ALIKE_SHARE = 0.3, 0.15
"""What stands is no matter where it is fewer than this share of what moves; else so many of it are to be liked as well
as the usual one that moves: in a simulated city a third were, in a clip of cars 5 px wide one of forty."""


class Conduct(IntEnum):
    """What a detection does over three frames."""

    ALONE = 0
    STANDS = 1
    MOVES = 2


@dataclass(frozen=True)
class Found:
    """Detections of a frame, down to a low threshold.

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
class MotionEvidence:
    """Precision and recall against the threshold, as motion tells them.

    Attributes
    ----------
    threshold : float64 (m,)
        Falling.
    precision : float64 (m,)
        Share of cars among the detections above it that move or are alone.
    recall : float64 (m,)
        Share of all that move that are above it.
    chosen : float
        The middle of the thresholds at which precision and recall together are nearly best; NaN where too few move
        to tell.
    standing : float64 (k,)
        Scores of what stands.
    """

    threshold: FloatArray
    precision: FloatArray
    recall: FloatArray
    chosen: float
    standing: FloatArray

    @property
    def at(self) -> int:
        """Where on the curve the chosen threshold is."""
        return int(np.argmin(np.abs(self.threshold - self.chosen)))

    def tells_cars(self, usual: float) -> bool:
        """Whether cars are told from all else, so that what stands and is found may be taken for cars as well.

        What stands does not tell in precision and recall. Where cars are small and look like much else, thousands of
        things that stand are liked a little, hardly one as much as the usual car.

        Parameters
        ----------
        usual
            Score of the usual car that moves, where it was left out of training.
        """
        if not self.chosen >= 0:  # below, what is found is liked less than disliked
            return False
        at = self.at
        stand = self.standing[self.standing > self.chosen]
        few = len(stand) < _FEW_STANDING * at
        alike = few or float((stand > usual).mean()) > _ALIKE_SHARE
        return alike and min(self.precision[at], self.recall[at]) > _TELLING


def conduct(before: Found, middle: Found, after: Found, *, car_length_px: float) -> NDArray[np.int8]:
    """What each detection of the middle frame does, as `Conduct`, (n,)."""
    first, second = middle.time_s - before.time_s, after.time_s - middle.time_s
    kinds = np.full(len(middle.xy), Conduct.ALONE, np.int8)
    for i, (came, went) in enumerate(_neighbours(before, middle, after, first, second, car_length_px)):
        into, out = middle.xy[i] - before.xy[came], after.xy[went] - middle.xy[i]
        total = into[:, None] + out[None]
        moved = np.hypot(total[..., 0], total[..., 1])
        gap = out[None] / second - into[:, None] / first
        mismatch = np.hypot(gap[..., 0], gap[..., 1]) * (first + second) / 2
        good = mismatch < _MISMATCH_LENGTHS * car_length_px + _MISMATCH_SHARE * moved / 2
        angle = np.arctan2(total[..., 1], total[..., 0]) - middle.orientation_rad[i]
        along = np.abs(np.mod(angle + np.pi / 2, np.pi) - np.pi / 2) < MAX_AXIS_OFFSET_RAD
        stays = min(np.hypot(*step.T).min(initial=np.inf) for step in (into, out)) < _STANDS_LENGTHS * car_length_px
        if (good & (moved < 2 * _STANDS_LENGTHS * car_length_px)).any():
            kinds[i] = Conduct.STANDS
        elif (good & along & (moved > _MOVES_LENGTHS * car_length_px)).any():
            kinds[i] = Conduct.MOVES
        elif stays:  # missed in one of the two: no more alone than one that is found in both
            kinds[i] = Conduct.STANDS
    return kinds


def conduct_of_bursts(
    frames: Sequence[Found], *, car_length_px: float, max_interval_s: float = _MAX_INTERVAL_S
) -> tuple[list[int], list[NDArray[np.int8]]]:
    """Frames, by their place, that have a neighbour in time on both sides, and what each one's detections do."""
    middles = [
        k
        for k in range(1, len(frames) - 1)
        if max(frames[k].time_s - frames[k - 1].time_s, frames[k + 1].time_s - frames[k].time_s) <= max_interval_s
    ]
    return middles, [conduct(*frames[k - 1 : k + 2], car_length_px=car_length_px) for k in middles]


def neighbours(times_s: Sequence[float], wanted: int, max_interval_s: float = _MAX_INTERVAL_S) -> IntArray:
    """Frames, by their place, of up to ``wanted`` bursts of three neighbours in time, spread evenly.

    Frames farther apart than ``max_interval_s`` are none.

    Examples
    --------
    >>> neighbours([0.0, 0.2, 0.4, 4.0, 4.2, 4.4, 8.0, 8.2, 8.4], 2).tolist()
    [0, 1, 2, 6, 7, 8]
    """
    gaps = np.diff(np.asarray(times_s, np.float64))
    starts = np.flatnonzero(np.maximum(gaps[:-1], gaps[1:]) <= max_interval_s)
    chosen = starts[np.unique(np.linspace(0, len(starts) - 1, min(wanted, len(starts))).round().astype(int))]
    return np.unique((chosen[:, None] + np.arange(3)).ravel())


def evidence_from_motion(
    frames: Sequence[Found], *, car_length_px: float, max_interval_s: float = _MAX_INTERVAL_S
) -> MotionEvidence:
    """Precision and recall of a detector from how its detections move.

    Parameters
    ----------
    frames : sequence of Found
        In time order; bursts of three or more will do.
    car_length_px : float
        A car's length, working px.
    max_interval_s : float
        Frames farther apart than this are no neighbours.
    """
    middles, kinds = conduct_of_bursts(frames, car_length_px=car_length_px, max_interval_s=max_interval_s)
    score = np.concatenate([np.empty(0), *(frames[k].score for k in middles)])
    kind = np.concatenate([np.empty(0, np.int8), *kinds])
    told = kind != Conduct.STANDS
    order = np.argsort(-score[told], kind="stable")
    threshold, moves = score[told][order], kind[told][order] == Conduct.MOVES
    if moves.sum() < _MIN_MOVING:
        return MotionEvidence(np.empty(0), np.empty(0), np.empty(0), float("nan"), np.empty(0))
    found = np.cumsum(moves)
    alone = np.arange(1, len(found) + 1) - found
    surest = int(np.searchsorted(found, _SUREST * found[-1]))
    false = np.maximum(alone - found * (alone[surest] / found[surest]), 0.0)
    precision, recall = 1 - false / (found + alone), found / found[-1]
    good = nearly_best(precision, recall, beta=1.0)
    # A tracklet wants three finds in a row, and links drop what is no car: rather low. What stands where no car is does
    # not tell in these figures: not as low as they would let.
    chosen = float(threshold[good[0]] + threshold[good[-1]]) / 2
    return MotionEvidence(threshold, precision, recall, chosen, score[~told])


def evidence_of(
    detector: Detector,
    frames: Sequence[MotionFrame],
    background: GreyImage | None,
    config: DetectionConfig,
    *,
    least_score: float = LEAST_SCORE,
    max_interval_s: float = _MAX_INTERVAL_S,
) -> MotionEvidence:
    """Precision and recall of a detector on registered frames that nobody marked.

    Parameters
    ----------
    detector : Detector
    frames : sequence of MotionFrame
        Bursts of three (`neighbours`); six tell enough.
    background : uint8 (h, w) or None
        Temporal median, for a detector that looks at the difference to it.
    config : DetectionConfig
    least_score : float
        Detections below this are not looked at.
    max_interval_s : float
        Frames farther apart than this are no neighbours.
    """
    low = config.model_copy(update={"threshold": least_score})

    def found(frame: MotionFrame) -> Found:
        cars = detect_frame(frame.image, frame.valid, detector, low, background)
        return Found(cars.xy, cars.orientation_rad, np.asarray(cars.score, np.float64), frame.time_s)

    length = detector.record.working_car_length_px
    return evidence_from_motion(each(found, frames), car_length_px=length, max_interval_s=max_interval_s)


def _neighbours(
    before: Found, middle: Found, after: Found, first_s: float, second_s: float, car_length_px: float
) -> list[tuple[IntArray, IntArray]]:
    """Of each detection of the middle frame, those before and after that a car could have come from or gone to."""
    near: list[list[IntArray]] = []
    for other, interval in ((before, first_s), (after, second_s)):
        radius = MAX_LENGTHS_PER_S * interval * car_length_px
        tree = KDTree(other.xy.reshape(-1, 2))
        near.append([np.array(tree.query_ball_point(place, radius), np.int64) for place in middle.xy])
    return list(zip(near[0], near[1], strict=True))
