"""A run written in the formats that others read: what `velfield export` does."""

import json
from collections.abc import Callable
from pathlib import Path

from schemas.report import Report
from velfield.errors import InputError
from velfield.exports.arrows import arrows_geojson
from velfield.exports.cog import write_cog
from velfield.exports.geoparquet import tracklets_geoparquet
from velfield.exports.passages import geotrax_csv
from velfield.exports.place import Place
from velfield.exports.sumo import sumo_fcd
from velfield.provenance import write_atomically
from velfield.render.report import render_report
from velfield.run import Run
from velfield.steps.report import report_figures
from velfield.stores import open_field

Writer = Callable[[Run, Path], None]


def _place(run: Run) -> Place:
    grid = run.grid
    return Place((grid.height_px, grid.width_px), grid.crs_wkt, grid.affine, grid.gsd_m)


def _geoparquet(run: Run, path: Path) -> None:
    write_atomically(path, tracklets_geoparquet(run.tracklets(), _place(run)))


def _geotrax(run: Run, path: Path) -> None:
    write_atomically(path, geotrax_csv(run.tracklets(), _place(run)).encode())


def _sumo(run: Run, path: Path) -> None:
    write_atomically(path, sumo_fcd(run.tracklets(), _place(run)).encode())


def _arrows(run: Run, path: Path) -> None:
    arrows = arrows_geojson(run.field.modal_velocity(), run.field.count(), _place(run))
    write_atomically(path, json.dumps(arrows).encode())


def _cog(run: Run, path: Path) -> None:
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


def _report(run: Run, path: Path) -> None:
    """The page's summary as one file that holds all it shows."""
    record = run.layout.report_record
    if not record.exists():
        raise InputError(f"{record} is not there: the run was not finished, or an older velfield made it; run it again")
    report = Report.model_validate_json(record.read_bytes())
    alone = report.model_copy(update={"files": ()})  # they do not travel with the mail
    figures = [figure.model_copy(update={"full_size": None}) for figure in report_figures(run.layout).values()]
    write_atomically(path, render_report(alone, figures).encode())


FORMATS: dict[str, tuple[str, Writer]] = {
    "cog": ("field.tif", _cog),
    "geoparquet": ("tracklets.parquet", _geoparquet),
    "geotrax": ("tracks.csv", _geotrax),
    "sumo": ("tracks.fcd.xml", _sumo),
    "arrows": ("arrows.geojson", _arrows),
    "report": ("report.html", _report),
}
"""Format -> usual file name and writer."""


def export_run(run: Run, format_name: str, out: Path | None) -> Path:
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
    write(run, path)
    return path
