"""A frame's cars from the network's heatmap: its peaks, at sub-pixel positions. Non-maximum suppression is left to the
caller.
"""

import math

import cv2
import numpy as np

from schemas.arrays import Float32Array, FloatArray, GreyImage, IntArray, Mask
from velfield.compiled import kernel
from velfield.detection.cnn.inference import BORDER_PX, Predictor, predict_crops, predict_heatmap
from velfield.detection.cnn.network import ALIGNMENT, SIZE_STRIDE, STRIDE, USUAL_SIZE_PX
from velfield.detection.crops import crops_at

SMOOTHING_SIGMA = 0.8
"""Standard deviation by which the heatmap is smoothed, in its pixels."""
_LEAST_PROBABILITY = 1e-6
_LOG_SIZES, _LOG_SD = (-2.0, 2.0), (-4.0, 1.0)
"""Limits of the network's sizes, in logarithms: what a vehicle can be, and how sure training lets it be."""
_SPAN = 64
"""Pixels of the heatmap that are searched for peaks, or are not, together."""
_QUARTER_CAR_PX = 4.0
SCORE_OFFSET = 0.35
"""Probability predicted where a candidate is as often a car as not: around centres the loss lets the network predict
less than it should. Scores are probabilities less this."""
_MIN_PEAK_PROBABILITY = 0.2


def detect_cars(
    predict: Predictor,
    image: GreyImage,
    valid: Mask | None,
    *,
    border_px: int = BORDER_PX,
    crops: IntArray | None = None,
) -> FloatArray:
    """Detect cars in a frame, or in an image of crops; a car may be detected several times, see `nms_oriented`.

    Returns
    -------
    (n, 9): x, y in working px, orientation (axial, [0, pi)), score (probability - `SCORE_OFFSET`), standard deviation
    of the orientation, rad, and the sizes of `read_sizes`.
    """
    if crops is None:
        probability, orientation, sizes = predict_heatmap(predict, image, border_px=border_px)
    else:
        probability, orientation, sizes = predict_crops(predict, image, crops)
    peaks = find_peaks(probability, orientation, valid, stride=STRIDE, min_probability=_MIN_PEAK_PROBABILITY)
    if not len(peaks):
        return np.empty((0, 9))
    resultant = np.clip(np.hypot(peaks[:, 2], peaks[:, 3]), 1e-3, 1 - 1e-3)
    axis = np.mod(0.5 * np.arctan2(peaks[:, 3], peaks[:, 2]), np.pi)
    sd = 0.5 * np.sqrt(-2 * np.log(resultant))
    of_peaks = read_sizes(sizes, peaks[:, :2])
    detections = np.column_stack([peaks[:, :2], axis, peaks[:, 4] - SCORE_OFFSET, sd, of_peaks])
    return detections[are_mostly_visible(detections, image.shape, valid)]


def read_sizes(sizes: Float32Array, xy: FloatArray) -> FloatArray:
    """Sizes (n, 4) at positions (n, 2), working px: length and width, px, and the standard deviations of their
    logarithms; ``sizes`` (4, h, w) as the network gives them."""
    found = read_at(sizes, xy).astype(np.float64)
    length_and_width = np.exp(np.clip(found[:, :2], *_LOG_SIZES)) * USUAL_SIZE_PX
    return np.column_stack([length_and_width, np.exp(np.clip(found[:, 2:], *_LOG_SD))])


def read_at(maps: Float32Array, xy: FloatArray) -> Float32Array:
    """Values (n, channels) at positions (n, 2), working px, of maps (channels, h, w) of a pixel each `SIZE_STRIDE`."""
    column, row = (np.floor((xy[:, k] + 0.5) / SIZE_STRIDE).astype(np.int64) for k in (0, 1))
    return maps[:, np.clip(row, 0, maps.shape[1] - 1), np.clip(column, 0, maps.shape[2] - 1)].T


_VIEW_PX, _VIEWS, VIEW_REACH_PX = 80, 64, 48
"""Side of the views by which vehicles at known places are measured, views at once, and how far they reach from a
vehicle. They begin at multiples of `ALIGNMENT`, so that the network's coarse pixels lie as in the whole image: lengths
depend on where these lie."""


