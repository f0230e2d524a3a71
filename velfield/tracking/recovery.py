"""Detections guided by tracks: what a track confirms where the detector alone was not sure enough.

A vehicle in shade, or half under a tree, is often detected at a score below the threshold, or too seldom for a tracklet
of three frames in a row. Where a track predicts a vehicle, such a candidate is enough evidence (ByteTrack, Zhang and
others 2022). Ends and starts of tracks are extended from frame to frame; a gap between two parts of one track is filled
where candidates lie on the way between them.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from schemas.arrays import FloatArray, IntArray, Mask
from velfield.tracking.join_costs import GapLimits, TrackEnds
from velfield.tracking.joins import EndContext, close_gaps, component_minimum

_MAX_MISSED_S = 0.75
"""An end is not extended any more when so long nothing was found."""
_ALONG_M, _ACROSS_M, _ACCELERATION_M_PER_S2, _ACROSS_M_PER_S = 0.9, 0.8, 4.0, 0.5
"""How far from the prediction a candidate may lie along the way and across it, at once and growing with time."""
_MAX_AXIS_RAD, _AXIS_FROM_M_PER_S = np.radians(30), 2.0
"""How far its axis may differ from the way, of a vehicle faster than this."""
_POSITION_GAIN, _VELOCITY_GAIN = 0.7, 0.2
"""Gains of the offset between candidate and prediction: a detection's position is accurate to a pixel only."""
_FILL_M, _FILL_M_PER_S, _MAX_FILL_M = 0.8, 0.5, 1.6
"""How far a candidate may lie from the way across a gap, at once and growing with the time to what is known."""
_ROOM_M = 1e-3
"""More than roundings."""


@dataclass(frozen=True)
class Candidates:
    """Detections that are in no tracklet, and weak ones, by frame.

    Attributes
    ----------
    detection_id, frame, time_s, axis_rad
        (n,) each, sorted by frame.
    position_m
        (n, 2).
    """

    detection_id: IntArray
    frame: IntArray
    time_s: FloatArray
    position_m: FloatArray
    axis_rad: FloatArray

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True)
class Recovered:
    """Tracks after gap closing, extension and filling."""

    tracks: IntArray
    """(chains,) int64 the track that each chain of tracklets is part of."""
    joins: pd.DataFrame
    """As of `velfield.tracking.joins.ClosedGaps`."""
    track_id: IntArray
    candidate: IntArray
    """(k,) each: candidates that belong to tracks."""
    gaps: list["Gap"]
    """Gaps of the joins, with the candidates in them: positions of vehicles while nothing was detected."""


def recover_tracks(
    ids: IntArray, ends: TrackEnds, starts: TrackEnds, limits: GapLimits, context: EndContext, candidates: Candidates
) -> Recovered:
    """Close gaps; extend what is left open, and close gaps again; fill the gaps.

    Parameters
    ----------
    ids
        (chains,) ascending ids of the chains of tracklets.
    ends, starts
        Last and first positions of each chain.
    """
    free = np.ones(len(candidates), bool)
    first = close_gaps(ids, ends, starts, limits, context)
    open_end, open_start = ~np.isin(ids, first.joins["before"]), ~np.isin(ids, first.joins["after"])
    moving = [np.hypot(*one.velocity_m_per_s.T) > limits.stationary_speed_m_per_s for one in (ends, starts)]
    which_ends, which_starts = np.flatnonzero(open_end & moving[0]), np.flatnonzero(open_start & moving[1])
    onward, found_onward, ends = extend_tracks(ends, which_ends, candidates, free, forward=True)
    back, found_back, starts = extend_tracks(starts, which_starts, candidates, free, forward=False)
    second = close_gaps(ids, ends, starts, limits, context, open_end=open_end, open_start=open_start)
    joins = pd.concat([first.joins, second.joins], ignore_index=True)
    before, after = (np.searchsorted(ids, joins[name].to_numpy(np.int64)) for name in ("before", "after"))
    tracks = component_minimum(ids, np.column_stack([before, after]))
    gaps = []
    for end, start in zip(before.tolist(), after.tolist(), strict=True):
        gap = Gap(
            int(tracks[end]),
            (float(ends.time_s[end]), float(starts.time_s[start])),
            (ends.position_m[end], starts.position_m[start]),
            (ends.velocity_m_per_s[end], starts.velocity_m_per_s[start]),
        )
        gaps.append(replace(gap, filled=fill_gap(gap, candidates, free)))
    joins = joins.assign(track_id=tracks[before], end_time_s=ends.time_s[before], start_time_s=starts.time_s[after])
    chain = np.concatenate([onward, back])
    filled = [np.full(len(gap.filled), gap.track_id) for gap in gaps]
    return Recovered(
        tracks,
        joins.sort_values(["end_time_s", "before"], ignore_index=True),
        np.concatenate([tracks[chain], *filled]).astype(np.int64),
        np.concatenate([found_onward, found_back, *(gap.filled for gap in gaps)]).astype(np.int64),
        gaps,
    )


