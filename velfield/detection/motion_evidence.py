"""How many detections move as cars do: the evidence on a detector where nobody marked a car.

A detection in the middle one of three frames either goes on at one velocity along its axis (a car, all but surely),
stands (a parked car or a chimney: no evidence either way), or has no partners (a false find, or a car that was missed
beside). From the first and the last kind follow precision and recall against the threshold.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from schemas.flight import DetectionConfig
from velfield.detection.detect import detect_frame
from velfield.detection.detector import Detector
from velfield.detection.motion_bodies import MAX_AXIS_OFFSET_RAD
from velfield.detection.motion_difference import MotionFrame
from velfield.detection.motion_links import MAX_LENGTHS_PER_S

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Grey = NDArray[np.uint8]

LEAST_SCORE = -0.3
"""Detections below this are noise whatever the detector."""
_STANDS_LENGTHS = 0.12
_MOVES_LENGTHS = 0.35
_MISMATCH_LENGTHS = 0.3  # a detection lies within a pixel or two; regions of motion within less
_MISMATCH_SHARE = 0.08
_MIN_MOVING = 20
_BETA = 0.7
"""Precision counts twice as much as recall: the field wants few wrong tracks rather than all cars."""


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

    xy: Floats
    orientation_rad: Floats
    score: Floats
    time_s: float


@dataclass(frozen=True)
class MotionEvidence:
    """Precision and recall against the threshold, as motion tells them.

    Attributes
    ----------
    threshold : float64 (m,)
        Falling.
    precision : float64 (m,)
        Share of the detections above it that move, of those that move or are alone.
    recall : float64 (m,)
        Share of all that move that are above it.
    chosen : float
        The threshold at which precision, and with half its weight recall, is best; NaN where too few move to tell.
    """

    threshold: Floats
    precision: Floats
    recall: Floats
    chosen: float


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
        if (good & (moved < 2 * _STANDS_LENGTHS * car_length_px)).any():
            kinds[i] = Conduct.STANDS
        elif (good & along & (moved > _MOVES_LENGTHS * car_length_px)).any():
            kinds[i] = Conduct.MOVES
    return kinds


def evidence_from_motion(
    frames: Sequence[Found], *, car_length_px: float, max_interval_s: float = 0.45
) -> MotionEvidence:
    """Precision and recall of a detector from how its detections move.

    Parameters
    ----------
    frames : sequence of Found
        In time order; bursts of three or more will do.
    car_length_px : float
        A car's length, working px.
    max_interval_s : float
        Frames farther apart than this are not neighbours.
    """
    scores, kinds = [np.empty(0)], [np.empty(0, np.int8)]
    for before, middle, after in zip(frames, frames[1:], frames[2:], strict=False):
        if max(middle.time_s - before.time_s, after.time_s - middle.time_s) <= max_interval_s:
            scores.append(middle.score)
            kinds.append(conduct(before, middle, after, car_length_px=car_length_px))
    score, kind = np.concatenate(scores), np.concatenate(kinds)
    told = kind != Conduct.STANDS
    order = np.argsort(-score[told], kind="stable")
    threshold, moves = score[told][order], kind[told][order] == Conduct.MOVES
    if moves.sum() < _MIN_MOVING:
        return MotionEvidence(np.empty(0), np.empty(0), np.empty(0), float("nan"))
    found = np.cumsum(moves)
    precision, recall = found / np.arange(1, len(found) + 1), found / found[-1]
    merit = (1 + _BETA**2) * precision * recall / (_BETA**2 * precision + recall + 1e-12)
    return MotionEvidence(threshold, precision, recall, float(threshold[merit.argmax()]))


def evidence_of(
    detector: Detector,
    frames: Sequence[MotionFrame],
    background: Grey | None,
    config: DetectionConfig,
    *,
    least_score: float = LEAST_SCORE,
) -> MotionEvidence:
    """Precision and recall of a detector on registered frames that nobody marked.

    Parameters
    ----------
    detector : Detector
    frames : sequence of MotionFrame
        Two or three bursts of three tell enough (`choose_frames`); more where few cars move.
    background : uint8 (h, w) or None
        Temporal median, for a detector that looks at the difference to it.
    config : DetectionConfig
    least_score : float
        Detections below this are not looked at.
    """
    low = config.model_copy(update={"threshold": least_score})
    found = []
    for frame in frames:
        cars = detect_frame(frame.image, frame.valid, detector, low, background)
        found.append(Found(cars.xy, cars.orientation_rad, np.asarray(cars.score, np.float64), frame.time_s))
    return evidence_from_motion(found, car_length_px=detector.record.working_car_length_px)


def _neighbours(
    before: Found, middle: Found, after: Found, first_s: float, second_s: float, car_length_px: float
) -> list[tuple[Ints, Ints]]:
    """Of each detection of the middle frame, those before and after that a car could have come from or gone to."""
    near: list[list[Ints]] = []
    for other, interval in ((before, first_s), (after, second_s)):
        radius = MAX_LENGTHS_PER_S * interval * car_length_px
        tree = KDTree(other.xy.reshape(-1, 2))
        near.append([np.array(tree.query_ball_point(place, radius), np.int64) for place in middle.xy])
    return list(zip(near[0], near[1], strict=True))
