"""The cars of one frame, and their crops for tracking.

A frame is searched whole (`detect_frame`), or only where it differs from one that was (`search_frame`). Of a city most
stands still: roofs, trees, parked cars. Where a frame looks as the other does, within its noise, the detector would
detect the same again; so it is run on the rest alone, and the other frame's detections are kept elsewhere. Whatever
moves, arrives or leaves changes the image, at the edge of the frame as well; so does much else (foliage, the parallax
of roofs), which costs time but loses nothing.

The difference of two frames is averaged over about half a car, without its slow part (exposure, shadows of clouds), and
compared by cells of 8 px. A detection is kept only while nothing within the length of a bus changed: the middle of a
slow bus looks the same before and after.

The image is on the working grid: the base image's grid, scaled so that a car is ``working_car_length_px`` long. The
crops (`attach_crops`) are patches rotated to the axis, to compare appearance, upright chips, to align, and strips at
half the resolution along the axis, to measure vehicles up to the length of a bus.

Candidates of a lower score than a detection's are kept apart (`SearchedFrame.weak`): where a track shows that a vehicle
must be, they are enough evidence of it, as in the second association of ByteTrack (Zhang and others 2022).
"""

import math
from dataclasses import dataclass, field, fields
from functools import cached_property

import cv2
import numpy as np

from schemas.arrays import ByteArray, Float32Array, FloatArray, GreyImage, IntArray, Mask
from velfield.compiled import kernel
from velfield.detection.changes import (
    BOX_AREA,
    BOX_PX,
    CELL_PX,
    any_kernel,
    box_sums_kernel,
    changed_kernel,
    difference_kernel,
)
from velfield.detection.frame import SearchableFrame, half_resolution
from velfield.detection.interface import Detections, Detector, concatenate
from velfield.detection.long_vehicles.classifier import confirm_long_vehicles
from velfield.detection.mosaic import Box, find_in_boxes
from velfield.detection.nms import nms_oriented

_SLOW_PX = 96
"""Side of the boxes over which a difference counts as illumination."""
_NOISE_SIGMAS, _CHANGE_LEVELS = 5.0, (3.0, 8.0)
"""A change is a mean difference above so many standard deviations of the noise, but at least and at most so many grey
levels: in a frame that changed everywhere the noise cannot be estimated. In a simulated city every vehicle that moved
by 4 px changed its place by more than 10."""
_SHIFT_PX = 0.3
"""Between two frames the map is wrong by about as much, working px, by rolling shutter and by the noise of its fit. At
every edge of a city that makes a change: without the allowance up to three quarters of a shaken frame were searched."""
_SAMPLE_PX = CELL_PX
"""Distance of the pixels, at half the resolution, that noise is estimated from: one in two by two cells."""
_REACH_CARS = 1.75
"""A detection is not kept where something changed so near, in car lengths: half of a long bus."""
_UNSURE_FRACTION = 0.1
"""Fraction of the detections, those with the lowest scores, that is never kept. Most false detections are among them,
and kept detections make tracklets: precision 0.984 with all kept, 0.988 without these, in a simulated city."""


_CHIP_PX = 32
"""Side of the upright chips, the widest crops."""


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
    x, y = _grid_kernel(xy, np.cos(orientation_rad), np.sin(orientation_rad), length, width)
    return _sample(image, x, y).reshape(count, length, width)


@kernel
def _grid_kernel(
    xy: FloatArray, cosine: FloatArray, sine: FloatArray, length: int, width: int
) -> tuple[Float32Array, Float32Array]:
    """Where the pixels of patches lie in an image, row by row: x and y, each (n, length width) float32."""
    x, y = np.empty((len(xy), length * width), np.float32), np.empty((len(xy), length * width), np.float32)
    for n in range(len(xy)):
        for i in range(length):
            along = i - (length - 1) / 2
            begin_x, begin_y = xy[n, 0] + along * cosine[n], xy[n, 1] + along * sine[n]
            for j in range(width):
                across = j - (width - 1) / 2
                x[n, i * width + j] = begin_x - across * sine[n]
                y[n, i * width + j] = begin_y + across * cosine[n]
    return x, y


