"""Kernels that find where two frames differ, all at half the resolution, by cells of `CELL_PX`."""

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import Mask
from velfield.compiled import kernel

CELL_PX = 8
"""Side of the cells in which frames are compared and searched, working px."""
BOX_PX = 8
"""Side of the boxes that the difference is averaged over: about half a car."""
BOX_AREA = (BOX_PX // 2) ** 2
"""In pixels at half the resolution."""


@kernel
def difference_kernel(image, other, valid, other_valid, sums, counts, one_only) -> NDArray[np.int16]:  # type: ignore[no-untyped-def]
    """Difference of two images (h, w) where both are valid, else 0; of each cell its sum, the number of such pixels,
    and whether there are some where just one is valid.

    Rows whole, one quantity after the other, then by cells: loops over the few pixels of a cell, or over arrays of many
    types, are not vectorised.
    """
    side = np.uint64(CELL_PX // 2)
    height, width = np.uint64(image.shape[0]), np.uint64(image.shape[1])
    out = np.empty(image.shape, np.int16)
    total, number, unlike = np.empty(width, np.int16), np.empty(width, np.uint8), np.empty(width, np.bool_)
    for row in range(np.uint64(sums.shape[0])):
        total[:], number[:], unlike[:] = 0, 0, False
        for y in range(row * side, min((row + np.uint64(1)) * side, height)):
            for x in range(width):
                both = valid[y, x] & other_valid[y, x]
                out[y, x] = (np.int16(image[y, x]) - np.int16(other[y, x])) * both
            for x in range(width):
                total[x] += out[y, x]
            for x in range(width):
                number[x] += valid[y, x] & other_valid[y, x]
            for x in range(width):
                unlike[x] |= valid[y, x] ^ other_valid[y, x]
        for column in range(np.uint64(sums.shape[1])):
            for x in range(column * side, min((column + np.uint64(1)) * side, width)):
                sums[row, column] += np.float32(total[x])
                counts[row, column] += np.float32(number[x])
                one_only[row, column] |= unlike[x]
    return out


@kernel
def changed_kernel(boxes, slow, slope, valid, other_valid, limit, shift) -> Mask:  # type: ignore[no-untyped-def]
    """Cells that hold a pixel whose change exceeds the limit and what a shift by so many px would make."""
    side, scale = np.uint64(CELL_PX // 2), np.float32(1 / BOX_AREA)
    out = np.zeros(slow.shape, np.bool_)
    height, width = np.uint64(valid.shape[0]), np.uint64(valid.shape[1])
    about, above = np.empty(width, np.float32), np.empty(width, np.bool_)
    for row in range(np.uint64(slow.shape[0])):
        for column in range(np.uint64(slow.shape[1])):
            for x in range(column * side, min((column + np.uint64(1)) * side, width)):
                about[x] = slow[row, column]
        above[:] = False
        for y in range(row * side, min((row + np.uint64(1)) * side, height)):
            for x in range(width):
                change = abs(np.float32(boxes[y, x]) * scale - about[x])
                above[x] |= (change > limit + shift * slope[y, x]) & valid[y, x] & other_valid[y, x]
        _mark_cells(above, out[row])
    return out


@kernel
def _mark_cells(pixels: Mask, cells: Mask) -> None:
    """Mark the cells of a row in which a row of pixels holds anywhere."""
    side, width = np.uint64(CELL_PX // 2), np.uint64(pixels.size)
    for column in range(np.uint64(cells.size)):
        for x in range(column * side, min((column + np.uint64(1)) * side, width)):
            cells[column] |= pixels[x]
