"""GeoParquet 1.1: tracklets as lines, with a bounding box a row, by which readers of a region skip the rest."""

import io
import json
import struct
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from rasterio.crs import CRS

from schemas.arrays import FloatArray
from schemas.export import ExportOptions
from velfield.exports.georeference import Georeference
from velfield.run.run import Run

FILE_NAME = "tracklets.parquet"

_LINE = struct.Struct("<BIIdddddd")  # little-endian, LineString, three points
_LINE_STRING = 2


def encode(run: Run, _path: Path, _options: ExportOptions) -> bytes:
    """See `velfield.exports.export.ExportModule`."""
    return tracklets_geoparquet(run.with_source_ids(run.tracklets()), Georeference.from_grid(run.grid))


def tracklets_geoparquet(tracklets: pd.DataFrame, georeference: Georeference) -> bytes:
    """Tracklets as a GeoParquet file.

    Parameters
    ----------
    tracklets
        Columns of `schemas.tables.TRACKLET_COLUMNS`; all are kept, with their units in their names.
    georeference
        Lines are in the base image's reference system; without one in base pixels, y upwards, and the file
        declares its reference system unknown.

    Returns
    -------
    The file's bytes: ``geometry`` WKB, ``bbox`` struct, the tracklets' columns, ``heading_deg`` and ``heading_from``.
    """
    table, lines = tracklet_lines(tracklets, georeference)
    low, high = lines.min(axis=1), lines.max(axis=1)
    table = table.add_column(1, "bbox", _boxes(low, high))
    table = table.replace_schema_metadata({"geo": json.dumps(_metadata(georeference, low, high))})
    sink = io.BytesIO()
    pq.write_table(table, sink, compression="zstd")
    return sink.getvalue()


def tracklet_lines(tracklets: pd.DataFrame, georeference: Georeference) -> tuple[pa.Table, FloatArray]:
    """Tracklets as a table (``geometry`` WKB, ``heading_deg``, ``heading_from``, their own columns), and their lines
    (n, 3, 2)."""
    xy = np.stack([tracklets[[f"x_{k}_px", f"y_{k}_px"]].to_numpy(np.float64) for k in range(3)], axis=1)
    flat = xy.reshape(-1, 2)
    lines = (georeference.to_crs(flat) if georeference.has_crs else flat * (1.0, -1.0)).reshape(-1, 3, 2)
    columns: dict[str, pa.Array] = {
        "geometry": pa.array([_LINE.pack(1, _LINE_STRING, 3, *line.ravel()) for line in lines], pa.binary()),
        "heading_deg": pa.array(_headings(tracklets, xy, georeference), pa.float32()),
        "heading_from": pa.array([georeference.heading_from] * len(lines)),
    }
    columns |= {str(name): pa.array(tracklets[name].to_numpy()) for name in tracklets.columns}
    return pa.table(columns), lines


def _boxes(low: FloatArray, high: FloatArray) -> pa.Array:
    corners = [low[:, 0], low[:, 1], high[:, 0], high[:, 1]]
    return pa.StructArray.from_arrays([pa.array(corner) for corner in corners], ["xmin", "ymin", "xmax", "ymax"])


def _headings(tracklets: pd.DataFrame, xy: FloatArray, georeference: Georeference) -> FloatArray:
    velocity = sum(
        tracklets[[f"vx_{part}_px_per_s", f"vy_{part}_px_per_s"]].to_numpy(np.float64) for part in ("01", "12")
    )
    return georeference.heading_deg(xy[:, 1], np.asarray(velocity) / 2)


def _metadata(georeference: Georeference, low: FloatArray, high: FloatArray) -> dict[str, object]:
    geometry: dict[str, object] = {
        "encoding": "WKB",
        "geometry_types": ["LineString"],
        "crs": CRS.from_wkt(georeference.crs_wkt).to_dict(projjson=True) if georeference.has_crs else None,
        "covering": {"bbox": {side: ["bbox", side] for side in ("xmin", "ymin", "xmax", "ymax")}},
    }
    if len(low):
        geometry["bbox"] = [*low.min(axis=0).tolist(), *high.max(axis=0).tolist()]
    return {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": geometry}}
