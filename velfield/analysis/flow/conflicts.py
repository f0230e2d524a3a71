"""Conflicts: post-encroachment time where paths cross or merge, time to collision behind a leader; with the probability
that each is a conflict, given the errors of positions."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy import special
from scipy.spatial import cKDTree

from schemas.arrays import FloatArray, IntArray
from velfield.analysis.flow.passings import LaneTraffic, Passings
from velfield.analysis.lanes.find import project
from velfield.analysis.lanes.junctions import Crossing, find_crossings, inside_hull
from velfield.analysis.lanes.model import LaneGraph
from velfield.analysis.trajectories import VEHICLE_WIDTH_M, Trajectories, group_rows
from velfield.compiled import kernel
from velfield.tracking.smoothing import speed_sd_m_per_s

ConflictKind = Literal["crossing", "merging", "following"]
MAX_PET_S, MAX_TTC_S = 3.0, 3.0
_NEAR_S = 1.5
"""Threshold of the probability, of either time."""
POSITION_SD_M, SPEED_SD_M_PER_S = 0.35, 0.3
"""Standard deviations of a bumper's position on its path, including that of an unknown length, and of the speed, of
tracks without further errors."""
HARD_BRAKING_M_PER_S2 = 3.4
"""Drivers brake by this, and no harder, where nothing surprises them (AASHTO, A Policy on Geometric Design, 3.2.2): who
closes up on a queue so has less than 1.5 s to collision, and no conflict."""
LIKELY = 0.8
"""Probability from which on a conflict is counted: at one half every other of the doubtful ones is none."""
_MIN_SPEED_M_PER_S = 1.0
_MIN_FOLLOWER_M_PER_S = 3.0
_OVERLAP_M = 1.0
_PERSISTENCE_S = 0.4
_AT_ONCE_S, _BRIDGE_M = 0.5, 40.0
_ONE_LEVEL, _TWO_LEVELS = (1.0, 30.0), (3.0, 6.0)
"""Where one road is above the other vehicles know nothing of each other: of the pairs that pass within 3 s a third or
so has less than half a second between them, or none; on one level they avoid it. Beta distributions of that share,
which shows in the pairs within so far."""
_ONE_LEVEL_BEFORE, _LEAST_ONE_LEVEL, _CLEARLY_ONE_LEVEL = 0.1, 0.05, 0.9
"""Few pairs do not rule out two levels: to be taken for one level roads must be ten times as likely on it."""
_JOINED_M = 4.0
"""A lane that joins another is on it so far after its own end."""
_GOES_ON_M = 10.0
"""Lanes that join for less, and end, are beside each other up to the edge of the view, where positions are worst."""
_APART_M = 1.8
"""Lanes that lie nearer to each other on their whole way, and by errors, are one."""
_ON_LANE_M = 3.5
"""A vehicle that is farther from a lane's centre line is not on it."""
_CAME_M = 3
"""A vehicle came by a lane on which it drove so far."""


@dataclass(frozen=True)
class Conflict:
    """Two vehicles that were near in time: ``first`` and ``second`` by number of their tracks."""

    kind: ConflictKind
    first: int
    second: int
    time_s: float
    xy_m: FloatArray
    value_s: float
    sd_s: float
    """Post-encroachment time (crossing, merging), or least time to collision (following), and its standard
    deviation."""
    threshold_s: float
    probability: float
    """That it is below ``threshold_s``, and of crossing that the roads are on one level; of following, and that the
    follower must brake harder than `HARD_BRAKING_M_PER_S2` not to collide, and is behind, not beside."""
    one_level: float = 1.0
    """Probability that the roads are on one level."""

    @property
    def on_one_level(self) -> bool:
        """Whether it is clear that the roads are on one level."""
        return self.one_level >= _CLEARLY_ONE_LEVEL

    @property
    def likely(self) -> bool:
        """Whether it is a conflict with a probability of `LIKELY` or more, of roads that are clearly on one level."""
        return self.on_one_level and self.probability >= LIKELY

    @property
    def on_unclear_levels(self) -> bool:
        """Whether it would be likely if the roads were on one level, of which it is not clear that they are."""
        return not self.on_one_level and self.probability >= LIKELY * self.one_level


