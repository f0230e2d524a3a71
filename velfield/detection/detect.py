"""Cars of one frame on the working grid, with what tracking wants to know of them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, GreyImage
from schemas.flight import DetectionConfig
from velfield.detection.cascade.classifier import Look, distinct, find_cars
from velfield.detection.cascade.feature_image import COARSE, picture_of
from velfield.detection.cascade.long_vehicles import LONG, shipped_long_vehicles
from velfield.detection.cascade.proposals import propose
from velfield.detection.cnn.inference import background_difference_at, detect_cars, motion_score_bonus
from velfield.detection.crops import oriented_patches, upright_chips
from velfield.detection.detector import Detector
from velfield.detection.label_orientation import CAR_ASPECT
from velfield.detection.paper.classifier import find_cars_densely


@dataclass(frozen=True)
class FrameDetections:
    """Cars of a frame.

    Attributes
    ----------
    xy : (n, 2) float64, working px.
    orientation_rad : (n,) axial, [0, pi), from +x towards +y (down).
    orientation_sd_rad : (n,) its standard deviation.
    area_px : (n,) working px^2.
    score : (n,) response; the threshold is the detector's.
    patches : (n, 16, 8) uint8, turned along the axis.
    chips : (n, 32, 32) uint8, upright about the rounded place.
    """

    xy: FloatArray
    orientation_rad: FloatArray
    orientation_sd_rad: FloatArray
    area_px: FloatArray
    score: FloatArray
    patches: GreyImage
    chips: GreyImage


def detect_frame(
    image: GreyImage,
    valid: NDArray[np.bool_] | None,
    detector: Detector,
    config: DetectionConfig,
    background: GreyImage | None = None,
) -> FrameDetections:
    """Find cars.

    Parameters
    ----------
    image
        (h, w) uint8 on the working grid.
    valid
        (h, w) bool: where the frame covers it; none: everywhere.
    detector
        Its method decides; ``config.threshold`` overrides its threshold.
    background
        (h, w) uint8, for a detector that looks at |frame - background|.
    """
    threshold = detector.threshold if config.threshold is None else config.threshold
    length = detector.record.working_car_length_px
    if detector.record.method == "dense":
        cars, area = find_cars_densely(image, valid, detector, config, threshold)
    elif detector.record.method == "network":
        found = detect_cars(detector.network, image, valid)
        motion = detector.record.motion
        if motion is not None and background is not None:
            difference = background_difference_at(image, background, found[:, :2], length)
            found[:, 3] += motion_score_bonus(motion, difference)
        cars = _middles(image, valid, distinct(found[found[:, 3] > threshold], length), length)
        area = np.full(len(cars), length * length * CAR_ASPECT)
    else:
        cars = _aligned(image, valid, detector, threshold, background if detector.uses_background else None)
        area = np.full(len(cars), length * length * CAR_ASPECT)
    order = np.lexsort((cars[:, 0], cars[:, 1]))
    return pictured(image, cars[order], area[order])


def _aligned(
    image: GreyImage,
    valid: NDArray[np.bool_] | None,
    detector: Detector,
    threshold: float,
    background: GreyImage | None,
) -> FloatArray:
    """Cars (n, 5) as x, y, axis, score, axis' standard deviation."""
    proposer, floor = detector.record.proposer, detector.record.contrast_floor
    assert proposer is not None  # the schema says so of the aligned method
    assert floor is not None
    places = propose(
        picture_of(image, background, COARSE),
        image.shape,
        valid,
        detector.proposer_sums,
        contrast_floor=floor,
        least_score=proposer.least_score,
    )
    look = Look(picture_of(image, background), detector.sums, floor)
    found = find_cars(look, places, least_score=threshold, least_first_score=proposer.least_first_score)
    length = detector.record.working_car_length_px
    return _middles(image, valid, distinct(found, length), length)


def _middles(image: GreyImage, valid: NDArray[np.bool_] | None, cars: FloatArray, length: float) -> FloatArray:
    """The cars, lorries and buses among them at their middle."""
    long = shipped_long_vehicles()
    if length != long.record.working_car_length_px:
        return cars
    return long.centred(picture_of(image, None, LONG), cars, np.ones(image.shape, bool) if valid is None else valid)


def pictured(image: GreyImage, cars: FloatArray, area_px: FloatArray) -> FrameDetections:
    """Cars (n, 5) as x, y, axis, score, axis' standard deviation, with their pictures."""
    xy, axis = np.ascontiguousarray(cars[:, :2]), np.ascontiguousarray(cars[:, 2])
    return FrameDetections(
        xy=xy,
        orientation_rad=axis,
        orientation_sd_rad=cars[:, 4],
        area_px=area_px,
        score=cars[:, 3],
        patches=oriented_patches(image, xy, axis),
        chips=upright_chips(image, xy),
    )
