"""The formats that a finished run is exported in, and what some of them ask for."""

from datetime import datetime
from typing import Literal, TypeAlias

from pydantic import Field

from schemas.model import Model

EXPORT_FORMATS: dict[str, str] = {
    "cog": "the field's layers as GeoTIFF",
    "geoparquet": "tracklets as lines, as Parquet",
    "gpkg": "tracklets as lines, as GeoPackage",
    "geotrax": "tracks as CSV",
    "sumo": "tracks as FCD XML",
    "arrows": "modal velocities as GeoJSON",
    "stac": "a catalogue's item",
    "direction": "the map of directions as PNG",
    "speed": "the map of speeds as PNG",
    "report": "the summary as one HTML file, to send by mail",
    "sumo_network": "SUMO's network, routes and measured edge data, as ZIP",
    "opendrive": "the lanes as OpenDRIVE",
    "highd": "trajectories as CSV in highD's columns",
    "trajectories": "trajectories as Parquet, or as CSV with `--out FILE.csv`",
    "turning_counts": "turning counts by 15 minutes as Excel workbook, with peak-hour factor",
    "utdf": "volumes, lanes and phases of the junctions as Synchro's UTDF",
    "signal_events": "greens, reds and stop-line detectors as a controller's event log (Indiana enumerations), as ZIP",
    "ssam": "trajectories as SSAM's .trj, for its conflict analysis",
    "moving_features": "trajectories as OGC Moving Features JSON",
    "video": "the stabilised clip with vehicles, speeds and the field, as MP4",
    "poster": "both maps on a sheet with legend, scale, north, n and date, as PDF or SVG",
}
"""Format -> what it holds, for the command's help; each is a module of the same name, in a package of
`velfield.exports`."""
ExportFormat: TypeAlias = Literal[tuple(EXPORT_FORMATS)]  # type: ignore[valid-type]
SpeedUnit = Literal["km/h", "mph", "m/s", "px/s"]
PER_M_PER_S: dict[SpeedUnit, float] = {"km/h": 3.6, "mph": 2.2369362920544, "m/s": 1.0}
"""What a speed of 1 m/s is in each metric unit."""


class ExportOptions(Model):
    """Options of some formats."""

    width_px: int | None = Field(default=None, gt=0)
    """Width of a figure's or a video's map; None: one pixel a base pixel, of a video at most 1920."""
    unit: SpeedUnit = "km/h"
    """Unit of speed in a figure."""
    start: datetime | None = None
    """When the flight began, with its time zone: a STAC item needs it and a poster shows it; few videos record it."""
