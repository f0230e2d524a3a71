"""Crossings of a line by vehicles: a virtual loop detector on the map."""

from collections.abc import Iterator

import numpy as np
import pandas as pd

from schemas.arrays import FloatArray, IntArray
from schemas.flight import assumed_gsd_m
from velfield.field.segments import Segments

CROSSING_COLUMNS = ["track_id", "time_s", "x_px", "y_px", "vx_px_per_s", "vy_px_per_s", "speed_px_per_s", "direction"]
_HYSTERESIS_M = 2.0


def hysteresis_px(gsd_m: float | None) -> float:
    """Distance beyond a line at which a vehicle has crossed it, px: half a car, more than jitter."""
    return _HYSTERESIS_M / assumed_gsd_m(gsd_m)


def find_crossings(
    segments: Segments, start_xy: tuple[float, float], end_xy: tuple[float, float], *, hysteresis_px: float
) -> pd.DataFrame:
    """Crossings of the line from ``start_xy`` to ``end_xy``.

    Parameters
    ----------
    segments
        Segment table, sorted by track and time.
    start_xy, end_xy
        Ends of the line, base px.
    hysteresis_px
        A vehicle that crosses back before it is this far from the line has crossed it neither time: a stationary
        vehicle on the line jitters.

    Returns
    -------
    DataFrame
        `CROSSING_COLUMNS`, by track and time; ``direction`` is +1 from the left of the line to its right, as the image
        is seen and looking from its start to its end, otherwise -1.
    """
    before, along = _line_coordinates(segments["x0_px"], segments["y0_px"], start_xy, end_xy)
    after, along_after = _line_coordinates(segments["x1_px"], segments["y1_px"], start_xy, end_xy)
    crosses = (before >= 0) != (after >= 0)
    fraction = np.divide(before, before - after, out=np.zeros(len(segments)), where=crosses)
    along = along + fraction * (along_after - along)
    rows = np.flatnonzero(crosses & (along >= 0) & (along <= 1))
    kept = np.array(list(_with_hysteresis(segments["track"], after, rows, hysteresis_px)), np.int64)
    found, part = segments[kept], fraction[kept]
    return pd.DataFrame(
        {
            "track_id": found["track"],
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


def _line_coordinates(
    x: FloatArray, y: FloatArray, start: tuple[float, float], end: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """Signed distance of points from the line, positive to its right, px, and their position along it, 0 at its start
    and 1 at its end."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    length = max(float(np.hypot(dx, dy)), 1e-9)
    right = (dx * (y - start[1]) - dy * (x - start[0])) / length
    along = (dx * (x - start[0]) + dy * (y - start[1])) / length**2
    return right, along


def _with_hysteresis(track: IntArray, after: FloatArray, rows: IntArray, hysteresis_px: float) -> Iterator[int]:
    """Rows that cross, without the pairs in which a vehicle crosses and crosses back within ``hysteresis_px``."""
    stack: list[int] = []
    for row in rows:
        if stack and track[stack[-1]] != track[row]:
            yield from stack
            stack = []
        back = bool(stack) and (after[stack[-1]] >= 0) != (after[row] >= 0)
        if back and np.abs(after[stack[-1] : row]).max() < hysteresis_px:  # largest distance from the line between
            stack.pop()
        else:
            stack.append(int(row))
    yield from stack
