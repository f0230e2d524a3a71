"""Tracklets as the tracks that other programs read: one row a vehicle and frame."""

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from velfield.exports.place import Place

MPS_TO_KMH = 3.6


def passage_points(tracklets: pd.DataFrame) -> pd.DataFrame:
    """Detections of each passage, each once, with the velocity of the tracklet parts that meet there.

    Parameters
    ----------
    tracklets
        Columns of `schemas.tables.TRACKLET_COLUMNS`.

    Returns
    -------
    DataFrame ``passage_id, detection_id, frame, time_s, x_px, y_px, vx_px_per_s, vy_px_per_s``, by passage and time.
    """
    parts = [_ends(tracklets, end, segment) for end, segment in ((0, "01"), (1, "01"), (1, "12"), (2, "12"))]
    rows = pd.concat(parts, ignore_index=True)
    velocities = ["vx_px_per_s", "vy_px_per_s"]
    keys = ["passage_id", "detection_id"]
    mean = rows.groupby(keys, sort=False)[velocities].mean()
    once = rows.drop(columns=velocities).drop_duplicates(keys).join(mean, on=keys)
    return once.sort_values(["passage_id", "time_s", "detection_id"], ignore_index=True)


def geotrax_table(tracklets: pd.DataFrame, place: Place, *, vehicle_length_m: float | None = None) -> pd.DataFrame:
    """Tracks in the columns of geo-trax's CSV, what we do not know left empty.

    Parameters
    ----------
    vehicle_length_m
        Given where one is known; geo-trax measures each vehicle, we do not.

    Returns
    -------
    DataFrame with ``Vehicle_ID, Timestamp, Frame_Number, Ortho_X, Ortho_Y, Local_X, Local_Y, Latitude, Longitude,
    ...``: ``Timestamp`` in s of the source's clock, ``Ortho`` base pixels, ``Local`` the reference system's coordinates
    or, without one, metres; ``Vehicle_Speed`` km/h, ``Vehicle_Acceleration`` m/s^2.
    """
    points = passage_points(tracklets)
    xy = points[["x_px", "y_px"]].to_numpy(np.float64)
    empty = np.full(len(points), np.nan)
    local = place.to_crs(xy) if place.has_crs else _metres_or_nan(place, xy)
    lonlat = place.to_lonlat(xy) if place.has_crs else np.column_stack([empty, empty])
    gsd_m = np.nan if place.gsd_m is None else place.gsd_m
    velocity = points[["vx_px_per_s", "vy_px_per_s"]].to_numpy(np.float64)
    speed = pd.Series(np.linalg.norm(velocity, axis=1) * gsd_m)
    same = points["passage_id"].eq(points["passage_id"].shift())
    acceleration = (speed.diff() / points["time_s"].diff()).where(same)
    return pd.DataFrame(
        {
            "Vehicle_ID": points["passage_id"].rank(method="dense").astype("int64"),
            "Timestamp": points["time_s"],
            "Frame_Number": points["frame"],
            "Ortho_X": points["x_px"],
            "Ortho_Y": points["y_px"],
            "Local_X": local[:, 0],
            "Local_Y": local[:, 1],
            "Latitude": lonlat[:, 1],
            "Longitude": lonlat[:, 0],
            "Vehicle_Length": empty if vehicle_length_m is None else np.full(len(points), vehicle_length_m),
            "Vehicle_Width": empty,
            "Vehicle_Class": 0,
            "Vehicle_Speed": speed * MPS_TO_KMH,
            "Vehicle_Acceleration": acceleration,
            "Road_Section": "",
            "Lane_Number": "",
            "Visibility": 1,
        }
    )


def geotrax_csv(tracklets: pd.DataFrame, place: Place) -> str:
    """`geotrax_table` as text, decimals as geo-trax has them."""
    table = geotrax_table(tracklets, place)
    decimals = {"Timestamp": 3, "Ortho_X": 1, "Ortho_Y": 1, "Local_X": 2, "Local_Y": 2, "Latitude": 7, "Longitude": 7}
    table = table.round({**decimals, "Vehicle_Speed": 1, "Vehicle_Acceleration": 2})
    return str(table.to_csv(index=False, lineterminator="\n"))


def _ends(tracklets: pd.DataFrame, end: int, segment: str) -> pd.DataFrame:
    names = {
        "passage_id": "passage_id",
        f"detection_id_{end}": "detection_id",
        f"frame_{end}": "frame",
        f"time_{end}_s": "time_s",
        f"x_{end}_px": "x_px",
        f"y_{end}_px": "y_px",
        f"vx_{segment}_px_per_s": "vx_px_per_s",
        f"vy_{segment}_px_per_s": "vy_px_per_s",
    }
    return tracklets[list(names)].rename(columns=names)


def _metres_or_nan(place: Place, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.full(xy.shape, np.nan) if place.gsd_m is None else place.to_metres(xy)
