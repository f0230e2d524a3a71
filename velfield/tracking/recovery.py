"""Detections guided by tracks: what a track confirms where the detector alone was not sure enough.

A vehicle in shade, or half under a tree, is often detected at a score below the threshold, or too seldom for a tracklet
of three frames in a row. Where a track predicts a vehicle, such a candidate is enough evidence (ByteTrack, Zhang and
others 2022). Ends and starts of tracks are extended from frame to frame; a gap between two parts of one track is filled
where candidates lie on the way between them.

Tracks of one vehicle beside each other: a vehicle's shadow, or the cab and the load of a lorry, may each have a track.
Two vehicles that drive in one lane keep a distance of more than a vehicle's length; two tracks that keep a shorter one,
and the same one, while they move are one vehicle's, and one of them is a double. Where a vehicle is detected now in one
of its parts, now in the other, each track is inferred while the other is seen: they are joined.
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
_SPACING_M, _SPACING_S, _MAX_SPACING_M = 5.0, 0.25, 8.0
"""From centre to centre, and more with speed: two cars that queue bumper to bumper are 6 m apart, and driving ones keep
a gap of half a second and more."""
_MAX_ASIDE_M = 1.8
"""Across the direction of travel: a vehicle in the next lane is 3 m and more away."""
_ABREAST_M, _BLACK_ABREAST_M, _BLACK = 2.6, 3.2, 0.3
"""Two vehicles are not nearer to each other, side by side either; nor is one, for long, to one that has so small a part
of its grey level, as the shadow of a van in a low sun has."""
_MAX_SPREAD_M = 0.8
"""Standard deviation of the spacing: of detections' positions, not of driving."""
_MIN_SPEED_M_PER_S, _MIN_EXTENT_M = 2.5, 8.0
_MIN_FRAMES, _MIN_SHARE = 4, 0.6
"""Frames that both have, and their share of those of the shorter one."""
_PARTS_M, _SPLIT_SHARE, _MAX_SEEN_SHARE, _MAX_SPLIT_S = 3.5, 0.8, 0.35, 4.0
"""Tracks that were split: maximum distance along the way between the parts of a lorry; minimum fraction of the common
frames in which they are in one place; maximum fraction in which both are seen; and maximum duration for which either
is inferred, as its place is too uncertain beyond it."""
_SEEN = 2
"""Positions whose ``source`` is below this are seen; the others are inferred."""


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
    """Tracks after gap closing, extension and filling.

    Attributes
    ----------
    tracks
        (chains,) int64 the track that each chain of tracklets is part of.
    joins
        As of `velfield.tracking.joins.ClosedGaps`.
    track_id, candidate
        (k,) each: candidates that belong to tracks.
    gaps
        Gaps of the joins, with the candidates in them: positions of vehicles while nothing was detected.
    """

    tracks: IntArray
    joins: pd.DataFrame
    track_id: IntArray
    candidate: IntArray
    gaps: list["Gap"]


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
    forward = extend_tracks(ends, np.flatnonzero(open_end & moving[0]), candidates, free, forward=True)
    backward = extend_tracks(starts, np.flatnonzero(open_start & moving[1]), candidates, free, forward=False)
    ends, starts = forward.ends, backward.ends
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
    chain = np.concatenate([forward.track, backward.track])
    filled = [np.full(len(gap.filled), gap.track_id) for gap in gaps]
    return Recovered(
        tracks,
        joins.sort_values(["end_time_s", "before"], ignore_index=True),
        np.concatenate([tracks[chain], *filled]).astype(np.int64),
        np.concatenate([forward.candidate, backward.candidate, *(gap.filled for gap in gaps)]).astype(np.int64),
        gaps,
    )


@dataclass(frozen=True)
class Extension:
    """Candidates (k,) that extend tracks (k,), by their indices, and the ends (or starts) that result."""

    track: IntArray
    candidate: IntArray
    ends: TrackEnds


