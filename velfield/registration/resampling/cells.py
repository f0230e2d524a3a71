"""Cells of an image filled from a raw frame by cubic interpolation: map, interpolation and placement in one kernel.

OpenCV takes 5 ns a pixel for its map and its remap, and more to place pixels in cells; this takes 3.5 ns in all. Each
loop over a cell is plain, of float32 and without branches, so that it becomes vectors, and four pixels in a row are
loaded as one word.
"""

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import ByteArray, Float32Array, IntArray, Mask
from velfield.compiled import compiled

CELL_PX = 16
"""Side of a cell, output px."""
PAD_PX = 3
"""Width of the source's padding: pixels farther outside have the values of its border."""
_SHARPNESS = np.float32(-0.75)
"""Coefficient of cubic interpolation, as in OpenCV."""
_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
_BYTE, _MOST = np.int32(255), np.float32(255)


def as_words(extended: ByteArray) -> NDArray[np.int32]:
    """View of an image (h, w) as the words that begin at each of its pixels but the last three, (h * w - 3,)."""
    return np.ndarray((extended.size - 3,), np.int32, extended, strides=(1,))


@compiled(error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def _weights(part: np.float32) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Weights of four pixels in a row at a position between the second and the third."""
    rest = _ONE - part
    return (
        _SHARPNESS * part * rest * rest,
        ((_SHARPNESS + _TWO) * part - (_SHARPNESS + _TWO + _ONE)) * part * part + _ONE,
        ((_SHARPNESS + _TWO) * rest - (_SHARPNESS + _TWO + _ONE)) * rest * rest + _ONE,
        _SHARPNESS * rest * part * part,
    )


@compiled(error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def resample_kernel(
    extended: ByteArray,
    words: NDArray[np.int32],
    coarse: Float32Array,
    step: int,
    cells: IntArray,
    image: ByteArray,
    valid: Mask,
) -> None:
    """As `velfield.registration.warp.resample_cells`; ``words`` are `as_words` of ``extended``."""
    height, width = np.int32(extended.shape[0] - 2 * PAD_PX), np.int32(extended.shape[1] - 2 * PAD_PX)
    last_x, last_y = np.int32(width + PAD_PX - 1), np.int32(height + PAD_PX - 1)
    stride, side, size = np.uint64(extended.shape[1]), np.uint64(CELL_PX), np.uint64(CELL_PX * CELL_PX)
    flat, flat_valid, out_width = image.reshape(-1), valid.reshape(-1), np.uint64(image.shape[1])
    runs, across = np.empty(CELL_PX, np.int64), np.empty(CELL_PX, np.float32)
    for j in range(CELL_PX):
        below = (j + 0.5) / step + 0.5
        runs[j], across[j] = int(below), below - int(below)
    lines = np.empty((CELL_PX // step + 2, 2), np.float32)
    # zeros: pixels of a cell beyond the image's right edge get no position, but are sampled with the others
    x, y, part_x, part_y = np.zeros((4, CELL_PX * CELL_PX), np.float32)
    at, first, second, third, fourth = np.empty((5, CELL_PX * CELL_PX), np.int32)
    levels, inside = np.empty(CELL_PX * CELL_PX, np.uint8), np.empty(CELL_PX * CELL_PX, np.bool_)
    for n in range(len(cells)):
        top, left = cells[n, 0] * CELL_PX, cells[n, 1] * CELL_PX
        row, column = top // step, left // step
        nodes = min(len(lines), coarse.shape[1] - column)
        for r in range(CELL_PX):
            above = min(row + runs[r], coarse.shape[0] - 2)  # the last row only for pixels that no image has
            for m in range(nodes):
                for axis in range(2):
                    start = coarse[above, column + m, axis]
                    lines[m, axis] = start + across[r] * (coarse[above + 1, column + m, axis] - start)
            for m in range(nodes - 1):
                slope_x, slope_y = lines[m + 1, 0] - lines[m, 0], lines[m + 1, 1] - lines[m, 1]
                for c in range(np.uint64(max(m * step - step // 2, 0)), np.uint64(min(m * step + step // 2, CELL_PX))):
                    here = np.uint64(r) * side + np.uint64(c)
                    x[here], y[here] = lines[m, 0] + across[c] * slope_x, lines[m, 1] + across[c] * slope_y
        for k in range(size):
            in_x, in_y = (x[k] >= -_HALF) & (x[k] <= width - _HALF), (y[k] >= -_HALF) & (y[k] <= height - _HALF)
            inside[k] = in_x & in_y
            # beyond the padding's first pixel all four are the border's
            from_x = min(max(x[k] + np.float32(PAD_PX - 1), _ZERO), np.float32(last_x))
            from_y = min(max(y[k] + np.float32(PAD_PX - 1), _ZERO), np.float32(last_y))
            pixel_x, pixel_y = np.int32(from_x), np.int32(from_y)
            part_x[k], part_y[k] = from_x - np.float32(pixel_x), from_y - np.float32(pixel_y)
            at[k] = pixel_y * np.int32(stride) + pixel_x
        for k in range(size):
            place = np.uint64(at[k])
            first[k], second[k] = words[place], words[place + stride]
            third[k], fourth[k] = words[place + stride + stride], words[place + stride + stride + stride]
        for k in range(size):
            by_column, total = _weights(part_x[k]), _HALF
            rows = (first[k], second[k], third[k], fourth[k])
            for word, weight in zip(rows, _weights(part_y[k])):  # noqa: B905  # numba has no strict
                line = by_column[0] * np.float32(word & _BYTE)
                line += by_column[1] * np.float32((word >> np.int32(8)) & _BYTE)
                line += by_column[2] * np.float32((word >> np.int32(16)) & _BYTE)
                line += by_column[3] * np.float32((word >> np.int32(24)) & _BYTE)
                total += weight * line
            levels[k] = np.int32(min(max(total, _ZERO), _MOST))
        columns = np.uint64(min(CELL_PX, image.shape[1] - left))
        for r in range(np.uint64(min(CELL_PX, image.shape[0] - top))):
            to, source = (np.uint64(top) + r) * out_width + np.uint64(left), r * side
            for c in range(columns):
                flat[to + c], flat_valid[to + c] = levels[source + c], inside[source + c]
