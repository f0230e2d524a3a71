"""Tracks of vehicles: connected components of tracklets that share detections.

Gap closing: tracks that a missed detection interrupted are reconnected.

A detector misses a car now and then, and its track ends there; without gap closing a flight counts each vehicle about
four times, and those in a queue more often. Both sides of a gap give a position and a velocity. Under a constant
acceleration between them the displacement is the mean of the two velocities times the gap, whatever the acceleration,
so the start of the later track is predicted to better than a metre for gaps of a second or two. A stationary vehicle is
predicted where it was, however long the gap.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from schemas.arrays import FloatArray, IntArray
from schemas.flight import PAPER_GSD_M, STATIONARY_SPEED_M_PER_S


def assign_tracks(detection_ids: IntArray) -> IntArray:
    """The track of each tracklet: the smallest detection id of its connected component.

    Parameters
    ----------
    detection_ids
        (n, 3) ids of each tracklet's detections. Tracklets that share a detection belong to one track.

    Returns
    -------
    (n,) int64

    Examples
    --------
    >>> assign_tracks(np.array([[1, 12, 23], [12, 23, 34], [2, 13, 24]])).tolist()
    [1, 1, 2]
    """
    if not detection_ids.size:
        return np.zeros(0, np.int64)
    ids, flat = np.unique(detection_ids, return_inverse=True)
    node = flat.reshape(detection_ids.shape)
    edges = np.concatenate([node[:, :2], node[:, 1:]])
    return component_minimum(ids, edges)[node[:, 0]]


def component_minimum(ids: IntArray, edges: IntArray) -> IntArray:
    """The smallest of ids (n,) in each one's connected component; edges (m, 2) are pairs of their indices."""
    count = len(ids)
    graph = coo_array((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    smallest = np.full(count, np.iinfo(np.int64).max)
    np.minimum.at(smallest, label, ids)
    return np.asarray(smallest[label], dtype=np.int64)


_SLACK_M = 1.5
"""Tolerance of the prediction for a gap of no length: detections are not always at the same point of a car."""
_ACCELERATION_CHANGE_M_PER_S2 = 4.0
"""Change of acceleration within a gap, as from hard braking to none. Over dt it displaces a vehicle by dt^2 / 8 times
this."""
_MAX_OFFSET_M = 2.2
"""Upper bound of the tolerance: half a car, so that a queue's next vehicle is not taken for it."""

_GAP_PENALTY_PER_S = 0.5
"""A gap longer by a second ranks as an offset larger by half the tolerance."""
_STATIONARY_OFFSET_M = 1.0
"""Tolerance for a vehicle that is stationary on both sides of the gap; another one would arrive moving."""


@dataclass(frozen=True)
class _TrackEnds:
    """One end of each track: time (n,) s, position (n, 2) m, velocity (n, 2) m/s."""

    time_s: FloatArray
    position_m: FloatArray
    velocity_m_per_s: FloatArray

    @property
    def speed_m_per_s(self) -> FloatArray:
        return np.asarray(np.hypot(self.velocity_m_per_s[:, 0], self.velocity_m_per_s[:, 1]))


@dataclass(frozen=True)
class GapLimits:
    """Longest gaps that are closed, s; a vehicle slower than ``stationary_speed_m_per_s`` on both sides is
    stationary."""

    moving_s: float
    stationary_s: float = 0.0
    stationary_speed_m_per_s: float = STATIONARY_SPEED_M_PER_S


END_COLUMNS = [
    *("time_0_s", "x_0_px", "y_0_px", "vx_01_px_per_s", "vy_01_px_per_s"),
    *("time_2_s", "x_2_px", "y_2_px", "vx_12_px_per_s", "vy_12_px_per_s"),
]
"""Columns of tracklets that `reconnect_tracks` reads."""


def reconnect_tracks(tracklets: pd.DataFrame, tracks: IntArray, gaps: GapLimits, *, gsd_m: float | None) -> IntArray:
    """The track of each tracklet, tracks that continue each other over a gap being one.

    A greedy one-to-one assignment of track ends to track starts, the smallest offset from the prediction first.

    Parameters
    ----------
    tracklets
        `END_COLUMNS`.
    tracks
        (n,) track of each tracklet, by `velfield.tracking.tracks.assign_tracks`.
    gaps
        The longest gaps; 0 leaves the tracks as they are.
    gsd_m
        Metres a base pixel; None: the paper's.

    Returns
    -------
    (n,) int64: the smallest of the ids of the tracks that were reconnected.
    """
    ids, track = np.unique(tracks, return_inverse=True)
    metres = PAPER_GSD_M if gsd_m is None else gsd_m
    order = np.lexsort((tracklets["time_0_s"].to_numpy(), track))
    first = order[np.searchsorted(track[order], np.arange(len(ids)))]
    order = np.lexsort((tracklets["time_2_s"].to_numpy(), track))
    last = order[np.searchsorted(track[order], np.arange(len(ids)), side="right") - 1]
    starts = _ends(tracklets.iloc[first], "0", "01", metres)
    ends = _ends(tracklets.iloc[last], "2", "12", metres)
    end_used, start_used = np.zeros(len(ids), bool), np.zeros(len(ids), bool)
    closed: list[IntArray] = []
    for pair in _candidates(ends, starts, gaps):
        end, start = pair
        if not end_used[end] and not start_used[start]:
            end_used[end] = start_used[start] = True
            closed.append(pair)
    return component_minimum(ids, np.array(closed, np.int64).reshape(-1, 2))[track]


def _ends(rows: pd.DataFrame, detection: str, link: str, metres: float) -> _TrackEnds:
    return _TrackEnds(
        rows[f"time_{detection}_s"].to_numpy(np.float64),
        rows[[f"x_{detection}_px", f"y_{detection}_px"]].to_numpy(np.float64) * metres,
        rows[[f"vx_{link}_px_per_s", f"vy_{link}_px_per_s"]].to_numpy(np.float64) * metres,
    )


def _candidates(ends: _TrackEnds, starts: _TrackEnds, gaps: GapLimits) -> IntArray:
    """(m, 2) ends and starts within the tolerance, the smallest offset first."""
    order = np.argsort(starts.time_s, kind="stable")
    times = starts.time_s[order]
    start_stationary = starts.speed_m_per_s < gaps.stationary_speed_m_per_s
    end_stationary = ends.speed_m_per_s < gaps.stationary_speed_m_per_s
    longest = np.where(end_stationary, max(gaps.moving_s, gaps.stationary_s), gaps.moving_s)
    low = np.searchsorted(times, ends.time_s, side="right")
    high = np.searchsorted(times, ends.time_s + longest, side="right")
    found = []
    for end in np.flatnonzero(high > low):
        start = order[low[end] : high[end]]
        gap = starts.time_s[start] - ends.time_s[end]
        displacement = starts.position_m[start] - ends.position_m[end]
        mean = (ends.velocity_m_per_s[end] + starts.velocity_m_per_s[start]) / 2
        offset = np.hypot(*(displacement - mean * gap[:, None]).T)
        relative = offset / np.minimum(_SLACK_M + _ACCELERATION_CHANGE_M_PER_S2 * gap**2 / 8, _MAX_OFFSET_M)
        relative[gap > gaps.moving_s] = np.inf
        if end_stationary[end]:
            both = start_stationary[start] & (gap <= gaps.stationary_s)
            stays = np.minimum(relative, np.hypot(*displacement.T) / _STATIONARY_OFFSET_M)
            relative = np.where(both, stays, relative)
        within = relative <= 1
        # Of two of equal offset, the earlier.
        rank = relative[within] + _GAP_PENALTY_PER_S * gap[within]
        found.append(np.stack([rank, np.full(within.sum(), end), start[within]], axis=1))
    table = np.concatenate(found) if found else np.empty((0, 3))
    pairs = table[:, 1:].astype(np.int64)
    return np.asarray(pairs[np.lexsort((pairs[:, 1], pairs[:, 0], table[:, 0]))], np.int64)