def extend_tracks(
    ends: TrackEnds, which: IntArray, candidates: Candidates, free: Mask, *, forward: bool
) -> tuple[IntArray, IntArray, TrackEnds]:
    """Extend the ends of tracks forward, or their starts backward, from frame to frame.

    Parameters
    ----------
    ends
        Ends, or starts, of all tracks; velocities are forward in time either way.
    which
        Indices of the tracks to extend.
    free
        (candidates,) whether each may be used; those that are used are cleared.

    Returns
    -------
    (k,), (k,), TrackEnds
        Tracks and the candidates that extend them, by their indices, and the ends (or starts) that result.
    """
    sign = 1 if forward else -1
    time, place, velocity = ends.time_s.copy(), ends.position_m.copy(), ends.velocity_m_per_s.copy()
    frame = ends.frame.copy()
    bounds = np.flatnonzero(np.diff(candidates.frame)) + 1
    groups = [group for group in np.split(np.arange(len(candidates)), bounds) if len(group)]
    order = which[np.argsort(sign * ends.time_s[which], kind="stable")]  # a track is active from its end on
    active, position = np.empty(0, np.int64), 0
    tracks, taken = [], []
    for group in groups if forward else groups[::-1]:
        now, number = candidates.time_s[group[0]], candidates.frame[group[0]]
        until = position
        while until < len(order) and sign * frame[order[until]] < sign * number:
            until += 1
        active = np.concatenate([active, order[position:until]])
        position = until
        active = active[sign * (now - time[active]) <= _MAX_MISSED_S]
        rows = group[free[group]]
        if not len(active) or not len(rows):
            continue
        mine, found = _match(time[active], place[active], velocity[active], candidates, rows, now)
        mine = active[mine]
        step = (now - time[mine])[:, None]
        predicted = place[mine] + velocity[mine] * step
        offset = candidates.position_m[found] - predicted
        velocity[mine] += _VELOCITY_GAIN * offset / step
        time[mine], place[mine], frame[mine] = now, predicted + _POSITION_GAIN * offset, number
        free[found] = False
        tracks.append(mine)
        taken.append(found)
    nothing = [np.empty(0, np.int64)]
    result = replace(ends, time_s=time, position_m=place, velocity_m_per_s=velocity, frame=frame)
    return np.concatenate(nothing + tracks), np.concatenate(nothing + taken), result


def _match(
    time: FloatArray, place: FloatArray, velocity: FloatArray, candidates: Candidates, rows: IntArray, now: float
) -> tuple[IntArray, IntArray]:
    """Tracks and the candidates that are each other's nearest, in units of the tolerance."""
    dt = np.abs(now - time)
    predicted = place + velocity * (now - time)[:, None]
    speed = np.hypot(*velocity.T)
    reach = _ALONG_M + _ACCELERATION_M_PER_S2 * dt.max() ** 2 / 2
    near = cKDTree(candidates.position_m[rows]).query_ball_point(predicted, reach)
    track = np.repeat(np.arange(len(near)), [len(one) for one in near])
    column = np.array([k for one in near for k in sorted(one)], np.int64)
    candidate = rows[column]
    offset = candidates.position_m[candidate] - predicted[track]
    direction = velocity[track] / np.maximum(speed[track], 1e-9)[:, None]
    along = np.abs(np.sum(offset * direction, axis=1))
    across = np.sqrt(np.maximum(np.sum(offset**2, axis=1) - along**2, 0))
    cost = np.hypot(
        along / (_ALONG_M + _ACCELERATION_M_PER_S2 * dt[track] ** 2 / 2),
        across / (_ACROSS_M + _ACROSS_M_PER_S * dt[track]),
    )
    heading = np.arctan2(*velocity[track].T[::-1])
    turn = candidates.axis_rad[candidate] - heading
    turned = np.abs(np.mod(turn + np.pi / 2, np.pi) - np.pi / 2) > _MAX_AXIS_RAD  # axes have no front
    possible = np.flatnonzero((cost <= 1) & ~(turned & (speed[track] > _AXIS_FROM_M_PER_S)))
    possible = possible[np.lexsort((candidate[possible], track[possible], cost[possible]))]
    first_of_track = np.unique(track[possible], return_index=True)[1]
    first_of_candidate = np.unique(candidate[possible], return_index=True)[1]
    both = possible[np.intersect1d(first_of_track, first_of_candidate)]
    return track[both], candidate[both]