def find_conflicts(
    trajectories: Trajectories,
    traffic: LaneTraffic,
    *,
    lengths_m: FloatArray | None = None,
    vehicle: IntArray | None = None,
    signalised_m: Sequence[FloatArray] = (),
) -> list[Conflict]:
    """All pairs with a post-encroachment time or time to collision below 3 s, by time.

    Parameters
    ----------
    lengths_m
        (tracks,) lengths of the vehicles; None: as measured, a car's where they were not.
    vehicle
        (tracks,) number of each track's vehicle, where tracks are cut; None: each track is one.
    signalised_m
        (n, 2) corners of the area of each junction with a signal: its roads are on one level.
    """
    vehicles = np.arange(len(trajectories)) if vehicle is None else vehicle
    sd_m, speed_sd = _deviations(trajectories.position_sd_m)
    lengths = trajectories.length_m if lengths_m is None else lengths_m
    found = [
        conflict
        for crossing in find_crossings(traffic.graph.lanes)
        for conflict in _post_encroachments(crossing, traffic, lengths, _NEAR_S, sd_m)
    ]
    found = _on_one_level(found, signalised_m)
    # Tracks that overlap by more than the position error are one vehicle, or side by side.
    found += [c for c in _merges(traffic, lengths, vehicles, _NEAR_S, sd_m) if c.value_s > -2 * c.sd_s]
    found += time_to_collision(trajectories, traffic.graph, lengths, _NEAR_S, (sd_m, speed_sd))
    return sorted(_closest(found), key=lambda c: c.time_s)


def _on_one_level(found: list[Conflict], signalised_m: Sequence[FloatArray]) -> list[Conflict]:
    """The crossings, each as probable as its roads are on one level; without those that are hardly on one."""
    xy = np.array([c.xy_m for c in found]).reshape(-1, 2)
    at_once = np.array([c.value_s < _AT_ONCE_S for c in found], bool)
    near = cKDTree(xy).query_ball_point(xy, _BRIDGE_M) if len(xy) else []
    level = np.array([one_level_probability(int(at_once[rows].sum()), at_once[rows].size) for rows in near])
    for hull in signalised_m:
        level[inside_hull(xy, hull)] = 1.0
    return [
        replace(c, probability=float(c.probability * p), one_level=float(p))
        for c, p in zip(found, level, strict=True)
        if p > _LEAST_ONE_LEVEL
    ]


def one_level_probability(at_once: int, pairs: int) -> float:
    """Probability that roads cross on one level, of ``pairs`` within 3 s of which some are ``at_once``: by Bayes' rule,
    before any pair `_ONE_LEVEL_BEFORE`.

    Examples
    --------
    >>> [round(one_level_probability(k, 20), 2) for k in (0, 2, 5)]
    [0.8, 0.14, 0.01]
    """
    one, two = (
        float(special.betaln(at_once + a, pairs - at_once + b) - special.betaln(a, b))
        for a, b in (_ONE_LEVEL, _TWO_LEVELS)
    )
    return float(special.expit(one - two + special.logit(_ONE_LEVEL_BEFORE)))


def _deviations(position_sd_m: float) -> tuple[float, float]:
    """Standard deviations of a bumper's position, m, and of a speed, m/s, of tracks whose smoothed positions have this
    one."""
    return float(np.hypot(POSITION_SD_M, position_sd_m)), max(SPEED_SD_M_PER_S, speed_sd_m_per_s(position_sd_m))


def _closest(found: list[Conflict]) -> list[Conflict]:
    """One conflict a pair and kind: the closest."""
    best: dict[tuple[str, int, int], Conflict] = {}
    for conflict in found:
        key = (conflict.kind, conflict.first, conflict.second)
        if key not in best or conflict.value_s < best[key].value_s:
            best[key] = conflict
    return list(best.values())


def _post_encroachments(
    crossing: Crossing, traffic: LaneTraffic, lengths: FloatArray, threshold_s: float, sd_m: float
) -> list[Conflict]:
    """Pairs that cross one after the other, by different lanes."""
    a = traffic.passings(crossing.lane, crossing.along_m)
    b = traffic.passings(crossing.other, crossing.other_along_m)
    half_m = VEHICLE_WIDTH_M / 2 / max(abs(np.sin(crossing.angle_rad)), 0.3)
    track, time, speed = (np.r_[getattr(a, k), getattr(b, k)] for k in ("track", "time_s", "speed_m_per_s"))
    both = Passings(track, time, speed, np.zeros(len(track)))  # of two lanes there is no common centre line
    stream = np.repeat([0, 1], [len(a), len(b)])
    return _pairs("crossing", both, stream, crossing.xy_m, lengths, half_m, threshold_s, sd_m)


