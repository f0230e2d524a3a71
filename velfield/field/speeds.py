"""The distribution of speed at a pixel, from its velocity histogram."""

from math import floor, hypot, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

from schemas.arrays import FloatArray

CELLS_PER_BIN = 8
"""Bins of the speed histogram (cells) a bin of velocity."""


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def max_cells(reach: int) -> int:
    """Number of cells for the speeds of a velocity histogram with ``reach`` bins on either side."""
    return int((floor(1.5 * reach) + 3) * CELLS_PER_BIN)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def kernel_variance(sigma: float) -> float:
    """Variance that the histogram adds to a speed, bins^2: the kernel's, and twice that of a bin's width (once when
    bins are filled, once when they are spread over cells)."""
    return sigma * sigma + 2.0 / 12.0


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def speed_cells(h: NDArray[np.int32], reach: int, cells: FloatArray) -> float:
    """Fill ``cells`` with the histogram of speed, each bin spread uniformly over one bin's width of speed; returns the
    sum."""
    cells[:] = 0.0
    total = 0.0
    half = CELLS_PER_BIN // 2
    for y in range(h.shape[0]):
        for x in range(h.shape[1]):
            if h[y, x] <= 0:
                continue
            weight = float(h[y, x])
            total += weight
            low = hypot(float(y - reach), float(x - reach)) * CELLS_PER_BIN - half
            if low < 0.0:  # the central bin: speeds are not negative
                for c in range(half):
                    cells[c] += weight / half
                continue
            first = floor(low)
            part = low - first
            for c in range(CELLS_PER_BIN):
                cells[first + c] += weight * (1.0 - part) / CELLS_PER_BIN
                cells[first + c + 1] += weight * part / CELLS_PER_BIN
    return total


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def quantile(cells: FloatArray, total: float, probability: float) -> float:
    """Quantile of the speed, bins; linear within a cell."""
    target = min(max(probability, 0.0), 1.0) * total
    below = 0.0
    for c in range(cells.size):
        if below + cells[c] >= target and cells[c] > 0.0:
            return float((c + max(target - below, 0.0) / cells[c]) / CELLS_PER_BIN)
        below += cells[c]
    return cells.size / CELLS_PER_BIN


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def deconvolution_factor(cells: FloatArray, total: float, blur: float) -> float:
    """Standard deviation of the speed without the kernel's variance ``blur`` over that with it: the factor by which
    quantiles move towards the median."""
    mean, square = 0.0, 0.0
    for c in range(cells.size):
        speed = (c + 0.5) / CELLS_PER_BIN
        mean += cells[c] * speed
        square += cells[c] * speed * speed
    variance = square / total - (mean / total) ** 2
    return sqrt(max(variance - blur, 0.0) / variance)
