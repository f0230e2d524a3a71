"""SUMO floating car data: where each vehicle is at each time, for SUMO's own tools."""

from xml.sax.saxutils import quoteattr

import numpy as np
import pandas as pd

from velfield.exports.place import Place
from velfield.exports.tracks import passage_points


def sumo_fcd(tracklets: pd.DataFrame, place: Place, *, vehicle_type: str = "car") -> str:
    """Tracks as SUMO's FCD XML.

    Parameters
    ----------
    tracklets
        Columns of `schemas.tables.TRACKLET_COLUMNS`.
    place
        Its ground sample distance is needed: SUMO works in metres. x east, y north, from the base image's lower left
        corner.
    vehicle_type
        ``type`` of all vehicles.

    Returns
    -------
    XML text. ``time`` in s from the first tracked frame, ``speed`` m/s, ``angle`` degrees clockwise from north;
    from the picture's up, as ``y`` is, where the base image has no reference system and north is not known.

    Raises
    ------
    InputError
        The ground sample distance is not known.
    """
    points = passage_points(tracklets).sort_values(["time_s", "passage_id"], kind="stable")
    xy = points[["x_px", "y_px"]].to_numpy(np.float64)
    velocity = points[["vx_px_per_s", "vy_px_per_s"]].to_numpy(np.float64)
    metres = place.to_metres(xy)
    angle = place.heading_deg(xy, velocity)
    speed = np.linalg.norm(velocity, axis=1) * (place.gsd_m or np.nan)
    start_s = points["time_s"].min() if len(points) else 0.0
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', "<fcd-export>"]
    kind = quoteattr(vehicle_type)
    numbers = points["passage_id"].to_numpy()
    for time_s, places in points.reset_index(drop=True).groupby("time_s", sort=True).indices.items():
        lines.append(f'    <timestep time="{float(str(time_s)) - start_s:.3f}">')
        for k in places:
            lines.append(
                f'        <vehicle id="{numbers[k]}" x="{metres[k, 0]:.2f}" y="{metres[k, 1]:.2f}" '
                f'angle="{angle[k]:.2f}" type={kind} speed="{speed[k]:.2f}"/>'
            )
        lines.append("    </timestep>")
    return "\n".join([*lines, "</fcd-export>", ""])
