"""geo-trax CSV: one row a vehicle and frame."""

from pathlib import Path

import numpy as np
import pandas as pd
from rasterio.crs import CRS
from rasterio.warp import transform

from schemas.arrays import Points
from schemas.export import ExportOptions
from velfield.exports.georeference import MPS_TO_KMH, Georeference
from velfield.exports.tracks.points import track_points, whole_ids
from velfield.run.run import Run
from velfield.sources.geo import utm_crs

FILE_NAME = "tracks.csv"
_SAME = 0.01
"""A unit of the reference system that differs by more than this from a metre on the ground is none."""


def encode(run: Run, _path: Path, _options: ExportOptions) -> bytes:
    """See `velfield.exports.export.ExportModule`."""
    tracklets, vehicles = run.tracklets(), run.vehicles()
    ids = whole_ids(run, tracklets["track_id"])
    tracklets, vehicles = (one.assign(track_id=one["track_id"].map(ids)) for one in (tracklets, vehicles))
    return geotrax_csv(tracklets, Georeference.from_grid(run.grid), vehicles).encode()


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
    ...``: ``Timestamp`` in s of the source's clock, ``Ortho`` base pixels (y down), ``Local`` metres with y up: the
    reference system's coordinates, of the UTM zone where its unit is no metre on the ground (feet, Web Mercator), from
    the map's lower left corner without one; ``Vehicle_Speed`` km/h, ``Vehicle_Acceleration`` m/s^2.
    """
    points = track_points(tracklets)
    xy = points[["x_px", "y_px"]].to_numpy(np.float64)
    empty = np.full(len(points), np.nan)
    lonlat = georeference.to_lonlat(xy) if georeference.has_crs else np.column_stack([empty, empty])
    local = _local_metres(georeference, xy, lonlat)
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
            "Vehicle_ID": points["track_id"],
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


def _local_metres(georeference: Georeference, xy: Points, lonlat: Points) -> Points:
    if georeference.affine is None or not len(xy):
        return np.full(xy.shape, np.nan) if georeference.gsd_m is None else georeference.to_metres(xy)
    a, b, _, d, e, _ = georeference.affine
    unit_m = (georeference.gsd_m or np.nan) / np.sqrt(abs(a * e - b * d))
    if abs(unit_m - 1) < _SAME:
        return georeference.to_crs(xy)
    utm = utm_crs(*np.median(lonlat, axis=0))
    return np.column_stack(transform(CRS.from_epsg(4326), utm, lonlat[:, 0], lonlat[:, 1]))
