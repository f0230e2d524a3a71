"""Self-training: adapts the pre-trained network to a flight without labels, with pseudo-labels from moving vehicles.

The network is fine-tuned on vehicles confirmed by their motion, and its weights are interpolated with those before
(WiSE-FT). Detections that differ from the background (foreground) get a score bonus. Stationary ones need a higher
threshold, estimated under the assumption that stationary cars have the score distribution of moving ones.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, GreyImage
from schemas.detector import CnnConfig, MotionRecord, PrecisionRecallCurve
from velfield.detection.cnn.fine_tuning import fine_tune_interpolated
from velfield.detection.cnn.model import FULL_TTA, MIN_SCORE, background_difference_at
from velfield.detection.cnn.network import network_to_record
from velfield.detection.detect import detect_frame
from velfield.detection.evaluation import f_measure_plateau, to_curve_record
from velfield.detection.motion.difference import MotionFrame
from velfield.detection.motion.evaluation import MotionState, TimedDetections, classify_bursts
from velfield.detection.samples import LabelledImage
from velfield.parallel import count_steps, parallel_map

if TYPE_CHECKING:
    from velfield.detection.cnn.detector import CnnDetector

_STEPS_FACTOR = 3
"""Motion gives hundreds of labels: this many times the steps of fine-tuning on one labelled frame."""
_FINE_TUNED_FRACTION = 0.7
"""Interpolation of the weights towards the fine-tuned ones: stationary cars, which have no pseudo-labels, are forgotten
less. On a clip with cars 5 px wide half of the stationary ones were detected at a precision of 0.60; at almost the
whole fraction 0.50, at none 0.43."""
_MIN_MOVING, _MIN_MOVING_FOREGROUND = 40, 20
_RELIABLE_FRACTION = 0.5
"""The moving detections of highest score, up to this fraction, do not constrain the number of stationary cars."""
_MOVING_QUANTILE, _MIN_SEPARATION = 0.1, 2.0
"""This quantile of the moving detections' difference to the background must be this many times the stationary ones'
median."""
_CURVE_DESCRIPTION = (
    "foreground detections in bursts of three frames: those that move as cars do, against isolated ones"
)


def self_train_from_motion(
    samples: Sequence[LabelledImage],
    pretrained: "CnnDetector",
    bursts: Sequence[MotionFrame],
    background: GreyImage,
    config: CnnConfig,
    *,
    max_interval_s: float,
) -> "CnnDetector | None":
    """Fine-tune on pseudo-labels from motion, then estimate the score bonus and the threshold from detections' motion.

    Parameters
    ----------
    samples
        Frames with labels from motion.
    pretrained
        Detector to start from.
    bursts
        Registered frames in bursts of three.
    background
        (h, w) temporal median of the flight, working px.
    max_interval_s
        Frames farther apart than this are not neighbours.

    Returns
    -------
    None where too few detections move to estimate thresholds, or those that move do not differ from the background.
    """
    longer = config.model_copy(update={"fine_tune_steps": _STEPS_FACTOR * config.fine_tune_steps})
    network = fine_tune_interpolated(samples, pretrained, longer, fraction=_FINE_TUNED_FRACTION)
    update = {
        "onnx": network_to_record(network),
        "layers": None,
        "tta_range": FULL_TTA,
        "curve": None,
        "motion": None,
        "activation_ranges": None,
    }
    record = pretrained.record.model_copy(update=update)
    length_px = record.working_car_length_px

    def detect(frame: MotionFrame) -> tuple[TimedDetections, FloatArray]:
        cars = detect_frame(frame.image, frame.valid, type(pretrained)(record), threshold=MIN_SCORE)
        difference = background_difference_at(frame.image, background, cars.xy, length_px)
        count_steps(1)
        return TimedDetections(cars.xy, cars.orientation_rad, cars.score, frame.time_s), difference

    count_steps(0, announced=len(bursts))
    detections, differences = zip(*parallel_map(detect, bursts), strict=True)
    middles, states = classify_bursts(detections, car_length_px=length_px, max_interval_s=max_interval_s)
    if not middles:
        return None
    score, state = np.concatenate([detections[k].score for k in middles]), np.concatenate(states)
    difference = np.concatenate([differences[k] for k in middles])
    fitted = fit_motion_thresholds(score, state, difference)
    if fitted is None:
        return None
    threshold, motion, curve = fitted
    cars = sum(len(sample.cars) for sample in samples)
    estimated = {"threshold": threshold, "motion": motion, "curve": curve, "cars": cars}
    return type(pretrained)(record.model_copy(update=estimated))


def fit_motion_thresholds(
    score: FloatArray, state: NDArray[np.int8], difference: FloatArray
) -> tuple[float, MotionRecord, PrecisionRecallCurve] | None:
    """Threshold of stationary detections, score bonus of foreground ones, and the latter's precision-recall curve.

    Parameters
    ----------
    score, state, difference
        (n,) of detections at a low threshold: score, `MotionState`, difference to the background in grey levels.
    """
    moving, stationary = state == MotionState.MOVING, state == MotionState.STATIONARY
    if moving.sum() < _MIN_MOVING:
        return None
    stationary_grey = max(float(np.median(difference[stationary])), 1.0) if stationary.any() else 1.0
    moving_grey = float(np.quantile(difference[moving], _MOVING_QUANTILE))
    if moving_grey < _MIN_SEPARATION * stationary_grey:
        return None
    # Some detections that are stationary over a short burst are slow vehicles: the median is not one of them.
    ramp_start = float(np.sqrt(stationary_grey * moving_grey))
    foreground = difference > (ramp_start + moving_grey) / 2
    counted = foreground & ~stationary
    order = np.argsort(-score[counted], kind="stable")
    thresholds, correct = score[counted][order], moving[counted][order]
    true_positives = np.cumsum(correct)
    if not len(true_positives) or true_positives[-1] < _MIN_MOVING_FOREGROUND:
        return None
    precision = true_positives / np.arange(1, len(true_positives) + 1)
    recall = true_positives / true_positives[-1]
    plateau = f_measure_plateau(precision, recall, beta=1.0)
    foreground_threshold = float(thresholds[plateau[0]] + thresholds[plateau[-1]]) / 2
    threshold = max(stationary_threshold(score[moving], score[stationary & ~foreground]), foreground_threshold)
    bonus = threshold - foreground_threshold
    nearest = int(np.abs(thresholds - foreground_threshold).argmin())
    curve = to_curve_record(
        precision, recall, thresholds + threshold - foreground_threshold, nearest, _CURVE_DESCRIPTION
    )
    return (
        threshold,
        MotionRecord(bonus_ramp_start=ramp_start, bonus_ramp_end=moving_grey, max_score_bonus=bonus),
        curve,
    )


def stationary_threshold(moving: FloatArray, stationary: FloatArray) -> float:
    """Score threshold of stationary detections, from the scores of moving ones.

    Stationary cars are assumed to have the score distribution of moving cars. Above no score can there be more cars
    than stationary detections, so the lowest ratio of stationary to moving detections over all scores bounds the number
    of stationary cars, and with it the precision at each score. The moving detections of highest score are left out of
    this bound: the network was trained on them, which favours them.
    """
    thresholds = np.sort(moving)[::-1]
    count = np.arange(1, len(thresholds) + 1)
    above = len(stationary) - np.searchsorted(np.sort(stationary), thresholds)
    reliable = count >= _RELIABLE_FRACTION * len(thresholds)
    if not (above[reliable] > 0).all():
        return float(thresholds[-1])
    cars_per_moving = float((above[reliable] / count[reliable]).min())
    precision = np.minimum(cars_per_moving * count / np.maximum(above, 1), 1.0)
    plateau = f_measure_plateau(precision[reliable], count[reliable] / len(thresholds), beta=1.0)
    return float(np.median(thresholds[reliable][plateau]))
