"""Scores of a boosted classifier at many offsets of patches whose integral images lie side by side, one a lane."""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 16


@intrinsic
def sum_rectangles(_context, flat, corners, first, last, base, total):  # type: ignore[no-untyped-def]
    """Sum rectangles ``first`` to ``last``, whose corners (n, 4) have the shares +, -, -, +, in each lane.

    numba keeps the sums of the lanes in memory, rectangle by rectangle, and asks each time whether that is the memory
    that it reads; here they stay in a register.
    """
    signature = types.void(flat, corners, first, last, base, total)
    number = ir.IntType(64)

    def generate(context: Any, build: Any, _signature: Any, arguments: Any) -> Any:
        values, places, target = (
            cgutils.create_struct_proxy(kind)(context, build, arguments[k]).data
            for kind, k in ((flat, 0), (corners, 1), (total, 5))
        )
        lanes = ir.VectorType(ir.IntType(32), LANES)
        begin, end = (
            build.sext(arguments[k], number) if kind.bitwidth < 64 else arguments[k]
            for k, kind in ((2, first), (3, last))
        )
        sums = cgutils.alloca_once_value(build, ir.Constant(lanes, [0] * LANES))
        with cgutils.for_range_slice(build, begin, end, ir.Constant(number, 1), number) as (rectangle, _):
            row, found = build.mul(rectangle, ir.Constant(number, 4)), []
            for k in range(4):
                place = build.load(build.gep(places, [build.add(row, ir.Constant(number, k))]))
                start = build.gep(values, [build.add(arguments[4], place)])
                found.append(build.load(build.bitcast(start, lanes.as_pointer())))
                found[-1].align = 4
            positive, negative = build.add(found[0], found[3]), build.add(found[1], found[2])
            build.store(build.add(build.load(sums), build.sub(positive, negative)), sums)
        build.store(build.load(sums), build.bitcast(target, lanes.as_pointer())).align = 4
        return context.get_dummy_value()

    return signature, generate


@njit(cache=True, nogil=True)
def signed_corners(corners, signs):  # type: ignore[no-untyped-def]
    """Corners (n, 4) in the order of their shares +, -, -, +: those of a negative rectangle are swapped."""
    out = corners.copy()
    for r in range(len(corners)):
        if signs[r] < 0:
            out[r, 0], out[r, 1], out[r, 2], out[r, 3] = corners[r, 1], corners[r, 0], corners[r, 3], corners[r, 2]
    return out


@njit(cache=True, nogil=True)
def normalise(flat, window, window_area, plane, base, floor, total, mean, contrast):  # type: ignore[no-untyped-def]
    """Mean grey of the window about a position, and its mean gradient plus ``floor``."""
    scale, first, last = np.float32(1 / window_area), np.int32(0), np.int32(1)
    sum_rectangles(flat, window, first, last, base, total)
    for lane in range(LANES):
        mean[lane] = np.float32(total[lane]) * scale
    sum_rectangles(flat, window, first, last, base + plane, total)
    for lane in range(LANES):
        contrast[lane] = np.float32(total[lane]) * scale + np.float32(floor)
    sum_rectangles(flat, window, first, last, base + plane + plane, total)
    for lane in range(LANES):
        contrast[lane] += np.float32(total[lane]) * scale


@njit(cache=True, nogil=True)
def score_offsets(  # type: ignore[no-untyped-def]
    flat, window, window_area, plane, floor, corners, starts, planes, areas, thresholds, leaves, bases, rounds, out,
):  # fmt: skip
    """Sums of the leaves of the first ``rounds``, (offsets, LANES), at every offset of ``LANES`` patches.

    ``corners`` and ``window`` as of `signed_corners`.
    """
    total = np.zeros(LANES, np.int32)
    mean, contrast = np.zeros(LANES, np.float32), np.zeros(LANES, np.float32)
    for m in range(len(bases)):
        normalise(flat, window, window_area, plane, bases[m], floor, total, mean, contrast)
        for lane in range(LANES):
            out[m, lane] = 0
        for f in range(rounds):
            sum_rectangles(flat, corners, starts[f], starts[f + 1], bases[m] + planes[f], total)
            threshold, area = thresholds[f], areas[f]
            low, high = leaves[f, 0], leaves[f, 1]
            for lane in range(LANES):
                split = threshold * contrast[lane] + area * mean[lane]
                out[m, lane] += high if np.float32(total[lane]) > split else low
