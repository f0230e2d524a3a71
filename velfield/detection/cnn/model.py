"""The network that detects cars, and a frame's detections from it.

From a grey image it predicts, at half the resolution, a heatmap of car centres and the orientation of the car at each
pixel as (cos 2a, sin 2a); its layers are those of `velfield.detection.cnn.network`.

Peaks of the heatmap are candidates at sub-pixel positions. Those between two probabilities that the detector file gives
are scored again on two crops, one rotated to the predicted orientation and one across it, and the outputs are averaged
(test-time augmentation). Non-maximum suppression is left to the caller.
"""

import math
from functools import partial

import cv2
import numpy as np
from numba import njit

from schemas.arrays import Float32Array, FloatArray, GreyImage, IntArray, Mask
from velfield.detection.cnn.network import STRIDE, Network
from velfield.detection.cnn.quantization import BlockPredict

_TILE_PX, HALO_PX = 2048, 64
"""Larger images are processed in tiles, each with a halo wider than the reach of the receptive field."""
BORDER_PX = 16
"""An image is continued so far by reflection, for cars at its edge: F1 0.837 in place of 0.833 on the minsk clip, cars
that the edge cuts included; with 64 px 0.836."""
_BATCH_PX = 500_000
"""Pixels of the crops that the network is run on at once: more no longer stays in the processor's cache."""
_BORDER = cv2.BORDER_REFLECT_101
SMOOTHING_SIGMA = 0.8
"""Standard deviation by which the heatmap is smoothed, in its pixels."""
_LEAST_PROBABILITY = 1e-6
_SPAN = 64
"""Pixels of the heatmap that are searched for peaks, or are not, together."""
_QUARTER_CAR_PX = 4.0


def forward(network: Network, images: GreyImage) -> tuple[Float32Array, Float32Array]:
    """Heatmap and orientation vectors of a batch of images.

    Parameters
    ----------
    images
        (n, h, w) uint8; height and width are multiples of `Network.alignment`.

    Returns
    -------
    (n, h / 2, w / 2) probability of a car's centre; (n, 2, h / 2, w / 2) cosine and sine of twice its orientation.
    """
    return network.predict(images)


