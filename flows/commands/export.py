"""``velfield export``: a finished run in a format that others read."""

from datetime import datetime
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

Format = Literal["cog", "geoparquet", "gpkg", "geotrax", "sumo", "arrows", "stac", "direction", "speed", "report"]
Unit = Literal["km/h", "mph", "m/s", "px/s"]


def export(
    run_folder: Path,
    /,
    *,
    format_name: Annotated[Format, Parameter(name="--format")],
    out: Path | None = None,
    width: int | None = None,
    unit: Unit = "km/h",
    start: str | None = None,
) -> int:
    """Write a finished run in a format that others read.

    Parameters
    ----------
    run_folder
        The run folder.
    format_name
        `cog`: the field's layers as GeoTIFF; `geoparquet`, `gpkg`: tracklets as lines; `geotrax`: tracks as CSV;
        `sumo`: tracks as FCD XML; `arrows`: modal velocities as GeoJSON; `stac`: a catalogue's item; `direction`,
        `speed`: the figures as PNG; `report`: the summary as one HTML file, to send by mail.
    out
        File to write. Default: in the run folder's `exports/`.
    width
        Width of a figure's map, px. Default: a pixel a base pixel.
    unit
        Unit of speed in a figure.
    start
        When the flight began, as 2024-05-01T12:00:00Z; for `stac`.
    """
    from velfield.exports.export import ExportOptions, export_run
    from velfield.run.run import open_run

    options = ExportOptions(width_px=width, unit=unit, start=_moment(start))
    print(export_run(open_run(run_folder), format_name, out, options))
    return 0


def _moment(text: str | None) -> datetime | None:
    from velfield.errors import InputError

    try:
        return None if text is None else datetime.fromisoformat(text)
    except ValueError:
        raise InputError(f"--start {text}: expected a time as 2024-05-01T12:00:00Z") from None
