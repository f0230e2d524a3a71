"""GeoParquet 1.1: tracklets as lines, with a bounding box a row, so that readers of a region skip the rest."""

import io
import json
import struct

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from rasterio.crs import CRS

from velfield.exports.place import Place

_LINE = struct.Struct("<BIIdddddd")  # little-endian, LineString, three points
_LINE_STRING = 2


def tracklets_geoparquet(tracklets: pd.DataFrame, place: Place) -> bytes:
    """Tracklets as a GeoParquet file.

    Parameters
    ----------
    tracklets
        Columns of `schemas.tables.TRACKLET_COLUMNS`; all are kept, with their units in their names.
    place
        Lines are in the base image's reference system; without one in base pixels, y upwards, and the file says that
        its reference system is not known.

    Returns
    -------
    The file's bytes: ``geometry`` WKB, ``bbox`` struct, the tracklets' columns, and ``heading_deg``.
    """
    table, lines = tracklet_lines(tracklets, place)
    low, high = lines.min(axis=1), lines.max(axis=1)
    table = table.add_column(1, "bbox", _boxes(low, high))
    table = table.replace_schema_metadata({"geo": json.dumps(_metadata(place, low, high))})
    sink = io.BytesIO()
    pq.write_table(table, sink, compression="zstd")
    return sink.getvalue()


def tracklet_lines(tracklets: pd.DataFrame, place: Place) -> tuple[pa.Table, NDArray[np.float64]]:
    """Tracklets as a table (``geometry`` WKB, ``heading_deg``, their own columns), and their lines (n, 3, 2)."""
    xy = np.stack([tracklets[[f"x_{k}_px", f"y_{k}_px"]].to_numpy(np.float64) for k in range(3)], axis=1)
    flat = xy.reshape(-1, 2)
    lines = (place.to_crs(flat) if place.has_crs else flat * (1.0, -1.0)).reshape(-1, 3, 2)
    columns: dict[str, pa.Array] = {
        "geometry": pa.array([_wkb(line) for line in lines], pa.binary()),
        "heading_deg": pa.array(_headings(tracklets, xy, place), pa.float32()),
    }
    columns |= {str(name): pa.array(tracklets[name].to_numpy()) for name in tracklets.columns}
    return pa.table(columns), lines


def _wkb(line: NDArray[np.float64]) -> bytes:
    return _LINE.pack(1, _LINE_STRING, 3, *line.ravel().tolist())


def _boxes(low: NDArray[np.float64], high: NDArray[np.float64]) -> pa.Array:
    corners = [low[:, 0], low[:, 1], high[:, 0], high[:, 1]]
    return pa.StructArray.from_arrays([pa.array(corner) for corner in corners], ["xmin", "ymin", "xmax", "ymax"])


def _headings(tracklets: pd.DataFrame, xy: NDArray[np.float64], place: Place) -> NDArray[np.float64]:
    velocity = sum(
        tracklets[[f"vx_{part}_px_per_s", f"vy_{part}_px_per_s"]].to_numpy(np.float64) for part in ("01", "12")
    )
    return place.heading_deg(xy[:, 1], np.asarray(velocity) / 2)


def _metadata(place: Place, low: NDArray[np.float64], high: NDArray[np.float64]) -> dict[str, object]:
    geometry: dict[str, object] = {
        "encoding": "WKB",
        "geometry_types": ["LineString"],
        "crs": CRS.from_wkt(place.crs_wkt).to_dict(projjson=True) if place.has_crs else None,
        "covering": {"bbox": {side: ["bbox", side] for side in ("xmin", "ymin", "xmax", "ymax")}},
    }
    if len(low):
        geometry["bbox"] = [*low.min(axis=0).tolist(), *high.max(axis=0).tolist()]
    return {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": geometry}}