def upright_chips(image: GreyImage, xy: FloatArray, *, side: int = _CHIP_PX) -> GreyImage:
    """Crops about the rounded positions, (n, side, side) uint8: pixel (side / 2, side / 2) is the rounded position."""
    return np.asarray(_chips_kernel(image, np.rint(xy).astype(np.int64) - side // 2, side))


@kernel
def _chips_kernel(image: ByteArray, corners: IntArray, side: int) -> ByteArray:
    """Crops with these corners (n, 2); beyond the image its edge goes on."""
    height, width = image.shape
    out = np.empty((len(corners), side, side), np.uint8)
    for n in range(len(corners)):
        left, top = corners[n]
        if 0 <= left <= width - side and 0 <= top <= height - side:
            for i in range(side):
                source, target = image[top + i], out[n, i]
                for j in range(np.uint64(side)):
                    target[j] = source[np.uint64(left) + j]
            continue
        for i in range(side):
            y = min(max(corners[n, 1] + i, 0), height - 1)
            for j in range(side):
                out[n, i, j] = image[y, min(max(corners[n, 0] + j, 0), width - 1)]
    return out


def oriented_strips(
    half_image: GreyImage, xy: FloatArray, orientation_rad: FloatArray, *, length: int = 32, width: int = 10
) -> GreyImage:
    """Patches of twice a bus's length at half the resolution, the axis along the columns: (n, length, width) uint8.

    Parameters
    ----------
    half_image
        The image on the working grid at half its resolution, as of `ComparableFrame.half_image`.
    """
    return oriented_patches(half_image, (xy - 0.5) / 2, orientation_rad, width=width, length=length)


def _sample(image: GreyImage, x: Float32Array, y: Float32Array) -> GreyImage:
    rows = []
    for start in range(0, len(x), 16_000):  # remap takes at most 32,767 rows
        part = slice(start, start + 16_000)
        rows.append(cv2.remap(image, x[part], y[part], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    return np.asarray(np.concatenate(rows) if len(rows) > 1 else rows[0], np.uint8)


@dataclass(frozen=True)
class FrameDetections(Detections):
    """Cars of a frame, and their patches.

    Attributes
    ----------
    patches : (n, 16, 8) uint8, rotated to the axis.
    chips : (n, 32, 32) uint8, upright about the rounded position.
    strips : (n, 32, 10) uint8, rotated to the axis, at half the resolution.
    """

    patches: GreyImage
    chips: GreyImage
    strips: GreyImage

    def select(self, mask: Mask) -> "FrameDetections":
        """The cars of a mask (n,)."""
        return FrameDetections(**{one.name: getattr(self, one.name)[mask] for one in fields(self)})


def detect_frame(
    image: GreyImage,
    valid: Mask | None,
    detector: Detector,
    *,
    threshold: float | None = None,
) -> FrameDetections:
    """Detect the cars of a frame, top to bottom; the parameters are those of `Detector.detect`."""
    cars = detector.detect(image, valid, threshold=threshold)
    order = np.lexsort((cars.xy[:, 0], cars.xy[:, 1]))
    return attach_crops(image, cars, order)


def attach_crops(
    image: GreyImage, cars: Detections, order: IntArray | slice = slice(None), *, half_image: GreyImage | None = None
) -> FrameDetections:
    """Detections in an order, with their patches; the image at half its resolution is made where it is not given."""
    half = half_resolution(image) if half_image is None else half_image
    xy, axis = np.ascontiguousarray(cars.xy[order]), np.ascontiguousarray(cars.orientation_rad[order])
    return FrameDetections(
        xy=xy,
        orientation_rad=axis,
        orientation_sd_rad=cars.orientation_sd_rad[order],
        area_px=cars.area_px[order],
        score=cars.score[order],
        patches=oriented_patches(image, xy, axis),
        chips=upright_chips(image, xy),
        strips=oriented_strips(half, xy, axis),
    )


@dataclass(frozen=True)
class SearchedFrame:
    """A frame and the cars found in it.

    Attributes
    ----------
    frame : the frame.
    detections : its cars.
    searched : fraction of the frame's cells that the detector was run on.
    weak : candidates of a lower score that no car covers; long vehicles among them are in ``detections``.
    """

    frame: SearchableFrame
    detections: Detections
    searched: float
    weak: Detections = field(default_factory=lambda: concatenate([]))

    @cached_property
    def slope(self) -> Float32Array:
        """`box_mean_slope` of the frame: several are compared with it."""
        return box_mean_slope(self.frame)


def search_frame(
    detector: Detector,
    frame: SearchableFrame,
    *,
    reference: SearchedFrame | None = None,
    threshold: float | None = None,
) -> SearchedFrame:
    """Detect the cars of a frame and weak candidates: everywhere that it covers, or where it differs from a reference.

    Parameters
    ----------
    threshold
        As of `Detector.detect`; `Detector.weak_margin` below the threshold begin the weak candidates.
    reference
        A frame that was searched whole, on the same grid; none: this one is searched whole.

    Raises
    ------
    ValueError
        The reference has another shape.
    """
    own = detector.threshold if threshold is None else threshold
    weak_above = own - detector.weak_margin
    covered = _any_in_cells(frame.half_valid)
    if reference is None:
        cells = covered
    else:
        changed = covered & changed_cells(frame, reference.frame, reference.slope)
        length_px = detector.record.working_car_length_px
        cells = changed | (covered & _cells_to_repeat(changed, reference.detections, length_px))
    boxes = split_into_boxes(cells, detector.context_px / CELL_PX, detector.box_cost_px / CELL_PX**2)
    searched = np.zeros(cells.shape, bool)
    for top, left, bottom, right in boxes:
        searched[top:bottom, left:right] = True
    frame.resample(_grow(searched, -(-detector.context_px // CELL_PX)), CELL_PX)
    found = find_in_boxes(detector, frame, boxes, weak_above)
    above = found.score > own if detector.weak_margin else np.ones(len(found), bool)
    kept = None if reference is None else _outside(reference.detections, searched, frame.half_valid)
    cars = detector.refine(frame, found.take(np.flatnonzero(above)), kept)
    weak = found.take(np.flatnonzero(~above))
    if reference is not None:
        weak = concatenate([weak, _outside(reference.weak, searched, frame.half_valid)])
    length_px = detector.record.working_car_length_px
    weak = suppress_weak(weak, cars, length_px)
    long = confirm_long_vehicles(frame, weak, cars, length_px)
    if len(long):
        cars = concatenate([cars, long])
        weak = suppress_weak(weak, long, length_px)
    frame.resample(_cells_of_crops(np.concatenate([cars.xy, weak.xy]), cells.shape), CELL_PX)
    fraction = float(searched[covered].mean()) if covered.any() else 0.0
    return SearchedFrame(frame, cars, fraction, weak)


def suppress_weak(weak: Detections, cars: Detections, car_length_px: float) -> Detections:
    """Weak candidates that neither a car nor a better one of them covers."""
    if not len(weak):
        return weak
    number = np.arange(len(weak) + len(cars))[:, None]
    kept = nms_oriented(np.column_stack([concatenate([weak, cars]).to_rows(), number]), car_length_px)[:, -1]
    return weak.take(np.sort(kept[kept < len(weak)]).astype(np.int64))


def _grow(cells: Mask, reach: int) -> Mask:
    """Cells and those so many rows and columns from one."""
    side = 2 * reach + 1
    return np.asarray(cv2.dilate(cells.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def _cells_of_crops(xy: FloatArray, shape: tuple[int, ...]) -> Mask:
    """Cells (rows, columns) that the crops about positions reach into."""
    cells = np.zeros(shape, bool)
    cells[_locate_cells(xy, shape)] = True
    return _grow(cells, -(-_CHIP_PX // (2 * CELL_PX)))


def changed_cells(frame: SearchableFrame, reference: SearchableFrame, slope: Float32Array | None = None) -> Mask:
    """Where two frames on one grid differ by more than noise, illumination and the error of their registration; where
    just one covers the grid as well.

    Parameters
    ----------
    slope
        `box_mean_slope` of the reference, where it is known already.

    Returns
    -------
    (rows, columns) bool, of cells of `CELL_PX`, the last of each row and column perhaps smaller.
    """
    if frame.image.shape != reference.image.shape:
        raise ValueError(f"found frames of {frame.image.shape} and {reference.image.shape} px, expected one grid")
    slope = box_mean_slope(reference) if slope is None else slope
    side = CELL_PX // 2
    rows, columns = (-(-size // side) for size in frame.half_valid.shape)
    sums, counts = np.zeros((rows, columns), np.float32), np.zeros((rows, columns), np.float32)
    one_only = np.zeros((rows, columns), bool)
    images, masks = (frame.half_image, reference.half_image), (frame.half_valid, reference.half_valid)
    difference = difference_kernel(*images, *masks, sums, counts, one_only)
    boxes = box_sums_kernel(difference)
    share = np.float32(1 / side**2)
    slow = _slow_part(sums * share, counts * share)
    sample = (slice(_SAMPLE_PX // 2, None, _SAMPLE_PX),) * 2
    of_samples = (slice(_SAMPLE_PX // 2 // side, None, _SAMPLE_PX // side),) * 2
    at = boxes[sample] * np.float32(1 / BOX_AREA)
    at = np.abs(at - slow[of_samples])[masks[0][sample] & masks[1][sample]]
    noise = 1.4826 * float(np.median(at)) if at.size else 0.0
    lowest, highest = _CHANGE_LEVELS
    limit = np.float32(min(max(_NOISE_SIGMAS * noise, lowest), highest))
    changed = changed_kernel(boxes, slow, slope, *masks, limit, np.float32(_SHIFT_PX / 2))
    return np.asarray(changed | one_only)


def box_mean_slope(frame: SearchableFrame) -> Float32Array:
    """Steepness of a frame's mean over boxes of `BOX_PX`, grey levels a pixel of half the resolution."""
    side = BOX_PX // 2
    mean = cv2.boxFilter(frame.half_image, cv2.CV_32F, (side, side), borderType=cv2.BORDER_REPLICATE)
    along, across = (cv2.Sobel(mean, cv2.CV_32F, 1 - k, k, scale=1 / 8) for k in (0, 1))
    return np.asarray(cv2.magnitude(along, across, along), np.float32)


def _slow_part(difference: Float32Array, covered: Float32Array) -> Float32Array:
    """Mean difference about each cell, over `_SLOW_PX`, where both frames cover the grid, from the means of cells."""
    reach = _SLOW_PX // CELL_PX
    parts = [cv2.blur(mean, (reach, reach), borderType=cv2.BORDER_REPLICATE) for mean in (difference, covered)]
    return np.asarray(parts[0] / np.maximum(parts[1], 1e-3), np.float32)


def split_into_boxes(cells: Mask, margin: float, box_cost: float) -> list[Box]:
    """Disjoint boxes that cover the marked cells, cheap to search.

    Boxes are split in two, by the row or the column after which both are smallest, down to single cells; then, from
    the smallest up, a box takes the place of its parts where it costs no more. The cost of a box is its area with a
    margin on every side, plus a constant.

    Parameters
    ----------
    cells
        (rows, columns).
    margin, box_cost
        In cells, and in areas of a cell.
    """
    found = _split_kernel(np.ascontiguousarray(cells), margin, box_cost)
    return [(int(top), int(left), int(bottom), int(right)) for top, left, bottom, right in found]


@kernel
def _split_kernel(cells: Mask, margin: float, box_cost: float) -> IntArray:
    """Boxes (n, 4). Nodes of the tree are numbered so that parts come after the box that they are parts of."""
    height, width = cells.shape
    of_rows, of_columns = np.empty((height + 1, 2), np.int64), np.empty((width + 1, 2), np.int64)
    of_rows[height], of_columns[width] = 0, 0
    _find_extents(cells, (0, 0, height, width), of_rows, of_columns)
    nodes = [_bounds(of_rows, 0, height)]
    parts = [(0, 0)]
    done = 0
    two_cells = 2 * ((1 + 2 * margin) ** 2 + box_cost)
    while done < len(nodes):
        top, left, bottom, right = nodes[done]
        cost = (bottom - top + 2 * margin) * (right - left + 2 * margin) + box_cost
        # Parts are not made where they cannot cost less: two boxes cost no less than those of two cells, nor than
        # squares that hold as many cells as are marked.
        marked = 0.0
        if cost > two_cells:
            marked = _find_extents(cells, nodes[done], of_rows, of_columns)
        if cost <= max(two_cells, marked + 4 * margin * math.sqrt(marked) + 8 * margin * margin + 2 * box_cost):
            done += 1
            continue
        by_row, row = _best_split(of_rows, top, bottom, margin)
        by_column, column = _best_split(of_columns, left, right, margin)
        if min(by_row, by_column) < np.inf:
            if by_row <= by_column:
                nodes.append(_bounds(of_rows, top, row))
                nodes.append(_bounds(of_rows, row, bottom))
            else:
                for begin, end in ((left, column), (column, right)):
                    first_column, first_row, last_column, last_row = _bounds(of_columns, begin, end)
                    nodes.append((first_row, first_column, last_row, last_column))
            parts[done] = (len(nodes) - 2, len(nodes) - 1)
            parts.append((0, 0))
            parts.append((0, 0))
        done += 1
    costs = np.zeros(len(nodes))
    split = np.zeros(len(nodes), np.bool_)
    for k in range(len(nodes) - 1, -1, -1):
        top, left, bottom, right = nodes[k]
        costs[k] = (bottom - top + 2 * margin) * (right - left + 2 * margin) + box_cost
        one, other = parts[k]
        if one > 0 and costs[one] + costs[other] < costs[k]:
            costs[k], split[k] = costs[one] + costs[other], True
    boxes = np.empty((len(nodes), 4), np.int64)
    count = 0
    taken = np.zeros(len(nodes), np.bool_)
    taken[0] = nodes[0][2] > nodes[0][0]
    for k in range(len(nodes)):
        if taken[k] and split[k]:
            taken[parts[k][0]] = taken[parts[k][1]] = True
        elif taken[k]:
            for side in range(4):
                boxes[count, side] = nodes[k][side]
            count += 1
    return boxes[:count]


@kernel
def _find_extents(
    cells: Mask, box: tuple[int, int, int, int] | tuple[int, ...], of_rows: IntArray, of_columns: IntArray
) -> int:
    """First marked cell of each row and column of a box, and that after the last; the last is 0 where none is.

    Returns their number.
    """
    top, left, bottom, right = box
    width, count = np.uint64(right - left), 0
    # Of the columns, counted from ``left``: without a branch on each cell, so that the loop is vectorised.
    first, last = np.full(right - left, bottom, np.int32), np.zeros(right - left, np.int32)
    for row in range(top, bottom):
        line, marked, below, after = cells[row, left:right], np.int32(0), np.int32(row), np.int32(row + 1)
        for column in range(width):
            marked += np.int32(line[column])
        of_rows[row, 0], of_rows[row, 1] = right, 0
        if marked == 0:
            continue
        count += int(marked)
        for column in range(width):
            first[column] = min(first[column], below) if line[column] else first[column]
            last[column] = after if line[column] else last[column]
        begin, end = left, right
        while not cells[row, begin]:
            begin += 1
        while not cells[row, end - 1]:
            end -= 1
        of_rows[row, 0], of_rows[row, 1] = begin, end
    for column in range(width):
        of_columns[left + column, 0], of_columns[left + column, 1] = first[column], last[column]
    return count


@kernel
def _bounds(extents: IntArray, begin: int, end: int) -> tuple[int, ...]:
    """Bounding box of the marked cells in a range of rows (or columns): first row and column, and one past the last."""
    while begin < end and extents[begin, 1] == 0:
        begin += 1
    while end > begin and extents[end - 1, 1] == 0:
        end -= 1
    first, last = extents[begin, 0], extents[begin, 1]
    for line in range(begin + 1, end):
        if extents[line, 1] > 0:
            first, last = min(first, extents[line, 0]), max(last, extents[line, 1])
    return begin, first, end, last


@kernel
def _best_split(extents: IntArray, begin: int, end: int, margin: float) -> tuple[float, int]:
    """The least area of two boxes with margins, of the rows (or columns) of a box before and after one, and that row;
    inf for one row. The first and the last have a mark."""
    count = end - begin
    if count < 2:
        return np.inf, begin
    area = np.zeros(count)
    for way in range(2):
        edge = 0 if way == 0 else count - 1
        first, last, nearest = extents[begin + edge, 0], extents[begin + edge, 1], edge
        for step in range(count - 1):
            line = step if way == 0 else count - 1 - step
            if extents[begin + line, 1] > 0:
                first, last = min(first, extents[begin + line, 0]), max(last, extents[begin + line, 1])
                nearest = line
            size = abs(nearest - edge) + 1
            area[line + 1 if way == 0 else line] += (size + 2 * margin) * (last - first + 2 * margin)
    best = 1
    for line in range(2, count):
        if area[line] < area[best]:
            best = line
    return area[best], begin + best


def _outside(detections: Detections, searched: Mask, half_valid: Mask) -> Detections:
    """Detections of cells that were not searched, where the frame covers them."""
    row, column = _locate_cells(detections.xy, searched.shape)
    half = np.floor((detections.xy + 0.5) / 2).astype(np.int64)
    x, y = (np.clip(half[:, k], 0, half_valid.shape[1 - k] - 1) for k in (0, 1))
    return detections.take(np.flatnonzero(~searched[row, column] & half_valid[y, x]))


def _cells_to_repeat(changed: Mask, detections: Detections, length_px: float) -> Mask:
    """Cells of the detections near which something changed, and of those of the lowest scores."""
    reach = 2 * int(np.ceil(_REACH_CARS * length_px / CELL_PX)) + 1
    near = cv2.dilate(changed.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0
    repeat = np.zeros(changed.shape, bool)
    row, column = _locate_cells(detections.xy, changed.shape)
    repeat[row, column] = near[row, column]
    unsure = np.argsort(detections.score, kind="stable")[: int(np.ceil(_UNSURE_FRACTION * len(detections)))]
    repeat[row[unsure], column[unsure]] = True
    return repeat


def _locate_cells(xy: FloatArray, shape: tuple[int, ...]) -> tuple[IntArray, IntArray]:
    """Row and column, each (n,), of the cells in which positions lie."""
    cell = np.floor((xy + 0.5) / CELL_PX).astype(np.int64)
    return np.clip(cell[:, 1], 0, shape[0] - 1), np.clip(cell[:, 0], 0, shape[1] - 1)


def _any_in_cells(half: Mask) -> Mask:
    """Whether a mask at half the resolution holds anywhere in each cell."""
    out = np.zeros([-(-size // (CELL_PX // 2)) for size in half.shape], bool)
    any_kernel(half, out)
    return out
