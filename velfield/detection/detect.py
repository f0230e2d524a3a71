"""Cars of one frame on the working grid, with the image patches that tracking compares."""

from dataclasses import dataclass

import numpy as np

from schemas.arrays import GreyImage, IntArray, Mask
from velfield.detection.crops import oriented_patches, upright_chips
from velfield.detection.detector import Detections, Detector


@dataclass(frozen=True)
class FrameDetections(Detections):
    """Cars of a frame, and their patches.

    Attributes
    ----------
    patches : (n, 16, 8) uint8, rotated to the axis.
    chips : (n, 32, 32) uint8, upright about the rounded position.
    """

    patches: GreyImage
    chips: GreyImage


def detect_frame(
    image: GreyImage,
    valid: Mask | None,
    detector: Detector,
    background: GreyImage | None = None,
    *,
    threshold: float | None = None,
) -> FrameDetections:
    """Detect the cars of a frame, top to bottom; the parameters are those of `Detector.detect`."""
    cars = detector.detect(image, valid, background, threshold=threshold)
    order = np.lexsort((cars.xy[:, 0], cars.xy[:, 1]))
    return attach_crops(image, cars, order)


def attach_crops(image: GreyImage, cars: Detections, order: IntArray | slice = slice(None)) -> FrameDetections:
    """Detections in an order, with their patches."""
    xy, axis = np.ascontiguousarray(cars.xy[order]), np.ascontiguousarray(cars.orientation_rad[order])
    return FrameDetections(
        xy=xy,
        orientation_rad=axis,
        orientation_sd_rad=cars.orientation_sd_rad[order],
        area_px=cars.area_px[order],
        score=cars.score[order],
        patches=oriented_patches(image, xy, axis),
        chips=upright_chips(image, xy),
    )
