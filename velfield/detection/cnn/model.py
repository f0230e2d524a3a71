"""The network that detects cars: a small fully convolutional encoder-decoder.

From a grey image it predicts, at half the resolution, a heatmap of car centres and the orientation of the car at each
pixel as (cos 2a, sin 2a). The encoder halves the resolution twice by space-to-depth and a 1 x 1 convolution, two
residual blocks follow at a quarter of the resolution, and the decoder returns to a half by depth-to-space with a skip
connection, as in a U-Net. 126,000 parameters; the receptive field is about three car lengths.

`TOPOLOGY` is the one definition of the layers: inference, training and the detector file derive from it.

Convolution, its gradients, and space-to-depth on plain numpy arrays.

The images of a batch are stored as one matrix, a pixel a row and a channel a column, each image within a border of
zeros one pixel wide ("same" padding). A neighbour then is a fixed number of rows away, and a 3 x 3 convolution is one
matrix product for each block of rows (im2col).

Detections of one frame from the network: heatmap peaks, re-scored by test-time augmentation.

Peaks of the heatmap are candidates at sub-pixel positions. The network was trained on cars of every orientation, yet
its output depends on how a car lies to the pixel grid. So each candidate is scored again on two crops, one rotated to
its predicted orientation and one across it, and the outputs are averaged. Non-maximum suppression is left to the
caller.

A detector adapted to a flight by self-training adds a score bonus where the frame differs from the background.
"""

from base64 import b64decode, b64encode
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import cv2
import numpy as np
from numpy.lib.stride_tricks import as_strided

from schemas.arrays import Float32Array, FloatArray, GreyImage, IntArray, Mask
from schemas.detector import LayerRecord, MotionRecord
from velfield.detection.cascade.classifier import in_view, offset_along_axis
from velfield.detection.orientation import sample_nearest
from velfield.errors import InputError

_BLOCK_ROWS = 512
"""Rows of one matrix product: their neighbourhoods stay in the second-level cache."""