def _merges(
    traffic: LaneTraffic, lengths: FloatArray, vehicle: IntArray, threshold_s: float, sd_m: float
) -> list[Conflict]:
    """Pairs that come from different lanes onto one."""
    graph, out = traffic.graph, []
    for lane in graph:
        sources = graph.predecessors[lane.number]
        if len(sources) < 2:
            continue
        # where the last of the lanes has joined: the first joins at the start of this one
        ends = np.array([graph.lanes[k].xy_m[-1] for k in sources])
        joined_m = float(project(ends, lane.xy_m)[0].max())
        if not graph.successors[lane.number] and lane.length_m < joined_m + _GOES_ON_M:
            continue
        place = min(joined_m + _JOINED_M, 0.9 * lane.length_m)
        at = traffic.passings(lane.number, place)
        source = _sources(vehicle[at.track], [vehicle[traffic.samples(k).track] for k in sources])
        known = source >= 0
        source = _apart([graph.lanes[k].xy_m for k in sources], _APART_M + 3 * sd_m)[source]
        at = Passings(at.track[known], at.time_s[known], at.speed_m_per_s[known], at.offset_m[known])
        out += _pairs("merging", at, source[known], lane.at(place), lengths, 0.0, threshold_s, sd_m)
    return out


def _apart(lanes: list[FloatArray], apart_m: float) -> IntArray:
    """(n,) the first lane that each is not farther from, anywhere on its way: errors split one lane into several."""
    out = np.arange(len(lanes))
    for b in range(len(lanes)):
        near = [a for a in range(b) if np.abs(project(lanes[b], lanes[a])[1]).max() < apart_m]
        out[b] = out[near[0]] if near else b
    return out


def _sources(vehicle: IntArray, samples: list[IntArray]) -> IntArray:
    """Lane by which each vehicle (n,) came, -1 if none: the one that it drove longest, as it touches the ends of others
    where they join. ``samples``: the vehicle of each sample on each lane."""
    if not len(vehicle):
        return np.empty(0, np.int64)
    driven = np.array([np.bincount(of, minlength=int(vehicle.max()) + 1)[vehicle] for of in samples])
    return np.where(driven.max(axis=0) >= _CAME_M, driven.argmax(axis=0), -1)


def _pairs(
    kind: ConflictKind,
    at: Passings,
    stream: IntArray,
    xy_m: FloatArray,
    lengths: FloatArray,
    half_m: float,
    threshold_s: float,
    sd_m: float,
) -> list[Conflict]:
    """Consecutive passings of different streams (n,), nearer than ``MAX_PET_S``."""
    order = np.argsort(at.time_s, kind="stable")
    track, time, stream = at.track[order], at.time_s[order], stream[order]
    speed, offset = np.maximum(at.speed_m_per_s[order], _MIN_SPEED_M_PER_S), at.offset_m[order]
    k = np.flatnonzero((np.diff(stream) != 0) & (np.diff(time) < MAX_PET_S + 3.0) & (np.diff(track) != 0))
    reach = lengths[track] / 2 + half_m
    value = (time[k + 1] - reach[k + 1] / speed[k + 1]) - (time[k] + reach[k] / speed[k])
    sd = sd_m * np.hypot(1 / speed[k], 1 / speed[k + 1])
    probability = special.ndtr((threshold_s - value) / sd)
    if kind == "merging":  # and that they are not beside each other: errors may make one lane of two
        probability *= special.ndtr((VEHICLE_WIDTH_M - np.abs(offset[k + 1] - offset[k])) / (np.sqrt(2) * sd_m))
    return [
        Conflict(
            kind, int(track[i]), int(track[i + 1]), float(time[i + 1]), xy_m, float(v), float(s), threshold_s, float(p)
        )
        for i, v, s, p in zip(k, value, sd, probability, strict=True)
        if v < MAX_PET_S
    ]


