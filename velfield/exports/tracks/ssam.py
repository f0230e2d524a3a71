"""Trajectories as the binary .trj file of FHWA's Surrogate Safety Assessment Model (SSAM), format version 1.04.

A record is a byte for its type and its fields: FORMAT, DIMENSIONS, then by turns a TIMESTEP and the VEHICLEs in it. x
is to the right of the map and y up, from its lower left corner, in metres.
"""

from pathlib import Path

import numpy as np
import pandas as pd

from schemas.arrays import FloatArray
from schemas.export import ExportOptions
from velfield.analysis.trajectories import VEHICLE_LENGTH_M, VEHICLE_WIDTH_M
from velfield.exports.tracks.table import trajectory_table
from velfield.run.run import Run

FILE_NAME = "trajectories.trj"
FORMAT = np.dtype([("type", "u1"), ("endian", "S1"), ("version", "<f4")])
DIMENSIONS = np.dtype([("type", "u1"), ("metric", "u1"), ("scale", "<f4"), ("bounds", "<i4", 4)])
TIMESTEP = np.dtype([("type", "u1"), ("time_s", "<f4")])
VEHICLE = np.dtype(
    [("type", "u1"), ("id", "<i4"), ("link", "<i4"), ("lane", "u1"), ("front", "<f4", 2), ("rear", "<f4", 2)]
    + [(name, "<f4") for name in ("length", "width", "speed", "acceleration")]
)
"""Each lane is a link of its own, of one lane; 0: the vehicle is on none. Speed m/s, acceleration along it m/s²."""
_TURNS_M_PER_S = 1.0
"""The direction of a slower vehicle is that in which it came."""


def encode(run: Run, _path: Path, _options: ExportOptions) -> bytes:
    """See `velfield.exports.export.ExportModule`."""
    table = trajectory_table(run, whole=True)
    size_m = np.array([run.grid.width_px, run.grid.height_px]) * run.gsd_m
    table["y_m"] = size_m[1] - table["y_m"]
    table[["vy_m_per_s", "ay_m_per_s2"]] *= -1
    return ssam_records(table, size_m)


def ssam_records(table: pd.DataFrame, size_m: FloatArray) -> bytes:
    """The file of the table of `trajectory_table`, y up, and the map's width and height (2,)."""
    bounds = [0, 0, *np.ceil(size_m).astype(int)]
    head = np.array((0, b"L", 1.04), FORMAT).tobytes() + np.array((1, 1, 1.0, bounds), DIMENSIONS).tobytes()
    records = _vehicle_records(table)
    first_s = table["time_s"].min() if len(table) else 0.0
    out = [head]
    for _, rows in table.reset_index(drop=True).groupby("frame", sort=True):
        out.append(np.array((2, rows["time_s"].mean() - first_s), TIMESTEP).tobytes())
        out.append(records[rows.index].tobytes())
    return b"".join(out)


def _vehicle_records(table: pd.DataFrame) -> np.ndarray:
    way = _ways(table)
    length = table["length_m"].fillna(VEHICLE_LENGTH_M).to_numpy(np.float64)
    middle, half = table[["x_m", "y_m"]].to_numpy(np.float64), length[:, None] / 2 * way
    records = np.zeros(len(table), VEHICLE)
    records["type"], records["id"] = 3, table["track_id"]
    records["link"], records["lane"] = table["lane"] + 1, table["lane"] >= 0
    records["front"], records["rear"] = middle + half, middle - half
    records["length"], records["width"] = length, table["width_m"].fillna(VEHICLE_WIDTH_M)
    records["speed"] = table["speed_m_per_s"]
    records["acceleration"] = (table[["ax_m_per_s2", "ay_m_per_s2"]].to_numpy(np.float64) * way).sum(axis=1)
    return records


def _ways(table: pd.DataFrame) -> FloatArray:
    """Unit vectors (n, 2) in which the vehicles point: of a standing one as it came, else as it sets off."""
    way = table[["vx_m_per_s", "vy_m_per_s"]].div(table["speed_m_per_s"].clip(lower=1e-9), axis=0)
    moving = way.where(table["speed_m_per_s"] >= _TURNS_M_PER_S).groupby(table["track_id"])
    known = moving.ffill().fillna(moving.bfill()).fillna({"vx_m_per_s": 1.0, "vy_m_per_s": 0.0})
    return known.to_numpy(np.float64)
