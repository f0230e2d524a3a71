"""Cells of an image filled from a raw frame by cubic interpolation: map, interpolation and placement in one kernel.

The result is that of OpenCV's remap, to the bit on processors with fused multiplication and addition: positions rounded
to 1/32 px, the same weights, the same order of sums. OpenCV takes 8 ns a pixel, and 4 more to make the map and to place
the pixels; here it is 1.6 ns in all, for a row of a cell, 16 px, is one vector throughout.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from schemas.arrays import ByteArray, Float32Array, IntArray, Mask
from velfield.compiled import kernel
from velfield.vectors import BYTE, LONG, REAL, WORD, Vectors

CELL_PX = 16
"""Side of a cell, output px."""
_FRACTION_BITS = 5
"""Fractional bits of positions: 1/32 px, to which OpenCV's remap rounds them as well."""
_MARGIN_PX = 1024
"""About the frame: what lies farther outside is taken as if it were that far."""
PAD_PX = 3
"""Width of the source's padding: pixels farther outside have the values of its border."""
_SHARPNESS = -0.75
"""Coefficient of cubic interpolation, as in OpenCV."""


def _cubic_weights(v: Vectors, fine: Any) -> list[Any]:
    """Weights of four pixels in a row, from the second of which positions lie 0, 1/32, 2/32... px.

    All products and sums here are exact: they have at most 18 bits.
    """
    build, a = v.build, _SHARPNESS
    fraction = build.and_(fine, v.constant(WORD, (1 << _FRACTION_BITS) - 1))
    x = build.fmul(build.sitofp(fraction, v.kind(REAL)), v.constant(REAL, 1 / (1 << _FRACTION_BITS)))
    rest = build.fsub(v.constant(REAL, 1.0), x)

    def outer(near: Any, far: Any) -> Any:  # a near far^2
        return build.fmul(build.fmul(build.fmul(v.constant(REAL, a), near), far), far)

    def inner(distance: Any) -> Any:  # (a + 2) d^3 - (a + 3) d^2 + 1
        slope = v.multiply_add(v.constant(REAL, a + 2), distance, v.constant(REAL, -(a + 3)))
        return v.multiply_add(build.fmul(slope, distance), distance, v.constant(REAL, 1.0))

    return [outer(x, rest), inner(x), inner(rest), outer(rest, x)]


@intrinsic
def _place_row(  # type: ignore[no-untyped-def]
    _context, height, stride, nodes, above, across, down, places, row, inside, at
):
    """Where the 16 px of a row lie in the source: into ``places``, and from ``at`` on whether they lie in the frame.

    ``height`` of the frame, ``stride`` of the extended source. ``nodes`` (n, 4, 16): of rows of centres x of the centre
    before each pixel and of that after it, and y of these; the pixels lie below row ``above`` by the fraction ``down``,
    and behind the centres before them by ``across`` (16,). ``places`` (n, 3, 16), of which ``row`` is written: flat
    index in the extended source of the first of 4 x 4 pixels, and x and y in 1/32 px.

    Positions are in units of the fraction, from a margin of so many pixels: all positive, so that truncation rounds
    down.
    """

    def generate(context: Any, build: Any, signature: Any, arguments: Any) -> Any:
        v, unit = Vectors(context, build, signature, arguments, CELL_PX), float(1 << _FRACTION_BITS)
        height, stride, nodes, above, across, down, places, row, inside, at = v.arguments
        along_y, along_x = v.spread(down), v.load(across)
        nodes_at = build.mul(above, LONG(4 * CELL_PX))

        def at_centre(k: int) -> Any:
            upper, lower = (v.load(nodes, nodes_at, part * CELL_PX) for part in (k, 4 + k))
            value = build.fadd(upper, build.fmul(along_y, build.fsub(lower, upper)))
            return build.fmul(build.fadd(value, v.constant(REAL, _MARGIN_PX)), v.constant(REAL, unit))

        zero = v.constant(REAL, 0.0)
        width = build.sub(stride, WORD(2 * PAD_PX))
        in_frame, fine, first = None, [], []
        for k, size in ((0, width), (2, height)):
            before, after = at_centre(k), at_centre(k + 1)
            position = build.fadd(before, build.fmul(along_x, build.fsub(after, before)))
            length = v.spread(build.fmul(build.sitofp(size, REAL), REAL(unit)))
            start = v.constant(REAL, (_MARGIN_PX - 0.5) * unit)
            for test in (
                build.fcmp_ordered(">=", position, start),
                build.fcmp_ordered("<=", position, build.fadd(start, length)),
            ):
                in_frame = test if in_frame is None else build.and_(in_frame, test)
            last = build.fadd(length, v.constant(REAL, 2 * _MARGIN_PX * unit))
            rounded = build.fadd(position, v.constant(REAL, 0.5))
            rounded = build.select(build.fcmp_ordered(">", rounded, zero), rounded, zero)
            rounded = build.select(build.fcmp_ordered("<", rounded, last), rounded, last)
            fine.append(build.fptosi(rounded, v.kind(WORD)))
            # Of the first of four pixels, in the extended source: beyond its ends all four are the border's.
            whole = build.ashr(fine[-1], v.constant(WORD, _FRACTION_BITS))
            whole = build.add(whole, v.constant(WORD, PAD_PX - _MARGIN_PX - 1))
            most = v.spread(build.add(size, WORD(2)))
            first.append(v.call("smin", v.call("smax", whole, v.constant(WORD, 0)), most))
        index = build.add(build.mul(first[1], v.spread(stride)), first[0])
        for k, value in enumerate((index, *fine)):
            v.store(value, places, build.mul(row, LONG(3 * CELL_PX)), k * CELL_PX)
        v.store(build.zext(in_frame, v.kind(BYTE)), inside, at)
        return context.get_dummy_value()

    return types.void(height, stride, nodes, above, across, down, places, row, inside, at), generate