def time_to_collision(
    trajectories: Trajectories,
    graph: LaneGraph,
    lengths: FloatArray,
    threshold_s: float,
    sds: tuple[float, float] = (POSITION_SD_M, SPEED_SD_M_PER_S),
) -> list[Conflict]:
    """Least time to collision of each follower and its leader on a lane, where it is below ``MAX_TTC_S``.

    Followers slower than 3 m/s are left out: closing up in a queue is no conflict. So are pairs that overlap at some
    time: two tracks of one vehicle, or vehicles side by side on a wide lane. A pair's value is the least that holds
    for `_PERSISTENCE_S`, not that of one noisy frame. ``sds``: standard deviations of a position, m, and a speed, m/s.
    """
    lane, along, offset = positions_on_lanes(trajectories, graph)
    rows = np.flatnonzero(lane >= 0)
    frame = trajectories.frame[rows] - trajectories.frame.min(initial=0)
    rows = rows[group_rows(frame, int(frame.max(initial=0)) + 1)[0]]
    rows = rows[group_rows(lane[rows], len(graph))[0]]
    _sort_along(rows, lane, trajectories.frame, along)
    owner, speed = trajectories.owner, trajectories.speed_m_per_s
    near, overlaps = _followers(rows, lane, trajectories.frame, along, owner, speed, lengths)
    a, b = rows[near], rows[near + 1]  # b leads a
    pair, overlapping = (owner[rows[k]] * np.int64(len(trajectories)) + owner[rows[k + 1]] for k in (near, overlaps))
    apart = ~np.isin(pair, overlapping)
    a, b, pair = a[apart], b[apart], pair[apart]
    gap = np.maximum(along[b] - along[a] - (lengths[owner[a]] + lengths[owner[b]]) / 2, 0.05)
    closing = speed[a] - speed[b]
    value = persistent(pair, trajectories.time_s[a], gap / closing)
    lasts = np.isfinite(value)
    a, b, gap, closing, pair, value = a[lasts], b[lasts], gap[lasts], closing[lasts], pair[lasts], value[lasts]
    gap_sd, closing_sd = (np.sqrt(2) * sd for sd in sds)
    sd = value * np.hypot(gap_sd / gap, closing_sd / closing)
    # the probability on the closing speed's side: the gap is shorter than what this speed needs
    needed = np.minimum(threshold_s * closing, closing**2 / (2 * HARD_BRAKING_M_PER_S2))
    slope = np.minimum(threshold_s, closing / HARD_BRAKING_M_PER_S2)
    probability = special.ndtr((needed - gap) / np.hypot(gap_sd, slope * closing_sd))
    # and that they are not beside each other: errors may put a vehicle on the next lane
    probability *= special.ndtr((VEHICLE_WIDTH_M - np.abs(offset[a] - offset[b])) / gap_sd)
    best = np.lexsort((value, pair))
    _, first = np.unique(pair[best], return_index=True)
    return [
        Conflict(
            "following",
            int(owner[b[i]]),
            int(owner[a[i]]),
            float(trajectories.time_s[a[i]]),
            trajectories.xy_m[a[i]],
            float(value[i]),
            float(sd[i]),
            threshold_s,
            float(probability[i]),
        )
        for i in best[first]
    ]


@kernel
def _sort_along(rows: IntArray, lane: IntArray, frame: IntArray, along: FloatArray) -> None:
    """Bring rows, in place, of one frame and lane, which are together and few, into their order along the lane."""
    for i in range(1, len(rows)):
        row, k = rows[i], i
        while (
            k > 0
            and lane[rows[k - 1]] == lane[row]
            and frame[rows[k - 1]] == frame[row]
            and along[rows[k - 1]] > along[row]
        ):
            rows[k] = rows[k - 1]
            k -= 1
        rows[k] = row


@kernel
def _followers(
    rows: IntArray,
    lane: IntArray,
    frame: IntArray,
    along: FloatArray,
    owner: IntArray,
    speed: FloatArray,
    lengths: FloatArray,
) -> tuple[IntArray, IntArray]:
    """Numbers k at which ``rows[k]`` closes in on its leader ``rows[k + 1]``, and at which the two overlap."""
    near, overlaps = np.empty(len(rows), np.int64), np.empty(len(rows), np.int64)
    n = m = 0
    for k in range(len(rows) - 1):
        a, b = rows[k], rows[k + 1]
        if lane[a] != lane[b] or frame[a] != frame[b]:
            continue
        gap = along[b] - along[a] - (lengths[owner[a]] + lengths[owner[b]]) / 2
        closing = speed[a] - speed[b]
        if gap < -_OVERLAP_M:
            overlaps[m] = k
            m += 1
        moves = closing > 0.5 and speed[a] > _MIN_FOLLOWER_M_PER_S
        if moves and gap < MAX_TTC_S * closing and owner[a] != owner[b]:
            near[n] = k
            n += 1
    return near[:n].copy(), overlaps[:m].copy()


