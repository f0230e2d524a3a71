"""The boxes of a frame that are searched, cut out with context on every side and packed side by side into few images.

Boxes come by the hundred, and most are small: a detector that is called once for each spends a third of its time on the
calls. So crops lie on shelves as tall as their tallest one, and are searched together where that changes nothing (by
the network), or else one after another (`Detector.find_in_crops`); candidates in the context are dropped.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit

from schemas.arrays import GreyImage, IntArray
from velfield.detection.changes import CELL_PX
from velfield.detection.detector import Crop, Detections, Detector, concatenate
from velfield.detection.frame import SearchableFrame

Box = tuple[int, int, int, int]
"""Of cells: first row, first column, row and column after the last."""
_SIDE_PX = 1024
"""Of a mosaic, unless a crop is larger."""


@dataclass(frozen=True)
class Mosaic:
    """Boxes with context, side by side.

    Attributes
    ----------
    shape : (height, width), px.
    numbers : of the boxes, in the order of the crops.
    crops : where they lie.
    """

    shape: tuple[int, int]
    numbers: IntArray
    crops: tuple[Crop, ...]


def pack_boxes(boxes: Sequence[Box], context_px: int) -> list[Mosaic]:
    """Pack boxes with their context into mosaics, the tallest first."""
    around = 2 * context_px
    sizes = [(CELL_PX * (box[2] - box[0]) + around, CELL_PX * (box[3] - box[1]) + around) for box in boxes]
    mosaics: list[Mosaic] = []
    numbers: list[int] = []
    crops: list[Crop] = []
    y = x = shelf = 0
    for k in sorted(range(len(boxes)), key=lambda k: (-sizes[k][0], sizes[k][1], k)):
        height, width = sizes[k]
        if x and x + width > _SIDE_PX:
            y, x, shelf = y + shelf, 0, 0
        if y and not x and y + height > _SIDE_PX:
            mosaics.append(_close(numbers, crops))
            numbers, crops, y = [], [], 0
        numbers.append(k)
        crops.append((y, x, height, width))
        x, shelf = x + width, max(shelf, height)
    return [*mosaics, _close(numbers, crops)] if crops else mosaics


def _close(numbers: list[int], crops: list[Crop]) -> Mosaic:
    shape = max(y + height for y, _, height, _ in crops), max(x + width for _, x, _, width in crops)
    return Mosaic(shape, np.array(numbers), tuple(crops))


def find_in_boxes(
    detector: Detector,
    frame: SearchableFrame,
    background: GreyImage | None,
    boxes: Sequence[Box],
    threshold: float | None,
) -> Detections:
    """The candidates of a frame whose centres lie in some disjoint boxes, in the order of the boxes.

    Parameters
    ----------
    frame
        Resampled in the boxes and within `Detector.context_px` of them.
    background, threshold
        As of `Detector.find`.
    """
    found, numbers = [concatenate([])], [np.empty(0, np.int64)]
    for mosaic in pack_boxes(boxes, detector.context_px):
        candidates, of_box = _find_in_mosaic(detector, frame, background, boxes, mosaic, threshold)
        found.append(candidates)
        numbers.append(of_box)
    return concatenate(found).take(np.argsort(np.concatenate(numbers), kind="stable"))


def _find_in_mosaic(
    detector: Detector,
    frame: SearchableFrame,
    background: GreyImage | None,
    boxes: Sequence[Box],
    mosaic: Mosaic,
    threshold: float | None,
) -> tuple[Detections, IntArray]:
    """The candidates of a mosaic, in px of the frame, and the number of the box of each."""
    context = detector.context_px
    corners = np.array([boxes[k][:2] for k in mosaic.numbers]) * CELL_PX - context
    image = _assemble(frame.image, corners, mosaic, cv2.BORDER_REFLECT_101)
    valid = _assemble(frame.valid.view(np.uint8), corners, mosaic, cv2.BORDER_CONSTANT).view(np.bool_)
    ground = None if background is None else _assemble(background, corners, mosaic, cv2.BORDER_REFLECT_101)
    found = detector.find_in_crops(image, valid, ground, mosaic.crops, threshold=threshold)
    placed = np.array(mosaic.crops)
    crop = owners_kernel(found.xy, placed, context, *mosaic.shape)
    inside = np.flatnonzero(crop >= 0)
    found, crop = found.take(inside), crop[inside]
    shift = (corners - placed[:, :2])[crop]
    cars = found.to_rows()
    cars[:, :2] += shift[:, ::-1]
    return Detections.from_rows(cars[:, :5], cars[:, 5]), mosaic.numbers[crop]


@njit(cache=True, nogil=True)
def owners_kernel(xy, crops, context, height, width):  # type: ignore[no-untyped-def]
    """Number of the crop in whose box, within the context, the pixel of each position (n, 2) lies; -1 where in none."""
    out = np.full(len(xy), -1, np.int64)
    for n in range(len(xy)):
        x = min(max(int(np.floor(xy[n, 0] + 0.5)), 0), width - 1)
        y = min(max(int(np.floor(xy[n, 1] + 0.5)), 0), height - 1)
        for k in range(len(crops)):
            top, left, rows, columns = crops[k]
            if top + context <= y < top + rows - context and left + context <= x < left + columns - context:
                out[n] = k
    return out


def _assemble(image: GreyImage, corners: IntArray, mosaic: Mosaic, border: int) -> GreyImage:
    """A mosaic of the windows of an image with these corners (n, 2), beyond the image by OpenCV's border mode."""
    assembled = np.zeros(mosaic.shape, np.uint8)
    height, width = image.shape
    for (top, left), (row, column, rows, columns) in zip(corners.tolist(), mosaic.crops, strict=True):
        bottom, right = top + rows, left + columns
        inside = image[max(0, top) : bottom, max(0, left) : right]
        if top < 0 or left < 0 or bottom > height or right > width:
            outside = max(0, -top), max(0, bottom - height), max(0, -left), max(0, right - width)
            inside = np.asarray(cv2.copyMakeBorder(inside, *outside, border), np.uint8)
        assembled[row : row + rows, column : column + columns] = inside
    return assembled
