"""SUMO floating car data: the position of each vehicle at each time, for SUMO's tools."""

from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import pandas as pd

from schemas.export import ExportOptions
from velfield.exports.georeference import Georeference
from velfield.exports.tracks.points import track_points
from velfield.run.frame_transforms import heading_deg
from velfield.run.run import Run

FILE_NAME = "tracks.fcd.xml"


def encode(run: Run, _path: Path, _options: ExportOptions) -> bytes:
    """See `velfield.exports.export.ExportModule`."""
    return sumo_fcd(run.with_source_ids(run.tracklets()), Georeference.from_grid(run.grid)).encode()


def sumo_fcd(tracklets: pd.DataFrame, georeference: Georeference) -> str:
    """Tracks as SUMO's FCD XML.

    Parameters
    ----------
    tracklets
        Columns of `schemas.tables.TRACKLET_COLUMNS`.
    georeference
        Its ground sample distance is needed: SUMO works in metres. x to the right of the map and y up, from its lower
        left corner, as in the exported network.

    Returns
    -------
    XML text. ``time`` in s from the first tracked frame, ``speed`` m/s, ``angle`` degrees clockwise from +y: SUMO has
    one frame for both, so that it is from the map's top wherever north is. Positions are of the vehicle's centre.

    Raises
    ------
    InputError
        The ground sample distance is unknown.
    """
    points = track_points(tracklets).sort_values(["time_s", "track_id"], kind="stable")
    xy = points[["x_px", "y_px"]].to_numpy(np.float64)
    velocity = points[["vx_px_per_s", "vy_px_per_s"]].to_numpy(np.float64)
    metres = georeference.to_metres(xy)
    angle = heading_deg(np.arctan2(velocity[:, 1], velocity[:, 0]), None)
    speed = np.linalg.norm(velocity, axis=1) * (georeference.gsd_m or np.nan)
    start_s = points["time_s"].min() if len(points) else 0.0
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', "<fcd-export>"]
    numbers = points["track_id"].to_numpy()
    for time_s, rows in points.reset_index(drop=True).groupby("time_s", sort=True).indices.items():
        lines.append(f'    <timestep time="{float(str(time_s)) - start_s:.3f}">')
        for k in rows:
            lines.append(
                f'        <vehicle id={quoteattr(str(numbers[k]))} x="{metres[k, 0]:.2f}" y="{metres[k, 1]:.2f}" '
                f'angle="{angle[k]:.2f}" type="car" speed="{speed[k]:.2f}"/>'
            )
        lines.append("    </timestep>")
    return "\n".join([*lines, "</fcd-export>", ""])
