"""Tracks of the vehicles for other programs: one row a vehicle and frame."""

import pandas as pd


def track_points(tracklets: pd.DataFrame) -> pd.DataFrame:
    """Detections of each track, each once, with the velocity of the tracklet parts that meet there.

    Parameters
    ----------
    tracklets
        Columns of `schemas.tables.TRACKLET_COLUMNS`.

    Returns
    -------
    DataFrame ``track_id, detection_id, frame, time_s, x_px, y_px, vx_px_per_s, vy_px_per_s``, by track and time.
    """
    parts = [_ends(tracklets, end, segment) for end, segment in ((0, "01"), (1, "01"), (1, "12"), (2, "12"))]
    rows = pd.concat(parts, ignore_index=True)
    velocities = ["vx_px_per_s", "vy_px_per_s"]
    keys = ["track_id", "detection_id"]
    mean = rows.groupby(keys, sort=False)[velocities].mean()
    once = rows.drop(columns=velocities).drop_duplicates(keys).join(mean, on=keys)
    return once.sort_values(["track_id", "time_s", "detection_id"], ignore_index=True)


def _ends(tracklets: pd.DataFrame, end: int, segment: str) -> pd.DataFrame:
    names = {
        "track_id": "track_id",
        f"detection_id_{end}": "detection_id",
        f"frame_{end}": "frame",
        f"time_{end}_s": "time_s",
        f"x_{end}_px": "x_px",
        f"y_{end}_px": "y_px",
        f"vx_{segment}_px_per_s": "vx_px_per_s",
        f"vy_{segment}_px_per_s": "vy_px_per_s",
    }
    return tracklets[list(names)].rename(columns=names)
