"""Tracks of the vehicles for other programs: one row a vehicle and frame."""

from collections.abc import Iterable

import pandas as pd

from velfield.run.run import Run

_MOST_ID = 2**31


def whole_ids(run: Run, track_id: Iterable[int]) -> dict[int, int]:
    """Ids by ``track_id`` for formats that have whole numbers alone: those of the user's file, else 1, 2, ..., in the
    order of the tracks, where it has none or others than whole numbers."""
    tracks, own = sorted({int(k) for k in track_id}), run.source_ids or {}
    ids = [own.get(k) for k in tracks]
    whole = {k: one for k, one in zip(tracks, ids, strict=True) if isinstance(one, int) and 0 <= one < _MOST_ID}
    return whole if len(whole) == len(tracks) else {k: number for number, k in enumerate(tracks, 1)}


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
