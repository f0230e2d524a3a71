"""Pairs of a track's end and another's start that may be one vehicle's, and the cost of each join by their motion.

A cost is 0 as predicted and 1 at the tolerance of a short gap. Four models of what happened in the gap, each with a
cost of its own; the least counts: the vehicle drove on; it stopped, or stood; it was hidden for longer, straight on; it
was hidden and turned.
"""

from dataclasses import dataclass

import numpy as np

from schemas.arrays import ByteArray, FloatArray, IntArray
from schemas.flight import STATIONARY_SPEED_M_PER_S
from velfield.compiled import kernel

_SLACK_M = 2.0
"""Tolerance of the prediction for a gap of no length: detections are not always at the same point of a car."""
_ACCELERATION_CHANGE_M_PER_S2 = 4.0
"""Change of acceleration within a gap, as from hard braking to none. Over dt it displaces a vehicle by dt^2 / 8 times
this."""
_MAX_OFFSET_M = 2.2
"""Upper bound of the tolerance: half a car, so that a queue's next vehicle is not taken for it."""
_CAR_AND_GAP_M, _HEADWAY_S, _HEADWAY_FRACTION = 6.0, 0.8, 0.35
"""At speed the bound is this fraction of the distance to the next vehicle, which follows no closer than so."""

_LONG_M, _LONG_FRACTION, _ASIDE_M = 4.8, 0.9, 1.2
"""A vehicle beyond such a length is detected now at its cab, now at its load: so much of what is more is tolerance
along its way; and no more than this where its way is unknown, as the next lane is 3 m away."""
_GAP_PENALTY_PER_S = 0.25
"""A gap longer by a second costs as much as an offset larger by a quarter of the tolerance."""
STATIONARY_OFFSET_M = 1.6
"""Tolerance for a vehicle that is stationary on both sides of the gap; another one would arrive moving."""
_TYPICAL_ACCELERATION_M_PER_S2, _MAX_ACCELERATION_M_PER_S2, _STOP_SLACK_M = 2.0, 4.0, 0.5
_MAX_STOP_SPEED_M_PER_S, _MAX_STOP_OFFSET_M = 5.0, 4.0
"""Maximum speed of a vehicle that stops in the gap, as its stopping distance is too uncertain above it, and maximum
tolerance of that distance."""
_STOP_COST = 0.5
_HIDDEN_COST, _MIN_HIDDEN_S = 0.2, 0.5
_FOUND_WITHIN_M = 1.0
"""Minimum uncertainty of the place where a hidden vehicle reappears, however short the gap."""
_PACE_SD_M_PER_S, _PACE_SD_FRACTION, _FASTER_M_PER_S = 1.0, 0.35, 2.5
"""Hidden vehicles: standard deviation of the mean speed about the mean of those before and after, a constant and a
fraction of that mean; and how far above both it may be."""
_LANE_OFFSET_M, _LANE_OFFSET_FRACTION, _MAX_BEND_RAD = 1.8, 0.05, np.radians(50)
"""How far aside a hidden vehicle may appear, and how much its direction may differ from the way that it took."""
_TURN_COST, _MIN_TURN_RAD, _MAX_JUNCTION_RAD, _MAX_TURN_RAD = 0.4, *np.radians([30, 120, 179])
_MIN_RADIUS_M, _MIN_TURN_SPEED_M_PER_S, _MAX_SIDEWAYS_M_PER_S2 = 4.0, 1.5, 4.0
_JUNCTION_OFFSET_FRACTION, _ARC_OFFSET_FRACTION = 0.25, 0.08
"""Hidden vehicles that turn: cost, as fewer turn; limits of the angle; minimum radius and speed and maximum sideways
acceleration; tolerance across the way as a fraction of the chord, at a junction, where the place of the turn is
unknown, and on an arc, which two directions determine, each known to some degrees."""
CERTAINTY_SLOPE = 3.0
"""Log odds that a join is right, for each unit that the total would cost more without it."""
_REACH, _REACH_S, _REACH_M = 1.1, 0.5, 20.0
"""Farther than its way at the greatest pace, so much longer, with the greatest speed for so many seconds, and so many
metres, no vehicle gets at a finite cost: a hidden one is off its way by 0.06 of it and 2.2 m, the tolerance of one that
drives on is 0.4 s of its speed and 3 m, a stop takes 12.5 m with a tolerance of 4.5 m."""
_MAX_RELATIVE = 1.2
"""Offset of a hidden vehicle, in tolerances, beyond which it is not the same."""
_MAX_TURNED = float(np.cos(_MIN_TURN_RAD))
_ROOM = 1e-3
"""In m, m/s and cosines: more than roundings, in conditions that decide only what is weighed."""
_PAIRS_AT_ONCE = 1_000_000


