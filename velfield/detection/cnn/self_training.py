"""The network on a registered flight that nobody marked: learnt on from what moves, and two thresholds.

What differs from the background moves, and is all but surely a car where the network likes it a little. What stands is
held to more: how well cars that move are liked tells how well those that stand should be, and what is there beyond
their share is something else.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, GreyImage
from schemas.detector import MotionRecord, PrecisionRecallCurve
from schemas.flight import DetectionConfig
from velfield.detection.cnn.fine_tuning import learnt_on
from velfield.detection.cnn.inference import SCORE_FLOOR
from velfield.detection.cnn.model import record_of_network
from velfield.detection.cnn.motion_bonus import difference_about
from velfield.detection.detect import detect_frame
from velfield.detection.detector import Detector
from velfield.detection.evaluation import nearly_best, thinned_curve
from velfield.detection.motion.difference import MotionFrame
from velfield.detection.motion.evidence import Conduct, Found, conduct_of_bursts
from velfield.detection.samples import LabelledImage
from velfield.parallel import each

_STEPS_MORE = 3
"""What moves is hundreds of labels: so many times the steps that it takes from a marked frame."""
_SHARE_OF_NEW = 0.7
"""Weights lie so far from the earlier network's towards those that were learnt from what moves: of what stands, which
was not learnt, less is forgotten. In a clip of cars 5 px wide half of those standing were found at a precision of .6;
with nearly all of the way .5, with none .43."""
_MIN_MOVING, _MIN_LIKED = 40, 20
_SURE_SHARE = 0.5
_MOVING_SHARE, _APART = 0.1, 2.0
"""Nine of ten that move differ from the background by more: by so many times what stands does."""


def network_of_motion(
    samples: Sequence[LabelledImage],
    earlier: Detector,
    bursts: Sequence[MotionFrame],
    background: GreyImage,
    config: DetectionConfig,
    *,
    max_interval_s: float,
) -> Detector | None:
    """A network that learnt on from what moves, and what it is to like of what moves and of what stands.

    Parameters
    ----------
    samples
        Frames with labels from motion.
    earlier
        The network to go on from.
    bursts
        Registered frames in bursts of three.
    background
        (h, w) temporal median of the flight, working px.
    max_interval_s
        Frames farther apart than this are no neighbours.

    Returns
    -------
    None where too little moves to tell, or what moves does not differ from the background.
    """
    longer = config.model_copy(update={"network_steps": _STEPS_MORE * config.network_steps})
    network = learnt_on(samples, earlier, longer, share=_SHARE_OF_NEW)
    update = {"network": record_of_network(network), "curve": None, "motion": None}
    record = earlier.record.model_copy(update=update)
    length_px = record.working_car_length_px
    low = config.model_copy(update={"threshold": SCORE_FLOOR})

    def found(frame: MotionFrame) -> tuple[Found, FloatArray]:
        cars = detect_frame(frame.image, frame.valid, Detector(record), low)
        difference = difference_about(frame.image, background, cars.xy, length_px)
        return Found(cars.xy, cars.orientation_rad, cars.score, frame.time_s), difference

    told, differences = zip(*each(found, bursts), strict=True)
    middles, kinds = conduct_of_bursts(told, car_length_px=length_px, max_interval_s=max_interval_s)
    if not middles:
        return None
    score, kind = np.concatenate([told[k].score for k in middles]), np.concatenate(kinds)
    difference = np.concatenate([differences[k] for k in middles])
    chosen = thresholds_of(score, kind, difference)
    if chosen is None:
        return None
    standing, motion, curve = chosen
    cars = sum(len(sample.cars) for sample in samples)
    chosen_here = {"threshold": standing, "motion": motion, "curve": curve, "cars": cars}
    return Detector(record.model_copy(update=chosen_here))


def thresholds_of(
    score: FloatArray, kind: NDArray[np.int8], difference: FloatArray
) -> tuple[float, MotionRecord, PrecisionRecallCurve] | None:
    """T of what stands, how much less what moves needs, and the curve of what moves.

    Parameters
    ----------
    score, kind, difference
        (n,) of finds down to what is hardly liked: score, `Conduct`, grey levels off the background.
    """
    moves, stands = kind == Conduct.MOVES, kind == Conduct.STANDS
    if moves.sum() < _MIN_MOVING:
        return None
    usual = max(float(np.median(difference[stands])), 1.0) if stands.any() else 1.0
    moving = float(np.quantile(difference[moves], _MOVING_SHARE))
    if moving < _APART * usual:
        return None
    # What is seen to stand over a short burst may be slow: the middle one of all that stands does not move.
    still = float(np.sqrt(usual * moving))
    off = difference > (still + moving) / 2
    differs = off & ~stands
    order = np.argsort(-score[differs], kind="stable")
    threshold, right = score[differs][order], moves[differs][order]
    found = np.cumsum(right)
    if not len(found) or found[-1] < _MIN_LIKED:
        return None
    precision, recall = found / np.arange(1, len(found) + 1), found / found[-1]
    good = nearly_best(precision, recall, beta=1.0)
    least = float(threshold[good[0]] + threshold[good[-1]]) / 2
    standing = max(threshold_of_standing(score[moves], score[stands & ~off]), least)
    at = int(np.abs(threshold - least).argmin())
    told = "how what differs from the background moves in bursts of three frames: as cars do, or alone"
    curve = thinned_curve(precision, recall, threshold + standing - least, at, told)
    return standing, MotionRecord(still_grey=still, moving_grey=moving, lift=standing - least), curve


def threshold_of_standing(moving: FloatArray, standing: FloatArray) -> float:
    """T of finds that stand, from how well cars that move are liked.

    Cars that stand are liked as those that move. At no score can there be more of them than finds that stand: the
    score at which there are fewest, for each that moves, bounds how many stand; what is there beyond is no car. Of the
    few that are liked best, those that move have the network's favour, as it learnt from them: they do not count.
    """
    liked = np.sort(moving)[::-1]
    count = np.arange(1, len(liked) + 1)
    above = len(standing) - np.searchsorted(np.sort(standing), liked)
    sure = count >= _SURE_SHARE * len(liked)
    if not (above[sure] > 0).all():
        return float(liked[-1])
    cars = float((above[sure] / count[sure]).min())
    precision = np.minimum(cars * count / np.maximum(above, 1), 1.0)
    good = nearly_best(precision[sure], count[sure] / len(liked), beta=1.0)
    return float(np.median(liked[sure][good]))
