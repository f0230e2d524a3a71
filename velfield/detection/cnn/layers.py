"""Convolution, its gradients, and space-to-depth on plain numpy arrays: what training differentiates.

Images of a batch are (count, height, width, channels). A convolution gathers the neighbourhoods of a block of pixels as
rows of a matrix (im2col) that stays in the second-level cache, and multiplies it by the weights: 3 x 3 and 1 x 1
kernels keep the resolution, a 4 x 4 kernel has stride 2. Beyond an image there are zeros ("same" padding).
"""

import numpy as np

from schemas.arrays import Float32Array
from velfield.compiled import kernel

_KERNELS = {1: (1, 1), 9: (3, 1), 16: (4, 2)}
"""Side and stride of a kernel by the number of its taps."""
_BLOCK_ROWS = 576
"""Pixels of one matrix product: an eighth of half a batch at a quarter of the resolution."""


def conv2d(
    images: Float32Array, weights: Float32Array, bias: Float32Array | None = None, *, relu: bool = False
) -> Float32Array:
    """Convolve images (cross-correlation, as in every deep learning library).

    Parameters
    ----------
    images
        (count, height, width, channels in).
    weights
        (1, 9 or 16, channels in, channels out): kernel taps in row order.
    bias
        (channels out,) is added; none: zero.
    relu
        Replace what is negative by zero; with a bias only.

    Returns
    -------
    (count, height, width, channels out); half the height and the width for a kernel of 16 taps.
    """
    side, stride = _KERNELS[len(weights)]
    count, height, width, _ = images.shape
    matrix = weights.reshape(-1, weights.shape[2])
    out = np.empty((count, height // stride, width // stride, weights.shape[2]), np.float32)
    no_bias = np.empty(0, np.float32)
    _convolve(
        _pad(images, side), matrix, no_bias if bias is None else bias, relu, side, stride, out.reshape(-1, out.shape[3])
    )
    return out


def conv2d_backward(
    images: Float32Array, weights: Float32Array, gradient: Float32Array, *, by_images: bool = True
) -> tuple[Float32Array | None, Float32Array]:
    """Gradients of a loss by the input and by the weights of `conv2d`.

    Parameters
    ----------
    images, weights
        As given to `conv2d`.
    gradient
        (count, height, width, channels out) gradient by the output.
    by_images
        Whether the gradient by the input is wanted.

    Returns
    -------
    Gradient by the input, none where it is not wanted, and by the weights, each of its shape.
    """
    side, stride = _KERNELS[len(weights)]
    matrix = weights.reshape(-1, weights.shape[2])
    by_matrix, padded = np.zeros_like(matrix), _pad(images, side)
    by_padded = np.zeros(padded.shape if by_images else (0, 0, 0, 0), np.float32)
    rows = np.ascontiguousarray(gradient).reshape(-1, weights.shape[2])
    _convolve_backward(padded, matrix, rows, side, stride, by_matrix, by_padded)
    by_weights = by_matrix.reshape(weights.shape)
    if not by_images:
        return None, by_weights
    return np.ascontiguousarray(by_padded[:, 1:-1, 1:-1]) if side > 1 else by_padded, by_weights


def _pad(images: Float32Array, side: int) -> Float32Array:
    """Images with a margin of one zero for a kernel of more than one tap."""
    if side == 1:
        return np.ascontiguousarray(images)
    return np.pad(images, ((0, 0), (1, 1), (1, 1), (0, 0)))


@kernel
def _convolve(
    padded: Float32Array,
    matrix: Float32Array,
    bias: Float32Array,
    relu: bool,
    side: int,
    stride: int,
    out: Float32Array,
) -> None:
    """Fill ``out`` (pixels, channels out); an empty ``bias`` is none."""
    buffer = np.empty((min(_BLOCK_ROWS, out.shape[0]), matrix.shape[0]), np.float32)
    for start in range(0, out.shape[0], _BLOCK_ROWS):
        found = out[start : start + _BLOCK_ROWS]
        columns = buffer[: found.shape[0]]
        _gather(padded, columns, side, stride, start)
        np.dot(columns, matrix, found)
        if bias.size > 0:
            _add_bias(found, bias, relu)  # while the block is in the cache


@kernel
def _convolve_backward(
    padded: Float32Array,
    matrix: Float32Array,
    gradient: Float32Array,
    side: int,
    stride: int,
    by_matrix: Float32Array,
    by_padded: Float32Array,
) -> None:
    """Add the gradients by the weights and, unless it is empty, by the padded images to what they are; ``gradient``
    (pixels, channels out) is that by the output."""
    buffer = np.empty((min(_BLOCK_ROWS, gradient.shape[0]), matrix.shape[0]), np.float32)
    for start in range(0, gradient.shape[0], _BLOCK_ROWS):
        rows = gradient[start : start + _BLOCK_ROWS]
        columns = buffer[: rows.shape[0]]
        _gather(padded, columns, side, stride, start)
        by_matrix += np.dot(columns.T, rows)
        if by_padded.size > 0:
            np.dot(rows, matrix.T, columns)
            _scatter(columns, by_padded, side, stride, start)


@kernel
def _first_value(shape: tuple[int, int, int, int], margin: int, stride: int, pixel: int) -> int:
    """Where the neighbourhood of an output pixel begins in images of a shape, padded by ``margin`` on each side, by the
    number of the value."""
    _, height, width, channels = shape
    line, x = divmod(pixel, (width - 2 * margin) // stride)
    image, y = divmod(line, (height - 2 * margin) // stride)
    return ((image * height + y * stride) * width + x * stride) * channels


@kernel
def _gather(padded: Float32Array, columns: Float32Array, side: int, stride: int, first: int) -> None:
    """Fill rows with the neighbourhoods (side x side x channels) of successive output pixels from the first."""
    width, channels = padded.shape[2:]
    flat, length = padded.reshape(-1), side * channels
    for row in range(columns.shape[0]):
        start = _first_value(padded.shape, min(side - 1, 1), stride, first + row)
        neighbourhood = columns[row]
        for tap in range(side):
            # The taps of a row are adjacent in memory, in the image as in the neighbourhood.
            source = flat[start + tap * width * channels : start + tap * width * channels + length]
            target = neighbourhood[tap * length : (tap + 1) * length]
            for k in range(length):
                target[k] = source[k]


@kernel
def _scatter(columns: Float32Array, padded: Float32Array, side: int, stride: int, first: int) -> None:
    """Add rows to the neighbourhoods that `_gather` reads: its adjoint."""
    width, channels = padded.shape[2:]
    flat, length = padded.reshape(-1), side * channels
    for row in range(columns.shape[0]):
        start = _first_value(padded.shape, min(side - 1, 1), stride, first + row)
        neighbourhood = columns[row]
        for tap in range(side):
            target = flat[start + tap * width * channels : start + tap * width * channels + length]
            source = neighbourhood[tap * length : (tap + 1) * length]
            for k in range(length):
                target[k] += source[k]


@kernel
def _add_bias(rows: Float32Array, bias: Float32Array, relu: bool) -> None:
    """Add a bias (channels,) to rows (n, channels) in place, then a ReLU."""
    for row in range(rows.shape[0]):
        values = rows[row]
        if relu:
            for k in range(values.shape[0]):
                value = values[k] + bias[k]
                values[k] = np.float32(0.0) if value < 0 else value  # NaN stays
        else:
            for k in range(values.shape[0]):
                values[k] += bias[k]


def relu_backward(gradient: Float32Array, out: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Gradient by the input of a ReLU, from that by its output and the output; and its sum over all pixels.

    The sum is the gradient by a bias before the ReLU.
    """
    channels = out.shape[-1]
    by_input, total = np.empty(out.shape, np.float32), np.zeros(channels, np.float32)
    _mask_and_sum(gradient.reshape(-1, channels), out.reshape(-1, channels), by_input.reshape(-1, channels), total)
    return by_input, total


@kernel
def _mask_and_sum(gradient: Float32Array, out: Float32Array, masked: Float32Array, total: Float32Array) -> None:
    for row in range(gradient.shape[0]):
        source, activation, target = gradient[row], out[row], masked[row]
        for k in range(source.shape[0]):
            value = source[k] if activation[k] > 0 else np.float32(0.0)
            target[k] = value
            total[k] += value


def space_to_depth(images: Float32Array) -> Float32Array:
    """Move each 2 x 2 block of pixels into the channels: half the resolution, four times the channels.

    Channels are ordered by row of the block, column of the block, channel.
    """
    count, height, width, channels = images.shape
    # Both pixels of a row of a block are adjacent in memory, before and after.
    blocks = images.reshape(count, height // 2, 2, width // 2, 2 * channels).transpose(0, 1, 3, 2, 4)
    return np.ascontiguousarray(blocks).reshape(count, height // 2, width // 2, 4 * channels)


def depth_to_space(images: Float32Array) -> Float32Array:
    """Inverse of `space_to_depth` (pixel shuffle)."""
    count, height, width, channels = images.shape
    blocks = images.reshape(count, height, width, 2, channels // 2).transpose(0, 1, 3, 2, 4)
    return np.ascontiguousarray(blocks).reshape(count, 2 * height, 2 * width, channels // 4)
