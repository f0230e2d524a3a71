"""U-turns: tracks whose direction reverses within a short path."""

import math

import numpy as np
import pandas as pd

from schemas.arrays import FloatArray
from velfield.field.segments import Segments

U_TURN_COLUMNS = ["track_id", "time_s", "x_px", "y_px", "turn_rad", "path_px"]


def find_u_turns(
    segments: Segments,
    *,
    stationary_speed_px_per_s: float,
    max_path_px: float,
    min_turn_rad: float = math.radians(150),
) -> pd.DataFrame:
    """Tracks that reverse within a short path; a roundabout or a loop ramp is longer.

    Parameters
    ----------
    segments
        Segment table, sorted by track and time.
    stationary_speed_px_per_s
        Slower segments have no direction.
    max_path_px
        Longest path of a U-turn, px.
    min_turn_rad
        Smallest change of direction.

    Returns
    -------
    DataFrame
        `U_TURN_COLUMNS`: one row a track, at the middle of its largest change of direction within ``max_path_px``;
        ``turn_rad`` is positive from +x towards +y, i.e. to the right, ``path_px`` the path over which it turns.
    """
    moving = segments[np.hypot(segments["vx_px_per_s"], segments["vy_px_per_s"]) > stationary_speed_px_per_s]
    if not len(moving):
        return pd.DataFrame(columns=U_TURN_COLUMNS)
    borders = np.flatnonzero(np.diff(moving["track"])) + 1
    rows = [_largest_turn(part, max_path_px) for part in np.split(moving, borders) if len(part) >= 3]
    table = pd.DataFrame(rows, columns=U_TURN_COLUMNS)
    return table[table["turn_rad"].abs() >= min_turn_rad].reset_index(drop=True)


def _largest_turn(track: Segments, max_path_px: float) -> tuple[int, float, float, float, float, float]:
    """The largest change of direction between two segments of a track no more than ``max_path_px`` apart."""
    direction = np.unwrap(np.arctan2(track["vy_px_per_s"], track["vx_px_per_s"]))
    x = (track["x0_px"] + track["x1_px"]) / 2
    y = (track["y0_px"] + track["y1_px"]) / 2
    path = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    distance: FloatArray = path[None, :] - path[:, None]
    turn = np.where((distance >= 0) & (distance <= max_path_px), direction[None, :] - direction[:, None], 0.0)
    i, j = np.unravel_index(int(np.abs(turn).argmax()), turn.shape)
    middle = int(np.argmin(np.abs(direction - (direction[i] + direction[j]) / 2)[i : j + 1])) + int(i)
    return (
        int(track["track"][0]),
        float(track["start_s"][middle]),
        float(x[middle]),
        float(y[middle]),
        float(turn[i, j]),
        float(path[j] - path[i]),
    )
