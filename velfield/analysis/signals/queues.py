"""Stops and queues on the lanes that lead to a junction."""

from dataclasses import dataclass

import numpy as np

from schemas.arrays import FloatArray, IntArray, Mask
from velfield.analysis.lanes.model import Junction, LaneGraph
from velfield.analysis.trajectories import VEHICLE_LENGTH_M, PathSamples, Trajectories, within
from velfield.tracking.smoothing import speed_sd_m_per_s

STOP_M_PER_S, GO_M_PER_S = 0.7, 1.4
"""A vehicle has stopped below the one, and goes again above the other."""
MIN_STOP_S = 1.5
REACH_M = 120.0
"""Stops so far before a stop line belong to its queue."""
_HIDDEN_MOVE_M = 1.0
"""A vehicle that is seen again so much farther on did not stand where it is seen."""
_SETS_OFF_M_PER_S2 = 2.0
"""Acceleration of a vehicle that sets off."""
_LINE_M = 3.0
"""The first of a queue stops so near to its line at most."""
_AHEAD_M, _AHEAD_S = 20.0, 5.0
"""A vehicle that stood so far ahead at most, so long before another set off at most, was in its way."""
_OVER_M = 1.0
"""A vehicle behind others that stands with its front so far beyond the line has crossed it."""
_UPSTREAM_M, _RECUR_SHARE = 4.0, 0.25
"""Another line lies so far before the foremost at least, and so many stop there, to the place where most do."""
_CROSSES_S = 8.0
"""From its start to its crossing of the line, a vehicle at the head of a queue needs no longer."""


@dataclass(frozen=True)
class Stops:
    """Stops of vehicles, one row each: ``track``, ``start_s`` and ``end_s`` (when it goes again; NaN: its track ends
    before), ``xy_m`` (n, 2), ``seen_s`` (until when it is seen to stand); ``time_sd_s``: standard deviation of a
    start or an end, s."""

    track: IntArray
    start_s: FloatArray
    end_s: FloatArray
    xy_m: FloatArray
    seen_s: FloatArray
    time_sd_s: float


def find_stops(trajectories: Trajectories) -> Stops:
    """All stops of at least ``MIN_STOP_S``."""
    speed, owner = trajectories.speed_m_per_s, trajectories.owner
    slow = _hysteresis(speed, owner)
    edge = np.diff(np.r_[False, slow, False].astype(np.int8))
    first, last = np.flatnonzero(edge == 1), np.flatnonzero(edge == -1) - 1
    # a run of slow positions may reach from one track into the next
    inside = np.flatnonzero(slow[:-1] & slow[1:] & (owner[:-1] != owner[1:]))
    first, last = np.sort(np.r_[first, inside + 1]), np.sort(np.r_[last, inside])
    after = np.minimum(last + 1, len(owner) - 1)
    goes = (owner[after] == owner[last]) & (after > last)
    time = trajectories.time_s
    # between the last slow position and the first that is not, by the acceleration of a start
    start = time[last] + np.where(goes, (time[after] - time[last]) * 0.5, 0.0)
    end = np.where(goes, start, np.nan)
    long = (np.where(goes, start, time[last]) - time[first]) >= MIN_STOP_S
    xy = trajectories.xy_m[last]
    _stop_under_trees(trajectories, slow, first, last, xy, end)
    seen = np.where(np.isfinite(end), end, time[last])
    return Stops(owner[first[long]], time[first[long]], end[long], xy[long], seen[long], _time_sd_s(trajectories))


def _time_sd_s(trajectories: Trajectories) -> float:
    """Standard deviation of the time at which a vehicle stops or goes: it lies between two positions, and is late or
    early as the error of the speed is over the acceleration."""
    owner = trajectories.owner
    steps = np.diff(trajectories.time_s)[owner[1:] == owner[:-1]]
    step_s = float(np.median(steps)) if len(steps) else 0.0
    return float(np.hypot(step_s / np.sqrt(12), speed_sd_m_per_s(trajectories.position_sd_m) / _SETS_OFF_M_PER_S2))