def persistent(pair: IntArray, time_s: FloatArray, value_s: FloatArray) -> FloatArray:
    """The largest value (n,) of each pair within `_PERSISTENCE_S` from each time on; infinite where it is shorter, or
    has a gap as long."""
    n = len(value_s)
    out = np.full(n, np.inf)
    if not n:
        return out
    order = np.lexsort((time_s, pair))
    time, largest = time_s[order], value_s[order].copy()
    end = np.flatnonzero(np.r_[np.diff(pair[order]) != 0, True])
    end = np.repeat(end, np.diff(np.r_[-1, end]))  # last row of each row's pair
    value, lasts, unbroken = value_s[order], np.zeros(n, bool), np.ones(n, bool)
    rows, ahead = np.arange(n), 0
    while len(rows):  # rows whose time is not up yet, one further row of their pair at each step
        ahead += 1
        rows = rows[rows + ahead <= end[rows]]
        step = time[rows + ahead] - time[rows + ahead - 1]
        unbroken[rows] &= step <= _PERSISTENCE_S
        largest[rows] = np.maximum(largest[rows], value[rows + ahead])
        done = time[rows + ahead] >= time[rows] + _PERSISTENCE_S - 1e-9
        lasts[rows[done]] = True
        rows = rows[~done]
    out[order[lasts & unbroken]] = largest[lasts & unbroken]
    return out


def positions_on_lanes(trajectories: Trajectories, graph: LaneGraph) -> tuple[IntArray, FloatArray, FloatArray]:
    """Lane of each position (m,), -1: none, distance along it, and to the right of its centre line, m."""
    samples = graph.samples
    if not len(samples) or not len(trajectories):
        none = np.zeros(len(trajectories.time_s))
        return np.full(len(none), -1), none, none
    lane, along = _between(
        trajectories.first, trajectories.time_s, samples.track, samples.lane, samples.along_m, samples.time_s
    )
    offset = np.zeros(len(along))
    for one in graph:
        rows = np.flatnonzero(lane == one.number)
        x, y = (trajectories.xy_m[rows, k] - np.interp(along[rows], one.along_m, one.xy_m[:, k]) for k in (0, 1))
        way = np.interp(along[rows], one.along_m, np.unwrap(one.direction_rad))
        offset[rows] = y * np.cos(way) - x * np.sin(way)
        # who left the lane, and came back, was elsewhere between two samples on it
        lane[rows[np.hypot(x, y) > _ON_LANE_M]] = -1
    return lane, along, offset


@kernel
def _between(
    first: IntArray,
    time_s: FloatArray,
    sample_track: IntArray,
    sample_lane: IntArray,
    sample_along: FloatArray,
    sample_time: FloatArray,
) -> tuple[IntArray, FloatArray]:
    """Lane and distance of each position, between the two samples of its track around its time."""
    lane, along = np.full(len(time_s), -1, np.int64), np.zeros(len(time_s))
    k, last = 0, len(sample_track) - 1
    for track in range(len(first) - 1):
        for i in range(first[track], first[track + 1]):
            t = time_s[i]
            # the first sample of this track, or of a later one, that is not before the position
            while k <= last and (sample_track[k] < track or (sample_track[k] == track and sample_time[k] < t)):
                k += 1
            at = min(max(k - 1, 0), last - 1)
            if sample_track[at] == track and sample_track[at + 1] == track and sample_lane[at] == sample_lane[at + 1]:
                lasts = max(sample_time[at + 1] - sample_time[at], 1e-9)
                f = min(max((t - sample_time[at]) / lasts, 0.0), 1.0)
                lane[i] = sample_lane[at]
                along[i] = sample_along[at] + f * (sample_along[at + 1] - sample_along[at])
    return lane, along
