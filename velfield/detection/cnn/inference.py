"""Detections of one frame from the network: heatmap peaks, re-scored by test-time augmentation.

Peaks of the heatmap are candidates at sub-pixel positions. The network was trained on cars of every orientation, yet
its output depends on how a car lies to the pixel grid. So each candidate is scored again on two crops, one rotated to
its predicted orientation and one across it, and the outputs are averaged. Non-maximum suppression is left to the
caller.

A detector adapted to a flight by self-training adds a score bonus where the frame differs from the background.
"""

import cv2
import numpy as np

from schemas.arrays import Float32Array, FloatArray, GreyImage, IntArray, Mask
from schemas.detector import MotionRecord
from velfield.detection.cascade.classifier import offset_along_axis
from velfield.detection.cascade.proposals import in_view
from velfield.detection.cnn.model import STRIDE, Network, forward, predict_heatmap
from velfield.detection.orientation import sample_nearest

SCORE_OFFSET = 0.35
"""Probability predicted where a candidate is as often a car as not: around centres the loss lets the network predict
less than it should. Scores are probabilities less this."""
_SMOOTHING_SIGMA = 0.8
"""Of the heatmap, in its pixels."""
_MIN_PEAK_PROBABILITY = 0.2
MIN_SCORE = _MIN_PEAK_PROBABILITY - SCORE_OFFSET
"""Hardly any detection scores lower."""
_QUARTER_CAR_PX = 4.0
_CROP_PX = 44
_CENTRE = _CROP_PX // (2 * STRIDE)
"""Row and column of the heatmap of a crop where the candidate's centre is."""
_ROTATIONS = np.radians([0.0, 90.0])
"""Relative to the predicted orientation. Four rotations, or shifted crops as well, detected no more cars on the minsk
clip at up to three times the cost."""
_CANDIDATES_PER_BATCH = 8


def detect_cars(network: Network, image: GreyImage, valid: Mask | None) -> FloatArray:
    """Detect cars in a frame; a car may be detected several times, see `classifier.distinct`.

    Returns
    -------
    (n, 5): x, y in working px, orientation (axial, [0, pi)), score (probability - `SCORE_OFFSET`), standard deviation
    of the orientation, rad.
    """
    probability, orientation = predict_heatmap(network, image)
    smooth = cv2.GaussianBlur(probability, (0, 0), _SMOOTHING_SIGMA)
    peak = (smooth >= cv2.dilate(smooth, np.ones((3, 3), np.uint8))) & (smooth > _MIN_PEAK_PROBABILITY)
    if valid is not None:
        peak &= valid[::STRIDE, ::STRIDE]
    y, x = np.nonzero(peak)
    if not len(x):
        return np.empty((0, 5))
    xy = (np.column_stack([x, y]) + _subpixel_peak_offset(smooth, y, x)) * STRIDE + (STRIDE - 1) / 2
    vector = orientation[y, x].astype(np.float64)
    probabilities, vectors = _predict_rotated_crops(network, image, xy, 0.5 * np.arctan2(vector[:, 1], vector[:, 0]))
    score = probabilities.mean(axis=1)
    mean = (vectors * probabilities[..., None]).sum(axis=1) / np.maximum(probabilities.sum(axis=1), 1e-9)[:, None]
    resultant = np.clip(np.hypot(mean[:, 0], mean[:, 1]), 1e-3, 1 - 1e-3)
    axis = np.mod(0.5 * np.arctan2(mean[:, 1], mean[:, 0]), np.pi)
    detections = np.column_stack([xy, axis, score - SCORE_OFFSET, 0.5 * np.sqrt(-2 * np.log(resultant))])
    return detections[_is_mostly_visible(detections, image.shape, valid)]


def background_difference_at(
    image: GreyImage, background: GreyImage, xy: FloatArray, car_length_px: float
) -> FloatArray:
    """Mean absolute difference of a frame to the background around (n, 2) positions, grey levels.

    The mean is weighted by a Gaussian with a standard deviation of a fifth of a car's length.
    """
    difference = cv2.absdiff(image, background).astype(np.float32)
    return sample_nearest(cv2.GaussianBlur(difference, (0, 0), car_length_px / 5), xy)


