"""Scores of a boosted classifier at many offsets of patches whose integral images lie side by side, one a lane."""

import numpy as np
from numpy.typing import NDArray

from velfield.compiled import kernel

LANES = 16


@kernel
def sum_rectangles(flat, corners, first, last, base, total) -> None:  # type: ignore[no-untyped-def]
    """Sum rectangles ``first`` to ``last``, whose corners (n, 4) have the shares +, -, -, +, in each lane."""
    total[:] = 0
    for r in range(first, last):
        a, b, c, d = corners[r, 0] + base, corners[r, 1] + base, corners[r, 2] + base, corners[r, 3] + base
        for lane in range(np.uint64(LANES)):
            total[lane] += flat[a + lane] - flat[b + lane] - flat[c + lane] + flat[d + lane]


@kernel
def signed_corners(corners: NDArray[np.uint64], signs: NDArray[np.int32]) -> NDArray[np.uint64]:
    """Corners (n, 4) in the order of their shares +, -, -, +: those of a negative rectangle are swapped."""
    out = corners.copy()
    for r in range(len(corners)):
        if signs[r] < 0:
            out[r, 0], out[r, 1], out[r, 2], out[r, 3] = corners[r, 1], corners[r, 0], corners[r, 3], corners[r, 2]
    return out


@kernel
def normalise(flat, window, window_area, plane, base, floor, total, mean, contrast) -> None:  # type: ignore[no-untyped-def]
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


@kernel
def score_offsets(  # type: ignore[no-untyped-def]
    flat, window, window_area, plane, floor, corners, starts, planes, areas, thresholds, leaves, bases, rounds, out,
) -> None:  # fmt: skip
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