def _stop_under_trees(
    trajectories: Trajectories, slow: Mask, first: IntArray, last: IntArray, xy_m: FloatArray, end_s: FloatArray
) -> None:
    """Place stops (n,) that nothing was seen of, in place: ``slow`` from row ``first`` to ``last``, at ``xy_m``, until
    ``end_s``.

    A vehicle brakes to a tree, and appears behind it setting off. Where between it stood follows from both speeds, as
    acceleration and braking are about equal: their distances are as their squares.
    """
    time, owner, speed = trajectories.time_s, trajectories.owner, trajectories.speed_m_per_s
    moved = np.diff(trajectories.xy_m, axis=0)
    far = (np.diff(time) >= MIN_STOP_S) & (np.hypot(*moved.T) >= _HIDDEN_MOVE_M)
    rows = np.flatnonzero(slow[:-1] & slow[1:] & (owner[:-1] == owner[1:]) & far)
    # the speeds beside the gap are means over it
    before, after = np.maximum(rows - 1, 0), np.minimum(rows + 2, len(owner) - 1)
    v0 = np.where(owner[before] == owner[rows], speed[before], 0.0)
    v1 = np.where(owner[after] == owner[rows], speed[after], 0.0)
    share = v0**2 / np.maximum(v0**2 + v1**2, 1e-9)
    stop = np.searchsorted(first, rows, side="right") - 1
    xy_m[stop] = trajectories.xy_m[rows] + share[:, None] * moved[rows]
    sets_off = np.isfinite(end_s[stop]) & (rows + 1 == last[stop])
    distance = (1 - share) * np.hypot(*moved[rows].T)
    begin = time[rows + 1] - 2 * distance / np.maximum(v1, GO_M_PER_S)
    end_s[stop[sets_off]] = np.maximum(begin, time[rows] + 0.5)[sets_off]


def _hysteresis(speed: FloatArray, owner: IntArray) -> Mask:
    """Whether each position is of a stop: it begins below the lower speed and lasts to the upper one."""
    low, high = speed < STOP_M_PER_S, speed >= GO_M_PER_S
    new = np.r_[True, owner[1:] != owner[:-1]]
    decided = np.flatnonzero(low | high | new)
    return np.asarray(np.repeat(low[decided], np.diff(np.r_[decided, len(speed)])))


@dataclass(frozen=True)
class Approach:
    """The lanes of one direction that lead into a junction, one stream each."""

    junction: int
    lane: int
    """Number of the lane that crosses the junction's border."""
    path_m: FloatArray
    """(n, 2) course upstream of the border and through it, 1 m apart; ``border_m`` is the border's distance along
    it."""
    border_m: float


def find_approaches(graph: LaneGraph, junction: Junction) -> list[Approach]:
    """The lanes into a junction, each with what leads to it (its strongest predecessors) and what it leads to."""
    from velfield.analysis.lanes.junctions import inside_hull

    out = []
    for number in junction.lanes_in:
        lane = graph.lanes[number]
        inside = inside_hull(lane.xy_m, junction.hull_m)
        k = int(np.flatnonzero(~inside[:-1] & inside[1:])[0])
        upstream = [lane.xy_m[: k + 1]]
        length, at, seen = lane.along_m[k], number, {number}
        while length < REACH_M and graph.predecessors[at] and graph.predecessors[at][0] not in seen:
            at = graph.predecessors[at][0]
            seen.add(at)
            upstream.insert(0, graph.lanes[at].xy_m[:-1])
            length += graph.lanes[at].length_m
        downstream = [lane.xy_m[k + 1 :]]
        length, at = lane.length_m - lane.along_m[k], number
        while length < 40.0 and graph.successors[at] and graph.successors[at][0] not in seen:
            at = graph.successors[at][0]
            seen.add(at)
            downstream.append(graph.lanes[at].xy_m[1:])
            length += graph.lanes[at].length_m
        before = _space_evenly(np.concatenate(upstream))
        after = _space_evenly(np.concatenate([before[-1:], *downstream]))
        border = float(len(before) - 1)
        path = np.concatenate([before, after[1:]])
        start = max(len(before) - 1 - int(REACH_M), 0)
        out.append(Approach(junction.number, number, path[start : len(before) + 40], border - start))
    return out


def _space_evenly(line: FloatArray) -> FloatArray:
    """Points of a line 1 m apart."""
    along = np.concatenate([[0.0], np.hypot(*np.diff(line, axis=0).T).cumsum()])
    s = np.arange(0.0, along[-1] + 1e-9, 1.0)
    return np.column_stack([np.interp(s, along, line[:, k]) for k in (0, 1)])