@dataclass(frozen=True)
class Gap:
    """A gap of one track: both sides of it as times, positions (2,) and velocities (2,); the candidates in it, (k,)."""

    track_id: int
    time_s: tuple[float, float]
    position_m: tuple[FloatArray, FloatArray]
    velocity_m_per_s: tuple[FloatArray, FloatArray]
    filled: IntArray = field(default_factory=lambda: np.empty(0, np.int64))

    def at(self, time_s: FloatArray) -> FloatArray:
        """Positions (n, 2) by Hermite's cubic: the velocities of both sides are met."""
        (p0, p1), (v0, v1), span = self.position_m, self._velocities(), self.time_s[1] - self.time_s[0]
        u = ((time_s - self.time_s[0]) / span)[:, None]
        return np.asarray(
            (1 + 2 * u) * (1 - u) ** 2 * p0
            + u * (1 - u) ** 2 * span * v0
            + u**2 * (3 - 2 * u) * p1
            + u**2 * (u - 1) * span * v1
        )

    def box(self) -> tuple[FloatArray, FloatArray]:
        """The least and the greatest coordinates (2,) that `at` may give within the gap."""
        (p0, p1), (v0, v1), span = self.position_m, self._velocities(), self.time_s[1] - self.time_s[0]
        points = np.stack([p0, p0 + span / 3 * v0, p1 - span / 3 * v1, p1])
        return points.min(axis=0), points.max(axis=0)

    def _velocities(self) -> tuple[FloatArray, FloatArray]:
        """Velocities of both sides, limited so that the cubic does not overshoot if the mean speed within is low."""
        (p0, p1), span = self.position_m, self.time_s[1] - self.time_s[0]
        mean = np.hypot(*(p1 - p0)) / span
        v0, v1 = (v * min(1.0, 3 * mean / max(float(np.hypot(*v)), 1e-9)) for v in self.velocity_m_per_s)
        return v0, v1


def interpolate_gap(gap: Gap, candidates: Candidates, time_s: FloatArray) -> FloatArray:
    """Positions (n, 2) m in a gap at times (n,): on the way across it, through the candidates in it."""
    known = candidates.time_s[gap.filled]
    offset = candidates.position_m[gap.filled] - gap.at(known)
    anchors = np.concatenate([[gap.time_s[0]], known, [gap.time_s[1]]])
    offsets = np.concatenate([np.zeros((1, 2)), offset, np.zeros((1, 2))])
    correction = np.column_stack([np.interp(time_s, anchors, offsets[:, k]) for k in (0, 1)])
    return np.asarray(gap.at(time_s) + correction)


def fill_gap(gap: Gap, candidates: Candidates, free: Mask) -> IntArray:
    """Candidates on the way across a gap, one a frame at most; they are cleared in ``free``."""
    low, high = np.searchsorted(candidates.time_s, gap.time_s, side="right")
    rows = np.arange(low, high)
    rows = rows[free[low:high] & (candidates.time_s[low:high] < gap.time_s[1])]
    # Most are far from it: the way, a Bezier curve, is within the box of its control points.
    least, most = gap.box()
    place = candidates.position_m[rows]
    inside = (place >= least - _MAX_FILL_M - _ROOM_M) & (place <= most + _MAX_FILL_M + _ROOM_M)
    rows = rows[inside[:, 0] & inside[:, 1]]
    if not len(rows):
        return rows
    time = candidates.time_s[rows]
    offset = np.hypot(*(candidates.position_m[rows] - gap.at(time)).T)
    known = np.minimum(time - gap.time_s[0], gap.time_s[1] - time)
    allowed = np.minimum(_FILL_M + _FILL_M_PER_S * known, _MAX_FILL_M)
    rows, offset = rows[offset <= allowed], offset[offset <= allowed]
    order = np.lexsort((offset, candidates.frame[rows]))
    best = order[np.unique(candidates.frame[rows[order]], return_index=True)[1]]
    free[rows[best]] = False
    return np.asarray(rows[best])
