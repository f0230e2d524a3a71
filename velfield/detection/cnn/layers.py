"""Convolution, its gradients, and space-to-depth on plain numpy arrays: what training differentiates.

Images of a batch are (count, height, width, channels). A convolution gathers the neighbourhoods of a block of pixels as
rows of a matrix (im2col) that stays in the second-level cache, and multiplies it by the weights: 3 x 3 and 1 x 1
kernels keep the resolution, a 4 x 4 kernel has stride 2. Beyond an image there are zeros ("same" padding).
"""

import math
import threading
from collections.abc import Iterator

import numpy as np

from schemas.arrays import Float32Array
from velfield.compiled import kernel

_BLOCK_ROWS = 576
"""Pixels of one matrix product: an eighth of half a batch at a quarter of the resolution."""


class _Scratch(threading.local):
    """Memory of each thread that every convolution uses again: fresh pages took a tenth of a training step."""

    def __init__(self) -> None:
        self._buffers: dict[str, Float32Array] = {}

    def array(self, name: str, *shape: int) -> Float32Array:
        """An array of whatever values; the next one of that name overwrites it."""
        size, buffer = math.prod(shape), self._buffers.get(name)
        if buffer is None or buffer.size < size:
            buffer = self._buffers[name] = np.empty(size, np.float32)
        return buffer[:size].reshape(shape)


_scratch = _Scratch()


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
    matrix = weights.reshape(-1, weights.shape[2])
    stride = _stride(weights)
    count, height, width, _ = images.shape
    out = np.empty((count, height // stride, width // stride, weights.shape[2]), np.float32)
    rows = out.reshape(-1, weights.shape[2])
    for start, stop, columns in _neighbourhoods(images, weights):
        np.matmul(columns, matrix, out=rows[start:stop])
        if bias is not None:
            _add_bias(rows[start:stop], bias, relu)  # while the block is in the cache
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
    if len(weights) == 9 and by_images:
        return _conv3x3_backward(images, weights, gradient)
    transposed = np.ascontiguousarray(weights.reshape(-1, weights.shape[2]).T)
    rows = gradient.reshape(-1, weights.shape[2])
    by_weights = np.zeros((weights.shape[0] * weights.shape[1], weights.shape[2]), np.float32)
    count, height, width, channels = images.shape
    side, stride, padded = _side(weights), _stride(weights), None
    if by_images and side > 1:
        padded = np.zeros((count, height + 2, width + 2, channels), np.float32)
    for start, stop, columns in _neighbourhoods(images, weights):
        by_weights += columns.T @ rows[start:stop]
        if padded is not None:
            np.matmul(rows[start:stop], transposed, out=columns)
            _scatter(columns, padded, side, stride, start)
    by_weights = by_weights.reshape(weights.shape)
    if padded is not None:
        return np.ascontiguousarray(padded[:, 1:-1, 1:-1]), by_weights
    return (rows @ transposed).reshape(images.shape) if by_images else None, by_weights


def _conv3x3_backward(
    images: Float32Array, weights: Float32Array, gradient: Float32Array
) -> tuple[Float32Array, Float32Array]:
    """Both gradients from the neighbourhoods of the output's gradient, gathered once.

    An input pixel reaches the output through the mirrored kernel: its gradient is a convolution, and the gradient by a
    tap pairs each input pixel with the output pixel on the other side.
    """
    channels_in, channels_out = weights.shape[1:]
    mirrored = np.ascontiguousarray(weights[::-1].transpose(0, 2, 1)).reshape(-1, channels_in)
    by_images = np.empty(images.shape, np.float32)
    values, found = images.reshape(-1, channels_in), by_images.reshape(-1, channels_in)
    by_mirrored = np.zeros((9 * channels_out, channels_in), np.float32)
    for start, stop, columns in _neighbourhoods(gradient, weights):
        np.matmul(columns, mirrored, out=found[start:stop])
        by_mirrored += columns.T @ values[start:stop]
    by_weights = by_mirrored.reshape(9, channels_out, channels_in)[::-1].transpose(0, 2, 1)
    return by_images, np.ascontiguousarray(by_weights)


def _side(weights: Float32Array) -> int:
    return {1: 1, 9: 3, 16: 4}[len(weights)]


def _stride(weights: Float32Array) -> int:
    return 2 if len(weights) == 16 else 1


def _neighbourhoods(images: Float32Array, weights: Float32Array) -> Iterator[tuple[int, int, Float32Array]]:
    """Blocks of output pixels: the first, the end, and what the kernel sees of each (n, taps x channels).

    The next block overwrites the array, and so may the caller; a 1 x 1 kernel sees the images themselves.
    """
    side, stride = _side(weights), _stride(weights)
    count, height, width, channels = images.shape
    pixels = count * (height // stride) * (width // stride)
    if side == 1:
        yield 0, pixels, images.reshape(pixels, channels)
        return
    padded = _scratch.array("padded", count, height + 2, width + 2, channels)
    padded[:, 1:-1, 1:-1] = images
    padded[:, 0], padded[:, -1], padded[:, :, 0], padded[:, :, -1] = 0, 0, 0, 0
    buffer = _scratch.array("columns", min(_BLOCK_ROWS, pixels), side * side * channels)
    for start in range(0, pixels, _BLOCK_ROWS):
        stop = min(start + _BLOCK_ROWS, pixels)
        columns = buffer[: stop - start]
        _gather(padded, columns, side, stride, start)
        yield start, stop, columns


@kernel
def _first_value(shape: tuple[int, int, int, int], stride: int, pixel: int) -> int:
    """Where the neighbourhood of an output pixel begins in padded images of a shape, by the number of the value."""
    _, height, width, channels = shape
    line, x = divmod(pixel, (width - 2) // stride)
    image, y = divmod(line, (height - 2) // stride)
    return ((image * height + y * stride) * width + x * stride) * channels


@kernel
def _gather(padded: Float32Array, columns: Float32Array, side: int, stride: int, first: int) -> None:
    """Fill rows with the neighbourhoods (side x side x channels) of successive output pixels from the first."""
    width, channels = padded.shape[2:]
    flat, length = padded.reshape(-1), side * channels
    for row in range(columns.shape[0]):
        start = _first_value(padded.shape, stride, first + row)
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
        start = _first_value(padded.shape, stride, first + row)
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
