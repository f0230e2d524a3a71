"""Cells of an image filled from a raw frame by cubic interpolation: map, interpolation and placement in one kernel.

The result is that of OpenCV's remap, to the bit on processors with fused multiplication and addition: positions rounded
to 1/32 px, the same weights, the same order of sums. OpenCV takes 8 ns a pixel, and 4 more to make the map and to place
the pixels; here it is 5 ns in all, for the products of four pixels are four vectors.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

CELL_PX = 16
"""Side of a cell, output px."""
FRACTION_BITS = 5
"""Of positions: 1/32 px, to which OpenCV's remap rounds them as well."""
_MARGIN_PX = 1024
"""About the frame: what lies farther outside is taken as if it were that far."""
PAD_PX = 3
"""Of the source: pixels farther outside are those of its border."""


@intrinsic
def _interpolate_four(  # type: ignore[no-untyped-def]
    _context, grey, firsts, across, down, at, stride, weights, out, place
):
    """Interpolate at four positions, from number ``at`` on, and store the four grey levels from ``out[place]`` on.

    Of each position ``firsts`` holds the flat index of the first of its 4 x 4 pixels, ``across`` and ``down`` where the
    weights of its columns and rows begin. A vector holds the pixels of one column, four positions by four rows: numba
    alone makes no vectors of it.
    """
    signature = types.void(grey, firsts, across, down, at, stride, weights, out, place)
    byte, word, real = ir.IntType(8), ir.IntType(32), ir.FloatType()

    def generate(context: Any, build: Any, _signature: Any, arguments: Any) -> Any:
        pixels, first, columns, rows, factors, target = (
            cgutils.create_struct_proxy(kind)(context, build, arguments[k]).data
            for kind, k in ((grey, 0), (firsts, 1), (across, 2), (down, 3), (weights, 6), (out, 7))
        )

        def pointer(start: Any, index: Any, element: Any) -> Any:
            return build.bitcast(build.gep(start, [index]), element.as_pointer())

        def load(start: Any, index: Any, element: Any) -> Any:
            loaded = build.load(pointer(start, index, element))
            loaded.align = 1
            return loaded

        def call(name: str, *values: Any) -> Any:
            kind = values[0].type
            declared = ir.FunctionType(kind, [kind] * len(values))
            full = f"llvm.{name}.v{kind.count}f32"
            return build.call(cgutils.get_or_insert_function(build.module, declared, full), values)

        def take(vector: Any, lane: int) -> Any:
            order = [4 * (k // 4) + lane for k in range(16)]
            return build.shuffle_vector(vector, vector, ir.Constant(ir.VectorType(word, 16), order))

        def multiply_add(one: Any, other: Any, total: Any) -> Any:
            return build.fmul(one, other) if total is None else call("fmuladd", one, other, total)

        def join(parts: list[Any]) -> Any:
            while len(parts) > 1:
                size = 2 * parts[0].type.count
                order = ir.Constant(ir.VectorType(word, size), list(range(size)))
                pairs = zip(parts[::2], parts[1::2], strict=True)
                parts = [build.shuffle_vector(one, other, order) for one, other in pairs]
            return parts[0]

        def number_at(start: Any, index: Any) -> Any:
            return build.zext(build.load(build.gep(start, [index])), index.type)

        four = ir.VectorType(real, 4)
        words = ir.Constant(ir.VectorType(word, 16), ir.Undefined)
        width = build.zext(arguments[5], arguments[4].type)
        of_columns, of_rows = [], []
        for k in range(4):
            number = build.add(arguments[4], ir.IntType(64)(k))
            index = number_at(first, number)
            for row in range(4):
                words = build.insert_element(words, load(pixels, index, word), word(4 * k + row))
                index = build.add(index, width)
            of_columns.append(load(factors, number_at(columns, number), four))
            of_rows.append(load(factors, number_at(rows, number), four))
        by_column, by_row = join(of_columns), join(of_rows)
        sums = total = None
        for k in range(4):
            shift, low = (ir.Constant(words.type, [value] * 16) for value in (8 * k, 255))
            values = build.uitofp(build.and_(build.lshr(words, shift), low), ir.VectorType(real, 16))
            sums = multiply_add(values, take(by_column, k), sums)
        for k in range(4):
            total = multiply_add(take(sums, k), take(by_row, k), total)
        firsts_of_four = ir.Constant(ir.VectorType(word, 4), [0, 4, 8, 12])
        level = call("rint", build.shuffle_vector(total, total, firsts_of_four))
        black, white = (ir.Constant(four, [value] * 4) for value in (0.0, 255.0))
        level = call("minnum", call("maxnum", level, black), white)
        levels = build.trunc(build.fptosi(level, ir.VectorType(word, 4)), ir.VectorType(byte, 4))
        build.store(levels, pointer(target, arguments[8], levels.type)).align = 1
        return context.get_dummy_value()

    return signature, generate


@njit(cache=True, nogil=True)
def resample_kernel(extended, coarse, step, cells, weights, image, valid):  # type: ignore[no-untyped-def]
    """As `velfield.registration.warp.resample_cells`, with the weights of the cubic by fraction of a pixel.

    Positions are in units of the fraction, from a margin of so many pixels: all positive, so that truncation rounds
    down.
    """
    height, width = extended.shape[0] - 2 * PAD_PX, extended.shape[1] - 2 * PAD_PX
    unit, mask = np.float32(1 << FRACTION_BITS), np.int32((1 << FRACTION_BITS) - 1)
    margin, half, zero = np.float32(_MARGIN_PX), np.float32(0.5), np.float32(0)
    last_x, last_y = np.float32(width + 2 * _MARGIN_PX) * unit, np.float32(height + 2 * _MARGIN_PX) * unit
    start = (margin - half) * unit
    end_x, end_y = start + np.float32(width) * unit, start + np.float32(height) * unit
    # Of the first of four pixels, in the extended source: beyond, all four are the border's.
    shift, most_x, most_y = np.int32(PAD_PX - _MARGIN_PX - 1), np.int32(width + 2), np.int32(height + 2)
    nodes = CELL_PX // step + 2
    across, runs = np.empty(CELL_PX, np.float32), np.empty(CELL_PX, np.int64)
    run_ends = np.empty(nodes - 1, np.uint64)  # runs of pixels between the same two centres: alike in all cells
    for j in range(CELL_PX):
        at = (j + 0.5) / step + 0.5
        across[j], runs[j] = at - int(at), int(at)
        run_ends[int(at)] = j + 1
    x, y = np.empty(nodes, np.float32), np.empty(nodes, np.float32)
    inside, levels = np.empty(CELL_PX, np.bool_), np.empty(CELL_PX, np.uint8)
    fine_x, fine_y = np.empty(CELL_PX, np.int32), np.empty(CELL_PX, np.int32)
    first, wx, wy = np.empty(CELL_PX, np.int32), np.empty(CELL_PX, np.int32), np.empty(CELL_PX, np.int32)
    grey, flat, flat_valid = extended.reshape(-1), image.reshape(-1), valid.reshape(-1)
    stride, side, four = np.int32(extended.shape[1]), np.uint64(CELL_PX), np.uint64(4)
    for n in range(len(cells)):
        top, left = cells[n, 0] * CELL_PX, cells[n, 1] * CELL_PX
        k0, m0 = top // step, left // step
        columns = np.uint64(min(CELL_PX, image.shape[1] - left))
        for i in range(min(CELL_PX, image.shape[0] - top)):
            down, k = across[i], k0 + runs[i]
            for m in range(nodes):
                near = min(m0 + m, coarse.shape[1] - 1)
                above_x, above_y = coarse[k, near, 0], coarse[k, near, 1]
                x[m] = (above_x + down * (coarse[k + 1, near, 0] - above_x) + margin) * unit
                y[m] = (above_y + down * (coarse[k + 1, near, 1] - above_y) + margin) * unit
            begin = np.uint64(0)
            for m in range(nodes - 1):
                x0, y0 = x[m], y[m]
                dx, dy = x[m + 1] - x0, y[m + 1] - y0
                for q in range(begin, run_ends[m]):
                    px, py = x0 + across[q] * dx, y0 + across[q] * dy
                    inside[q] = (px >= start) & (px <= end_x) & (py >= start) & (py <= end_y)
                    fine_x[q] = np.int32(min(max(px + half, zero), last_x))
                    fine_y[q] = np.int32(min(max(py + half, zero), last_y))
                begin = run_ends[m]
            for q in range(side):
                u = min(max(np.int32((fine_x[q] >> FRACTION_BITS) + shift), np.int32(0)), most_x)
                v = min(max(np.int32((fine_y[q] >> FRACTION_BITS) + shift), np.int32(0)), most_y)
                first[q] = np.int32(np.int32(v * stride) + u)
                wx[q], wy[q] = np.int32((fine_x[q] & mask) * 4), np.int32((fine_y[q] & mask) * 4)
            place = np.uint64((top + i) * image.shape[1] + left)
            if columns == side:
                for q in range(np.uint64(0), side, four):
                    _interpolate_four(grey, first, wx, wy, q, stride, weights, flat, place + q)
            else:
                for q in range(np.uint64(0), side, four):
                    _interpolate_four(grey, first, wx, wy, q, stride, weights, levels, q)
                for q in range(columns):
                    flat[place + q] = levels[q]
            for q in range(columns):
                flat_valid[place + q] = inside[q]
