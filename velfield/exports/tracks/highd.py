"""Trajectories as a CSV with the columns of the highD data set's ``tracks.csv``, for programs that read that.

As in highD x points right and y down, in metres, and (x, y) is the upper left corner of the vehicle's upright box, of
``width`` along x and ``height`` along y. The box is the vehicle in the direction of travel, that of a usual car where
its dimensions were not measured.
"""

from pathlib import Path

import numpy as np
import pandas as pd

from schemas.export import ExportOptions
from velfield.exports.tracks.table import trajectory_table
from velfield.run.run import Run

FILE_NAME = "tracks-highd.csv"
_LENGTH_M, _WIDTH_M = 4.5, 1.8


def encode(run: Run, _path: Path, _options: ExportOptions) -> bytes:
    """See `velfield.exports.export.ExportModule`."""
    return highd_csv(trajectory_table(run, whole=True)).encode()


def highd_csv(table: pd.DataFrame) -> str:
    """The table of `trajectory_table` in highD's columns, and the time, s, as the last one."""
    angle = np.arctan2(table["vy_m_per_s"], table["vx_m_per_s"])
    c, s = np.abs(np.cos(angle)), np.abs(np.sin(angle))
    along, across = table["length_m"].fillna(_LENGTH_M), table["width_m"].fillna(_WIDTH_M)
    width, height = along * c + across * s, along * s + across * c
    columns = {
        "frame": table["frame"],
        "id": table["track_id"],
        "x": table["x_m"] - width / 2,
        "y": table["y_m"] - height / 2,
        "width": width,
        "height": height,
        "xVelocity": table["vx_m_per_s"],
        "yVelocity": table["vy_m_per_s"],
        "xAcceleration": table["ax_m_per_s2"],
        "yAcceleration": table["ay_m_per_s2"],
        "laneId": table["lane"] + 1,  # 0: none
        "time": table["time_s"],
    }
    return pd.DataFrame(columns).round(3).to_csv(index=False, lineterminator="\n")