@dataclass(frozen=True)
class Stream:
    """Traffic on an approach: queue starts, stops and crossings of the stop line.

    Attributes
    ----------
    stop_line_m
        Where the first of the queues stand, front bumper, along the approach's path; None: nobody stops.
    head_time_s, head_track
        Starts of vehicles that stood at the stop line.
    stop_track, stop_start_s, stop_end_s, stop_along_m, stop_length_m, stop_seen_s
        Stops on the approach, the lengths of their vehicles (a car's where none was measured), and until when these
        are seen to stand.
    stop_time_sd_s
        Standard deviation of a stop's start or end.
    hidden_share
        Share of the vehicles in queues that are not seen, at least.
    upstream
        The same traffic by another line, at which the first of queues stop, too: vehicles that give way wait beyond a
        stop line, and where the first of a queue was missed the second seems to be it. None: there is one place.
    cross_time_s, cross_track, cross_speed_m_per_s
        When tracks cross the stop line (the border without one), and how fast; in time order.
    """

    approach: Approach
    stop_line_m: float | None
    head_time_s: FloatArray
    head_track: IntArray
    stop_track: IntArray
    stop_start_s: FloatArray
    stop_end_s: FloatArray
    stop_along_m: FloatArray
    cross_time_s: FloatArray
    cross_track: IntArray
    cross_speed_m_per_s: FloatArray
    stop_length_m: FloatArray
    stop_seen_s: FloatArray
    stop_time_sd_s: float
    hidden_share: float = 0.0
    upstream: "Stream | None" = None


def observe_stream(
    approach: Approach, samples: PathSamples, stops: Stops, lengths_m: FloatArray | None = None
) -> Stream:
    """Stops and crossings on an approach; ``lengths_m`` (tracks,) of the vehicles, None: a car's."""
    along, across = _along(approach.path_m, stops.xy_m)
    here = np.flatnonzero((across < 1.6) & (along > 1.0) & (along < len(approach.path_m) - 2))
    length = np.full(len(here), VEHICLE_LENGTH_M) if lengths_m is None else lengths_m[stops.track[here]]
    front = along[here] + length / 2
    known = np.isfinite(stops.end_s[here])
    line = _stop_line(front[known], approach.border_m)
    first = known.copy()
    first[known] = _is_first(
        stops.track[here][known], stops.start_s[here][known], stops.end_s[here][known], front[known]
    )

    def observe(line: float | None, upstream: Stream | None) -> Stream:
        at = approach.border_m if line is None else min(line, len(approach.path_m) - 4.0)
        time, track, speed = _crossings(approach.path_m, at, samples)
        rows = here[known]
        time = _after_stops(time, track, at, stops.track[rows], stops.start_s[rows], stops.end_s[rows], along[rows])
        over = here[known & ~first & (front > at + _OVER_M)]
        time = _before_stops(time, track, stops.track[over], stops.start_s[over], stops.end_s[over])
        order = np.argsort(time, kind="stable")
        cross = time[order], track[order], speed[order]
        heads = here[first & (np.abs(front - (np.inf if line is None else line)) < _LINE_M)]
        heads = heads[_goes_on(stops.track[heads], stops.end_s[heads], cross[1], cross[0])]
        heads = heads[np.argsort(stops.end_s[heads])]
        return Stream(
            approach,
            line,
            stops.end_s[heads],
            stops.track[heads],
            stops.track[here],
            stops.start_s[here],
            stops.end_s[here],
            along[here],
            *cross,
            length,
            stops.seen_s[here],
            stops.time_sd_s,
            upstream=upstream,
        )

    before = None if line is None else _line_upstream(front[first], line, approach.border_m)
    return observe(line, None if before is None else observe(before, None))


def _is_first(track: IntArray, start_s: FloatArray, end_s: FloatArray, front_m: FloatArray) -> Mask:
    """Whether nobody stood ahead of each stop (n,) as it ended."""
    order = np.argsort(end_s, kind="stable")
    out = np.ones(len(track), bool)
    for at, row in enumerate(order):
        left = order[np.searchsorted(end_s[order], end_s[row] - _AHEAD_S) : at]
        ahead = front_m[left] - front_m[row]
        out[row] = not np.any((ahead > _LINE_M) & (ahead < _AHEAD_M) & (track[left] != track[row]))
    return out


def _after_stops(
    time_s: FloatArray,
    track: IntArray,
    at_m: float,
    stop_track: IntArray,
    start_s: FloatArray,
    end_s: FloatArray,
    along_m: FloatArray,
) -> FloatArray:
    """Times (n,) of crossings of ``at_m``: of those within a stop (m,) of their track, under a tree, after its end."""
    if not len(stop_track) or not len(track):
        return time_s
    order = np.lexsort((start_s, stop_track))
    begin = float(min(start_s.min(), time_s.min()))
    span = float(max(start_s.max(), time_s.max())) - begin + 1.0
    key = stop_track[order] * span + start_s[order] - begin
    row = order[np.maximum(np.searchsorted(key, track * span + time_s - begin, side="right") - 1, 0)]
    stands = (stop_track[row] == track) & (start_s[row] <= time_s) & (time_s < end_s[row])
    reaches = end_s[row] + np.sqrt(2 * np.maximum(at_m - along_m[row], 0.0) / _SETS_OFF_M_PER_S2)
    return np.asarray(np.where(stands, reaches, time_s))


