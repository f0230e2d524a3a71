"""Crossroads with turns: straight roads from south to north and from west to east, a signal of 60 s, for 5 minutes."""

import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd

from schemas.arrays import FloatArray
from schemas.flight import FlightConfig
from tests.analysis.test_traffic_analysis import corner, drive
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.analysis.trajectories import make_trajectories, moving
from velfield.pipeline.given_tracks.load import load_tracks

CYCLE_S = 60.0
CENTRE = np.array([200.0, 200.0])
_EAST = np.array([[20.0, 200.0], [380.0, 200.0]])
_NORTH = np.array([[200.0, 380.0], [200.0, 20.0]])
_SOUTH = corner(202.0, 200.0, 380.0)
_SOUTH[0, 0] = 20.0
NORTHWARDS, EASTWARDS, RIGHT = 60, 45, 15
"""Vehicles straight on, and from the west to the south: on a lane 12 m beside the one to the north."""
SD_M = 0.3


def write_tracks(file: Path, *, turned_deg: float = 0.0) -> None:
    """A table of the tracks of 120 vehicles; ``turned_deg``: the roads' turn, clockwise, about `CENTRE`."""
    rng = np.random.default_rng(2)
    angle = np.radians(turned_deg)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    tracks = []
    for cycle in range(5):
        green = cycle * CYCLE_S
        for begin, path in ((green + 30, _EAST), (green + 60, _NORTH)):
            for k in range(12):  # four wait for green, eight come while it lasts
                stop = {"stop_at_m": 165.0 - 7 * k, "go_s": begin + 1.8 + 1.8 * k} if k < 4 else {}
                start = begin - 30 + 3 * k if k < 4 else begin - 12 + 2.5 * k
                tracks.append(drive(_SOUTH if path is _EAST and k % 4 == 3 else path, start, **stop))
    rows = [
        pd.DataFrame({"track_id": k, "time_s": np.round(times, 1), "x_m": xy[:, 0], "y_m": xy[:, 1]})
        for k, (times, xy) in enumerate(tracks)
    ]
    table = pd.concat(rows)
    xy = CENTRE + (table[["x_m", "y_m"]].to_numpy() - CENTRE) @ turn
    table[["x_m", "y_m"]] = xy + rng.normal(0, SD_M, xy.shape)
    table.to_csv(file, index=False)


@cache
def turning_crossroads(turned_deg: float = 0.0) -> TrafficAnalysis:
    """Their analysis."""
    with tempfile.TemporaryDirectory() as folder:
        write_tracks(Path(folder) / "tracks.csv", turned_deg=turned_deg)
        given = load_tracks(Path(folder) / "tracks.csv", FlightConfig(position_y_axis="down"))
    table = given.table
    ids, frames = table["track_id"].to_numpy(np.int64), table["frame"].to_numpy(np.int64)
    made = make_trajectories(
        ids, frames, table["time_s"].to_numpy(np.float64), given.xy_m, gsd_m=given.gsd_m,
        position_sd_m=given.position_sd_m,
    )  # fmt: skip
    return TrafficAnalysis(moving(replace(made, seen_s=made.window_s)))


def apart_deg(a_rad: float, b_deg: float) -> float:
    """Angle between two directions, 0 to 180."""
    return float(np.degrees(np.abs(np.angle(np.exp(1j * (a_rad - np.radians(b_deg)))))))


def sides(turned_deg: float = 0.0) -> FloatArray:
    """Directions in which the roads lead away, degrees, y down: of the roads named E, S, W and N."""
    return np.array([0.0, 90.0, 180.0, 270.0]) + turned_deg
