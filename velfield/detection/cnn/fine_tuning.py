"""Fine-tuning the pre-trained network on labelled images; choosing its score threshold.

The threshold comes from held-out stripes: half of the steps are made without them, the network is evaluated there, and
the other half is made on everything. With few labels it is shrunk towards the pre-trained detector's threshold.
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from schemas.arrays import Mask
from schemas.detector import CnnConfig, CnnRecord, PrecisionRecallCurve
from velfield.detection.cnn.brightness import brighten_sample
from velfield.detection.cnn.dataset import PatchDataset
from velfield.detection.cnn.graph import network_to_record
from velfield.detection.cnn.inference import Predictor, predict_heatmap
from velfield.detection.cnn.model import detect_cars
from velfield.detection.cnn.network import Network
from velfield.detection.cnn.sizes import LOG_SCALE_RANGE, copy_sizes
from velfield.detection.cnn.trainer import Trainer, train
from velfield.detection.evaluation import (
    HELD_OUT_DESCRIPTION,
    MIN_CARS_TO_HOLD_OUT,
    MIN_CURVE_SCORE,
    HeldOutScores,
    held_out_half,
    match_labels,
    merge_scores,
    precision_recall_curve,
)
from velfield.detection.nms import nms_oriented
from velfield.detection.orientation import fill_missing_orientation
from velfield.detection.samples import LabelledImage, in_region, restrict_to_region
from velfield.errors import InputError
from velfield.parallel import parallel_map

_FINE_TUNING_RATE = 1e-3
_MIN_FOUND = 0.2
"""Fraction of the held-out cars: of labels that belong to other pictures a few are found by chance."""
_UNLABELLED_MIN_PROBABILITY, _LABELLED_RADIUS_PX, _UNLABELLED_MARGIN_PX = 0.12, 18, 3
"""In an incompletely labelled image a pixel of at least this probability may be an unlabelled car, except within a
radius of a labelled one, its shadow included."""
_NMS_RADIUS_PX = 16.0
_PRIOR_CARS = 150
"""Weight of the pre-trained detector's threshold, in labelled cars. The threshold of 47 cars alone lost a third of the
cars of another site without a gain; in four cases of four the best threshold lay nearer to the pre-trained one."""


def fine_tune(samples: Sequence[LabelledImage], pretrained: Network, record: CnnRecord, config: CnnConfig) -> CnnRecord:
    """Fine-tune a pre-trained network on labelled images and choose its score threshold on held-out folds.

    Parameters
    ----------
    samples
        Labelled images. Where labels are incomplete, what the pre-trained network detects elsewhere is not used as
        background.
    record
        Record of the pre-trained detector: its threshold, and who made it.

    Raises
    ------
    InputError
        The labels do not lie on cars: hardly one that was held out is found.
    """
    masked = parallel_map(lambda sample: _mask_unlabelled_positives(brighten_sample(sample), pretrained), samples)
    count = sum(len(sample.cars) for sample in samples)
    trainer, steps, evidence = Trainer.from_network(pretrained), config.fine_tune_steps, None
    if count >= MIN_CARS_TO_HOLD_OUT:
        evidence = _train_on_half(trainer, masked, steps // 2, config.seed + 1)
        _check_found(evidence)
        steps -= steps // 2
    dataset = PatchDataset([masked], [1.0], config.seed)
    network = train(trainer, dataset, steps=steps, learning_rate=_FINE_TUNING_RATE)
    if pretrained.measures:
        of_all_sizes = PatchDataset([masked], [1.0], config.seed, log_scale_range=LOG_SCALE_RANGE)
        network = copy_sizes(network, pretrained, of_all_sizes)
    threshold, curve = select_threshold(evidence, record.threshold)
    if curve is not None:
        weight = count / (count + _PRIOR_CARS)
        threshold = weight * threshold + (1 - weight) * record.threshold
        nearest = int(np.abs(np.array(curve.threshold) - threshold).argmin())
        curve = curve.model_copy(update={"operating_point": nearest})
    found = make_record(network, threshold if config.threshold is None else config.threshold, curve, count, config)
    return found.model_copy(update={"attribution": record.attribution})


def _check_found(evidence: HeldOutScores) -> None:
    found = int(evidence.correct.sum())
    if found < _MIN_FOUND * evidence.car_count:
        raise InputError(
            f"the detector finds {found} of {evidence.car_count} labelled cars that it was not trained on, expected "
            "most of them: the labels do not lie on the cars of these pictures; check that they are of this video, by "
            "their frame numbers and by the size of the pictures that they were drawn in"
        )


def select_threshold(evidence: HeldOutScores | None, default: float) -> tuple[float, PrecisionRecallCurve | None]:
    """Score threshold and precision-recall curve on held-out cars; the default where too few were held out."""
    curve = None if evidence is None else precision_recall_curve(evidence, HELD_OUT_DESCRIPTION)
    if curve is None or curve.operating_point is None:
        return default, None
    return curve.threshold[curve.operating_point], curve


def make_record(
    network: Network, threshold: float, curve: PrecisionRecallCurve | None, count: int, config: CnnConfig
) -> CnnRecord:
    """Content of the detector file."""
    return CnnRecord(
        working_car_length_px=config.working_car_length_px,
        onnx=network_to_record(network),
        threshold=float(threshold),
        curve=curve,
        cars=count,
    )


def _train_on_half(trainer: Trainer, samples: Sequence[LabelledImage], steps: int, seed: int) -> HeldOutScores:
    """Train without half of the images, in stripes, and evaluate there."""
    held_out = [held_out_half(sample) for sample in samples]
    training = [restrict_to_region(sample, ~region) for sample, region in zip(samples, held_out, strict=True)]
    dataset = PatchDataset([training], [1.0], seed)
    network = train(trainer, dataset, steps=steps, learning_rate=_FINE_TUNING_RATE)
    return merge_scores(
        parallel_map(lambda part: evaluate_network(network, *part), zip(samples, held_out, strict=True))
    )


def _mask_unlabelled_positives(sample: LabelledImage, network: Network) -> LabelledImage:
    """The sample with every orientation filled in, and without the pixels that may show an unlabelled car."""
    cars = fill_missing_orientation(sample.image, sample.cars, sample.abs_box_angle_rad)
    sample = replace(sample, cars=cars, abs_box_angle_rad=None)
    if sample.complete:
        return sample
    probability, *_ = predict_heatmap(Predictor(network), sample.image)
    likely = cv2.resize(probability, sample.image.shape[::-1]) > _UNLABELLED_MIN_PROBABILITY
    side = 2 * _UNLABELLED_MARGIN_PX + 1
    unlabelled = cv2.dilate(likely.astype(np.uint8), np.ones((side, side), np.uint8))
    for x, y in sample.cars[:, :2]:
        cv2.circle(unlabelled, (round(float(x)), round(float(y))), _LABELLED_RADIUS_PX, (0,), -1)
    known = unlabelled == 0
    return replace(sample, valid=known if sample.valid is None else sample.valid & known)


def evaluate_network(network: Network, sample: LabelledImage, region: Mask | None = None) -> HeldOutScores:
    """Match a network's detections to the labels of an image, or of a region (h, w) of it."""
    detections = nms_oriented(detect_cars(Predictor(network), sample.image, sample.valid), _NMS_RADIUS_PX)
    detections = detections[detections[:, 3] > MIN_CURVE_SCORE]
    cars = sample.cars
    if region is not None:
        detections, cars = detections[in_region(region, detections)], cars[in_region(region, cars)]
    correct, counted = match_labels(detections, cars, sample.ignore)
    return HeldOutScores(detections[counted, 3], correct[counted], len(cars), sample.complete)
