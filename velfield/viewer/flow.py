"""Velocities drawn from the field for the page's animation: ``view/flow.bin``.

Little-endian; n cells of `cell_side` px that vehicles passed, in raster order:

    uint32    cell (n), row * columns + column
    uint8     vehicles (n), the most at a pixel of the cell, 255 or more as 255
    uint16    bin (n, 16), vy * bins + vx

The 16 bins are a systematic sample of the sum of the histograms in the cell: a bin of weight w is among them
floor(16 w) or ceil(16 w) times, so that one of them at random is a draw from the distribution, every mode of it.
"""

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import IntArray, Mask
from schemas.flight import assumed_gsd_m
from velfield.compiled import kernel
from velfield.run.stores import HISTOGRAM, FieldStore

DRAWS = 16
_SIDE_M = 0.8
_MIN_MOVING_FRACTION = 0.1
_MAX_CELLS = 2**22
"""Maximum number of cells of the whole grid, which the page holds in memory."""


def cell_side(shape: tuple[int, int], gsd_m: float | None) -> int:
    """Side of a cell, px: a power of two of 0.8 m or more, a quarter of a lane.

    Examples
    --------
    >>> cell_side((2417, 3051), 0.23), cell_side((1000, 1000), 1.5)
    (4, 1)
    """
    side = 1
    while side * assumed_gsd_m(gsd_m) < _SIDE_M or shape[0] * shape[1] / side**2 > _MAX_CELLS:
        side *= 2
    return side


def flow_bytes(store: FieldStore, *, gsd_m: float | None, stationary_speed_px_per_s: float) -> bytes:
    """The file's content; of pixels that some vehicles drive over: nothing flows over what is parked."""
    side = cell_side(store.shape, gsd_m)
    count = np.where(_flowing(store, stationary_speed_px_per_s), store.layer("count"), 0)
    columns, across = -(-store.shape[1] // side), store.tile // side
    found, histogram = [], None
    for row, column in store.stored_chunks(HISTOGRAM):
        window = np.s_[row * store.tile : (row + 1) * store.tile, column * store.tile : (column + 1) * store.tile]
        if not count[window].any():
            continue
        histogram = store.read_tile(row, column, into=histogram)
        cells, vehicles, bins = _draw_tile(histogram, count[window], side, across)
        down, right = np.divmod(cells, across)
        found.append(((row * across + down) * columns + column * across + right, vehicles, bins))
    if not found:
        return b""
    cells, vehicles, bins = (np.concatenate(parts) for parts in zip(*found, strict=True))
    order = np.argsort(cells)
    return (
        cells[order].astype("<u4").tobytes()
        + vehicles[order].clip(0, 255).astype(np.uint8).tobytes()
        + bins[order].astype("<u2").tobytes()
    )


def _flowing(store: FieldStore, stationary_speed_px_per_s: float) -> Mask:
    """Mask of the pixels where the modal velocity, or more than a tenth of the vehicles, moves."""
    moving = np.hypot(store.layer("modal_vx"), store.layer("modal_vy")) > stationary_speed_px_per_s
    if "stationary_fraction" in store.layer_names():
        moving |= store.layer("stationary_fraction") < 1 - _MIN_MOVING_FRACTION
    return np.asarray(moving)


def _draw_tile(
    histogram: NDArray[np.int32], count: IntArray, side: int, across: int
) -> tuple[IntArray, IntArray, IntArray]:
    """Cells of a tile, row * across + column, the vehicles of each, and its bins (n, DRAWS)."""
    y, x = np.nonzero(count)
    of_pixel = (y // side) * across + x // side
    order = np.argsort(of_pixel, kind="stable")
    cell, first = np.unique(of_pixel[order], return_index=True)
    y, x = y[order], x[order]
    bins = np.empty((len(cell), DRAWS), np.int64)
    _draw_cells(histogram.reshape(*histogram.shape[:2], -1), y, x, np.append(first, len(y)), bins)
    return cell, np.maximum.reduceat(count[y, x], first), bins


@kernel
def _draw_cells(histogram: NDArray[np.int32], y: IntArray, x: IntArray, first: IntArray, bins: IntArray) -> None:
    """Fill ``bins`` (n, DRAWS) with a systematic sample of the sums of the histograms (ty, tx, bins) at the pixels
    ``first[k]`` to ``first[k + 1]`` of each cell: those of a tile at once would be as large as the tile, twice."""
    total = np.empty(histogram.shape[2], np.int64)
    for cell in range(bins.shape[0]):
        total[:] = 0
        for k in range(first[cell], first[cell + 1]):
            pixel = histogram[y[k], x[k]]
            for b in range(total.size):
                total[b] += pixel[b]
        weight, cumulative, drawn = np.int64(0), np.int64(0), 0
        for b in range(total.size):
            weight += total[b]
        bins[cell] = total.size
        for b in range(total.size):
            cumulative += total[b]
            while drawn < DRAWS and float(cumulative) > (drawn + 0.5) / DRAWS * weight:
                bins[cell, drawn] = b
                drawn += 1
