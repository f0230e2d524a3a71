"""GeoPackage: tracklets as lines, for QGIS and ArcGIS."""

from pathlib import Path

import pandas as pd

from velfield.errors import InputError
from velfield.exports.geoparquet import tracklet_lines
from velfield.exports.place import Place

LAYER = "tracklets"
_BASE_PIXELS = 'LOCAL_CS["Base pixels, y upwards",UNIT["pixel",1],AXIS["X",EAST],AXIS["Y",NORTH]]'
"""No place on earth, said as such."""


def write_geopackage(path: Path, tracklets: pd.DataFrame, place: Place) -> None:
    """Write tracklets as a layer of lines.

    Parameters
    ----------
    path
        The file; one that is there is replaced.
    tracklets
        Columns of `schemas.tables.TRACKLET_COLUMNS`; all are kept, with their units in their names.
    place
        Lines are in the base image's reference system; without one in base pixels, y upwards.

    Raises
    ------
    InputError
        GDAL's vector side is not installed.
    """
    try:
        import pyogrio
    except ImportError:
        raise InputError(
            "found no pyogrio, which writes GeoPackage; pip install 'velfield[gis]', or export geoparquet"
        ) from None
    table, _ = tracklet_lines(tracklets, place)
    path.unlink(missing_ok=True)
    pyogrio.write_arrow(
        table,
        path,
        layer=LAYER,
        driver="GPKG",
        geometry_name="geometry",
        geometry_type="LineString",
        crs=place.crs_wkt if place.has_crs else _BASE_PIXELS,
    )
