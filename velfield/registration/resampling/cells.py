"""Cells of an image filled from a raw frame by cubic interpolation: map, interpolation and placement in one kernel.

The result is that of OpenCV's remap, to the bit on processors with fused multiplication and addition: positions rounded
to 1/32 px, the same weights, the same order of sums. OpenCV takes 8 ns a pixel, and 4 more to make the map and to place
the pixels; here it is 1.6 ns in all, for a row of a cell, 16 px, is one vector throughout.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

CELL_PX = 16
"""Side of a cell, output px."""
_FRACTION_BITS = 5
"""Of positions: 1/32 px, to which OpenCV's remap rounds them as well."""
_MARGIN_PX = 1024
"""About the frame: what lies farther outside is taken as if it were that far."""
PAD_PX = 3
"""Of the source: pixels farther outside are those of its border."""
_SHARPNESS = -0.75
"""Of cubic interpolation, as in OpenCV."""

_BYTE, _WORD, _REAL, _INDEX = ir.IntType(8), ir.IntType(32), ir.FloatType(), ir.IntType(64)
_BYTES, _WORDS, _REALS = (ir.VectorType(element, CELL_PX) for element in (_BYTE, _WORD, _REAL))


@dataclass(frozen=True)
class _Vectors:
    """Instructions on vectors of `CELL_PX` numbers, put where a builder stands."""

    context: Any
    build: Any

    def start(self, kind: Any, array: Any) -> Any:
        """Pointer to the first element of an array of a numba type."""
        return cgutils.create_struct_proxy(kind)(self.context, self.build, array).data

    def pointer(self, start: Any, index: Any, element: Any) -> Any:
        return self.build.bitcast(self.build.gep(start, [index]), element.as_pointer())

    def load(self, start: Any, index: Any, element: Any) -> Any:
        loaded = self.build.load(self.pointer(start, index, element))
        loaded.align = 1
        return loaded

    def store(self, value: Any, start: Any, index: Any) -> None:
        self.build.store(value, self.pointer(start, index, value.type)).align = 1

    def call(self, name: str, *values: Any) -> Any:
        kind = values[0].type
        declared = ir.FunctionType(kind, [kind] * len(values))
        full = f"llvm.{name}.v{kind.count}{'f' if kind.element == _REAL else 'i'}32"
        return self.build.call(cgutils.get_or_insert_function(self.build.module, declared, full), values)

    def real(self, value: float) -> Any:
        return ir.Constant(_REALS, [value] * CELL_PX)

    def word(self, value: int) -> Any:
        return ir.Constant(_WORDS, [value] * CELL_PX)

    def splat(self, value: Any) -> Any:
        """A vector all of whose elements are one number."""
        empty = ir.Constant(ir.VectorType(value.type, CELL_PX), ir.Undefined)
        return self.build.shuffle_vector(self.build.insert_element(empty, value, _WORD(0)), empty, self.word(0))

    def join(self, parts: Sequence[Any]) -> Any:
        """One vector of a power of two of short ones."""
        while len(parts) > 1:
            size = 2 * parts[0].type.count
            order = ir.Constant(ir.VectorType(_WORD, size), list(range(size)))
            pairs = zip(parts[::2], parts[1::2], strict=True)
            parts = [self.build.shuffle_vector(one, other, order) for one, other in pairs]
        return parts[0]

    def multiply_add(self, one: Any, other: Any, total: Any) -> Any:
        return self.build.fmul(one, other) if total is None else self.call("fmuladd", one, other, total)

    def cubic_weights(self, fine: Any) -> list[Any]:
        """Weights of four pixels in a row, from the second of which positions lie 0, 1/32, 2/32... px.

        All products and sums here are exact: they have at most 18 bits.
        """
        build, a = self.build, _SHARPNESS
        fraction = build.and_(fine, self.word((1 << _FRACTION_BITS) - 1))
        x = build.fmul(build.sitofp(fraction, _REALS), self.real(1 / (1 << _FRACTION_BITS)))
        rest = build.fsub(self.real(1.0), x)

        def outer(near: Any, far: Any) -> Any:  # a near far^2
            return build.fmul(build.fmul(build.fmul(self.real(a), near), far), far)

        def inner(distance: Any) -> Any:  # (a + 2) d^3 - (a + 3) d^2 + 1
            slope = self.multiply_add(self.real(a + 2), distance, self.real(-(a + 3)))
            return self.multiply_add(build.fmul(slope, distance), distance, self.real(1.0))

        return [outer(x, rest), inner(x), inner(rest), outer(rest, x)]


