"""Where vehicles turn back, from their passages."""

import math

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from velfield.field.segments import Segments

U_TURN_COLUMNS = ["passage_id", "time_s", "x_px", "y_px", "turn_rad", "path_px"]


def u_turns(
    segments: Segments,
    *,
    stationary_speed_px_per_s: float,
    max_path_px: float,
    min_turn_rad: float = math.radians(150),
) -> pd.DataFrame:
    """Passages that turn back within a short path; a traffic circle or a loop ramp takes longer.

    Parameters
    ----------
    segments
        Segment table, sorted by passage and time.
    stationary_speed_px_per_s
        Slower segments have no direction.
    max_path_px
        Longest path of a U-turn, px: some 40 m.
    min_turn_rad
        Least change of direction.

    Returns
    -------
    DataFrame
        `U_TURN_COLUMNS`: a row a passage, the place in the middle of its sharpest turn; ``turn_rad`` is positive from
        +x towards +y, that is to the right on a picture seen from above.
    """
    moving = segments[np.hypot(segments["vx_px_per_s"], segments["vy_px_per_s"]) > stationary_speed_px_per_s]
    if not len(moving):
        return pd.DataFrame(columns=U_TURN_COLUMNS)
    borders = np.flatnonzero(np.diff(moving["track"])) + 1
    rows = [_sharpest_turn(part, max_path_px) for part in np.split(moving, borders) if len(part) >= 3]
    table = pd.DataFrame(rows, columns=U_TURN_COLUMNS)
    return table[table["turn_rad"].abs() >= min_turn_rad].reset_index(drop=True)


def _sharpest_turn(passage: Segments, max_path_px: float) -> tuple[int, float, float, float, float, float]:
    """The largest change of direction between two segments of a passage no more than ``max_path_px`` apart."""
    direction = np.unwrap(np.arctan2(passage["vy_px_per_s"], passage["vx_px_per_s"]))
    x = (passage["x0_px"] + passage["x1_px"]) / 2
    y = (passage["y0_px"] + passage["y1_px"]) / 2
    path = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    apart: NDArray[np.float64] = path[None, :] - path[:, None]
    turn = np.where((apart >= 0) & (apart <= max_path_px), direction[None, :] - direction[:, None], 0.0)
    i, j = np.unravel_index(int(np.abs(turn).argmax()), turn.shape)
    middle = int(np.argmin(np.abs(direction - (direction[i] + direction[j]) / 2)[i : j + 1])) + int(i)
    return (
        int(passage["track"][0]),
        float(passage["start_s"][middle]),
        float(x[middle]),
        float(y[middle]),
        float(turn[i, j]),
        float(path[j] - path[i]),
    )