@dataclass(frozen=True)
class PaddedBatchLayout:
    """Number and size of the images of a batch, each within a border of one pixel."""

    count: int
    height: int
    width: int

    @property
    def rows(self) -> int:
        """Number of pixels of all images, borders included: rows of a matrix of this layout."""
        return self.count * (self.height + 2) * (self.width + 2)

    def halved(self) -> "PaddedBatchLayout":
        """Layout of the same images at half the resolution."""
        return PaddedBatchLayout(self.count, self.height // 2, self.width // 2)

    def doubled(self) -> "PaddedBatchLayout":
        """Layout of the same images at twice the resolution."""
        return PaddedBatchLayout(self.count, 2 * self.height, 2 * self.width)

    def padded_view(self, values: Float32Array) -> Float32Array:
        """View a matrix (rows, channels) as (count, height + 2, width + 2, channels)."""
        return values.reshape(self.count, self.height + 2, self.width + 2, -1)

    def interior_view(self, values: Float32Array) -> Float32Array:
        """View a matrix (rows, channels) as (count, height, width, channels), without the border."""
        return self.padded_view(values)[:, 1:-1, 1:-1]

    def pack(self, images: Float32Array) -> Float32Array:
        """Matrix (rows, channels) of images (count, height, width, channels), zero in the border."""
        values = np.zeros((self.rows, images.shape[-1]), np.float32)
        self.interior_view(values)[...] = images
        return values

    def zero_border(self, values: Float32Array) -> None:
        """Set the border of a matrix (rows, channels) to zero, in place."""
        padded = self.padded_view(values)
        padded[:, 0], padded[:, -1], padded[:, :, 0], padded[:, :, -1] = 0, 0, 0, 0


def conv2d(values: Float32Array, weights: Float32Array, layout: PaddedBatchLayout) -> Float32Array:
    """Convolve with 1 x 1 or 3 x 3 kernels (cross-correlation, as in every deep learning library), without a bias.

    Parameters
    ----------
    values
        (rows, channels in).
    weights
        (1 or 9, channels in, channels out): kernel taps in row order.

    Returns
    -------
    (rows, channels out), zero in the border where the kernel is 3 x 3.
    """
    if len(weights) == 1:
        return np.asarray(values @ weights[0], np.float32)
    out = np.empty((layout.rows, weights.shape[2]), np.float32)
    matrix = weights.reshape(-1, weights.shape[2])
    for start, stop, columns in _im2col_blocks(values, layout):
        np.matmul(columns, matrix, out=out[start:stop])
    layout.zero_border(out)
    return out


def conv2d_backward(
    values: Float32Array, weights: Float32Array, gradient: Float32Array, layout: PaddedBatchLayout
) -> tuple[Float32Array, Float32Array]:
    """Gradients of a loss by the input and by the weights of `conv2d`.

    Parameters
    ----------
    values, weights
        As given to `conv2d`.
    gradient
        (rows, channels out) gradient by the output, zero in the border.

    Returns
    -------
    Gradient by the input (rows, channels in) and by the weights, of their shape.
    """
    if len(weights) == 1:
        return np.asarray(gradient @ weights[0].T, np.float32), (values.T @ gradient)[None]
    by_weights = np.zeros((9 * weights.shape[1], weights.shape[2]), np.float32)
    for start, stop, columns in _im2col_blocks(values, layout):
        by_weights += columns.T @ gradient[start:stop]
    mirrored = np.ascontiguousarray(weights[::-1].transpose(0, 2, 1))
    return conv2d(gradient, mirrored, layout), by_weights.reshape(weights.shape)


def _im2col_blocks(values: Float32Array, layout: PaddedBatchLayout) -> Iterator[tuple[int, int, Float32Array]]:
    """Blocks of rows: first row, end row, and the 3 x 3 neighbourhood of each row (n, 9 channels)."""
    line, channels = layout.width + 2, values.shape[1]
    reach = line + 1
    columns = np.empty((_BLOCK_ROWS, 3, 3 * channels), np.float32)
    row, one = values.strides
    for start in range(reach, layout.rows - reach, _BLOCK_ROWS):
        stop = min(start + _BLOCK_ROWS, layout.rows - reach)
        n = stop - start
        # Three neighbours of one image row are adjacent in memory: a strided window covers them without a copy.
        lines = as_strided(values[start - reach :], (n, 3, 3 * channels), (row, line * row, one), writeable=False)
        columns[:n] = lines
        yield start, stop, columns[:n].reshape(n, 9 * channels)


def space_to_depth(values: Float32Array, layout: PaddedBatchLayout) -> Float32Array:
    """Move each 2 x 2 block of pixels into the channels: half the resolution, four times the channels.

    ``layout`` is that of the input; the output has ``layout.halved()``. Channels are ordered by row of the block,
    column of the block, channel.
    """
    images = layout.interior_view(values)
    count, height, width, channels = images.shape
    blocks = images.reshape(count, height // 2, 2, width // 2, 2, channels).transpose(0, 1, 3, 2, 4, 5)
    return layout.halved().pack(blocks.reshape(count, height // 2, width // 2, 4 * channels))


def depth_to_space(values: Float32Array, layout: PaddedBatchLayout) -> Float32Array:
    """Inverse of `space_to_depth` (pixel shuffle); ``layout`` is that of the output."""
    images = layout.halved().interior_view(values)
    count, height, width, channels = images.shape
    blocks = images.reshape(count, height, width, 2, 2, channels // 4).transpose(0, 1, 3, 2, 4, 5)
    return layout.pack(blocks.reshape(count, 2 * height, 2 * width, channels // 4))


@dataclass(frozen=True)
class Conv:
    """A convolution with bias, by default with a ReLU after it.

    Where there is a ReLU, training from scratch normalises its input by batch; the trained normalisation is folded into
    weights and bias.
    """

    name: str
    kernel: Literal[1, 3]
    channels_in: int
    channels_out: int
    relu: bool = True

    @property
    def shape(self) -> tuple[int, int, int]:
        """Of the weights: kernel taps, channels in, channels out."""
        return self.kernel**2, self.channels_in, self.channels_out


@dataclass(frozen=True)
class SpaceToDepth:
    """Half the resolution, four times the channels."""


@dataclass(frozen=True)
class DepthToSpace:
    """Twice the resolution, a quarter of the channels."""


@dataclass(frozen=True)
class Residual:
    """Adds the output of its layers to their input, optionally with a ReLU after the sum."""

    layers: tuple["Layer", ...]
    relu: bool = False


Layer: TypeAlias = Conv | SpaceToDepth | DepthToSpace | Residual

TOPOLOGY: tuple[Layer, ...] = (
    Conv("stem", 3, 1, 16),
    SpaceToDepth(),
    Conv("down1", 1, 64, 32),
    Conv("enc1_0", 3, 32, 32),
    Conv("enc1_1", 3, 32, 32),
    Residual(
        (
            SpaceToDepth(),
            Conv("down2", 1, 128, 48),
            Residual((Conv("res1_0", 3, 48, 48), Conv("res1_1", 3, 48, 48))),
            Residual((Conv("res2_0", 3, 48, 48), Conv("res2_1", 3, 48, 48))),
            Conv("up1", 1, 48, 128, relu=False),
            DepthToSpace(),
        ),
        relu=True,
    ),
    Conv("dec1", 3, 32, 32),
    Conv("head", 1, 32, 3, relu=False),
)


def _convolutions(layers: Sequence[Layer]) -> Iterator[Conv]:
    for layer in layers:
        if isinstance(layer, Conv):
            yield layer
        elif isinstance(layer, Residual):
            yield from _convolutions(layer.layers)


CONVOLUTIONS: dict[str, Conv] = {conv.name: conv for conv in _convolutions(TOPOLOGY)}
"""The layers that have weights, by name, from input to output."""
STRIDE = 2
"""Working px a pixel of the heatmap."""
_TILE_PX, _HALO_PX = 768, 32
"""Large images are processed in tiles, each with a halo wider than the reach of the receptive field."""


@dataclass(frozen=True)
class Network:
    """Weights of a trained network.

    Attributes
    ----------
    weights : by layer, float32 (kernel taps, channels in, channels out).
    biases : by layer, float32 (channels out,).
    """

    weights: Mapping[str, Float32Array]
    biases: Mapping[str, Float32Array]


def network_from_record(record: Mapping[str, LayerRecord]) -> Network:
    """Unpack the layers of a detector file.

    Raises
    ------
    InputError
        The layers are not those of `TOPOLOGY`.
    """
    expected = {name: conv.shape for name, conv in CONVOLUTIONS.items()}
    found = {name: layer.shape for name, layer in record.items()}
    if found != expected:
        odd = next(name for name in [*expected, *found] if found.get(name) != expected.get(name))
        raise InputError(
            f"found a network whose layer {odd} is {found.get(odd)}, expected {expected.get(odd)}; it is of "
            "another version of velfield: train it again"
        )
    weights, biases = {}, {}
    for name, shape in expected.items():
        values = np.frombuffer(b64decode(record[name].weights_f16), "<f2").astype(np.float32)
        weights[name], biases[name] = values[: -shape[2]].reshape(shape), values[-shape[2] :]
    return Network(weights, biases)


def network_to_record(network: Network) -> dict[str, LayerRecord]:
    """Pack the layers for a detector file, at half precision."""
    record = {}
    for name, conv in CONVOLUTIONS.items():
        values = np.concatenate([network.weights[name].ravel(), network.biases[name]]).astype("<f2")
        record[name] = LayerRecord(shape=conv.shape, weights_f16=b64encode(values.tobytes()).decode())
    return record


def forward(network: Network, images: Float32Array) -> Float32Array:
    """Logits and orientation vectors of a batch of images.

    Parameters
    ----------
    images
        (n, h, w) float32, grey in [0, 1]; height and width are multiples of four.

    Returns
    -------
    (n, h / 2, w / 2, 3): the logit of a car's centre, cosine and sine of twice its orientation.
    """
    layout = PaddedBatchLayout(*images.shape)
    out, layout = _apply(TOPOLOGY, network, layout.pack(images[..., None]), layout)
    return np.ascontiguousarray(layout.interior_view(out))


def _apply(
    layers: Sequence[Layer], network: Network, values: Float32Array, layout: PaddedBatchLayout
) -> tuple[Float32Array, PaddedBatchLayout]:
    for layer in layers:
        if isinstance(layer, Conv):
            values = conv2d(values, network.weights[layer.name], layout)
            values += network.biases[layer.name]
            layout.zero_border(values)
        elif isinstance(layer, SpaceToDepth):
            values, layout = space_to_depth(values, layout), layout.halved()
        elif isinstance(layer, DepthToSpace):
            layout = layout.doubled()
            values = depth_to_space(values, layout)
        else:
            branch, _ = _apply(layer.layers, network, values, layout)
            branch += values
            values = branch
        if isinstance(layer, Conv | Residual) and layer.relu:
            np.maximum(values, 0, out=values)
    return values, layout


def predict_heatmap(network: Network, image: GreyImage) -> tuple[Float32Array, Float32Array]:
    """Probability and orientation of a car at each pixel of the heatmap, by tiled inference.

    Parameters
    ----------
    image
        (h, w) uint8 of any size.

    Returns
    -------
    (h / 2, w / 2) probability and (h / 2, w / 2, 2) orientation vector, sizes rounded up; heatmap pixel (x, y) is
    centred at (2 x + 0.5, 2 y + 0.5) of the image.
    """
    height, width = image.shape
    rows, columns = -(-height // _TILE_PX), -(-width // _TILE_PX)
    tile_h, tile_w = 4 * -(-height // (4 * rows)), 4 * -(-width // (4 * columns))
    excess = rows * tile_h - height, columns * tile_w - width
    padded = cv2.copyMakeBorder(
        image, _HALO_PX, _HALO_PX + excess[0], _HALO_PX, _HALO_PX + excess[1], cv2.BORDER_REFLECT_101
    )
    logits = np.empty((rows * tile_h // STRIDE, columns * tile_w // STRIDE, 3), np.float32)
    margin = _HALO_PX // STRIDE
    for y in range(0, rows * tile_h, tile_h):
        for x in range(0, columns * tile_w, tile_w):
            tile = padded[y : y + tile_h + 2 * _HALO_PX, x : x + tile_w + 2 * _HALO_PX]
            out = forward(network, (tile / np.float32(255))[None])[0]
            part = slice(y // STRIDE, (y + tile_h) // STRIDE), slice(x // STRIDE, (x + tile_w) // STRIDE)
            logits[part] = out[margin : margin + tile_h // STRIDE, margin : margin + tile_w // STRIDE]
    logits = logits[: -(-height // STRIDE), : -(-width // STRIDE)]
    return np.asarray(1 / (1 + np.exp(-logits[..., 0])), np.float32), logits[..., 1:]


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
