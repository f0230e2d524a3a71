"""GeoPackage: tracklets as lines, for QGIS and ArcGIS."""

import tempfile
from pathlib import Path

import pandas as pd

from schemas.export import ExportOptions
from velfield.errors import InputError
from velfield.exports.georeference import Georeference
from velfield.exports.gis.geoparquet import tracklet_lines
from velfield.run.run import Run

FILE_NAME = "tracklets.gpkg"
LAYER = "tracklets"
_BASE_PIXELS = 'LOCAL_CS["Base pixels, y upwards",UNIT["pixel",1],AXIS["X",EAST],AXIS["Y",NORTH]]'
"""A coordinate system without a position on earth."""


def encode(run: Run, _path: Path, _options: ExportOptions) -> bytes:
    """See `velfield.exports.export.ExportModule`."""
    return tracklets_gpkg(run.with_source_ids(run.tracklets()), Georeference.from_grid(run.grid))


def tracklets_gpkg(tracklets: pd.DataFrame, georeference: Georeference) -> bytes:
    """Tracklets as a GeoPackage with one layer of lines.

    Parameters
    ----------
    tracklets
        Columns of `schemas.tables.TRACKLET_COLUMNS`; all are kept, with their units in their names.
    georeference
        Lines are in the base image's reference system; without one in base pixels, y upwards.

    Raises
    ------
    InputError
        pyogrio is not installed.
    """
    try:
        import pyogrio
    except ImportError:
        raise InputError("GeoPackage needs pyogrio; pip install 'velfield[gis]', or export geoparquet") from None
    table, _ = tracklet_lines(tracklets, georeference)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / FILE_NAME
        pyogrio.write_arrow(
            table,
            path,
            layer=LAYER,
            driver="GPKG",
            geometry_name="geometry",
            geometry_type="LineString",
            crs=georeference.crs_wkt if georeference.has_crs else _BASE_PIXELS,
        )
        return path.read_bytes()