def _generator(fill: Callable[[_Vectors, Any, Any], None]) -> Any:
    """What numba asks of an intrinsic that returns nothing."""

    def generate(context: Any, build: Any, signature: Any, arguments: Any) -> Any:
        fill(_Vectors(context, build), signature.args, arguments)
        return context.get_dummy_value()

    return generate


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
    signature = types.void(height, stride, nodes, above, across, down, places, row, inside, at)

    def fill(vectors: _Vectors, kinds: Any, arguments: Any) -> None:
        build, unit = vectors.build, float(1 << _FRACTION_BITS)
        frame_height, source_stride, _, first_row, _, fraction, _, number, _, flags_at = arguments
        node, part, target, flags = (vectors.start(kinds[k], arguments[k]) for k in (2, 4, 6, 8))
        along_y, along_x = vectors.splat(fraction), vectors.load(part, _INDEX(0), _REALS)
        row_at = build.mul(first_row, _INDEX(4 * CELL_PX))

        def at_centre(k: int) -> Any:
            upper = vectors.load(node, build.add(row_at, _INDEX(k * CELL_PX)), _REALS)
            lower = vectors.load(node, build.add(row_at, _INDEX((4 + k) * CELL_PX)), _REALS)
            value = build.fadd(upper, build.fmul(along_y, build.fsub(lower, upper)))
            return build.fmul(build.fadd(value, vectors.real(_MARGIN_PX)), vectors.real(unit))

        width = build.sub(source_stride, _WORD(2 * PAD_PX))
        in_frame, fine, first = None, [], []
        for k, size in ((0, width), (2, frame_height)):
            before, after = at_centre(k), at_centre(k + 1)
            position = build.fadd(before, build.fmul(along_x, build.fsub(after, before)))
            length = vectors.splat(build.fmul(build.sitofp(size, _REAL), _REAL(unit)))
            start = vectors.real((_MARGIN_PX - 0.5) * unit)
            for test in (
                build.fcmp_ordered(">=", position, start),
                build.fcmp_ordered("<=", position, build.fadd(start, length)),
            ):
                in_frame = test if in_frame is None else build.and_(in_frame, test)
            last = build.fadd(length, vectors.real(2 * _MARGIN_PX * unit))
            rounded = build.fadd(position, vectors.real(0.5))
            rounded = build.select(build.fcmp_ordered(">", rounded, vectors.real(0.0)), rounded, vectors.real(0.0))
            rounded = build.select(build.fcmp_ordered("<", rounded, last), rounded, last)
            fine.append(build.fptosi(rounded, _WORDS))
            # Of the first of four pixels, in the extended source: beyond its ends all four are the border's.
            whole = build.ashr(fine[-1], vectors.word(_FRACTION_BITS))
            whole = build.add(whole, vectors.word(PAD_PX - _MARGIN_PX - 1))
            most = vectors.splat(build.add(size, _WORD(2)))
            first.append(vectors.call("smin", vectors.call("smax", whole, vectors.word(0)), most))
        index = build.add(build.mul(first[1], vectors.splat(source_stride)), first[0])
        for k, value in enumerate((index, *fine)):
            vectors.store(value, target, build.add(build.mul(number, _INDEX(3 * CELL_PX)), _INDEX(k * CELL_PX)))
        vectors.store(build.zext(in_frame, _BYTES), flags, flags_at)

    return signature, _generator(fill)


@intrinsic
def _interpolate_row(_context, grey, stride, places, row, out, at):  # type: ignore[no-untyped-def]
    """Interpolate at a row of ``places`` in the extended source ``grey``, and store 16 grey levels from ``out[at]`` on.

    Four pixels in a row are loaded as one word.
    """
    signature = types.void(grey, stride, places, row, out, at)

    def fill(vectors: _Vectors, kinds: Any, arguments: Any) -> None:
        build = vectors.build
        _, source_stride, _, number, _, out_at = arguments
        pixels, place, target = (vectors.start(kinds[k], arguments[k]) for k in (0, 2, 4))
        index_at = build.mul(number, _INDEX(3 * CELL_PX))
        by_column, by_row = (
            vectors.cubic_weights(vectors.load(place, build.add(index_at, _INDEX(k * CELL_PX)), _WORDS)) for k in (1, 2)
        )
        tops = [pixels]
        for _ in range(3):
            tops.append(build.gep(tops[-1], [build.zext(source_stride, _INDEX)]))
        four: list[list[Any]] = [[] for _ in tops]
        for q in range(CELL_PX):  # pixel by pixel, so that few vectors are open at a time
            index = build.zext(build.load(build.gep(place, [build.add(index_at, _INDEX(q))])), _INDEX)
            for top, parts in zip(tops, four, strict=True):
                if q % 4 == 0:
                    parts.append(ir.Constant(ir.VectorType(_WORD, 4), ir.Undefined))
                parts[-1] = build.insert_element(parts[-1], vectors.load(top, index, _WORD), _WORD(q % 4))
        total = None
        for parts, weight in zip(four, by_row, strict=True):
            words, sums = vectors.join(parts), None
            for k in range(4):
                value = build.and_(build.lshr(words, vectors.word(8 * k)), vectors.word(255))
                sums = vectors.multiply_add(build.sitofp(value, _REALS), by_column[k], sums)
            total = vectors.multiply_add(sums, weight, total)
        level = vectors.call("maxnum", vectors.call("rint", total), vectors.real(0.0))
        level = vectors.call("minnum", level, vectors.real(255.0))
        vectors.store(build.trunc(build.fptosi(level, _WORDS), _BYTES), target, out_at)

    return signature, _generator(fill)


@njit(cache=True, nogil=True)
def resample_kernel(extended, coarse, step, cells, image, valid):  # type: ignore[no-untyped-def]
    """As `velfield.registration.warp.resample_cells`."""
    height, stride = np.int32(extended.shape[0] - 2 * PAD_PX), np.int32(extended.shape[1])
    side, one, two = np.uint64(CELL_PX), np.uint64(1), np.uint64(2)  # unsigned: numba checks no index for its sign
    across, runs = np.empty(CELL_PX, np.float32), np.empty(CELL_PX, np.uint64)
    for j in range(CELL_PX):
        at = (j + 0.5) / step + 0.5
        across[j], runs[j] = at - int(at), np.uint64(at)
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
