"""U-turns: tracks that reverse their direction within a short path, on a road where others go on, or that leave a
roundabout by the arm by which they came."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.arrays import FloatArray, IntArray
from velfield.analysis.lanes.junctions import inside_hull
from velfield.analysis.lanes.model import LaneGraph
from velfield.analysis.movements.cut_tracks import CutTracks
from velfield.analysis.movements.movements import JunctionMovements
from velfield.analysis.trajectories import PathSamples

_PATH_M = 36
"""A U-turn is no longer; half round a circle of 13 m radius is."""
_MIN_TURN_RAD = np.radians(150)
_ROAD_M_PER_S = 5.5
"""Who is slower all the way from 40 m before a turn to 40 m after it turns in a car park."""
_APPROACH_M = 40
_LEG_M, _LEG_SIGMAS = 8, 24.0
"""Before the turn and after it the vehicle goes on so far, and farther than its errors by so many standard deviations,
the opposite way."""
_OPPOSITE_RAD = np.radians(150)
_BEND_M, _BEND_RAD = 8, np.radians(20)
"""A turn goes on where the next so many metres bend on by more; or twice as many by twice as much, as errors that last
straighten parts of it."""
_STRAIGHT_M = 16
"""Between the bends of a circle and of its arms the course is straight over less."""
_ARM_M = 20
"""The ways are opposite so far from the turn, too: the arm by which a circle is left after a part of it is not."""
_CIRCLE_RAD = np.radians(215)
"""Who turns by more goes round a circle: it is entered, and left, by a bend the other way."""

_TAKES_S = 12.0
"""A U-turn takes about so long with the ways before it and after it, where none was seen."""
_LEAST_SEEN = 0.5
"""In a short time at least this share of it counts: few U-turns say little of how long they take."""


@dataclass(frozen=True)
class Reversal:
    """A U-turn: number of the track, middle of the turn and its time; ``left`` or to the right; ``takes_s``: time from
    the way before it to the way after it, which both must be seen; ``round_circle``: at a roundabout."""

    track: int
    time_s: float
    xy_m: FloatArray
    left: bool
    takes_s: float
    round_circle: bool = False


def find_reversals(samples: PathSamples, graph: LaneGraph, *, position_sd_m: float = 0.0) -> list[Reversal]:
    """U-turns on roads, by time; those within roundabouts are none, nor what errors of positions may be."""
    n = len(samples)
    if n <= _PATH_M:
        return []
    step = np.angle(np.exp(1j * np.diff(samples.direction_rad)))
    step[np.diff(samples.track) != 0] = 0.0
    course = np.concatenate([[0.0], np.cumsum(step)])
    turn = course[_PATH_M:] - course[:-_PATH_M]
    turn[samples.track[_PATH_M:] != samples.track[:-_PATH_M]] = 0.0
    rows = np.flatnonzero(np.abs(turn) >= _MIN_TURN_RAD)
    rings = [junction.hull_m for junction in graph.junctions if junction.kind == "roundabout"]
    out = []
    for group in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
        if not len(group):
            continue
        best = int(group[np.argmax(np.abs(turn[group]))])
        middle = best + _PATH_M // 2
        inside_ring = any(inside_hull(samples.xy_m[[middle]], hull)[0] for hull in rings)
        if inside_ring or not _comes_by_road(samples, best):
            continue
        legs = _legs(samples, course, best, position_sd_m)
        if legs:
            track, takes_s = int(samples.track[middle]), float(np.diff(samples.time_s[list(legs)])[0])
            left = bool(turn[best] < 0)
            out.append(Reversal(track, float(samples.time_s[middle]), samples.xy_m[middle], left, takes_s))
    return sorted(out, key=lambda row: row.time_s)


def find_circle_reversals(movements: Sequence[JunctionMovements], cut: CutTracks) -> list[Reversal]:
    """Vehicles that go round a roundabout and leave it by the arm by which they came."""
    out = []
    for found in movements:
        if found.junction.kind != "roundabout":
            continue
        passes, vehicles = found.passes, cut.trajectories
        arm = np.array([gate.arm for gate in found.gates.gates] + [-1], np.int64)
        arm_in, arm_out = arm[passes.gate_in], arm[passes.gate_out]
        for k in np.flatnonzero((arm_in >= 0) & (arm_in == arm_out)):
            vehicle, begin_s, end_s = cut.vehicle[passes.track[k]], passes.entry_s[k], passes.exit_s[k]
            rows = np.arange(vehicles.first[vehicle], vehicles.first[vehicle + 1])
            rows = rows[(vehicles.time_s[rows] >= begin_s) & (vehicles.time_s[rows] <= end_s)]
            away = vehicles.xy_m[rows] - found.junction.centre_m
            swept = float(np.angle(np.exp(1j * np.diff(np.arctan2(away[:, 1], away[:, 0])))).sum())
            if abs(swept) > np.pi:  # else it passes an edge of the area
                middle = rows[len(rows) // 2]
                out.append(
                    Reversal(
                        int(passes.track[k]), float(vehicles.time_s[middle]), vehicles.xy_m[middle], swept < 0,
                        float(end_s - begin_s), round_circle=True,
                    )
                )  # fmt: skip
    return out


def seen_whole_s(reversals: Sequence[Reversal], observed_s: FloatArray) -> float:
    """Length of the times in which such U-turns may begin and are seen whole, of times (k, 2) that are seen, s.

    One that takes long is seen whole where it begins so long before the end of a time: with each as often as the times
    that it has are short, their number over this length is the rate at which they come.
    """
    lengths = np.diff(observed_s, axis=1)[:, 0]
    takes = np.array([reversal.takes_s for reversal in reversals] or [_TAKES_S])
    seen_s = np.maximum(lengths - takes[:, None], lengths * _LEAST_SEEN).sum(axis=1)
    return len(takes) / float((1 / seen_s).sum()) if len(lengths) else 0.0


def _legs(samples: PathSamples, course: FloatArray, row: int, position_sd_m: float) -> tuple[int, int] | None:
    """First row of the way before the turn and last row of the way after it, if the track goes back on it, farther
    than errors explain."""
    start, end = _turn_rows(samples.track, course, row)
    if abs(course[end] - course[start]) > _CIRCLE_RAD:
        return None
    start, end = _straight(samples.track, course, start, -1), _straight(samples.track, course, end, 1)
    leg = max(_LEG_M, int(np.ceil(_LEG_SIGMAS * position_sd_m)))
    first, last = np.searchsorted(samples.track, samples.track[row] + np.arange(2)) - np.arange(2)
    if start - leg < first or end + leg > last:
        return None
    back = all(
        _opposite(samples.xy_m, max(start - away, first + leg), min(end + away, last - leg), leg)
        for away in (0, _ARM_M)
    )
    return (start - leg, end + leg) if back else None


def _opposite(xy_m: FloatArray, start: int, end: int, leg: int) -> bool:
    """Whether the ways of so many rows before ``start`` and after ``end`` are opposite."""
    ways = xy_m[[start, end + leg]] - xy_m[[start - leg, end]]
    turn = np.abs(np.angle(np.exp(1j * float(np.subtract(*np.arctan2(ways[:, 1], ways[:, 0]))))))
    return bool(np.hypot(*ways.T).min() > 0.7 * leg and turn >= _OPPOSITE_RAD)


def _straight(track: IntArray, course: FloatArray, row: int, side: int) -> int:
    """First row from ``row`` on, forwards (``side`` 1) or back (-1), from which the track hardly bends, one way or the
    other, over `_STRAIGHT_M`; where it ends before, over what there is of it."""
    while True:
        rows = np.arange(row, row + side * _STRAIGHT_M, side)
        rows = rows[(rows >= 0) & (rows < len(track))]
        rows = rows[track[rows] == track[row]]
        if len(rows) < _LEG_M or np.ptp(course[rows]) <= _BEND_RAD * len(rows) / _STRAIGHT_M:
            return row
        row += side


def _turn_rows(track: IntArray, course: FloatArray, row: int) -> tuple[int, int]:
    """First and last row of the turn that is found in the window from ``row`` on: it may be shorter, or longer."""
    start, end = row, row + _PATH_M
    sense = np.sign(course[end] - course[start])

    def bends(a: int, b: int) -> bool:
        inside = a >= 0 and b < len(track) and track[a] == track[row] == track[b]
        return bool(inside and sense * (course[b] - course[a]) > _BEND_RAD * (b - a) / _BEND_M)

    while start < end and not bends(start, start + _BEND_M):
        start += 1
    while end > start and not bends(end - _BEND_M, end):
        end -= 1
    while any(bends(start - m, start) for m in (_BEND_M, 2 * _BEND_M)):
        start -= 1
    while any(bends(end, end + m) for m in (_BEND_M, 2 * _BEND_M)):
        end += 1
    return start, end


def _comes_by_road(samples: PathSamples, row: int) -> bool:
    """Whether the track was as fast as on a road before, or after, the turn."""
    low, high = max(row - _APPROACH_M, 0), min(row + _PATH_M + _APPROACH_M, len(samples))
    own = samples.track[low:high] == samples.track[row]
    return bool(np.quantile(samples.speed_m_per_s[low:high][own], 0.9) > _ROAD_M_PER_S)