@intrinsic
def _interpolate_row(_context, grey, stride, places, row, out, at):  # type: ignore[no-untyped-def]
    """Interpolate at a row of ``places`` in the extended source ``grey``, and store 16 grey levels from ``out[at]`` on.

    Four pixels in a row are loaded as one word.
    """

    def generate(context: Any, build: Any, signature: Any, arguments: Any) -> Any:
        v = Vectors(context, build, signature, arguments, CELL_PX)
        grey, stride, places, row, out, at = v.arguments
        row_at = build.mul(row, LONG(3 * CELL_PX))
        by_column, by_row = (_cubic_weights(v, v.load(places, row_at, k * CELL_PX)) for k in (1, 2))
        tops = [grey]
        for _ in range(3):
            tops.append(v.place(tops[-1], build.zext(stride, LONG)))
        four: list[list[Any]] = [[] for _ in tops]
        for q in range(CELL_PX):  # pixel by pixel, so that few vectors are open at a time
            index = build.zext(v.load(places, row_at, q, kind=WORD), LONG)
            for top, parts in zip(tops, four, strict=True):
                if q % 4 == 0:
                    parts.append(ir.Constant(ir.VectorType(WORD, 4), ir.Undefined))
                parts[-1] = build.insert_element(parts[-1], v.load(top, index, kind=WORD), WORD(q % 4))
        total = None
        for parts, weight in zip(four, by_row, strict=True):
            words, sums = v.join(parts), None
            for k in range(4):
                value = build.and_(build.lshr(words, v.constant(WORD, 8 * k)), v.constant(WORD, 255))
                sums = v.multiply_add(build.sitofp(value, v.kind(REAL)), by_column[k], sums)
            total = v.multiply_add(sums, weight, total)
        level = v.call("maxnum", v.call("rint", total), v.constant(REAL, 0.0))
        level = v.call("minnum", level, v.constant(REAL, 255.0))
        v.store(build.trunc(build.fptosi(level, v.kind(WORD)), v.kind(BYTE)), out, at)
        return context.get_dummy_value()

    return types.void(grey, stride, places, row, out, at), generate


@kernel
def resample_kernel(
    extended: ByteArray, coarse: Float32Array, step: int, cells: IntArray, image: ByteArray, valid: Mask
) -> None:
    """As `velfield.registration.warp.resample_cells`."""
    height, stride = np.int32(extended.shape[0] - 2 * PAD_PX), np.int32(extended.shape[1])
    side, one, two = np.uint64(CELL_PX), np.uint64(1), np.uint64(2)  # unsigned: numba checks no index for its sign
    across, runs = np.empty(CELL_PX, np.float32), np.empty(CELL_PX, np.uint64)
    for j in range(CELL_PX):
        below = (j + 0.5) / step + 0.5
        across[j], runs[j] = below - int(below), np.uint64(below)
    grey, flat, flat_valid, flat_coarse = extended.reshape(-1), image.reshape(-1), valid.reshape(-1), coarse.reshape(-1)
    width, coarse_width = np.uint64(image.shape[1]), np.uint64(coarse.shape[1])
    last = np.uint64(coarse.shape[0] * coarse.shape[1] - 1)  # past it only for pixels that no cell has
    node_rows = np.uint64(CELL_PX // step + 2)
    nodes = np.empty(np.uint64(4) * node_rows * side, np.float32)
    places = np.empty(3 * CELL_PX * CELL_PX, np.int32)
    levels, inside = np.empty(CELL_PX, np.uint8), np.empty(CELL_PX, np.bool_)
    for n in range(len(cells)):
        top, left = cells[n, 0] * CELL_PX, cells[n, 1] * CELL_PX
        corner, at_node = np.uint64(top // step) * coarse_width + np.uint64(left // step), np.uint64(0)
        for _ in range(node_rows):
            for q in range(side):
                before = min(corner + runs[q], last)
                after, here = min(before + one, last), at_node + q
                nodes[here] = flat_coarse[two * before]
                nodes[here + side] = flat_coarse[two * after]
                nodes[here + two * side] = flat_coarse[two * before + one]
                nodes[here + two * side + side] = flat_coarse[two * after + one]
            corner += coarse_width
            at_node += two * two * side
        rows, columns = np.uint64(min(CELL_PX, image.shape[0] - top)), np.uint64(min(CELL_PX, image.shape[1] - left))
        place = np.uint64(top) * width + np.uint64(left)
        if columns == side:
            for i in range(rows):
                at = place + i * width
                _place_row(height, stride, nodes, runs[i], across, across[i], places, i, flat_valid, at)
            # A loop of its own: what was just stored as a vector cannot be loaded word by word at once.
            for i in range(rows):
                _interpolate_row(grey, stride, places, i, flat, place + i * width)
        else:
            for i in range(rows):
                _place_row(height, stride, nodes, runs[i], across, across[i], places, i, inside, np.uint64(0))
                _interpolate_row(grey, stride, places, i, levels, np.uint64(0))
                for q in range(columns):
                    flat[place + i * width + q] = levels[q]
                    flat_valid[place + i * width + q] = inside[q]
