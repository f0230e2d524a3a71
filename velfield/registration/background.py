"""The background: what a place looks like with no traffic on it, and how much it varies.

Paper: none; it takes the place of labels where none are given. Median over frames spread over the flight: moving cars
are gone from it, and its range tells what differs for other reasons (a tree, a roof's edge under jitter).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

_MAX_STACK = 255


@dataclass(frozen=True, eq=False)
class Background:
    """Median and range of a place over the frames.

    Attributes
    ----------
    median, low, high : (h, w) uint8; low and high leave out ``trimmed`` values at either end.
    count : (h, w) uint8, frames that see the place; 0: nothing is known, and the pictures are 0 there.
    """

    median: NDArray[np.uint8]
    low: NDArray[np.uint8]
    high: NDArray[np.uint8]
    count: NDArray[np.uint8]

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(h, w) bool: seen by a frame at least."""
        return np.asarray(self.count > 0)


def median_background(
    images: Sequence[NDArray[np.uint8]], masks: Sequence[NDArray[np.bool_]], *, trim: float = 0.1
) -> Background:
    """Median over the frames that see each pixel.

    Parameters
    ----------
    images
        Frames on one grid, (h, w) uint8 each, 255 at most.
    masks
        (h, w) bool each: where the frame covers the grid.
    trim
        Share of the values left out at either end of the range: cars that went by are no range of the ground. With
        fewer than 1 / trim frames nothing is left out.

    Raises
    ------
    ValueError
        No images, or more than 255.
    """
    if not 0 < len(images) <= _MAX_STACK:
        raise ValueError(f"{len(images)} images for a background; 1 to {_MAX_STACK} can be taken")
    shape = images[0].shape
    median, low, high = (np.zeros(shape, np.uint8) for _ in range(3))
    count = np.zeros(shape, np.uint8)
    band = max(1, 2**22 // (len(images) * shape[1]))
    for top in range(0, shape[0], band):
        part = slice(top, top + band)
        stack = np.stack([image[part] for image in images], axis=-1)
        seen = np.stack([mask[part] for mask in masks], axis=-1)
        _ranked(stack, seen, trim, median[part], low[part], high[part], count[part])
    return Background(median, low, high, count)


@njit(cache=True, nogil=True)
def _ranked(stack, seen, trim, median, low, high, count):  # type: ignore[no-untyped-def]
    """Fill median, range and count of a band from stack and mask (h, w, n), by counting grey levels."""
    values = np.empty(stack.shape[2], np.uint8)
    for i in range(stack.shape[0]):
        for j in range(stack.shape[1]):
            n = 0
            for k in range(stack.shape[2]):
                if seen[i, j, k]:
                    value = stack[i, j, k]
                    p = n
                    while p > 0 and values[p - 1] > value:
                        values[p] = values[p - 1]
                        p -= 1
                    values[p] = value
                    n += 1
            count[i, j] = n
            if n > 0:
                cut = int(trim * n)
                median[i, j] = (int(values[(n - 1) // 2]) + int(values[n // 2]) + 1) // 2
                low[i, j] = values[cut]
                high[i, j] = values[n - 1 - cut]
