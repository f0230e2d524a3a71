"""Undo the row filters of an inflated PNG, many rows at once.

It is the dearest step of a flight of images: nearly all rows of a photograph are stored as differences from Paeth's
prediction, where each pixel waits for its left neighbour, and libpng, Pillow and OpenCV undo that pixel by pixel for
grey images: 36 ms for 5 Mpx, against 17 ms to inflate them. Here 64 rows are undone in step, each one byte behind the
row above, so that all that a byte waits for was made in steps before and one step is a few operations on vectors: 5 ms.
"""

import numpy as np
from numba import njit

_ROWS = 64
"""Undone in step."""
_LINE = 2 * _ROWS
"""From one step to the next in memory: apart, so that vectors may be made."""
_STEPS = 128
"""Between two transpositions: what they hold stays in the first cache."""
_ROUND, _SHIFT = 1 << 15, 16
_RED, _GREEN, _BLUE = 19595, 38470, 7471
"""ITU-R 601 luma in 65536ths, as Pillow rounds it."""


@njit(cache=True, nogil=True)
def undo_filters(filtered, channels, rows):  # type: ignore[no-untyped-def]
    """Undo the filters of all rows of an image of 8 bits a channel; whether all are filters of PNG.

    Parameters
    ----------
    filtered
        (h * (1 + width * channels),) uint8, inflated: each row behind the number of its filter, 0 to 4.
    channels
        Bytes a pixel.
    rows
        (h, width * channels) uint8, filled.

    Returns
    -------
    False where a row has another filter; then `rows` is filled in part.
    """
    height, line = rows.shape
    stride, one, lanes = line + 1, np.uint64(1), np.uint64(_ROWS)  # unsigned: numba checks no index for its sign
    # Step t makes the byte t - k of row k. The step is a line of `made`, behind those that it looks back to; row k is
    # at k + 1 in it, and the row above all of them at 0.
    back = channels + 1
    made = np.zeros((back + _STEPS) * _LINE, np.uint8)
    given, new = np.zeros(_STEPS * _ROWS, np.uint8), np.zeros(_ROWS, np.uint8)
    above = np.zeros(line + _STEPS + _ROWS, np.uint8)
    # Of each row, all bits of the one that is its filter; of a row that has not begun, none.
    sub, up = np.zeros(_ROWS, np.uint8), np.zeros(_ROWS, np.uint8)
    average, paeth = np.zeros(_ROWS, np.uint8), np.zeros(_ROWS, np.uint8)
    for first in range(0, height, _ROWS):
        count = min(_ROWS, height - first)
        for k in range(count):
            if filtered[(first + k) * stride] > 4:
                return False
        made[:] = 0
        made[(back - 1) * _LINE] = above[0]
        sub[:] = 0
        up[:] = 0
        average[:] = 0
        paeth[:] = 0
        for begin in range(0, line + count - 1, _STEPS):
            end = min(begin + _STEPS, line + count - 1)
            for k in range(count):
                start = (first + k) * stride + 1 - k
                for t in range(begin, min(k, end)):
                    given[(t - begin) * _ROWS + k] = 0
                for t in range(max(begin, k), min(end, k + line)):
                    given[np.uint64((t - begin) * _ROWS + k)] = filtered[np.uint64(start + t)]
            for t in range(begin, end):
                made[np.uint64((t - begin + back) * _LINE)] = above[np.uint64(t + 1)]
            for t in range(begin, end):
                if t < count:
                    kind = filtered[(first + t) * stride]
                    sub[t] = 255 if kind == 1 else 0
                    up[t] = 255 if kind == 2 else 0
                    average[t] = 255 if kind == 3 else 0
                    paeth[t] = 255 if kind == 4 else 0
                step = t - begin
                source, here = np.uint64(step * _ROWS), np.uint64((step + back) * _LINE) + one
                left = np.uint64((step + 1) * _LINE) + one
                upper, corner = np.uint64((step + channels) * _LINE), np.uint64(step * _LINE)
                for i in range(lanes):
                    a, b, c = made[left + i], made[upper + i], made[corner + i]
                    low, high = min(a, b), max(a, b)
                    # The nearest of a, b and c to a + b - c. With c between a and b it is so far from the three:
                    to_a = np.uint8(max(b, c) - min(b, c))
                    to_b = np.uint8(max(a, c) - min(a, c))
                    to_c = np.uint8(max(to_a, to_b) - min(to_a, to_b))
                    nearest = b if to_b <= to_c else c
                    nearest = a if (to_a <= to_b) & (to_a <= to_c) else nearest
                    # Else it lies beyond the one of a and b that is farther from c, or at it.
                    nearest = low if c >= high else nearest
                    nearest = high if c <= low else nearest
                    mean = np.uint8((a & b) + ((a ^ b) >> np.uint8(1)))
                    predicted = (a & sub[i]) | (b & up[i]) | (mean & average[i]) | (nearest & paeth[i])
                    new[i] = np.uint8(given[source + i] + predicted)
                # Not at once: of two places in one array the compiler does not know that they are apart.
                for i in range(lanes):
                    made[here + i] = new[i]
            for k in range(count):
                row = rows[first + k]
                for t in range(max(begin, k), min(end, k + line)):
                    row[np.uint64(t - k)] = made[np.uint64((t - begin + back) * _LINE + 1 + k)]
            made[: back * _LINE] = made[_STEPS * _LINE :]
        above[:line] = rows[first + count - 1]
    return True


@njit(cache=True, nogil=True)
def luma(pixels):  # type: ignore[no-untyped-def]
    """Grey levels (h, w) uint8 of colours (h, w, 3 or more) uint8: red, green, blue, and alpha, which is not looked at;
    ITU-R 601, to the bit as Pillow's conversion."""
    height, width = pixels.shape[:2]
    grey = np.empty((height, width), np.uint8)
    for y in range(height):
        for x in range(width):
            value = pixels[y, x, 0] * _RED + pixels[y, x, 1] * _GREEN + pixels[y, x, 2] * _BLUE
            grey[y, x] = (value + _ROUND) >> _SHIFT
    return grey
