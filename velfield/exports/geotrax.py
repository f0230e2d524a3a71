"""geo-trax CSV: one row a vehicle and frame."""

from pathlib import Path

import numpy as np
import pandas as pd

from schemas.arrays import Points
from schemas.export import ExportOptions
from velfield.exports.georeference import MPS_TO_KMH, Georeference
from velfield.exports.tracks import track_points
from velfield.run.run import Run

FILE_NAME = "tracks.csv"


def encode(run: Run, _path: Path, _options: ExportOptions) -> bytes:
    """See `velfield.exports.export.ExportModule`."""
    return geotrax_csv(run.tracklets(), Georeference.from_grid(run.grid), run.vehicles()).encode()


def geotrax_table(
    tracklets: pd.DataFrame, georeference: Georeference, vehicles: pd.DataFrame | None = None
) -> pd.DataFrame:
    """Tracks in the columns of geo-trax's CSV, unknown ones left empty.

    Parameters
    ----------
    vehicles
        With ``track_id, length_m, width_m``, NaN of a vehicle that was not measured; None: of none is known.

    Returns
    -------
    DataFrame with ``Vehicle_ID, Timestamp, Frame_Number, Ortho_X, Ortho_Y, Local_X, Local_Y, Latitude, Longitude,
    ...``: ``Timestamp`` in s of the source's clock, ``Ortho`` base pixels, ``Local`` the reference system's coordinates
    or, without one, metres; ``Vehicle_Speed`` km/h, ``Vehicle_Acceleration`` m/s^2.
    """
    points = track_points(tracklets)
    xy = points[["x_px", "y_px"]].to_numpy(np.float64)
    empty = np.full(len(points), np.nan)
    local = georeference.to_crs(xy) if georeference.has_crs else _metres_or_nan(georeference, xy)
    lonlat = georeference.to_lonlat(xy) if georeference.has_crs else np.column_stack([empty, empty])
    gsd_m = np.nan if georeference.gsd_m is None else georeference.gsd_m
    velocity = points[["vx_px_per_s", "vy_px_per_s"]].to_numpy(np.float64)
    speed = pd.Series(np.linalg.norm(velocity, axis=1) * gsd_m)
    same = points["track_id"].eq(points["track_id"].shift())
    acceleration = (speed.diff() / points["time_s"].diff()).where(same)
    if vehicles is None:
        dimensions = np.full((len(points), 2), np.nan)
    else:
        measured = vehicles.set_index("track_id")[["length_m", "width_m"]]
        dimensions = measured.reindex(points["track_id"]).to_numpy(np.float64)
    return pd.DataFrame(
        {
            "Vehicle_ID": points["track_id"].rank(method="dense").astype("int64"),
            "Timestamp": points["time_s"],
            "Frame_Number": points["frame"],
            "Ortho_X": points["x_px"],
            "Ortho_Y": points["y_px"],
            "Local_X": local[:, 0],
            "Local_Y": local[:, 1],
            "Latitude": lonlat[:, 1],
            "Longitude": lonlat[:, 0],
            "Vehicle_Length": dimensions[:, 0],
            "Vehicle_Width": dimensions[:, 1],
            "Vehicle_Class": 0,
            "Vehicle_Speed": speed * MPS_TO_KMH,
            "Vehicle_Acceleration": acceleration,
            "Road_Section": "",
            "Lane_Number": "",
            "Visibility": 1,
        }
    )


def geotrax_csv(tracklets: pd.DataFrame, georeference: Georeference, vehicles: pd.DataFrame | None = None) -> str:
    """`geotrax_table` as text, decimals as geo-trax has them."""
    table = geotrax_table(tracklets, georeference, vehicles)
    decimals = {"Timestamp": 3, "Ortho_X": 1, "Ortho_Y": 1, "Local_X": 2, "Local_Y": 2, "Latitude": 7, "Longitude": 7}
    decimals |= {"Vehicle_Length": 2, "Vehicle_Width": 2}
    table = table.round({**decimals, "Vehicle_Speed": 1, "Vehicle_Acceleration": 2})
    return str(table.to_csv(index=False, lineterminator="\n"))


def _metres_or_nan(georeference: Georeference, xy: Points) -> Points:
    return np.full(xy.shape, np.nan) if georeference.gsd_m is None else georeference.to_metres(xy)
