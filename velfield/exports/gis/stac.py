"""A STAC item: the run's footprint, time and files, for catalogues."""

import json
import os
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from rasterio.crs import CRS

from schemas.export import ExportOptions
from velfield.errors import InputError
from velfield.exports.georeference import Georeference
from velfield.run.layout import is_remote
from velfield.run.run import Run

FILE_NAME = "item.json"
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


def encode(run: Run, path: Path, options: ExportOptions) -> bytes:
    """See `velfield.exports.export.ExportModule`."""
    layout, times_s, recorded = run.layout, run.times_s, run.start
    start = options.start or (recorded.time if recorded is not None else None)
    georeference = Georeference.from_grid(run.grid)
    missing = {
        "start": None if start else "give --start 2024-05-01T12:00:00Z",
        "place on Earth": None if georeference.has_crs else "put the map there by `velfield georeference RUN`",
    }
    remedies = {what: remedy for what, remedy in missing.items() if remedy}
    if start is None or remedies:
        lacking, remedy = " and no ".join(remedies), " and ".join(remedies.values())
        raise InputError(f"--format stac: found no {lacking}, expected the flight's; {remedy}")
    properties: dict[str, object] = {"velfield:version": run.record.code_version, "velfield:frames": run.frames.count}
    if options.start is None and recorded is not None:
        zone = "" if recorded.is_utc else "; the camera's clock, whose time zone is not known, taken as UTC"
        properties["velfield:start_source"] = f"{recorded.source}{zone}"
    files = [file for file in (*sorted(layout.maps.glob("*.tif")), layout.field, layout.report) if file.exists()]
    item = stac_item(
        layout.root.resolve().name,
        georeference,
        {file.stem: _href(file, path.parent) for file in files},
        start=start,
        duration_s=float(times_s[-1] - times_s[0]),
        properties=properties,
    )
    return json.dumps(item, indent=1).encode()


def stac_item(
    name: str,
    georeference: Georeference,
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
    georeference
        With a reference system: an item has coordinates.
    assets
        Title -> path relative to the item.
    start, duration_s
        When the flight began (a time zone is needed; few videos record it), and how long it lasted, s.
    properties
        Further ones: counts, versions.

    Raises
    ------
    InputError
        No reference system, or a start without a time zone.
    """
    if start.tzinfo is None:
        raise InputError(f"found the start {start.isoformat()} without a time zone, expected one; add Z or an offset")
    rows, columns = georeference.shape
    corners = np.array([[0, rows], [columns, rows], [columns, 0], [0, 0], [0, rows]], np.float64) - 0.5
    ring = np.round(georeference.to_lonlat(corners), 7)
    begin = start.astimezone(UTC)
    stamps = [moment.isoformat().replace("+00:00", "Z") for moment in (begin, begin + timedelta(seconds=duration_s))]
    crs = CRS.from_wkt(georeference.crs_wkt)
    authority = crs.to_authority()
    described: dict[str, object] = {
        "datetime": None,
        "start_datetime": stamps[0],
        "end_datetime": stamps[1],
        "proj:code": ":".join(authority) if authority else None,
        "proj:wkt2": georeference.crs_wkt,
        "proj:shape": [rows, columns],
        "proj:transform": list(georeference.affine or ()),
        **(properties or {}),
    }
    if georeference.gsd_m is not None:
        described["gsd"] = round(georeference.gsd_m, 6)
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


def _href(file: Path, folder: Path) -> str:
    """Path of a file relative to a folder; its whole address where one of the two is on S3 and the other is not."""
    if is_remote(file) != is_remote(folder):
        return str(file.resolve())
    return os.path.relpath(str(file), str(folder))
