"""A run written in the formats that others read: what `velfield export` does."""

import json
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from schemas.report import Report
from velfield.errors import InputError
from velfield.exports.arrows import arrows_geojson
from velfield.exports.cog import write_cog
from velfield.exports.geopackage import write_geopackage
from velfield.exports.geoparquet import tracklets_geoparquet
from velfield.exports.place import Place
from velfield.exports.stac import stac_item
from velfield.exports.sumo import sumo_fcd
from velfield.exports.tracks import geotrax_csv
from velfield.field.bins import stationary_speed_px_per_s
from velfield.report.figures import MapScale, SpeedUnit, direction_figure, png_bytes, speed_figure
from velfield.report.report import render_report
from velfield.report.run_figures import report_figures
from velfield.run.commits import write_atomically
from velfield.run.grid import north_of
from velfield.run.run import Run
from velfield.run.stores import open_field

_LARGEST_SIDE_PX = 20_000


@dataclass(frozen=True)
class ExportOptions:
    """What some formats can be told.

    Attributes
    ----------
    width_px
        Width of a figure's map; None: a pixel a base pixel.
    unit
        Unit of speed in a figure.
    start
        When the flight began, with its time zone: a STAC item wants to know, and a video seldom tells.
    """

    width_px: int | None = None
    unit: SpeedUnit = "km/h"
    start: datetime | None = None


Writer = Callable[[Run, Path, ExportOptions], None]


def _place(run: Run) -> Place:
    grid = run.grid
    return Place((grid.height_px, grid.width_px), grid.crs_wkt, grid.affine, grid.gsd_m)


def _geoparquet(run: Run, path: Path, _: ExportOptions) -> None:
    write_atomically(path, tracklets_geoparquet(run.tracklets(), _place(run)))


def _geopackage(run: Run, path: Path, _: ExportOptions) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_geopackage(path, run.tracklets(), _place(run))


def _geotrax(run: Run, path: Path, _: ExportOptions) -> None:
    write_atomically(path, geotrax_csv(run.tracklets(), _place(run)).encode())


def _sumo(run: Run, path: Path, _: ExportOptions) -> None:
    write_atomically(path, sumo_fcd(run.tracklets(), _place(run)).encode())


def _arrows(run: Run, path: Path, _: ExportOptions) -> None:
    arrows = arrows_geojson(run.field.modal_velocity(), run.field.count(), _place(run))
    write_atomically(path, json.dumps(arrows).encode())


def _cog(run: Run, path: Path, _: ExportOptions) -> None:
    """All float layers of the field as bands, in SI where metres are known."""
    store, grid = open_field(run.layout.field), run.grid
    names = [name for name in store.layer_names() if store.layer(name).dtype.kind == "f"]
    units = [str(store.group[name].attrs.get("units", "1")) for name in names]
    factors = [grid.gsd_m if grid.gsd_m and unit == "px s-1" else 1.0 for unit in units]
    write_cog(
        path,
        [store.layer(name) * factor for name, factor in zip(names, factors, strict=True)],
        names=names,
        units=["m s-1" if grid.gsd_m and unit == "px s-1" else unit for unit in units],
        crs_wkt=grid.crs_wkt,
        affine=grid.affine,
    )


def _report(run: Run, path: Path, _: ExportOptions) -> None:
    """The page's summary as one file that holds all it shows."""
    record = run.layout.report_record
    if not record.exists():
        raise InputError(f"{record} is not there: the run was not finished, or an older velfield made it; run it again")
    report = Report.model_validate_json(record.read_bytes())
    alone = report.model_copy(update={"files": ()})  # they do not travel with the mail
    figures = [figure.model_copy(update={"full_size": None}) for figure in report_figures(run.layout.maps).values()]
    write_atomically(path, render_report(alone, figures).encode())