def _before_stops(
    time_s: FloatArray, track: IntArray, stop_track: IntArray, start_s: FloatArray, end_s: FloatArray
) -> FloatArray:
    """Times (n,) of crossings by the middle of a vehicle: as its stop (m,) begins, if it stands over the line."""
    begin = {int(k): (float(a), float(b)) for k, a, b in zip(stop_track, start_s, end_s, strict=True)}
    out = time_s.copy()
    for row in np.flatnonzero(np.isin(track, stop_track)):
        start, end = begin[int(track[row])]
        out[row] = start if start <= time_s[row] < end + _CROSSES_S else time_s[row]
    return out


def _goes_on(track: IntArray, end_s: FloatArray, crossed: IntArray, cross_s: FloatArray) -> Mask:
    """Whether the vehicle of each stop crosses the line soon after it."""
    time = {int(k): float(t) for k, t in zip(crossed, cross_s, strict=True)}
    when = np.array([time.get(int(k), np.nan) for k in track])
    return np.asarray((when - end_s > -1.0) & (when - end_s < _CROSSES_S))


def _along(path_m: FloatArray, xy_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance along a path of points 1 m apart, and from it."""
    from scipy.spatial import cKDTree

    distance, k = cKDTree(path_m).query(xy_m)
    k = np.clip(k, 0, len(path_m) - 2)
    u = path_m[k + 1] - path_m[k]
    d = xy_m - path_m[k]
    s = (d * u).sum(axis=1) / np.maximum((u**2).sum(axis=1), 1e-9)
    across = np.abs(u[:, 0] * d[:, 1] - u[:, 1] * d[:, 0]) / np.maximum(np.hypot(*u.T), 1e-9)
    return k + s, np.where(distance < 5.0, across, np.inf)


def _stop_line(front_m: FloatArray, border_m: float) -> float | None:
    """Where the foremost of many stops are, front bumpers: the last peak of their density near the border."""
    place, density = _places(front_m, border_m)
    strong = place[density > 0.4 * density.max(initial=0.0)]
    return float(strong[-1]) if len(strong) else None


def _line_upstream(first_m: FloatArray, line_m: float, border_m: float) -> float | None:
    """Where most of the vehicles with nobody ahead stop before the foremost line; None: nowhere twice."""
    place, density = _places(first_m, border_m)
    before = (place < line_m - _UPSTREAM_M) & (density > _RECUR_SHARE * density.max(initial=0.0))
    before &= density > 1.5  # two stops at one place
    return float(place[before][np.argmax(density[before])]) if before.any() else None


def _places(front_m: FloatArray, border_m: float) -> tuple[FloatArray, FloatArray]:
    """Places along the path, near the border, where vehicles stop, and how many do at each."""
    front = front_m[np.abs(front_m - border_m) < 25.0]
    if len(front) < 2:
        return np.empty(0), np.empty(0)
    grid = np.arange(front.min() - 1, front.max() + 1, 0.25)
    density = np.exp(-0.5 * ((grid[:, None] - front) / 0.8) ** 2).sum(axis=1)
    rows = np.flatnonzero((density[1:-1] >= density[:-2]) & (density[1:-1] > density[2:])) + 1
    return grid[rows], density[rows]


def _crossings(path_m: FloatArray, at_m: float, samples: PathSamples) -> tuple[FloatArray, IntArray, FloatArray]:
    """Time, track and speed of the samples' crossings of a path's point ``at_m`` along it, in time order."""
    k = int(np.clip(at_m, 0, len(path_m) - 2))
    u = path_m[k + 1] - path_m[k]
    u = u / max(float(np.hypot(*u)), 1e-9)
    origin = path_m[k] + (at_m - k) * u
    near = within(samples.xy_m, origin - 4.0, origin + 4.0)
    d = samples.xy_m[near] - origin
    s, across = d @ u, np.abs(u[0] * d[:, 1] - u[1] * d[:, 0])
    pair = (np.diff(near) == 1) & (np.diff(samples.track[near]) == 0) & (s[:-1] < 0) & (s[1:] >= 0)
    rows = np.flatnonzero(pair & (across[:-1] < 1.7))
    a, b = near[rows], near[rows + 1]
    f = -s[rows] / np.maximum(s[rows + 1] - s[rows], 1e-9)
    # a vehicle that waits at the line moves at the end of the time between two samples
    time = samples.time_s[b] - (1 - f) * np.minimum(samples.time_s[b] - samples.time_s[a], 1.5)
    order = np.argsort(time, kind="stable")
    return time[order], samples.track[a][order], samples.speed_m_per_s[b][order]