def predict_heatmap(
    network: Network, image: GreyImage, *, border_px: int = BORDER_PX
) -> tuple[Float32Array, Float32Array]:
    """Probability and orientation of a car at each pixel of the heatmap, by tiled inference.

    Parameters
    ----------
    image
        (h, w) uint8 of any size.
    border_px
        How far it is continued by reflection; 0 of a crop that has context already.

    Returns
    -------
    (h / 2, w / 2) probability and (2, h / 2, w / 2) orientation vector, sizes rounded up; heatmap pixel (x, y) is
    centred at (2 x + 0.5, 2 y + 0.5) of the image.
    """
    (height, width), unit = image.shape, network.alignment
    whole = unit * -(-height // unit), unit * -(-width // unit)
    side = [unit * -(-size // (unit * -(-size // _TILE_PX))) for size in whole]
    end = [border_px + size - given for size, given in zip(whole, image.shape, strict=True)]
    padded = cv2.copyMakeBorder(image, border_px, end[0], border_px, end[1], _BORDER) if any(end) else image
    if network.canvases is not None:
        of_padded = network.canvases.predict_crops(padded, np.array([(0, 0, *padded.shape)]))
        rows, columns = (slice(border_px // STRIDE, -(-(border_px + size) // STRIDE)) for size in image.shape)
        return of_padded[0][rows, columns], of_padded[1][:, rows, columns]
    if len(range(0, whole[0], side[0])) == len(range(0, whole[1], side[1])) == 1 and not border_px:
        of_image = forward(network, padded[None])
        return of_image[0][0][: -(-height // STRIDE), : -(-width // STRIDE)], of_image[1][0]
    probability = np.empty((whole[0] // STRIDE, whole[1] // STRIDE), np.float32)
    orientation = np.empty((2, *probability.shape), np.float32)
    for y in range(0, whole[0], side[0]):
        for x in range(0, whole[1], side[1]):
            # Beside other tiles the halo, at the image's edge its border: so tiles do not show.
            top, left = max(0, y + border_px - HALO_PX), max(0, x + border_px - HALO_PX)
            tile = padded[top : y + border_px + side[0] + HALO_PX, left : x + border_px + side[1] + HALO_PX]
            of_tile = forward(network, tile[None])
            rows, columns = (min(size, far - near) for size, far, near in zip(side, whole, (y, x), strict=True))
            down, right = (y + border_px - top) // STRIDE, (x + border_px - left) // STRIDE
            inner = slice(down, down + rows // STRIDE), slice(right, right + columns // STRIDE)
            part = slice(y // STRIDE, (y + rows) // STRIDE), slice(x // STRIDE, (x + columns) // STRIDE)
            probability[part], orientation[:, *part] = of_tile[0][0][inner], of_tile[1][0][:, *inner]
    size = -(-height // STRIDE), -(-width // STRIDE)
    return probability[: size[0], : size[1]], orientation[:, : size[0], : size[1]]


def predict_crops(network: Network, image: GreyImage, crops: IntArray) -> tuple[Float32Array, Float32Array]:
    """The same of crops of an image, each predicted as if it were alone; those of one size in one call.

    Parameters
    ----------
    image
        (h, w) uint8, even.
    crops
        (n, 4) first row, first column, height and width; disjoint, at multiples of `Network.alignment` and of such
        sizes.

    Returns
    -------
    As of `predict_heatmap`; zero where no crop is.
    """
    if network.canvases is not None:
        return network.canvases.predict_crops(image, crops)
    probability = np.zeros((image.shape[0] // STRIDE, image.shape[1] // STRIDE), np.float32)
    orientation = np.zeros((2, *probability.shape), np.float32)
    predict = network.predict
    fill_any = partial(_fill_crops, network)
    fill = predict.fill_crops if isinstance(predict, BlockPredict) else fill_any
    by_size = crops[np.lexsort((crops[:, 3], crops[:, 2]))]
    changes = np.flatnonzero((by_size[1:, 2:] != by_size[:-1, 2:]).any(axis=1)) + 1
    begin = 0
    for end in [*changes, len(by_size)] if len(by_size) else []:
        height, width = by_size[begin, 2:].tolist()
        tiled = max(height, width) > _TILE_PX
        at_once = 1 if tiled else max(1, _BATCH_PX // (height * width))
        for start in range(begin, end, at_once):
            corners = by_size[start : min(start + at_once, end), :2]
            (fill_any if tiled else fill)(image, corners, height, width, probability, orientation)
        begin = end
    return probability, orientation


def _fill_crops(
    network: Network,
    image: GreyImage,
    corners: IntArray,
    height: int,
    width: int,
    probability: Float32Array,
    orientation: Float32Array,
) -> None:
    """As `BlockPredict.fill_crops` does, of any network, or of one crop of any size."""
    pixels = _cut_kernel(image, corners, height, width)
    if max(height, width) > _TILE_PX:
        heatmap, vector = predict_heatmap(network, pixels[0], border_px=0)
        heatmaps, vectors = heatmap[None], vector[None]
    else:
        heatmaps, vectors = forward(network, pixels)
    _place_kernel(heatmaps, vectors, corners // STRIDE, probability, orientation)


@njit(cache=True, nogil=True)
def _cut_kernel(image, corners, height, width):  # type: ignore[no-untyped-def]
    """Crops (n, height, width) with these corners (n, 2): y, x."""
    out = np.empty((len(corners), height, width), np.uint8)
    for n in range(len(corners)):
        top, left = corners[n]
        for row in range(height):
            source, target = image[top + row], out[n, row]
            for x in range(np.uint64(width)):
                target[x] = source[np.uint64(left) + x]
    return out


@njit(cache=True, nogil=True)
def _place_kernel(heatmaps, vectors, corners, probability, orientation):  # type: ignore[no-untyped-def]
    """Write the heatmaps and orientation vectors of crops where these lie (n, 2): y, x."""
    height, width = heatmaps.shape[1:]
    for n in range(len(corners)):
        top, left = corners[n]
        for row in range(height):
            probability[top + row, left : left + width] = heatmaps[n, row]
            for k in range(2):
                orientation[k, top + row, left : left + width] = vectors[n, k, row]


SCORE_OFFSET = 0.35
"""Probability predicted where a candidate is as often a car as not: around centres the loss lets the network predict
less than it should. Scores are probabilities less this."""
_MIN_PEAK_PROBABILITY = 0.2
MIN_SCORE = _MIN_PEAK_PROBABILITY - SCORE_OFFSET
"""Hardly any detection scores lower."""
NO_TTA = 1.0, 1.0
"""No test-time augmentation (TTA), as in the shipped detector: on unseen images it scored cars no better (F1 0.900 in
place of 0.907 on the minsk clip), at three times the cost."""
FULL_TTA = 0.0, 1.0
"""TTA of all candidates."""
_CROP_PX = 48
_CENTRE = _CROP_PX // (2 * STRIDE)
"""Row and column of the heatmap of a crop where the candidate's centre is."""
_ROTATIONS = np.radians([0.0, 90.0])
"""Relative to the predicted orientation. Four rotations, or shifted crops as well, detected no more cars on the minsk
clip at up to three times the cost."""
_CANDIDATES_PER_BATCH = 8


def detect_cars(
    network: Network,
    image: GreyImage,
    valid: Mask | None,
    tta_range: tuple[float, float] = NO_TTA,
    *,
    border_px: int = BORDER_PX,
    crops: IntArray | None = None,
) -> FloatArray:
    """Detect cars in a frame, or in an image of crops; a car may be detected several times, see `nms_oriented`.

    Returns
    -------
    (n, 5): x, y in working px, orientation (axial, [0, pi)), score (probability - `SCORE_OFFSET`), standard deviation
    of the orientation, rad.
    """
    if crops is None:
        probability, orientation = predict_heatmap(network, image, border_px=border_px)
    else:
        probability, orientation = predict_crops(network, image, crops)
    peaks = find_peaks(probability, orientation, valid, stride=STRIDE, min_probability=_MIN_PEAK_PROBABILITY)
    if not len(peaks):
        return np.empty((0, 5))
    xy, vector, score = peaks[:, :2], peaks[:, 2:4].copy(), peaks[:, 4].copy()
    unsure = np.flatnonzero((score > tta_range[0]) & (score < tta_range[1]))
    if len(unsure):
        axis = 0.5 * np.arctan2(vector[unsure, 1], vector[unsure, 0])
        probabilities, vectors = _predict_rotated_crops(network, image, xy[unsure], axis)
        score[unsure] = probabilities.mean(axis=1)
        sum_of_weights = np.maximum(probabilities.sum(axis=1), 1e-9)[:, None]
        vector[unsure] = (vectors * probabilities[..., None]).sum(axis=1) / sum_of_weights
    resultant = np.clip(np.hypot(vector[:, 0], vector[:, 1]), 1e-3, 1 - 1e-3)
    axis = np.mod(0.5 * np.arctan2(vector[:, 1], vector[:, 0]), np.pi)
    detections = np.column_stack([xy, axis, score - SCORE_OFFSET, 0.5 * np.sqrt(-2 * np.log(resultant))])
    return detections[are_mostly_visible(detections, image.shape, valid)]


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
        crops = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=_BORDER)
        heatmaps, of_crops = forward(network, crops.reshape(-1, _CROP_PX, _CROP_PX))
        probability[part], vectors[part] = _read_centre(heatmaps, of_crops, rotations[part])
    return probability, vectors


def _read_centre(heatmaps: Float32Array, vectors: Float32Array, rotations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Highest smoothed probability within a pixel of the crops' centre, and the orientation vector at the centre."""
    window = heatmaps[:, _CENTRE - 3 : _CENTRE + 4, _CENTRE - 3 : _CENTRE + 4].astype(np.float64)
    kernel = cv2.getGaussianKernel(5, SMOOTHING_SIGMA)[:, 0]
    rows = sum(kernel[k] * window[:, k : k + 3] for k in range(5))
    smooth = sum(kernel[k] * rows[:, :, k : k + 3] for k in range(5))
    probability = np.asarray(smooth).max(axis=(1, 2)).reshape(rotations.shape)
    vector = vectors[:, :, _CENTRE, _CENTRE].astype(np.float64).reshape(*rotations.shape, 2)
    c, s = np.cos(2 * rotations), np.sin(2 * rotations)
    return probability, np.stack([vector[..., 0] * c - vector[..., 1] * s, vector[..., 0] * s + vector[..., 1] * c], -1)


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
    return np.asarray(_peaks_kernel(smooth, orientation, everywhere, stride, np.float32(min_probability)))


@njit(cache=True, nogil=True)
def _peaks_kernel(smooth, orientation, valid, stride, least):  # type: ignore[no-untyped-def]
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


@njit(cache=True, nogil=True)
def _count_above(values, least):  # type: ignore[no-untyped-def]
    count = np.int32(0)
    for x in range(np.uint64(values.size)):
        count += np.int32(values[x] > least)
    return count


@njit(cache=True, nogil=True)
def _offset(before, at, after):  # type: ignore[no-untyped-def]
    before, after = math.log(max(before, _LEAST_PROBABILITY)), math.log(max(after, _LEAST_PROBABILITY))
    bend = max(2 * math.log(max(at, _LEAST_PROBABILITY)) - before - after, 1e-6)
    return min(max((after - before) / (2 * bend), -0.5), 0.5)


def are_mostly_visible(cars: FloatArray, shape: tuple[int, ...], valid: Mask | None) -> Mask:
    """Whether three quarters of each car (n, 3...), x, y, axis, lie in an image of a shape, where it is ``valid``.

    The centre of a car that is truncated more is unreliable.
    """
    everywhere = np.empty((0, 0), np.bool_) if valid is None else valid
    return np.asarray(_visible_kernel(cars, shape[0], shape[1], everywhere))


@njit(cache=True, nogil=True)
def _visible_kernel(cars, height, width, valid):  # type: ignore[no-untyped-def]
    out = np.ones(len(cars), np.bool_)
    for n in range(len(cars)):
        for way in (-1.0, 1.0):
            x = cars[n, 0] + way * _QUARTER_CAR_PX * math.cos(cars[n, 2])
            y = cars[n, 1] + way * _QUARTER_CAR_PX * math.sin(cars[n, 2])
            near_x, near_y = int(min(max(np.rint(x), 0), width - 1)), int(min(max(np.rint(y), 0), height - 1))
            inside = abs(x - near_x) <= 0.5 and abs(y - near_y) <= 0.5
            out[n] &= inside and (valid.size == 0 or valid[near_y, near_x])
    return out
