"""The cars of one frame: runs a detector (`detect_frame`) and attaches crops of each car for tracking (`attach_crops`).

The image is on the working grid: the base image's grid, scaled so that a car is ``working_car_length_px`` long. The
crops are patches rotated to the axis, to compare appearance, and upright chips, to align.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from schemas.arrays import FloatArray, GreyImage, IntArray, Mask
from velfield.detection.detector import Detections, Detector


def oriented_patches(
    image: GreyImage, xy: FloatArray, orientation_rad: FloatArray, *, width: int = 8, length: int = 16
) -> GreyImage:
    """Patches rotated so that the car's axis runs along the columns (paper: the 8 x 16 oriented patch).

    Parameters
    ----------
    image
        (h, w) uint8 on the working grid.
    xy, orientation_rad
        (n, 2) centres, working px, and (n,) axes.

    Returns
    -------
    (n, length, width) uint8
    """
    count = len(xy)
    if not count:
        return np.empty((0, length, width), np.uint8)
    along = np.arange(length) - (length - 1) / 2
    across = np.arange(width) - (width - 1) / 2
    cos, sin = np.cos(orientation_rad)[:, None, None], np.sin(orientation_rad)[:, None, None]
    x = xy[:, 0, None, None] + along[:, None] * cos - across * sin
    y = xy[:, 1, None, None] + along[:, None] * sin + across * cos
    return _sample(image, x, y)


def upright_chips(image: GreyImage, xy: FloatArray, *, side: int = 32) -> GreyImage:
    """Crops about the rounded positions, (n, side, side) uint8: pixel (side / 2, side / 2) is the rounded position."""
    padded = np.pad(image, side, mode="edge")
    corner = np.rint(xy).astype(np.int64) + side - side // 2
    chips = [padded[y : y + side, x : x + side] for x, y in corner]
    return np.stack(chips) if chips else np.empty((0, side, side), np.uint8)


def _sample(image: GreyImage, x: FloatArray, y: FloatArray) -> GreyImage:
    shape = x.shape
    flat_x, flat_y = (np.ascontiguousarray(c.reshape(shape[0], -1), np.float32) for c in (x, y))
    rows = []
    for start in range(0, shape[0], 16_000):  # remap takes at most 32,767 rows
        part = slice(start, start + 16_000)
        rows.append(cv2.remap(image, flat_x[part], flat_y[part], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    return np.asarray(np.concatenate(rows).reshape(shape), np.uint8)


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
