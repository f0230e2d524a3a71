"""``velfield export``: a finished run in a format of other programs."""

from datetime import datetime
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from flows.options import RunFolder
from schemas.export import EXPORT_FORMATS, ExportFormat, ExportOptions, SpeedUnit

_FORMATS_HELP = "; ".join(f"`{name}`: {content}" for name, content in EXPORT_FORMATS.items()) + "."


def export(
    run_folder: RunFolder,
    /,
    *,
    format_name: Annotated[ExportFormat, Parameter(name="--format", help=_FORMATS_HELP)],
    out: Path | None = None,
    width: int | None = None,
    unit: SpeedUnit = "km/h",
    start: str | None = None,
) -> int:
    """Write a finished run in a format of other programs.

    Parameters
    ----------
    format_name
        One of `schemas.export.EXPORT_FORMATS`.
    out
        File to write. Default: in the run folder's `exports/`.
    width
        Width of the map in a figure or video, px. Default: that of the base image; a video has at most 1920.
    unit
        Unit of speed in a figure.
    start
        Start time of the flight, such as 2024-05-01T12:00:00Z; for `stac` and `poster`.
    """
    from flows.console import Console
    from velfield.exports.export import export_run
    from velfield.run.run import open_run

    options = ExportOptions(width_px=width, unit=unit, start=_parse_time(start))
    run, console = open_run(run_folder), Console("normal")
    with console.stage("export", format_name, 1) as bar:
        written = export_run(run, format_name, out, options, bar.set_progress)
    print(written)
    return 0


def _parse_time(text: str | None) -> datetime | None:
    from velfield.errors import InputError

    try:
        return None if text is None else datetime.fromisoformat(text)
    except ValueError:
        raise InputError(f"--start {text}: not a time; write it as 2024-05-01T12:00:00Z") from None
