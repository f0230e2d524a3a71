"""The boxes of a frame that are searched, cut out with context on every side and packed side by side into few images.

Boxes come by the hundred, and most are small: a detector that is called once for each spends a third of its time on the
calls. So crops lie on shelves as tall as their tallest one, and are searched together where that changes nothing (by
the network), or else one after another (`Detector.find_in_crops`); candidates in the context are dropped.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.arrays import ByteArray, FloatArray, IntArray
from velfield.compiled import kernel
from velfield.detection.changes import CELL_PX
from velfield.detection.frame import SearchableFrame
from velfield.detection.interface import Detections, Detector, concatenate

Box = tuple[int, int, int, int]
"""Rectangle of cells: first row, first column, row and column after the last."""
_SIDE_PX = 1024
"""Side of a mosaic, unless a crop is larger."""
CROP_UNIT_PX = 16
"""Sides of crops are multiples of this: the network halves the resolution four times."""


@dataclass(frozen=True)
class Mosaic:
    """Boxes with context, side by side.

    Attributes
    ----------
    shape : (height, width), px.
    numbers : (n,) of the boxes, in the order of the crops.
    crops : (n, 4) where they lie: first row, first column, height and width.
    """

    shape: tuple[int, int]
    numbers: IntArray
    crops: IntArray


def pack_boxes(boxes: Sequence[Box], context_px: int) -> list[Mosaic]:
    """Pack boxes with their context into mosaics, the tallest first."""
    if not len(boxes):
        return []
    sizes = _windows_px(boxes, context_px)[:, 2:]
    order = np.lexsort((sizes[:, 1], -sizes[:, 0]))
    number, corners = shelve_kernel(sizes[order], _SIDE_PX)
    crops = np.column_stack([corners, sizes[order]])
    ends = np.flatnonzero(np.diff(number)) + 1
    parts = zip(np.split(order, ends), np.split(crops, ends), strict=True)
    return [Mosaic((int((of[:, 0] + of[:, 2]).max()), int((of[:, 1] + of[:, 3]).max())), one, of) for one, of in parts]


def _windows_px(boxes: Sequence[Box], context_px: int) -> IntArray:
    """First row, first column, height and width (n, 4) of what is cut out: boxes with context, from and to multiples of
    `CROP_UNIT_PX` of the frame, so that the network's coarse pixels lie as in the whole frame."""
    cells = np.array(boxes) * CELL_PX
    first = (cells[:, :2] - context_px) // CROP_UNIT_PX * CROP_UNIT_PX
    last = -(-(cells[:, 2:] + context_px) // CROP_UNIT_PX) * CROP_UNIT_PX
    return np.column_stack([first, last - first])


@kernel
def shelve_kernel(sizes: IntArray, side: int) -> tuple[IntArray, IntArray]:
    """Number of the mosaic (n,) of crops of sizes (n, 2), height and width, the tallest first, and its corner there
    (n, 2): row and column. A mosaic is no larger than a side, unless a crop is."""
    number, corners = np.zeros(len(sizes), np.int64), np.zeros((len(sizes), 2), np.int64)
    mosaic = y = x = shelf = 0
    for k in range(len(sizes)):
        height, width = sizes[k]
        if x > 0 and x + width > side:
            y, x, shelf = y + shelf, 0, 0
        if y > 0 and x == 0 and y + height > side:
            mosaic, y = mosaic + 1, 0
        number[k], corners[k, 0], corners[k, 1] = mosaic, y, x
        x, shelf = x + width, max(shelf, height)
    return number, corners


def find_in_boxes(
    detector: Detector,
    frame: SearchableFrame,
    boxes: Sequence[Box],
    threshold: float | None,
) -> Detections:
    """The candidates of a frame whose centres lie in some disjoint boxes, in the order of the boxes.

    Parameters
    ----------
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
    detector: Detector,
    frame: SearchableFrame,
    boxes: Sequence[Box],
    mosaic: Mosaic,
    threshold: float | None,
) -> tuple[Detections, IntArray]:
    """The candidates of a mosaic, in px of the frame, and the number of the box of each."""
    placed, inner = mosaic.crops, np.array(boxes)[mosaic.numbers] * CELL_PX
    corners = _windows_px(boxes, detector.context_px)[mosaic.numbers, :2]
    image = assemble_kernel(frame.image, corners, placed, *mosaic.shape, True)
    valid = assemble_kernel(frame.valid.view(np.uint8), corners, placed, *mosaic.shape, False).view(np.bool_)
    found = detector.find_in_crops(image, valid, placed, threshold=threshold)
    searched = np.column_stack([placed[:, :2] + inner[:, :2] - corners, inner[:, 2:] - inner[:, :2]])
    crop = owners_kernel(np.ascontiguousarray(found.xy), searched, *mosaic.shape)
    inside = np.flatnonzero(crop >= 0)
    found, crop = found.take(inside), crop[inside]
    shift = (corners - placed[:, :2])[crop]
    cars = found.to_rows()
    cars[:, :2] += shift[:, ::-1]
    return Detections.from_all(cars), mosaic.numbers[crop]


@kernel
def owners_kernel(xy: FloatArray, boxes: IntArray, height: int, width: int) -> IntArray:
    """Number of the box (n, 4) of a mosaic in which the pixel of each position (n, 2) lies; -1 where in none."""
    out = np.full(len(xy), -1, np.int64)
    for n in range(len(xy)):
        x = min(max(int(np.floor(xy[n, 0] + 0.5)), 0), width - 1)
        y = min(max(int(np.floor(xy[n, 1] + 0.5)), 0), height - 1)
        for k in range(len(boxes)):
            top, left, rows, columns = boxes[k]
            if top <= y < top + rows and left <= x < left + columns:
                out[n] = k
    return out


@kernel
def assemble_kernel(
    image: ByteArray, corners: IntArray, crops: IntArray, height: int, width: int, reflected: bool
) -> ByteArray:
    """A mosaic (height, width) of the windows of an image with these corners (n, 2), where crops (n, 4) lie.

    Beyond the image a window is zero, or what of it lies inside goes on by reflection (OpenCV's BORDER_REFLECT_101).
    """
    out = np.zeros((height, width), np.uint8)
    for n in range(len(crops)):
        row, column, rows, columns = crops[n]
        top, left = corners[n]
        first_row, first_column = max(0, -top), max(0, -left)
        inner_rows = min(rows, image.shape[0] - top) - first_row
        inner_columns = min(columns, image.shape[1] - left) - first_column
        whole = inner_rows == rows and inner_columns == columns
        for y in range(rows):
            inside = 0 <= y - first_row < inner_rows
            if not inside and not reflected:
                continue
            source = image[top + first_row + _reflect(y - first_row, inner_rows)]
            target = out[row + y, column : column + columns]
            shift, begin = left + first_column, np.uint64(first_column)
            # By a loop: numba assigns slices byte by byte, at seven times the cost.
            for x in range(np.uint64(inner_columns)):
                target[begin + x] = source[np.uint64(shift) + x]
            if reflected and not whole:
                for x in range(first_column):
                    target[x] = source[shift + _reflect(x - first_column, inner_columns)]
                for x in range(first_column + inner_columns, columns):
                    target[x] = source[shift + _reflect(x - first_column, inner_columns)]
    return out


@kernel
def _reflect(place: int, count: int) -> int:
    """The place among so many that one beyond them is the mirror image of, about the first or the last."""
    while not 0 <= place < count:
        place = 0 if count == 1 else -place if place < 0 else 2 * count - 2 - place
    return place
