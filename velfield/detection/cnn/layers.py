"""Convolution, its gradients, and space-to-depth on plain numpy arrays: what training differentiates.

The images of a batch are stored as one matrix, a pixel a row and a channel a column, each image within a border of
zeros one pixel wide ("same" padding). A neighbour then is a fixed number of rows away, and a 3 x 3 convolution is one
matrix product for each block of rows (im2col).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import as_strided

from schemas.arrays import Float32Array

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


_TAP, _WITHIN = (0, 1, 1, 2), (1, 0, 1, 0)
"""Of the four rows of a strided 4 x 4 kernel: the row of blocks, and the row within the block."""


def kernel_on_blocks(weights: Float32Array) -> Float32Array:
    """A 4 x 4 kernel of stride 2 (16, channels in, channels out) as a 3 x 3 one on blocks: (9, 4 channels in, out).

    After `space_to_depth` the strided convolution is a plain one, most of whose taps at the border are zero.
    """
    channels = weights.shape[1]
    out = np.zeros((9, 4 * channels, weights.shape[2]), np.float32)
    for tap, part, of in _strided_taps(channels):
        out[tap, part] = weights[of]
    return out


def kernel_off_blocks(weights: Float32Array) -> Float32Array:
    """Transpose of `kernel_on_blocks`: the gradient by the strided kernel from that by the one on blocks."""
    channels = weights.shape[1] // 4
    out = np.empty((16, channels, weights.shape[2]), np.float32)
    for tap, part, of in _strided_taps(channels):
        out[of] = weights[tap, part]
    return out


def _strided_taps(channels: int) -> Iterator[tuple[int, slice, int]]:
    """Of each tap of the strided kernel: the tap and the channels on blocks, and its own number."""
    for row in range(4):
        for column in range(4):
            part = channels * (2 * _WITHIN[row] + _WITHIN[column])
            yield 3 * _TAP[row] + _TAP[column], slice(part, part + channels), 4 * row + column