def extend_tracks(ends: TrackEnds, which: IntArray, candidates: Candidates, free: Mask, *, forward: bool) -> Extension:
    """Extend the ends of tracks forward, or their starts backward, from frame to frame.

    Parameters
    ----------
    ends
        Ends, or starts, of all tracks; velocities are forward in time either way.
    which
        Indices of the tracks to extend.
    free
        (candidates,) whether each may be used; those that are used are cleared.
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
    return Extension(np.concatenate(nothing + tracks), np.concatenate(nothing + taken), result)


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


def find_doubles(positions: pd.DataFrame, grey: pd.Series, metres: float) -> IntArray:
    """Ids of the tracks that are doubles of another, which is brighter: a shadow is darker than what casts it.

    Parameters
    ----------
    positions
        ``track_id, frame, time_s, x_px, y_px, source`` of every track, inferred ones too.
    grey
        Mean grey level of each track's vehicle, by ``track_id``; of tracks that it lacks nothing is known.
    metres
        A base pixel, m.

    Examples
    --------
    >>> t = np.arange(8) * 0.2
    >>> car = pd.DataFrame({"track_id": 1, "frame": range(8), "time_s": t, "x_px": 50 * t, "y_px": 0.0, "source": 0})
    >>> shadow = car[1:].assign(track_id=2, x_px=50 * t[1:] + 14)
    >>> find_doubles(pd.concat([car, shadow]), pd.Series({1: 140.0, 2: 40.0}), 0.25).tolist()
    [2]
    """
    if not len(positions):
        return np.empty(0, np.int64)
    table = positions.sort_values(["track_id", "frame"], ignore_index=True)
    table = _moving(table, metres)
    pairs = _near_pairs(table, metres)
    if not len(pairs):
        return np.empty(0, np.int64)
    ids, counts = np.unique(table["track_id"].to_numpy(), return_counts=True)
    count, level = dict(zip(ids.tolist(), counts.tolist(), strict=True)), grey.to_dict()
    doubles: set[int] = set()
    part, _, both_seen = _count_seen(pairs)
    for k in np.flatnonzero(both_seen >= _MIN_FRAMES).tolist():
        rows = pairs.part(part[k], part[k + 1])
        darker, brighter = sorted(rows.ids(), key=lambda track: (level.get(track, np.inf), -track))
        black = level.get(darker, np.nan) <= _BLACK * level.get(brighter, np.nan)
        long_enough = len(rows) >= _MIN_SHARE * min(count[darker], count[brighter])
        abreast_m = _BLACK_ABREAST_M if black else _ABREAST_M
        if long_enough and brighter not in doubles and _in_lockstep(rows.both_seen(), abreast_m):
            doubles.add(darker)
    return np.array(sorted(doubles), np.int64)


def find_split_tracks(positions: pd.DataFrame, metres: float) -> pd.Series:
    """Tracks that are parts of one vehicle's: each is inferred while another one is seen in its place.

    Parameters
    ----------
    positions
        ``track_id, frame, time_s, x_px, y_px, source`` of every track, inferred ones too.
    metres
        A base pixel, m.

    Returns
    -------
    The id of the whole, by the id of each part; only of tracks that are parts.

    Examples
    --------
    >>> t = np.arange(12) * 0.2
    >>> seen = np.repeat([0, 2, 0], 4)  # by `source`: four frames seen, four inferred, four seen
    >>> cab = pd.DataFrame({"track_id": 1, "frame": range(12), "time_s": t, "x_px": 50 * t, "y_px": 0.0})
    >>> cab = cab.assign(source=seen)
    >>> load = cab.assign(track_id=2, x_px=50 * t - 6, source=2 - seen)
    >>> find_split_tracks(pd.concat([cab, load]), 0.25).to_dict()
    {1: 1, 2: 1}
    """
    table = _moving(positions.sort_values(["track_id", "frame"], ignore_index=True), metres)
    table = table[_inferred_s(table) <= _MAX_SPLIT_S].reset_index(drop=True)
    pairs = _near_pairs(table, metres)
    part, one_seen, both_seen = _count_seen(pairs)
    possible = (np.diff(part) >= _MIN_FRAMES) & (both_seen <= _MAX_SEEN_SHARE * np.diff(part)) & (one_seen > 0)
    track, frame = table["track_id"].to_numpy(np.int64), table["frame"].to_numpy(np.int64)
    found = []
    for rows in (pairs.part(part[k], part[k + 1]) for k in np.flatnonzero(possible)):
        both = rows.ids()
        first, second = (frame[slice(*np.searchsorted(track, [number, number + 1]))] for number in both)
        if _in_one_place(rows).sum() >= max(_SPLIT_SHARE * len(np.intersect1d(first, second)), _MIN_FRAMES):
            found.append(both)
    if not found:
        return pd.Series(dtype=np.int64)
    ids, edges = np.unique(np.array(found, np.int64), return_inverse=True)
    return pd.Series(component_minimum(ids, edges.reshape(-1, 2)), index=ids)


@dataclass(frozen=True)
class _Pairs:
    """Pairs of tracks that are near in a frame, by track and time.

    Attributes
    ----------
    one, other
        (n,) ids of the tracks.
    time_s
        (n,)
    xy_m, offset_m
        (2, n) position of one, and offset of the other, m: a row is in one piece of memory, so that sums over it are
        accurate.
    seen
        (n,) how many of the two are seen.
    """

    one: IntArray
    other: IntArray
    time_s: FloatArray
    xy_m: FloatArray
    offset_m: FloatArray
    seen: IntArray

    def __len__(self) -> int:
        return len(self.one)

    def part(self, begin: int, end: int) -> "_Pairs":
        """Rows from one to another."""
        rows = slice(begin, end)
        xy_m, offset_m = self.xy_m[:, rows], self.offset_m[:, rows]
        return _Pairs(self.one[rows], self.other[rows], self.time_s[rows], xy_m, offset_m, self.seen[rows])

    def both_seen(self) -> "_Pairs":
        """The rows in which both are seen."""
        rows = np.flatnonzero(self.seen == 2)
        xy_m, offset_m = np.take(self.xy_m, rows, axis=1), np.take(self.offset_m, rows, axis=1)
        return _Pairs(self.one[rows], self.other[rows], self.time_s[rows], xy_m, offset_m, self.seen[rows])

    def ids(self) -> tuple[int, int]:
        """Both tracks, of rows of one pair."""
        return int(self.one[0]), int(self.other[0])


def _count_seen(pairs: _Pairs) -> tuple[IntArray, IntArray, IntArray]:
    """First row of each pair of tracks (k + 1,), and the numbers of rows in which one is seen, and both (k,)."""
    changes = (np.diff(pairs.one) != 0) | (np.diff(pairs.other) != 0)
    begin = np.flatnonzero(np.r_[True, changes][: len(pairs)])
    counts = [np.add.reduceat((pairs.seen == n).astype(np.int64), begin) if len(begin) else begin for n in (1, 2)]
    return np.r_[begin, len(pairs)], counts[0], counts[1]


def _moving(table: pd.DataFrame, metres: float) -> pd.DataFrame:
    """Positions, sorted by track, of the tracks that get somewhere."""
    xy = table.groupby("track_id")[["x_px", "y_px"]]
    extent = np.hypot(*(xy.max() - xy.min()).to_numpy().T) * metres
    moves = extent[np.unique(table["track_id"], return_inverse=True)[1]] >= _MIN_EXTENT_M
    kept: pd.DataFrame = table[moves].reset_index(drop=True)
    return kept


def _inferred_s(table: pd.DataFrame) -> FloatArray:
    """Duration of the inferred part of the track around each position (n,), sorted by track and frame; 0 where seen."""
    seen = table["time_s"].where(table["source"] < _SEEN)
    before, after = seen.groupby(table["track_id"]).ffill(), seen.groupby(table["track_id"]).bfill()
    return np.asarray((after - before).fillna(np.inf), dtype=np.float64)


def _in_one_place(rows: _Pairs) -> FloatArray:
    """Whether a pair is nearer in each row than two vehicles are, along the way and across it."""
    offset, heading, _ = _driven(rows)
    along = (offset * heading).sum(axis=1)
    across = np.hypot(*(offset - along[:, None] * heading).T)
    return np.asarray((np.abs(along) <= _PARTS_M) & (across <= _MAX_ASIDE_M))


def _near_pairs(table: pd.DataFrame, metres: float) -> _Pairs:
    """Pairs of tracks that are near in a frame."""
    xy, track = table[["x_px", "y_px"]].to_numpy(np.float64) * metres, table["track_id"].to_numpy(np.int64)
    found: list[IntArray] = [np.empty((0, 2), np.int64)]
    frame = table["frame"].to_numpy(np.int64)
    order = np.argsort(frame, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(frame[order])) + 1):
        near = cKDTree(xy[rows]).query_pairs(_MAX_SPACING_M + _MAX_SPREAD_M, output_type="ndarray")
        found.append(rows[near])
    pair = np.concatenate(found)
    one, other = np.where(track[pair[:, 0]] > track[pair[:, 1]], pair[:, ::-1].T, pair.T)
    time_s = table["time_s"].to_numpy(np.float64)[one]
    rank = np.lexsort((time_s, track[other], track[one]))
    one, other = one[rank], other[rank]
    seen = (table["source"].to_numpy() < _SEEN).astype(np.int64)
    place, further = (np.take(xy.T, rows, axis=1) for rows in (one, other))
    return _Pairs(track[one], track[other], time_s[rank], place, further - place, seen[one] + seen[other])


def _in_lockstep(rows: _Pairs, abreast_m: float) -> bool:
    """Whether the pair keeps its spacing, in the world as a shadow does, or along the vehicle as a load does.

    To any side up to ``abreast_m``.
    """
    offset, heading, speed = _driven(rows)
    if np.median(speed) < _MIN_SPEED_M_PER_S:
        return False
    along = (offset * heading).sum(axis=1)
    across = heading[:, 0] * offset[:, 1] - heading[:, 1] * offset[:, 0]
    spacing = min(_SPACING_M + _SPACING_S * float(np.median(speed)), _MAX_SPACING_M)
    distance = float(np.hypot(*np.median(offset, axis=0)))
    near = distance <= abreast_m or (distance <= spacing and abs(np.median(across)) <= _MAX_ASIDE_M)
    spread = min(_spread(offset), _spread(np.column_stack([along, across])))
    return bool(near and spread <= _MAX_SPREAD_M)


def _driven(rows: _Pairs) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Offsets (n, 2) m of a pair of tracks, and the first one's headings (n, 2), unit vectors, and speeds (n,) m/s."""
    velocity = np.gradient(rows.xy_m.T, rows.time_s, axis=0)
    speed = np.hypot(*velocity.T)
    return rows.offset_m.T, velocity / np.maximum(speed, 1e-9)[:, None], speed


def _spread(offset: FloatArray) -> float:
    return float(np.sqrt(offset.var(axis=0).sum()))