def measure_vehicles(predict: Predictor, image: GreyImage, xy: FloatArray) -> FloatArray:
    """Sizes (n, 4), as of `read_sizes`, of vehicles that something else found at positions (n, 2), working px.

    Parameters
    ----------
    image
        (h, w) uint8 on the working grid, known `VIEW_REACH_PX` about each position.
    """
    found = [np.empty((0, 4))]
    for start in range(0, len(xy), _VIEWS):
        some = xy[start : start + _VIEWS]
        corners = (np.rint(some).astype(np.int64) - (_VIEW_PX - ALIGNMENT) // 2) // ALIGNMENT * ALIGNMENT
        sizes = predict(crops_at(image, corners, _VIEW_PX))[2]
        found += [read_sizes(one, at[None]) for one, at in zip(sizes, some - corners, strict=True)]
    return np.concatenate(found)


def find_peaks(
    probability: Float32Array, orientation: Float32Array, valid: Mask | None, *, stride: int, min_probability: float
) -> FloatArray:
    """Candidates (n, 5) of a heatmap, top to bottom: x, y in px of the image, orientation vector, probability.

    Parameters
    ----------
    probability, orientation
        (h, w) and (2, h, w), a pixel for every ``stride`` of the image.
    valid
        Mask of the image, true where a peak counts; None: everywhere.
    min_probability
        After smoothing.
    """
    smooth = cv2.GaussianBlur(probability, (0, 0), SMOOTHING_SIGMA)
    everywhere = np.empty((0, 0), np.bool_) if valid is None else valid
    # one layout in memory, whichever part of an output it is: numba compiles again for each
    orientation = np.ascontiguousarray(orientation)
    return np.asarray(_peaks_kernel(smooth, orientation, everywhere, stride, np.float32(min_probability)))


@kernel
def _peaks_kernel(
    smooth: Float32Array, orientation: Float32Array, valid: Mask, stride: int, least: np.float32
) -> FloatArray:
    """A peak is no smaller than its eight neighbours. Its offset is that of a parabola through their logarithms."""
    height, width = smooth.shape
    masked = valid.size > 0
    # Most spans of a row hold nothing: to count is vectorised, to look at every pixel is not.
    counts = np.empty((height, -(-width // _SPAN)), np.int32)
    for y in range(height):
        for span in range(counts.shape[1]):
            counts[y, span] = _count_above(smooth[y, span * _SPAN : (span + 1) * _SPAN], least)
    out = np.empty((counts.sum(), 5))
    n = 0
    for y, span in np.argwhere(counts):
        top, bottom = max(y - 1, 0), min(y + 1, height - 1)
        for x in range(span * _SPAN, min((span + 1) * _SPAN, width)):
            value = smooth[y, x]
            if not value > least or (masked and not valid[y * stride, x * stride]):
                continue
            left, right = max(x - 1, 0), min(x + 1, width - 1)
            if value < max(smooth[y, left], smooth[y, right], smooth[top, x], smooth[bottom, x]):
                continue
            if value < max(smooth[top, left], smooth[top, right], smooth[bottom, left], smooth[bottom, right]):
                continue
            out[n, 0] = (x + _offset(smooth[y, left], value, smooth[y, right])) * stride + (stride - 1) / 2
            out[n, 1] = (y + _offset(smooth[top, x], value, smooth[bottom, x])) * stride + (stride - 1) / 2
            out[n, 2], out[n, 3], out[n, 4] = orientation[0, y, x], orientation[1, y, x], value
            n += 1
    return out[:n]


@kernel
def _count_above(values: Float32Array, least: np.float32) -> np.int32:
    count = np.int32(0)
    for x in range(np.uint64(values.size)):
        count += np.int32(values[x] > least)
    return count


@kernel
def _offset(before: float, at: float, after: float) -> float:
    before, after = math.log(max(before, _LEAST_PROBABILITY)), math.log(max(after, _LEAST_PROBABILITY))
    bend = max(2 * math.log(max(at, _LEAST_PROBABILITY)) - before - after, 1e-6)
    return min(max((after - before) / (2 * bend), -0.5), 0.5)


def are_mostly_visible(cars: FloatArray, shape: tuple[int, ...], valid: Mask | None) -> Mask:
    """Whether three quarters of each car (n, 3...), x, y, axis, lie in an image of a shape, where it is ``valid``.

    The centre of a car that is truncated more is unreliable.
    """
    step = _QUARTER_CAR_PX * np.column_stack([np.cos(cars[:, 2]), np.sin(cars[:, 2])])
    visible = np.ones(len(cars), np.bool_)
    for xy in (cars[:, :2] - step, cars[:, :2] + step):
        near = np.clip(np.rint(xy), 0, np.array(shape[1::-1]) - 1)
        visible &= (np.abs(xy - near) <= 0.5).all(axis=1)
        if valid is not None:
            column, row = near.astype(np.int64).T
            visible &= valid[row, column]
    return visible
