"""Background model: per-pixel median and trimmed range over rectified frames.

Not in the paper; it replaces labels where none are given. In the median over frames spread over the flight moving
vehicles vanish; the range measures variation from other causes (trees, roof edges under registration jitter).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from schemas.arrays import ByteArray, GreyImage, Mask

_MAX_IMAGES = 255


@dataclass(frozen=True, eq=False)
class Background:
    """Median and range of each pixel over the frames.

    Attributes
    ----------
    median, low, high : (h, w) uint8; low and high are trimmed: a fraction ``trim`` is left out at either end.
    count : (h, w) uint8, number of frames that cover the pixel; where it is 0, so are the images.
    """

    median: GreyImage
    low: GreyImage
    high: GreyImage
    count: ByteArray

    @property
    def valid(self) -> Mask:
        """(h, w) bool: covered by at least one frame."""
        return np.asarray(self.count > 0)


def median_background(images: Sequence[GreyImage], masks: Sequence[Mask], *, trim: float = 0.1) -> Background:
    """Median over the frames that cover each pixel.

    Parameters
    ----------
    images
        Frames on a common grid, (h, w) uint8 each, at most 255.
    masks
        (h, w) bool each: where the frame covers the grid.
    trim
        Fraction of the values left out at either end of the range: passing vehicles are not variation of the ground.
        With fewer than 1 / trim frames none is left out.

    Raises
    ------
    ValueError
        No images, or more than 255.
    """
    if not 0 < len(images) <= _MAX_IMAGES:
        raise ValueError(f"found {len(images)} images for a background, expected 1 to {_MAX_IMAGES}")
    shape = images[0].shape
    median, low, high = (np.zeros(shape, np.uint8) for _ in range(3))
    count = np.zeros(shape, np.uint8)
    band = max(1, 2**22 // (len(images) * shape[1]))
    for top in range(0, shape[0], band):
        part = slice(top, top + band)
        stack = np.stack([image[part] for image in images], axis=-1)
        visible = np.stack([mask[part] for mask in masks], axis=-1)
        _rank_statistics(stack, visible, trim, median[part], low[part], high[part], count[part])
    return Background(median, low, high, count)


@njit(cache=True, nogil=True)
def _rank_statistics(stack, visible, trim, median, low, high, count):  # type: ignore[no-untyped-def]
    """Fill median, range and count of a band from stack and mask (h, w, n), by insertion sort of each pixel."""
    values = np.empty(stack.shape[2], np.uint8)
    for i in range(stack.shape[0]):
        for j in range(stack.shape[1]):
            n = 0
            for k in range(stack.shape[2]):
                if visible[i, j, k]:
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
