"""Trajectories as a table in metres: one row a vehicle and frame, smoothed, with the lane that it is on."""

import numpy as np
import pandas as pd

from velfield.exports.georeference import Georeference
from velfield.exports.tracks.points import whole_ids
from velfield.run.run import Run

_OF_VEHICLES = ["length_m", "width_m", "vehicle_class", "class_probability"]


def trajectory_table(run: Run, *, whole: bool = False) -> pd.DataFrame:
    """Trajectories of the vehicles that move.

    Parameters
    ----------
    whole
        ``track_id`` is a whole number, by `whole_ids`; else as in the user's file, of tracks that were given.

    Returns
    -------
    DataFrame ``track_id, frame, time_s, x_m, y_m, vx_m_per_s, vy_m_per_s, ax_m_per_s2, ay_m_per_s2, speed_m_per_s,
    heading_deg, heading_from, lane, length_m, width_m, vehicle_class, class_probability`` and, with a reference system,
    ``longitude_deg, latitude_deg``; x to the right of the map and y down, from its upper left corner; ``heading_from``
    ``north`` or ``top of the image``; ``lane`` -1 where none was found, dimensions NaN and classes missing of a vehicle
    that was not measured; by track and time.

    Raises
    ------
    InputError
        The ground sample distance is not known.
    """
    gsd_m = run.gsd_m
    paths, samples = run.analysis.trajectories, run.analysis.lanes().samples
    owner, numbers = paths.owner, whole_ids(run, paths.track_id)
    ids = np.array([numbers[k] for k in paths.track_id.tolist()], np.int64) if whole else paths.ids
    acceleration = np.zeros_like(paths.velocity_m_per_s)
    lane = np.full(len(owner), -1, np.int64)
    for number, rows in enumerate(paths):
        if rows.stop - rows.start > 1:
            acceleration[rows] = np.gradient(paths.velocity_m_per_s[rows], paths.time_s[rows], axis=0)
        mine = np.flatnonzero(samples.track == number)
        if len(mine):
            mine = mine[np.argsort(samples.time_s[mine], kind="stable")]
            after = np.searchsorted(samples.time_s[mine], paths.time_s[rows]).clip(0, len(mine) - 1)
            lane[rows] = samples.lane[mine[after]]
    xy_px, velocity = paths.xy_m / gsd_m, paths.velocity_m_per_s
    georeference = Georeference.from_grid(run.grid)
    table = pd.DataFrame(
        {
            "track_id": ids[owner],
            "frame": paths.frame,
            "time_s": paths.time_s,
            "x_m": paths.xy_m[:, 0],
            "y_m": paths.xy_m[:, 1],
            "vx_m_per_s": velocity[:, 0],
            "vy_m_per_s": velocity[:, 1],
            "ax_m_per_s2": acceleration[:, 0],
            "ay_m_per_s2": acceleration[:, 1],
            "speed_m_per_s": paths.speed_m_per_s,
            "heading_deg": georeference.heading_deg(xy_px, velocity),
            "heading_from": georeference.heading_from,
            "lane": lane,
        }
    )
    vehicles = run.vehicles().set_index("track_id").reindex(paths.track_id)[_OF_VEHICLES]
    table[_OF_VEHICLES] = vehicles.iloc[owner].reset_index(drop=True)
    if georeference.has_crs:
        table[["longitude_deg", "latitude_deg"]] = georeference.to_lonlat(xy_px)
    return table
