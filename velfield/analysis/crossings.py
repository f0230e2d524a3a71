"""Who crosses a line drawn across a road, which way and how fast: a loop detector laid on the map."""

from collections.abc import Iterator

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from schemas.flight import PAPER_GSD_M
from velfield.field.segments import Segments

CROSSING_COLUMNS = ["passage", "time_s", "x_px", "y_px", "vx_px_per_s", "vy_px_per_s", "speed_px_per_s", "direction"]
_SETTLE_M = 2.0


def settle_px(gsd_m: float | None) -> float:
    """How far beyond a line a vehicle must get to have crossed it, px: half a car; jitter stays below."""
    return _SETTLE_M / (gsd_m or PAPER_GSD_M)


def line_crossings(
    segments: Segments, start_xy: tuple[float, float], end_xy: tuple[float, float], *, settle_px: float
) -> pd.DataFrame:
    """Crossings of the line from ``start_xy`` to ``end_xy``.

    Parameters
    ----------
    segments
        Segment table, sorted by passage and time.
    start_xy, end_xy
        Ends of the line, base px.
    settle_px
        A vehicle that comes back over the line before it got so far from it has not crossed it, neither time: who
        stands on the line jitters.

    Returns
    -------
    DataFrame
        `CROSSING_COLUMNS`, by passage and time; ``direction`` is +1 for who goes from the left of the line to its
        right, looking from its start to its end as the picture is seen, else -1.
    """
    before, place = _beside(segments["x0_px"], segments["y0_px"], start_xy, end_xy)
    after, place_after = _beside(segments["x1_px"], segments["y1_px"], start_xy, end_xy)
    crosses = (before >= 0) != (after >= 0)
    share = np.divide(before, before - after, out=np.zeros(len(segments)), where=crosses)
    place = place + share * (place_after - place)
    rows = np.flatnonzero(crosses & (place >= 0) & (place <= 1))
    kept = np.array(list(_settled(segments["track"], after, rows, settle_px)), np.int64)
    found, part = segments[kept], share[kept]
    return pd.DataFrame(
        {
            "passage": found["track"],
            "time_s": found["start_s"] + part * found["duration_s"],
            "x_px": found["x0_px"] + part * (found["x1_px"] - found["x0_px"]),
            "y_px": found["y0_px"] + part * (found["y1_px"] - found["y0_px"]),
            "vx_px_per_s": found["vx_px_per_s"],
            "vy_px_per_s": found["vy_px_per_s"],
            "speed_px_per_s": np.hypot(found["vx_px_per_s"], found["vy_px_per_s"]),
            "direction": np.where(after[kept] >= 0, 1, -1),
        },
        columns=CROSSING_COLUMNS,
    )


def _beside(
    x: FloatArray, y: FloatArray, start: tuple[float, float], end: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """Distance of points to the right of the line, px, and their place along it, 0 at its start and 1 at its end."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    length = max(float(np.hypot(dx, dy)), 1e-9)
    right = (dx * (y - start[1]) - dy * (x - start[0])) / length
    along = (dx * (x - start[0]) + dy * (y - start[1])) / length**2
    return right, along


def _settled(passage: NDArray[np.int64], after: FloatArray, rows: NDArray[np.int64], settle_px: float) -> Iterator[int]:
    """Rows that cross, without the pairs of a vehicle that went over the line and back within ``settle_px``."""
    stack: list[int] = []
    for row in rows:
        if stack and passage[stack[-1]] != passage[row]:
            yield from stack
            stack = []
        if stack and (after[stack[-1]] >= 0) != (after[row] >= 0) and _excursion(after, stack[-1], row) < settle_px:
            stack.pop()
        else:
            stack.append(int(row))
    yield from stack


def _excursion(after: FloatArray, out: int, back: int) -> float:
    """Farthest from the line between crossing out and back, px."""
    return float(np.abs(after[out:back]).max())
