"""``velfield export``: a finished run in a format that others read."""

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

Format = Literal["cog", "geoparquet", "geotrax", "sumo", "arrows", "report"]


def export(
    run_folder: Path,
    /,
    *,
    format_name: Annotated[Format, Parameter(name="--format")],
    out: Path | None = None,
) -> int:
    """Write a finished run in a format that others read.

    Parameters
    ----------
    run_folder
        The run folder.
    format_name
        `cog`: the field's layers as GeoTIFF; `geoparquet`: tracklets as lines; `geotrax`: tracks as CSV; `sumo`: tracks
        as FCD XML; `arrows`: modal velocities as GeoJSON; `report`: the summary as one HTML file, to send by mail.
    out
        File to write. Default: in the run folder's `exports/`.
    """
    from velfield.exporting import export_run
    from velfield.run import open_run

    print(export_run(open_run(run_folder), format_name, out))
    return 0
