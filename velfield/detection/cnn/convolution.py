"""Convolutions of a small network on plain arrays, and what they hand back in training.

Pictures of a batch lie one after another as rows of pixels with their channels side by side, each picture within a
border of zeros: a neighbour is then a fixed number of rows away, and a convolution is one product of matrices a piece.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import as_strided

from schemas.arrays import Float32Array

_PIECE = 512
"""Rows at once: their neighbourhoods stay in the second cache."""


@dataclass(frozen=True)
class Layout:
    """So many pictures of one size, each within a border of one pixel."""

    count: int
    height: int
    width: int

    @property
    def rows(self) -> int:
        """Rows of an array of this layout."""
        return self.count * (self.height + 2) * (self.width + 2)

    def halved(self) -> "Layout":
        """Of the same pictures at every second pixel."""
        return Layout(self.count, self.height // 2, self.width // 2)

    def framed(self, values: Float32Array) -> Float32Array:
        """(count, height + 2, width + 2, channels), a view."""
        return values.reshape(self.count, self.height + 2, self.width + 2, -1)

    def inner(self, values: Float32Array) -> Float32Array:
        """(count, height, width, channels) without the border, a view."""
        return self.framed(values)[:, 1:-1, 1:-1]

    def laid_out(self, inner: Float32Array) -> Float32Array:
        """(rows, channels) of what lies within the borders, (count, height, width, channels)."""
        values = np.zeros((self.rows, inner.shape[-1]), np.float32)
        self.inner(values)[...] = inner
        return values

    def clear_border(self, values: Float32Array) -> None:
        """Zero where no picture is."""
        framed = self.framed(values)
        framed[:, 0], framed[:, -1], framed[:, :, 0], framed[:, :, -1] = 0, 0, 0, 0


def convolved(values: Float32Array, weights: Float32Array, layout: Layout) -> Float32Array:
    """Convolve with 1 x 1 or 3 x 3 weights.

    Parameters
    ----------
    values
        (rows, c).
    weights
        (1 or 9, c, k): of the pixel, or of it and its neighbours by rows.

    Returns
    -------
    (rows, k), zero in the border.
    """
    if len(weights) == 1:
        return np.asarray(values @ weights[0], np.float32)
    out = np.empty((layout.rows, weights.shape[2]), np.float32)
    flat = weights.reshape(-1, weights.shape[2])
    for start, stop, near in _pieces(values, layout):
        np.matmul(near, flat, out=out[start:stop])
    layout.clear_border(out)
    return out


def handed_back(
    values: Float32Array, weights: Float32Array, slope: Float32Array, layout: Layout
) -> tuple[Float32Array, Float32Array]:
    """What a convolution hands back: the loss's slope by its values (rows, c), and by its weights, from that by what
    came out (rows, k), zero in the border."""
    if len(weights) == 1:
        return np.asarray(slope @ weights[0].T, np.float32), (values.T @ slope)[None]
    by_weights = np.zeros((9 * weights.shape[1], weights.shape[2]), np.float32)
    for start, stop, near in _pieces(values, layout):
        by_weights += near.T @ slope[start:stop]
    mirrored = np.ascontiguousarray(weights[::-1].transpose(0, 2, 1))
    return convolved(slope, mirrored, layout), by_weights.reshape(weights.shape)


def _pieces(values: Float32Array, layout: Layout) -> Iterator[tuple[int, int, Float32Array]]:
    """Pieces of rows: start, stop, and each row's neighbourhood (n, 9 c)."""
    line, channels = layout.width + 2, values.shape[1]
    reach = line + 1
    near = np.empty((_PIECE, 3, 3 * channels), np.float32)
    row, one = values.strides
    for start in range(reach, layout.rows - reach, _PIECE):
        stop = min(start + _PIECE, layout.rows - reach)
        n = stop - start
        # Three neighbours in a line lie side by side already: a window on them, one channel's step at a time.
        lines = as_strided(values[start - reach :], (n, 3, 3 * channels), (row, line * row, one), writeable=False)
        near[:n] = lines
        yield start, stop, near[:n].reshape(n, 9 * channels)


def gathered(values: Float32Array, layout: Layout) -> Float32Array:
    """Squares of 2 x 2 pixels as one pixel of four times the channels, of the halved layout."""
    inner = layout.inner(values)
    count, height, width, channels = inner.shape
    squares = inner.reshape(count, height // 2, 2, width // 2, 2, channels).transpose(0, 1, 3, 2, 4, 5)
    return layout.halved().laid_out(squares.reshape(count, height // 2, width // 2, 4 * channels))


def spread(values: Float32Array, layout: Layout) -> Float32Array:
    """The reverse of `gathered`: from the halved layout to this one, a quarter of the channels."""
    inner = layout.halved().inner(values)
    count, height, width, channels = inner.shape
    squares = inner.reshape(count, height, width, 2, 2, channels // 4).transpose(0, 1, 3, 2, 4, 5)
    return layout.laid_out(squares.reshape(count, 2 * height, 2 * width, channels // 4))
