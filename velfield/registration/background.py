"""Median over rectified frames, of each pixel those that cover it: moving vehicles vanish in it. Not in the paper.

The values of a pixel are sorted by a network of comparisons (Batcher's merge exchange; Knuth, The Art of Computer
Programming, volume 3, algorithm 5.2.2M), whose order depends on their number alone: each comparison is one of whole
rows of pixels, in vectors, and costs a thirtieth of sorting pixel by pixel.
"""

from functools import lru_cache

import numpy as np

from schemas.arrays import ByteArray, GreyImage, IntArray
from velfield.compiled import kernel

NOT_COVERED = 255
"""Grey level in place of pixels that a frame does not cover: they come last when sorted."""
_TILE_PX = 512


def median_of_stack(stack: ByteArray, count: ByteArray) -> GreyImage:
    """The median of each pixel over the ``count`` (h, w) frames that cover it, (h, w) uint8, halves rounded up; 0 where
    none does. The stack (n, h, w) uint8 of frames on a common grid is `NOT_COVERED` where a frame does not cover it.
    """
    median = np.zeros(count.shape, np.uint8)
    _medians(stack, count, _comparisons(len(stack)), median)
    return median


@lru_cache(maxsize=8)
def _comparisons(count: int) -> IntArray:
    """Pairs (m, 2) of places, to be put in order one after the other: then all ``count`` values are."""
    pairs = []
    top = 1 << max((count - 1).bit_length() - 1, 0)
    p = top
    while p > 0:
        q, r, d = top, 0, p
        while True:
            pairs += [(i, i + d) for i in range(count - d) if i & p == r]
            if q == p:
                break
            d, q, r = q - p, q // 2, p
        p //= 2
    return np.array(pairs, np.int64).reshape(-1, 2)


@kernel
def _medians(stack: ByteArray, count: ByteArray, pairs: IntArray, median: ByteArray) -> None:
    """Fill the median (h, w) from a stack (n, h, w), tile by tile, each small enough for the processor's cache."""
    frames, height, width = stack.shape
    values = np.empty((frames, _TILE_PX), np.uint8)
    for i in range(height):
        for left in range(0, width, _TILE_PX):
            size = min(_TILE_PX, width - left)
            for k in range(frames):
                source, target = stack[k, i, left : left + size], values[k]
                for x in range(size):
                    target[x] = source[x]
            for m in range(len(pairs)):
                first, second = values[pairs[m, 0]], values[pairs[m, 1]]
                for x in range(_TILE_PX):
                    a, b = first[x], second[x]
                    first[x] = min(a, b)
                    second[x] = max(a, b)
            for x in range(size):
                n = count[i, left + x]
                if n > 0:
                    median[i, left + x] = (int(values[(n - 1) // 2, x]) + int(values[n // 2, x]) + 1) // 2
