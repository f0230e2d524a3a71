"""The boxes of a frame that are searched, cut out with context on every side and packed side by side into few images.

Boxes come by the hundred, and most are small: a detector that is called once for each spends a third of its time on the
calls. So crops lie on shelves as tall as their tallest one, and are searched together where that changes nothing (by
the network), or else one after another (`Detector.find_in_crops`); candidates in the context are dropped.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from schemas.arrays import FloatArray, GreyImage, IntArray
from velfield.detection.changes import CELL_PX
from velfield.detection.frame import SearchableFrame
from velfield.detection.interface import Detections, Detector, concatenate

_SIDE_PX = 1024
"""Side of a mosaic, unless a crop is larger."""
CROP_UNIT_PX = 16
"""Sides of crops are multiples of this: the network halves the resolution four times."""


@dataclass(frozen=True)
class Mosaic:
    """Boxes with context, side by side."""

    shape: tuple[int, int]
    """(height, width), px."""
    numbers: IntArray
    """(n,) of the boxes, in the order of the crops."""
    crops: IntArray
    """(n, 4) where they lie: first row, first column, height and width."""
    corners: IntArray
    """(n, 2) first row and column of what they show of the frame."""


def pack_boxes(boxes: IntArray, context_px: int) -> list[Mosaic]:
    """Pack boxes with their context into mosaics, the tallest first.

    They are cut out from and to multiples of `CROP_UNIT_PX` of the frame, so that the network's coarse pixels lie as in
    the whole frame.
    """
    if not len(boxes):
        return []
    first = (boxes[:, :2] * CELL_PX - context_px) // CROP_UNIT_PX * CROP_UNIT_PX
    sizes = -(-(boxes[:, 2:] * CELL_PX + context_px) // CROP_UNIT_PX) * CROP_UNIT_PX - first
    order = np.lexsort((sizes[:, 1], -sizes[:, 0]))
    number, *places = _shelve(sizes[order].tolist())
    crops = np.column_stack([*places, sizes[order]])
    ends = np.flatnonzero(np.diff(number)) + 1
    parts = zip(*(np.split(of, ends) for of in (order, crops, first[order])), strict=True)
    return [Mosaic(tuple((of[:, :2] + of[:, 2:]).max(axis=0).tolist()), one, of, at) for one, of, at in parts]


def _shelve(sizes: list[list[int]]) -> IntArray:
    """Number of the mosaic of each crop of sizes (height, width), the tallest first, and its row and column there:
    (3, n). A mosaic is no larger than `_SIDE_PX`, unless a crop is."""
    places, mosaic, y, x, shelf = [], 0, 0, 0, 0
    for height, width in sizes:
        if x > 0 and x + width > _SIDE_PX:
            y, x, shelf = y + shelf, 0, 0
        if y > 0 and x == 0 and y + height > _SIDE_PX:
            mosaic, y = mosaic + 1, 0
        places.append((mosaic, y, x))
        x, shelf = x + width, max(shelf, height)
    return np.array(places).T


def find_in_boxes(detector: Detector, frame: SearchableFrame, boxes: IntArray, threshold: float | None) -> Detections:
    """The candidates of a frame whose centres lie in some disjoint boxes, in the order of the boxes.

    Parameters
    ----------
    boxes
        (n, 4) of cells: first row, first column, row and column after the last.
    frame
        Resampled in the boxes and within `Detector.context_px` and `CROP_UNIT_PX` of them.
    threshold
        As of `Detector.find`.
    """
    found, numbers = [concatenate([])], [np.empty(0, np.int64)]
    for mosaic in pack_boxes(boxes, detector.context_px):
        candidates, of_box = _find_in_mosaic(detector, frame, boxes, mosaic, threshold)
        found.append(candidates)
        numbers.append(of_box)
    return concatenate(found).take(np.argsort(np.concatenate(numbers), kind="stable"))


def _find_in_mosaic(
    detector: Detector, frame: SearchableFrame, boxes: IntArray, mosaic: Mosaic, threshold: float | None
) -> tuple[Detections, IntArray]:
    """The candidates of a mosaic, in px of the frame, and the number of the box of each."""
    placed, corners, inner = mosaic.crops, mosaic.corners, boxes[mosaic.numbers] * CELL_PX
    image = assemble(frame.image, mosaic, cv2.BORDER_REFLECT_101)
    valid = assemble(frame.valid.view(np.uint8), mosaic, cv2.BORDER_CONSTANT).view(np.bool_)
    found = detector.find_in_crops(image, valid, placed, threshold=threshold)
    searched = np.column_stack([placed[:, :2] + inner[:, :2] - corners, inner[:, 2:] - inner[:, :2]])
    candidate, crop = find_owners(found.xy, searched, mosaic.shape)
    cars = found.take(candidate).to_rows()
    cars[:, :2] += (corners - placed[:, :2])[crop, ::-1]
    return Detections.from_all(cars), mosaic.numbers[crop]


def find_owners(xy: FloatArray, boxes: IntArray, shape: tuple[int, int]) -> tuple[IntArray, IntArray]:
    """Which of the positions (n, 2) lie by their pixels in disjoint boxes (m, 4) of a mosaic, and in which."""
    y, x = (np.clip(np.floor(xy[:, 1 - k] + 0.5), 0, shape[k] - 1)[:, None] for k in (0, 1))
    top, left, rows, columns = boxes.T
    inside = (top <= y) & (y < top + rows) & (left <= x) & (x < left + columns)
    position, box = np.nonzero(inside)
    return position, box


def assemble(image: GreyImage, mosaic: Mosaic, border: int) -> GreyImage:
    """The windows of an image that a mosaic shows, put together; beyond the image they go on as OpenCV's border."""
    out, (height, width) = np.zeros(mosaic.shape, np.uint8), image.shape
    for (row, column, rows, columns), (top, left) in zip(mosaic.crops.tolist(), mosaic.corners.tolist(), strict=True):
        bottom, right = top + rows, left + columns
        window = image[max(top, 0) : bottom, max(left, 0) : right]
        if window.shape != (rows, columns):
            beyond = max(-top, 0), max(bottom - height, 0), max(-left, 0), max(right - width, 0)
            window = cv2.copyMakeBorder(window, *beyond, border)
        out[row : row + rows, column : column + columns] = window
    return out