@dataclass(frozen=True)
class TrackEnds:
    """One end of each track: frame (n,), time (n,) s, position (n, 2) m, velocity (n, 2) m/s."""

    frame: IntArray
    time_s: FloatArray
    position_m: FloatArray
    velocity_m_per_s: FloatArray

    @property
    def speed_m_per_s(self) -> FloatArray:
        return np.asarray(np.hypot(self.velocity_m_per_s[:, 0], self.velocity_m_per_s[:, 1]))


@dataclass(frozen=True)
class GapLimits:
    """Longest gaps that are closed, s: of a vehicle that drives on, of one that stands, and of one that is hidden.

    A vehicle slower than ``stationary_speed_m_per_s`` on both sides is stationary.
    """

    moving_s: float
    stationary_s: float = 0.0
    hidden_s: float = 0.0
    stationary_speed_m_per_s: float = STATIONARY_SPEED_M_PER_S


def find_candidates(
    ends: TrackEnds, starts: TrackEnds, limits: GapLimits, length_m: FloatArray | None = None
) -> tuple[IntArray, FloatArray]:
    """Ends and starts that may be one vehicle's.

    Parameters
    ----------
    ends, starts
        Last and first positions of each track.
    limits
        The longest gaps.
    length_m
        (tracks,) length of each vehicle, m; NaN where unknown. None: all unknown.

    Returns
    -------
    (m, 2) int64, (m,) float64
        The tracks of an end and of a start, and the cost of joining them; the cheapest first.
    """
    slack = np.zeros(len(ends.frame))
    if length_m is not None:
        slack = _LONG_FRACTION * np.maximum(np.nan_to_num(length_m) - _LONG_M, 0.0)
    order = np.argsort(starts.time_s, kind="stable")
    times = starts.time_s[order]
    longest = max(limits.moving_s, limits.stationary_s, limits.hidden_s)
    low = np.searchsorted(times, ends.time_s, side="right")
    high = np.searchsorted(times, ends.time_s + longest, side="right")
    bounds = np.array([limits.moving_s, limits.stationary_s, limits.hidden_s, limits.stationary_speed_m_per_s])
    columns = [(one.time_s, one.position_m, one.velocity_m_per_s, one.speed_m_per_s, slack) for one in (ends, starts)]
    sides = [tuple(np.array(column, order="C") for column in side) for side in columns]  # one layout: compiled once
    total = np.cumsum(np.maximum(high - low, 0))
    found = []
    for block in np.split(np.arange(len(total)), np.flatnonzero(np.diff(total // _PAIRS_AT_ONCE)) + 1):
        end, start, models = _possible_pairs(sides[0], sides[1], block, order, low, high, bounds)
        cost = np.full(len(end), np.inf)
        for k, model in enumerate(_MODELS):
            rows = np.flatnonzero(models & (1 << k))
            gaps = _Gaps(
                starts.time_s[start[rows]] - ends.time_s[end[rows]],
                starts.position_m[start[rows]] - ends.position_m[end[rows]],
                ends.velocity_m_per_s[end[rows]],
                starts.velocity_m_per_s[start[rows]],
                (slack[end[rows]] + slack[start[rows]]) / 2,
            )
            cost[rows] = np.minimum(cost[rows], model(gaps, limits))
        possible = np.flatnonzero(np.isfinite(cost))
        found.append(np.stack([cost[possible], end[possible], start[possible]], axis=1))
    table = np.concatenate(found) if found else np.empty((0, 3))
    pairs = table[:, 1:].astype(np.int64)
    rank = np.lexsort((pairs[:, 1], pairs[:, 0], table[:, 0]))
    return pairs[rank], table[rank, 0]


@kernel
def _possible_pairs(ends, starts, block, order, low, high, bounds) -> tuple[IntArray, IntArray, ByteArray]:  # type: ignore[no-untyped-def]
    """Pairs of ends (those of ``block``) and starts that a model may find possible, and which: a bit a model, in the
    order of `_MODELS`.

    Most pairs are far from possible, and a model costs many times what it takes to see that: so the conditions here are
    what is cheap of theirs, each with some room (`_ROOM`) for roundings, and a pair that is left out has no finite
    cost. ``order`` of the starts by time, of which ``low`` to ``high`` come into question for an end.

    Sides are (times, positions, velocities, speeds, slack); ``bounds`` the fields of `GapLimits`.
    """
    end_s, end_m, end_v, end_speed, slack = ends
    start_s, start_m, start_v, start_speed, _ = starts
    moving_s, stationary_s, hidden_s, standing_speed = bounds
    count = 0
    for i in block:
        count += max(high[i] - low[i], 0)
    end, start, models = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count, np.uint8)
    n = 0
    for i in block:
        for position in range(low[i], high[i]):
            j = order[position]
            seconds, more = start_s[j] - end_s[i], 0.5 * (slack[i] + slack[j])
            dx, dy = start_m[j, 0] - end_m[i, 0], start_m[j, 1] - end_m[i, 1]
            square = dx * dx + dy * dy
            slow, fast = min(end_speed[i], start_speed[j]), max(end_speed[i], start_speed[j])
            found = 0
            if seconds <= moving_s:
                reach = _SLACK_M + _ACCELERATION_CHANGE_M_PER_S2 * seconds**2 / 8 + more
                aside_x = dx - 0.5 * (end_v[i, 0] + start_v[j, 0]) * seconds
                aside_y = dy - 0.5 * (end_v[i, 1] + start_v[j, 1]) * seconds
                found |= int(aside_x**2 + aside_y**2 <= (reach + _ROOM) ** 2)
            if seconds <= stationary_s and (fast <= _MAX_STOP_SPEED_M_PER_S + _ROOM or fast < standing_speed + _ROOM):
                stopping = (slow**2 + fast**2) / (2 * _TYPICAL_ACCELERATION_M_PER_S2)
                reach = max(stopping + _MAX_STOP_OFFSET_M + more + _SLACK_M, STATIONARY_OFFSET_M + _ASIDE_M)
                found |= 2 * int(square <= (reach + _ROOM) ** 2)
            if _MIN_HIDDEN_S <= seconds <= hidden_s:
                reach = _REACH * (fast + _FASTER_M_PER_S) * seconds + _REACH_S * fast + _REACH_M + 2 * more
                if square <= (reach + _ROOM) ** 2:
                    found |= 4 * _goes_on(dx, dy, end_v[i, 0] + start_v[j, 0], end_v[i, 1] + start_v[j, 1])
                    turned = end_v[i, 0] * start_v[j, 0] + end_v[i, 1] * start_v[j, 1]
                    turns = slow >= _MIN_TURN_SPEED_M_PER_S - _ROOM and turned <= (_MAX_TURNED + _ROOM) * slow * fast
                    found |= 8 * int(turns)
            if found:
                end[n], start[n], models[n] = i, j, found
                n += 1
    return end[:n].copy(), start[:n].copy(), models[:n].copy()


@kernel
def _goes_on(dx: float, dy: float, vx: float, vy: float) -> bool:
    """Whether a displacement may be of a vehicle that keeps to its way, the direction of a sum of velocities."""
    length = np.sqrt(vx * vx + vy * vy)
    if length < _ROOM:
        return True  # of no direction that could be told
    width = _LANE_OFFSET_M + _LANE_OFFSET_FRACTION * np.sqrt(dx * dx + dy * dy)
    ahead, aside = dx * vx + dy * vy, abs(vx * dy - vy * dx)
    return bool(ahead > -_ROOM * length and aside <= (_MAX_RELATIVE * width + _ROOM) * length)


@dataclass(frozen=True)
class _Gaps:
    """Gaps between ends and starts: duration (n,) s, displacement (n, 2) m, velocities before and after (n, 2) m/s, and
    the tolerance (n,) m that a long vehicle adds."""

    duration: FloatArray
    displacement: FloatArray
    before: FloatArray
    after: FloatArray
    slack: FloatArray

    def speeds(self) -> tuple[FloatArray, FloatArray]:
        return np.hypot(*self.before.T), np.hypot(*self.after.T)


def _cost_in_motion(gaps: _Gaps, limits: GapLimits) -> FloatArray:
    """Cost of gaps in which a vehicle drives on, its acceleration nearly constant; inf beyond the tolerance."""
    mean = (gaps.before + gaps.after) / 2
    offset = gaps.displacement - mean * gaps.duration[:, None]
    along, _ = _components(offset, mean)
    across = np.sqrt(np.maximum(np.sum(offset**2, axis=1) - along**2, 0))  # all of it where there is no direction
    nearest = np.maximum(_MAX_OFFSET_M, _HEADWAY_FRACTION * (_CAR_AND_GAP_M + _HEADWAY_S * np.hypot(*mean.T)))
    tolerance = np.minimum(_SLACK_M + _ACCELERATION_CHANGE_M_PER_S2 * gaps.duration**2 / 8, nearest)
    relative = np.hypot(along / (tolerance + gaps.slack), across / tolerance)
    possible = (relative <= 1) & (gaps.duration <= limits.moving_s)
    return np.where(possible, relative + _GAP_PENALTY_PER_S * gaps.duration, np.inf)


def _cost_of_stop(gaps: _Gaps, limits: GapLimits) -> FloatArray:
    """Cost of gaps in which a vehicle stops and sets off again, or is stationary throughout; inf beyond the tolerance.

    It brakes from one velocity to rest and accelerates to the other along one line: how far that takes it follows from
    the speeds, independent of the gap's duration.
    """
    before, after = gaps.speeds()
    stands = (before < limits.stationary_speed_m_per_s) & (after < limits.stationary_speed_m_per_s)
    standing = np.hypot(*gaps.displacement.T) / (STATIONARY_OFFSET_M + np.minimum(gaps.slack, _ASIDE_M))
    expected = (before**2 + after**2) / (2 * _TYPICAL_ACCELERATION_M_PER_S2)
    along, across = _components(gaps.displacement, gaps.before + gaps.after)
    tolerance = np.minimum(_SLACK_M + 0.5 * expected, _MAX_STOP_OFFSET_M) + gaps.slack
    stopping = np.hypot((along - expected) / tolerance, across / _SLACK_M)
    possible = (gaps.duration >= (before + after) / _MAX_ACCELERATION_M_PER_S2) & (
        np.maximum(before, after) <= _MAX_STOP_SPEED_M_PER_S
    )
    possible &= along >= (before**2 + after**2) / (2 * _MAX_ACCELERATION_M_PER_S2) - _STOP_SLACK_M - gaps.slack
    relative = np.where(stands, standing, np.where(possible, stopping, np.inf))
    return np.where((relative <= 1) & (gaps.duration <= limits.stationary_s), relative + _STOP_COST, np.inf)


def _cost_when_hidden(gaps: _Gaps, limits: GapLimits) -> FloatArray:
    """Cost of gaps in which a vehicle keeps its direction at an unknown, moderate speed; inf where it cannot.

    A vehicle that is at rest on one side goes the way that the other side gives.
    """
    distance = np.hypot(*gaps.displacement.T)
    speeds = gaps.speeds()
    along, across = _components(gaps.displacement, gaps.before + gaps.after)
    bend = np.zeros(len(distance))
    for velocity, speed in zip((gaps.before, gaps.after), speeds, strict=True):
        cos = np.sum(gaps.displacement * velocity, axis=1) / np.maximum(distance * speed, 1e-9)
        directed = (speed > limits.stationary_speed_m_per_s) & (distance > _CAR_AND_GAP_M / 2)
        bend = np.where(directed, np.maximum(bend, np.arccos(np.clip(cos, -1, 1))), bend)
    width = _LANE_OFFSET_M + _LANE_OFFSET_FRACTION * distance
    cost = _HIDDEN_COST + _cost_of_pace(gaps, limits, along, across, width)
    return np.where((along > 0) & (bend <= _MAX_BEND_RAD), cost, np.inf)


def _cost_of_hidden_turn(gaps: _Gaps, limits: GapLimits) -> FloatArray:
    """Cost of gaps in which a vehicle turns at an unknown, moderate speed, at a junction or on an arc; else inf.

    It drives straight on, along an arc, and straight on again. Where the turn is halfway, the chord's direction is
    halfway between those before and after.
    """
    cross = gaps.before[:, 0] * gaps.after[:, 1] - gaps.before[:, 1] * gaps.after[:, 0]
    turn = np.arctan2(cross, np.sum(gaps.before * gaps.after, axis=1))
    bend = np.clip(np.abs(turn), _MIN_TURN_RAD, _MAX_TURN_RAD)
    chord = np.hypot(*gaps.displacement.T)
    along, across = _components(gaps.displacement, gaps.before)
    off = np.arctan2(across * np.sign(turn), along) - bend / 2  # of the chord from halfway
    # where the lines of both sides meet: so far ahead of the one, so far behind the other; the arc begins at the nearer
    onward, back = (chord * np.sin(bend / 2 + angle) / np.sin(bend) for angle in (-off, off))
    tangent, at_junction = np.tan(bend / 2), bend <= _MAX_JUNCTION_RAD
    radius = np.where(at_junction, np.minimum(onward, back) / tangent, chord / (2 * np.sin(bend / 2)))
    way = np.where(at_junction, onward + back - 2 * tangent * radius, 0) + bend * radius
    width = _LANE_OFFSET_M + np.where(at_junction, _JUNCTION_OFFSET_FRACTION, _ARC_OFFSET_FRACTION) * chord
    cost = _TURN_COST + _cost_of_pace(gaps, limits, way, chord * np.sin(off), width)
    possible = (np.abs(turn) >= _MIN_TURN_RAD) & (np.abs(off) < np.pi / 2) & (radius >= _MIN_RADIUS_M)
    possible &= np.minimum(*gaps.speeds()) >= _MIN_TURN_SPEED_M_PER_S
    possible &= (way / gaps.duration) ** 2 <= _MAX_SIDEWAYS_M_PER_S2 * radius
    return np.where(possible, cost, np.inf)


def _cost_of_pace(gaps: _Gaps, limits: GapLimits, way: FloatArray, across: FloatArray, width: FloatArray) -> FloatArray:
    """Cost of hidden vehicles by the length of their paths and their lateral offset, relative to the usual ``width``.

    The larger the area in which a vehicle may come out, the less one that comes out at a place speaks for it: the
    normalisation of a density, whose logarithm over the slope of the certainty is a cost.
    """
    speeds = np.stack(gaps.speeds())
    mean, pace = speeds.mean(axis=0), way / gaps.duration
    pace_sd = _PACE_SD_M_PER_S + _PACE_SD_FRACTION * mean
    relative = np.hypot((pace - mean) / pace_sd / 1.5, across / width)
    area = np.hypot(_FOUND_WITHIN_M, pace_sd * gaps.duration) * width / _LANE_OFFSET_M
    possible = (gaps.duration >= _MIN_HIDDEN_S) & (gaps.duration <= limits.hidden_s) & (relative <= _MAX_RELATIVE)
    possible &= pace <= speeds.max(axis=0) + _FASTER_M_PER_S
    return np.where(possible, relative + np.log(area) / CERTAINTY_SLOPE, np.inf)


def _components(vectors: FloatArray, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Components (n,) of vectors (n, 2) along directions (n, 2) of any length, and across them."""
    unit = directions / np.maximum(np.hypot(*directions.T), 1e-9)[:, None]
    return np.sum(vectors * unit, axis=1), unit[:, 0] * vectors[:, 1] - unit[:, 1] * vectors[:, 0]


_MODELS = (_cost_in_motion, _cost_of_stop, _cost_when_hidden, _cost_of_hidden_turn)
