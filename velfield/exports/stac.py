"""A STAC item: what the run is, where on earth and when, so that catalogues find it."""

from collections.abc import Mapping
from datetime import UTC, datetime, timedelta

import numpy as np
from rasterio.crs import CRS

from velfield.errors import InputError
from velfield.exports.place import Place

_PROJECTION = "https://stac-extensions.github.io/projection/v2.0.0/schema.json"
_KINDS: dict[str, tuple[str, list[str]]] = {
    ".tif": ("image/tiff; application=geotiff; profile=cloud-optimized", ["data"]),
    ".parquet": ("application/vnd.apache.parquet", ["data"]),
    ".geojson": ("application/geo+json", ["data"]),
    ".zarr": ("application/vnd+zarr", ["data"]),
    ".png": ("image/png", ["overview"]),
    ".html": ("text/html", ["overview"]),
    ".csv": ("text/csv", ["data"]),
    ".xml": ("application/xml", ["data"]),
    ".json": ("application/json", ["metadata"]),
}


def stac_item(
    name: str,
    place: Place,
    assets: Mapping[str, str],
    *,
    start: datetime,
    duration_s: float,
    properties: Mapping[str, object] | None = None,
) -> dict[str, object]:
    """Describe a run as a STAC 1.1 item.

    Parameters
    ----------
    name
        The item's id.
    place
        With a reference system: an item lies on earth.
    assets
        Title -> path relative to the item.
    start, duration_s
        When the flight began (a time zone is needed; a video seldom tells), and how long it lasted, s.
    properties
        More of them: counts, versions.

    Raises
    ------
    InputError
        No reference system, or a start without a time zone.
    """
    if start.tzinfo is None:
        raise InputError(f"found the start {start.isoformat()} without a time zone, expected one; add Z or an offset")
    rows, columns = place.shape
    corners = np.array([[0, rows], [columns, rows], [columns, 0], [0, 0], [0, rows]], np.float64) - 0.5
    ring = np.round(place.to_lonlat(corners), 7)
    begin = start.astimezone(UTC)
    stamps = [moment.isoformat().replace("+00:00", "Z") for moment in (begin, begin + timedelta(seconds=duration_s))]
    crs = CRS.from_wkt(place.crs_wkt)
    authority = crs.to_authority()
    described: dict[str, object] = {
        "datetime": None,
        "start_datetime": stamps[0],
        "end_datetime": stamps[1],
        "proj:code": ":".join(authority) if authority else None,
        "proj:wkt2": place.crs_wkt,
        "proj:shape": [rows, columns],
        "proj:transform": list(place.affine or ()),
        **(properties or {}),
    }
    if place.gsd_m is not None:
        described["gsd"] = round(place.gsd_m, 6)
    return {
        "type": "Feature",
        "stac_version": "1.1.0",
        "stac_extensions": [_PROJECTION],
        "id": name,
        "geometry": {"type": "Polygon", "coordinates": [ring.tolist()]},
        "bbox": [*ring.min(axis=0).tolist(), *ring.max(axis=0).tolist()],
        "properties": described,
        "links": [],
        "assets": {title: _asset(title, href) for title, href in assets.items()},
    }


def _asset(title: str, href: str) -> dict[str, object]:
    suffix = "." + href.rstrip("/").rsplit(".", 1)[-1].lower()
    media, roles = _KINDS.get(suffix, ("application/octet-stream", ["data"]))
    return {"href": href, "title": title, "type": media, "roles": roles}