def _direction(run: Run, path: Path, options: ExportOptions) -> None:
    direction = _standing_left_out(run, run.field.modal_direction_rad())
    grey, values, scale = _at_width(run, direction, options)
    write_atomically(path, png_bytes(direction_figure(grey, values, scale)))


def _speed(run: Run, path: Path, options: ExportOptions) -> None:
    grey, values, scale = _at_width(run, run.field.modal_speed_px_per_s(), options)
    # the colours are of speeds in base pixels, whatever the figure's size
    shown = replace(scale, gsd_m=run.grid.gsd_m)
    write_atomically(path, png_bytes(speed_figure(grey, values, shown, bar_gsd_m=scale.gsd_m)))


def _at_width(run: Run, values: FloatArray, options: ExportOptions) -> tuple[NDArray[np.uint8], FloatArray, MapScale]:
    """Base image and layer at the wanted width, and what the legend says at that size."""
    grey, grid = run.base_image, run.grid
    factor = 1.0 if options.width_px is None else options.width_px / grid.width_px
    size = max(1, round(grid.width_px * factor)), max(1, round(grid.height_px * factor))
    if max(size) > _LARGEST_SIDE_PX:
        raise InputError(
            f"--width {options.width_px}: a figure of {size[0]} x {size[1]} px; at most {_LARGEST_SIDE_PX}"
        )
    picture = cv2.resize(grey, size, interpolation=cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC)
    layer = cv2.resize(np.asarray(values, np.float32), size, interpolation=cv2.INTER_NEAREST_EXACT)
    gsd_m = None if grid.gsd_m is None else grid.gsd_m / factor
    scale = MapScale(gsd_m=gsd_m, unit=options.unit, north_rad=north_of(grid))
    return np.asarray(picture, np.uint8), np.asarray(layer, np.float64), scale


def _standing_left_out(run: Run, direction: FloatArray) -> FloatArray:
    slow = stationary_speed_px_per_s(run.record.config.field, run.grid.gsd_m)
    return np.where(run.field.modal_speed_px_per_s() >= slow, direction, np.nan)


def _stac(run: Run, path: Path, options: ExportOptions) -> None:
    if options.start is None:
        raise InputError("--format stac: a STAC item says when; give --start 2024-05-01T12:00:00Z")
    root = run.layout.root
    told = [
        path for path in (*sorted(run.layout.maps.glob("*.tif")), run.layout.field, run.layout.report) if path.exists()
    ]
    assets = {found.stem: os.path.relpath(found, path.parent) for found in told}
    times_s = run.times_s
    item = stac_item(
        root.resolve().name,
        _place(run),
        assets,
        start=options.start,
        duration_s=float(times_s[-1] - times_s[0]),
        properties={"velfield:version": run.record.code_version, "velfield:frames": run.frames.count},
    )
    write_atomically(path, json.dumps(item, indent=1).encode())


FORMATS: dict[str, tuple[str, Writer]] = {
    "cog": ("field.tif", _cog),
    "geoparquet": ("tracklets.parquet", _geoparquet),
    "gpkg": ("tracklets.gpkg", _geopackage),
    "geotrax": ("tracks.csv", _geotrax),
    "sumo": ("tracks.fcd.xml", _sumo),
    "arrows": ("arrows.geojson", _arrows),
    "stac": ("item.json", _stac),
    "direction": ("direction.png", _direction),
    "speed": ("speed.png", _speed),
    "report": ("report.html", _report),
}
"""Format -> usual file name and writer."""


def export_run(run: Run, format_name: str, out: Path | None, options: ExportOptions | None = None) -> Path:
    """Write one export; returns where it stands.

    Raises
    ------
    InputError
        The format is not known, or needs what the run does not have (metres, coordinates).
    """
    if format_name not in FORMATS:
        raise InputError(f"--format {format_name}: not known; expected one of {', '.join(FORMATS)}")
    name, write = FORMATS[format_name]
    path = out or run.layout.root / "exports" / name
    write(run, path, options or ExportOptions())
    return path