def motion_score_bonus(motion: MotionRecord, difference: FloatArray) -> FloatArray:
    """Score added to detections by their difference to the background: a linear ramp, clipped at both ends."""
    ramp = motion.bonus_ramp_end - motion.bonus_ramp_start
    fraction = (difference - motion.bonus_ramp_start) / ramp
    return motion.max_score_bonus * np.clip(fraction, 0.0, 1.0)


def _is_mostly_visible(cars: FloatArray, shape: tuple[int, int], valid: Mask | None) -> Mask:
    """Whether three quarters of a car lie in the frame: the centre of a car that is truncated more is unreliable."""
    visible = np.ones(len(cars), bool)
    for along in (-_QUARTER_CAR_PX, _QUARTER_CAR_PX):
        visible &= in_view(offset_along_axis(cars[:, :2], cars[:, 2], np.array([[along, 0.0]])), shape, valid)
    return visible


def _subpixel_peak_offset(values: Float32Array, y: IntArray, x: IntArray) -> FloatArray:
    """Offset (n, 2), right and down, of the peak of a parabola through the logarithms of a pixel and its neighbours."""
    log = np.log(np.maximum(np.pad(values, 1, mode="edge"), 1e-6)).astype(np.float64)
    centre, offset = log[y + 1, x + 1], []
    for down, right in ((0, 1), (1, 0)):
        before, after = log[y + 1 - down, x + 1 - right], log[y + 1 + down, x + 1 + right]
        offset.append(np.clip((after - before) / (2 * np.maximum(2 * centre - before - after, 1e-6)), -0.5, 0.5))
    return np.column_stack(offset)


def _predict_rotated_crops(
    network: Network, image: GreyImage, xy: FloatArray, axis: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Test-time augmentation: probability (n, 2) and orientation vector (n, 2, 2) on crops along and across the axis.

    Orientation vectors are rotated back into the image.
    """
    rotations = axis[:, None] + _ROTATIONS
    offsets = np.arange(_CROP_PX) - (_CENTRE * STRIDE + (STRIDE - 1) / 2)
    v, u = np.meshgrid(offsets, offsets, indexing="ij")
    probability, vectors = np.empty(rotations.shape), np.empty((*rotations.shape, 2))
    for start in range(0, len(xy), _CANDIDATES_PER_BATCH):
        part = slice(start, start + _CANDIDATES_PER_BATCH)
        c, s = np.cos(rotations[part])[..., None, None], np.sin(rotations[part])[..., None, None]
        map_x, map_y = xy[part, 0, None, None, None] + u * c - v * s, xy[part, 1, None, None, None] + u * s + v * c
        flat = (-1, _CROP_PX)
        maps = map_x.reshape(flat).astype(np.float32), map_y.reshape(flat).astype(np.float32)
        crops = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        out = forward(network, crops.reshape(-1, _CROP_PX, _CROP_PX) / np.float32(255))
        probability[part], vectors[part] = _read_centre(out, rotations[part])
    return probability, vectors


def _read_centre(out: Float32Array, rotations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Highest smoothed probability within a pixel of the crops' centre, and the orientation vector at the centre."""
    window = out[:, _CENTRE - 3 : _CENTRE + 4, _CENTRE - 3 : _CENTRE + 4]
    sigmoid = 1 / (1 + np.exp(-window[..., 0].astype(np.float64)))
    kernel = cv2.getGaussianKernel(5, _SMOOTHING_SIGMA)[:, 0]
    rows = sum(kernel[k] * sigmoid[:, k : k + 3] for k in range(5))
    smooth = sum(kernel[k] * rows[:, :, k : k + 3] for k in range(5))
    probability = np.asarray(smooth).max(axis=(1, 2)).reshape(rotations.shape)
    vector = out[:, _CENTRE, _CENTRE, 1:].astype(np.float64).reshape(*rotations.shape, 2)
    c, s = np.cos(2 * rotations), np.sin(2 * rotations)
    return probability, np.stack([vector[..., 0] * c - vector[..., 1] * s, vector[..., 0] * s + vector[..., 1] * c], -1)
