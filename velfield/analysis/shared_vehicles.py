"""Vehicles that two cameras saw at the same time: their tracks run side by side on the map."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from schemas.arrays import FloatArray, IntArray

_STEP_S = 0.1
"""Tracks are compared at multiples of this."""
MAX_OFFSET_S = 3.0
"""Two cameras' clocks may differ by so much."""
_MAX_DISTANCE_M = 1.6
"""Half a lane: a vehicle on the next one is another."""
_MIN_STEPS, _MIN_AGREEMENT = 4, 0.7
"""Steps that both tracks cover; fraction of them at which they are one vehicle's."""
_MOVES_M = 5.0
_TRACKS_OF_THE_OFFSET = 300
"""Number of moving tracks, evenly spread, by which the offset of the clocks is estimated."""
_NEARLY_AS_MANY = 0.9
"""The smallest offset at which so large a part of the most tracks agree is used."""


@dataclass(frozen=True)
class SharedVehicles:
    """Pairs of tracks of one vehicle."""

    tracks: IntArray
    """(n, 2) ids: of the first run, of the second."""
    offset_s: float
    """What the second run's clock is ahead of the first one's, s; 0 where no moving vehicles determine it."""

    @property
    def count(self) -> int:
        """Vehicles that both saw; one whose track is in two parts is one."""
        return min((len(np.unique(self.tracks[:, k])) for k in (0, 1)), default=0)


@dataclass(frozen=True)
class _Steps:
    """Positions of tracks at multiples of `_STEP_S`, (n,) each."""

    track: IntArray
    step: IntArray
    x: FloatArray
    y: FloatArray

    def only(self, tracks: IntArray) -> "_Steps":
        kept = np.isin(self.track, tracks)
        return _Steps(self.track[kept], self.step[kept], self.x[kept], self.y[kept])

    def moving(self, least_px: float) -> IntArray:
        """Ids of the tracks that cover a distance."""
        table = pd.DataFrame({"track": self.track, "x": self.x, "y": self.y}).groupby("track")
        extent = table.max() - table.min()
        return np.asarray(extent.index[np.hypot(extent["x"], extent["y"]) >= least_px], np.int64)


def find_shared_vehicles(first: pd.DataFrame, second: pd.DataFrame, *, gsd_m: float) -> SharedVehicles:
    """The vehicles that two runs on one base image saw at the same time.

    Parameters
    ----------
    first, second
        Positions of tracks on one base image and one clock: track_id, time_s, x_px, y_px.
    gsd_m
        Metres a pixel.
    """
    a, b = _at_steps(first), _at_steps(second)
    reach = _MAX_DISTANCE_M / gsd_m
    offset = _find_offset(a, b, reach=reach, least_px=_MOVES_M / gsd_m)
    return SharedVehicles(_pairs(a, b, offset, reach), round(offset * _STEP_S, 3))


def _at_steps(table: pd.DataFrame) -> _Steps:
    parts: list[tuple[IntArray, IntArray, FloatArray, FloatArray]] = []
    ordered = table.sort_values("time_s")
    for number, rows in ordered.groupby(ordered["track_id"].to_numpy(np.int64)):
        time_s = rows["time_s"].to_numpy() / _STEP_S
        step = np.arange(np.ceil(time_s[0]), np.floor(time_s[-1]) + 1).astype(np.int64)
        x, y = (np.interp(step, time_s, rows[name].to_numpy()) for name in ("x_px", "y_px"))
        parts.append((np.full(len(step), number, np.int64), step, x, y))
    if not parts:
        return _Steps(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
    tracks, steps, xs, ys = zip(*parts, strict=True)
    return _Steps(np.concatenate(tracks), np.concatenate(steps), np.concatenate(xs), np.concatenate(ys))


def _find_offset(a: _Steps, b: _Steps, *, reach: float, least_px: float) -> int:
    """Steps that the second clock is ahead of the first: at which most moving tracks agree; the smallest of such."""
    moving = a.moving(least_px)
    sample = moving[:: max(len(moving) // _TRACKS_OF_THE_OFFSET, 1)]
    a, b = a.only(sample), b.only(b.moving(least_px))
    limit = round(MAX_OFFSET_S / _STEP_S)
    offsets = sorted(range(-limit, limit + 1), key=abs)
    agreeing = np.array([len(_pairs(a, b, offset, reach)) for offset in offsets])
    if not agreeing.any():
        return 0
    good = np.flatnonzero(agreeing >= _NEARLY_AS_MANY * agreeing.max())
    return offsets[int(good[0])]


def _pairs(a: _Steps, b: _Steps, offset: int, reach: float) -> IntArray:
    """Pairs of tracks (n, 2) that are within reach of each other at most of the steps that both cover."""
    if not len(a.track) or not len(b.track):
        return np.zeros((0, 2), np.int64)
    # Steps lie further apart than the reach, so that only positions of one time are neighbours.
    points = [
        np.column_stack([side.x / reach, side.y / reach, 2.0 * (side.step - shift)])
        for side, shift in ((a, 0), (b, offset))
    ]
    _, nearest = cKDTree(points[1]).query(points[0], distance_upper_bound=1.0)
    nearest = np.asarray(nearest)
    found = nearest < len(b.track)
    pairs = pd.DataFrame({"a": a.track[found], "b": b.track[nearest[found]]}).groupby(["a", "b"]).size()
    spans = [pd.DataFrame({"track": side.track, "step": side.step}).groupby("track")["step"] for side in (a, b)]
    (start_a, end_a), (start_b, end_b) = ((span.min(), span.max()) for span in spans)
    ids_a, ids_b = (pairs.index.get_level_values(name) for name in ("a", "b"))
    end = np.minimum(end_a[ids_a].to_numpy(), end_b[ids_b].to_numpy() - offset)
    start = np.maximum(start_a[ids_a].to_numpy(), start_b[ids_b].to_numpy() - offset)
    common = end - start + 1
    good = (common >= _MIN_STEPS) & (pairs.to_numpy() >= _MIN_AGREEMENT * common)
    return np.column_stack([ids_a[good], ids_b[good]]).astype(np.int64)
