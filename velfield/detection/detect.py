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
crops (`attach_crops`) are upright chips, to compare and to align, and strips at half the resolution along the axis, to
compare vehicles up to the length of a bus. Detections of a detector that does
not measure vehicles are measured by the network that ships (`with_sizes`).

Candidates of a lower score than a detection's are kept apart (`SearchedFrame.weak`): where a track shows that a vehicle
must be, they are enough evidence of it, as in the second association of ByteTrack (Zhang and others 2022).
"""

from dataclasses import dataclass, field, fields, replace
from functools import cache, cached_property

import cv2
import numpy as np

from schemas.arrays import Float32Array, FloatArray, GreyImage, IntArray, Mask
from velfield.detection.boxes import split_into_boxes
from velfield.detection.changes import (
    BOX_AREA,
    BOX_PX,
    CELL_PX,
    changed_kernel,
    difference_kernel,
)
from velfield.detection.cnn.detector import CnnDetector
from velfield.detection.cnn.inference import Predictor
from velfield.detection.cnn.model import VIEW_REACH_PX, measure_vehicles
from velfield.detection.crops import CHIP_PX, oriented_strips, upright_chips
from velfield.detection.frame import SearchableFrame, half_resolution
from velfield.detection.interface import Detections, Detector, concatenate
from velfield.detection.mosaic import CROP_UNIT_PX, find_in_boxes
from velfield.detection.nms import nms_oriented
from velfield.detection.registry import shipped_detector

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
_BOX = (BOX_PX // 2, BOX_PX // 2)
_REACH_CARS = 1.75
"""A detection is not kept where something changed so near, in car lengths: half of a long bus."""
_UNSURE_FRACTION = 0.1
"""Fraction of the detections, those with the lowest scores, that is never kept. Most false detections are among them,
and kept detections make tracklets: precision 0.984 with all kept, 0.988 without these, in a simulated city."""


@dataclass(frozen=True)
class FrameDetections(Detections):
    """Cars of a frame, and their crops."""

    chips: GreyImage
    """(n, 32, 32) uint8, upright about the rounded position."""
    strips: GreyImage
    """(n, 32, 10) uint8, rotated to the axis, at half the resolution."""

    def select(self, mask: Mask) -> "FrameDetections":
        """The cars of a mask (n,)."""
        return FrameDetections(**{one.name: getattr(self, one.name)[mask] for one in fields(self)})


def with_sizes(image: GreyImage, cars: Detections) -> Detections:
    """Detections in an image, those without sizes measured by the network that ships."""
    unknown = np.flatnonzero(np.isnan(cars.sizes).any(axis=1))
    if not len(unknown):
        return cars
    sizes = cars.sizes.copy()
    sizes[unknown] = measure_vehicles(_shipped_predictor(), image, cars.xy[unknown])
    return replace(cars, sizes=sizes)


@cache
def _shipped_predictor() -> Predictor:
    detector = shipped_detector()
    assert isinstance(detector, CnnDetector)
    return detector.predictor


def detect_frame(image: GreyImage, valid: Mask | None, detector: Detector) -> FrameDetections:
    """Detect the cars of a frame, top to bottom; the parameters are those of `Detector.detect`."""
    cars = with_sizes(image, detector.detect(image, valid))
    order = np.lexsort((cars.xy[:, 0], cars.xy[:, 1]))
    return attach_crops(image, cars, order)


def attach_crops(
    image: GreyImage, cars: Detections, order: IntArray | slice = slice(None), *, half_image: GreyImage | None = None
) -> FrameDetections:
    """Detections in an order, with their crops; the image at half its resolution is made where it is not given."""
    half = half_resolution(image) if half_image is None else half_image
    xy, axis = np.ascontiguousarray(cars.xy[order]), np.ascontiguousarray(cars.orientation_rad[order])
    return FrameDetections(
        xy=xy,
        orientation_rad=axis,
        orientation_sd_rad=cars.orientation_sd_rad[order],
        area_px=cars.area_px[order],
        score=cars.score[order],
        sizes=cars.sizes[order],
        chips=upright_chips(image, xy),
        strips=oriented_strips(half, xy, axis),
    )


@dataclass(frozen=True)
class SearchedFrame:
    """A frame and the cars found in it."""

    frame: SearchableFrame
    detections: Detections
    searched: float
    """Fraction of the frame's cells that the detector was run on."""
    weak: Detections = field(default_factory=lambda: concatenate([]))
    """Candidates of a lower score that no car covers."""

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
    for top, left, bottom, right in boxes.tolist():
        searched[top:bottom, left:right] = True
    frame.resample(_grow(searched, -(-(detector.context_px + CROP_UNIT_PX - CELL_PX) // CELL_PX)), CELL_PX)
    found = find_in_boxes(detector, frame, boxes, weak_above)
    above = found.score > own if detector.weak_margin else np.ones(len(found), bool)
    kept = None if reference is None else _outside(reference.detections, searched, frame.half_valid)
    cars = detector.refine(found.take(np.flatnonzero(above)), kept)
    unknown = np.isnan(cars.sizes).any(axis=1)
    frame.resample(_cells_of_crops(cars.xy[unknown], cells.shape, VIEW_REACH_PX), CELL_PX)
    cars = with_sizes(frame.image, cars)
    weak = found.take(np.flatnonzero(~above))
    if reference is not None:
        weak = concatenate([weak, _outside(reference.weak, searched, frame.half_valid)])
    length_px = detector.record.working_car_length_px
    weak = suppress_weak(weak, cars, length_px)
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


def _cells_of_crops(xy: FloatArray, shape: tuple[int, ...], reach_px: int = CHIP_PX // 2) -> Mask:
    """Cells (rows, columns) that crops about positions reach into, by default the chips."""
    cells = np.zeros(shape, bool)
    cells[_locate_cells(xy, shape)] = True
    return _grow(cells, -(-reach_px // CELL_PX))


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
    boxes = cv2.boxFilter(difference, cv2.CV_16S, _BOX, normalize=False, borderType=cv2.BORDER_REPLICATE)
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
    mean = cv2.boxFilter(frame.half_image, cv2.CV_32F, _BOX, borderType=cv2.BORDER_REPLICATE)
    along, across = (cv2.Sobel(mean, cv2.CV_32F, 1 - k, k, scale=1 / 8) for k in (0, 1))
    return np.asarray(cv2.magnitude(along, across, along), np.float32)


def _slow_part(difference: Float32Array, covered: Float32Array) -> Float32Array:
    """Mean difference about each cell, over `_SLOW_PX`, where both frames cover the grid, from the means of cells."""
    reach = _SLOW_PX // CELL_PX
    parts = [cv2.blur(mean, (reach, reach), borderType=cv2.BORDER_REPLICATE) for mean in (difference, covered)]
    return np.asarray(parts[0] / np.maximum(parts[1], 1e-3), np.float32)


def _outside(detections: Detections, searched: Mask, half_valid: Mask) -> Detections:
    """Detections of cells that were not searched, where the frame covers them."""
    row, column = _locate_cells(detections.xy, searched.shape)
    half = np.floor((detections.xy + 0.5) / 2).astype(np.int64)
    x, y = (np.clip(half[:, k], 0, half_valid.shape[1 - k] - 1) for k in (0, 1))
    return detections.take(np.flatnonzero(~searched[row, column] & half_valid[y, x]))


def _cells_to_repeat(changed: Mask, detections: Detections, length_px: float) -> Mask:
    """Cells of the detections near which something changed, and of those of the lowest scores."""
    near = _grow(changed, int(np.ceil(_REACH_CARS * length_px / CELL_PX)))
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
    side = CELL_PX // 2
    grown = cv2.dilate(half.view(np.uint8), np.ones((side, side), np.uint8), anchor=(0, 0))
    return np.asarray(grown[::side, ::side] > 0)
