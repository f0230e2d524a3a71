"""Gap closing: tracks that a missed detection interrupted are joined.

A detector misses a car now and then, and its track ends there; without gap closing a flight counts each vehicle about
four times, and those in a queue more often. Both sides of a gap give a position and a velocity. Under a constant
acceleration between them the displacement is the mean of the two velocities times the gap, whatever the acceleration,
so the start of the later track is predicted to better than a metre for gaps of a second or two. A stationary vehicle is
predicted where it was, however long the gap. Traffic that creeps under trees is hidden for longer than either holds;
but it keeps to its lane and its order, and it cannot vanish.

All joins are chosen at once: a one-to-one assignment of ends to starts of the least total cost, where an end or a start
that is left alone in the middle of the frames costs more than one at their border. What the total would cost more
without a join is the evidence for it, and gives its probability.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, min_weight_full_bipartite_matching

from schemas.arrays import FloatArray, IntArray, Mask
from schemas.flight import assumed_gsd_m
from velfield.compiled import kernel
from velfield.tracking.dimensions import looks_difference
from velfield.tracking.join_costs import CERTAINTY_SLOPE, STATIONARY_OFFSET_M, GapLimits, TrackEnds, find_candidates

_ALONE_COST = 1.0
"""Cost of a track's end, or start, that continues in none; a pair costs at most twice as much."""
_VANISHED_COST = 0.6
"""Additional cost of an end or start in the middle of the frames and of the flight: few vehicles vanish there, under
trees."""
_DOUBTFUL_S, _DOUBTFUL_COST = 1.0, 0.8
"""Maximum duration of a doubtful track, in one place amid the frames, and the cost of its end or start: two of five are
of no vehicle (simulated flights)."""
_UNDECIDED_LOOKS_DIFFERENCE = 0.68
"""Difference of looks, in standard deviations of a strip, that is as likely for one vehicle as for two: the median is
0.43 for one, 1.08 for two, the logarithm normal with a standard deviation of 0.5 for both (simulated flights)."""
_LOOKS_WEIGHT, _MIN_LOOKS_COST, _MAX_LOOKS_COST = 1.23, -0.3, 1.3
"""Cost of looks by the logarithm of their difference over that, which is a log likelihood ratio in units of cost; and
its limits."""
_MIN_PROBABILITY = 0.9
"""A join of a lower probability is not made."""
_VELOCITY_SLACK_M_PER_S = 1.5
"""By how much a velocity at an end may differ from the median of what is known around it: an acceleration within a
link's time."""
_MAX_TABLE = 250_000
"""Ends times starts of a group up to which they are assigned by a table of all."""
_LOOKS_AT_ONCE = 20_000
_NEIGHBOURHOOD, _SURE_MARGIN = 80, 1.5
"""Ends and starts around a join among which another assignment without it is looked for; not where the best other
partners of both sides show already that the total would cost so much more."""


END_COLUMNS = [
    *("frame_0", "time_0_s", "x_0_px", "y_0_px", "vx_01_px_per_s", "vy_01_px_per_s"),
    *("frame_2", "time_2_s", "x_2_px", "y_2_px", "vx_12_px_per_s", "vy_12_px_per_s"),
]
"""Columns of tracklets that `find_ends` reads."""


@dataclass(frozen=True)
class EndContext:
    """Properties of the ends and the starts of tracks, apart from their motion; tracks in the order of their ids."""

    end_vanishes: Mask
    start_vanishes: Mask
    """(tracks,) whether the end, or the start, lies in the middle of the frames and of the flight."""
    end_looks: FloatArray
    start_looks: FloatArray
    """(tracks, 16, 6) mean looks before the end and after the start (`velfield.tracking.dimensions.looks`); NaN where
    unknown."""
    length_m: FloatArray
    """(tracks,) what each vehicle is longer than, but for one in six: its length less a standard deviation; NaN where
    unknown."""


@dataclass(frozen=True)
class ClosedGaps:
    """Tracks after gap closing."""

    tracks: IntArray
    """(tracks,) int64 the track that each is part of: the smallest of the ids of those that were joined."""
    joins: pd.DataFrame
    """A row a join, in time order: ``track_id``, ``before`` and ``after`` (ids of the tracks that it joins),
    ``end_time_s``, ``start_time_s``, ``probability`` that it is right."""


def close_gaps(
    ids: IntArray,
    ends: TrackEnds,
    starts: TrackEnds,
    gaps: GapLimits,
    context: EndContext | None = None,
    *,
    open_end: Mask | None = None,
    open_start: Mask | None = None,
) -> ClosedGaps:
    """Join tracks that continue each other over a gap.

    Parameters
    ----------
    ids
        (tracks,) ascending.
    ends, starts
        Last and first positions of each track.
    gaps
        The longest gaps.
    context
        None: from motion alone.
    open_end, open_start
        (tracks,) whether each end, or start, may be joined; None: all.
    """
    pairs, cost = find_candidates(ends, starts, gaps, None if context is None else context.length_m)
    if open_end is not None and open_start is not None:
        may = open_end[pairs[:, 0]] & open_start[pairs[:, 1]]
        pairs, cost = pairs[may], cost[may]
    alone = _cost_alone(pairs, ends, starts, context)
    if context is not None:
        blocks = np.split(pairs, range(_LOOKS_AT_ONCE, len(pairs), _LOOKS_AT_ONCE))  # 1.5 kB a pair
        looks = [_cost_of_looks(context.end_looks[one[:, 0]], context.start_looks[one[:, 1]]) for one in blocks]
        cost = cost + np.concatenate(looks)
    joined, margin = _assign(pairs, alone.sum(axis=0) - cost)
    probability = 1 / (1 + np.exp(-CERTAINTY_SLOPE * margin))
    if context is not None:
        sure = probability >= _MIN_PROBABILITY
        joined, probability = joined[sure], probability[sure]
    tracks = component_minimum(ids, joined)
    joins = pd.DataFrame(
        {
            "track_id": tracks[joined[:, 0]],
            "before": ids[joined[:, 0]],
            "after": ids[joined[:, 1]],
            "end_time_s": ends.time_s[joined[:, 0]],
            "start_time_s": starts.time_s[joined[:, 1]],
            "probability": probability,
        }
    )
    return ClosedGaps(tracks, joins.sort_values(["end_time_s", "before"], ignore_index=True))


def _cost_alone(pairs: IntArray, ends: TrackEnds, starts: TrackEnds, context: EndContext | None) -> FloatArray:
    """(2, m) what it costs to leave the end and the start of each candidate pair alone."""
    if context is None:
        return np.full((2, len(pairs)), _ALONE_COST)
    alone = _ALONE_COST + _VANISHED_COST * np.stack(
        [context.end_vanishes[pairs[:, 0]], context.start_vanishes[pairs[:, 1]]]
    )
    doubtful = np.hypot(*(ends.position_m - starts.position_m).T) <= STATIONARY_OFFSET_M
    doubtful &= (ends.time_s - starts.time_s <= _DOUBTFUL_S) & context.end_vanishes & context.start_vanishes
    sides = doubtful[pairs.T]
    # two of them in one place are one thing, whatever it is
    return np.where(sides & (sides[0] ^ sides[1]), _DOUBTFUL_COST, alone)


def find_ends(tracklets: pd.DataFrame, track: IntArray, count: int, gsd_m: float | None) -> tuple[TrackEnds, TrackEnds]:
    """Starts and ends of tracks, from `END_COLUMNS`; ``track`` (n,) is the index of each tracklet's, of ``count``.

    A velocity is that of the last link, unless the links and positions before contradict it: half under a tree a crop
    aligns with the leaves.
    """
    metres = assumed_gsd_m(gsd_m)
    first, last = end_rows(tracklets, track, count)
    starts = _ends(tracklets, track, first, ("0", "01", "12"), metres)
    return starts, _ends(tracklets, track, last, ("2", "12", "01"), metres)


def _ends(
    tracklets: pd.DataFrame, track: IntArray, rows: IntArray, names: tuple[str, str, str], metres: float
) -> TrackEnds:
    """The ends at the outer tracklet (count,) of each track: ``names`` of its outer detection, outer and inner link."""
    detection, outer, inner = names
    order = np.lexsort((tracklets[f"time_{detection}_s"].to_numpy(), track))
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    beside = order[np.clip(rank[rows] + (1 if detection == "0" else -1), 0, max(len(order) - 1, 0))]
    ends, before = tracklets.iloc[rows], tracklets.iloc[beside]
    alone = ((track[beside] != track[rows]) | (beside == rows))[:, None]
    last = _velocity(ends, outer)
    known = [last, _velocity(ends, inner), _velocity(ends, None)]
    known += [np.where(alone, np.nan, _velocity(before, link)) for link in (inner, None)]
    usual = np.nanmedian(np.stack(known), axis=0)
    contradicted = np.hypot(*(last - usual).T) * metres > _VELOCITY_SLACK_M_PER_S
    return TrackEnds(
        ends[f"frame_{detection}"].to_numpy(np.int64),
        ends[f"time_{detection}_s"].to_numpy(np.float64),
        ends[[f"x_{detection}_px", f"y_{detection}_px"]].to_numpy(np.float64) * metres,
        np.where(contradicted[:, None], usual, last) * metres,
    )


def _velocity(rows: pd.DataFrame, link: str | None) -> FloatArray:
    """(n, 2) px/s of a link of tracklets; None: by their first and last positions."""
    if link is not None:
        return rows[[f"vx_{link}_px_per_s", f"vy_{link}_px_per_s"]].to_numpy(np.float64)
    duration = (rows["time_2_s"] - rows["time_0_s"]).to_numpy(np.float64)
    moved = [(rows[f"{axis}_2_px"] - rows[f"{axis}_0_px"]).to_numpy(np.float64) for axis in "xy"]
    return np.asarray(np.column_stack(moved) / duration[:, None])


def end_rows(tracklets: pd.DataFrame, track: IntArray, count: int) -> tuple[IntArray, IntArray]:
    """(count,) the first and the last tracklet of each track, whose index ``track`` (n,) gives."""
    order = np.lexsort((tracklets["time_0_s"].to_numpy(), track))
    first = order[np.searchsorted(track[order], np.arange(count))]
    order = np.lexsort((tracklets["time_2_s"].to_numpy(), track))
    return first, order[np.searchsorted(track[order], np.arange(count), side="right") - 1]


def _cost_of_looks(before: FloatArray, after: FloatArray) -> FloatArray:
    """A difference larger than of one vehicle costs, a smaller one gains; nothing where looks are unknown."""
    difference = looks_difference(before, after)
    ratio = np.log(np.maximum(difference, 1e-3) / _UNDECIDED_LOOKS_DIFFERENCE)
    return np.nan_to_num(np.clip(_LOOKS_WEIGHT * ratio, _MIN_LOOKS_COST, _MAX_LOOKS_COST))


def _assign(pairs: IntArray, gain: FloatArray) -> tuple[IntArray, FloatArray]:
    """Select the candidate pairs (m, 2) of the greatest total gain, each end with at most one start and the reverse.

    Returns (k, 2) pairs, and (k,) by how much the total would be less without each.
    """
    pairs, gain = pairs[gain > 0], gain[gain > 0]
    if not len(pairs):
        return pairs, gain
    ends, start_base = pairs[:, 0], int(pairs.max()) + 1
    graph = coo_array((np.ones(len(pairs), np.int8), (ends, start_base + pairs[:, 1])), shape=(2 * start_base,) * 2)
    _, label = connected_components(graph, directed=False)
    group = label[ends]
    order = np.argsort(group, kind="stable")
    chosen, margins = [], []
    for rows in np.split(order, np.flatnonzero(np.diff(group[order])) + 1):
        end, row = np.unique(pairs[rows, 0], return_inverse=True)
        start, column = np.unique(pairs[rows, 1], return_inverse=True)
        solve = _assign_table if len(end) * len(start) <= _MAX_TABLE else _assign_sparse
        best, margin = solve(row, column, gain[rows])
        chosen.append(np.column_stack([end[best[:, 0]], start[best[:, 1]]]))
        margins.append(margin)
    return np.concatenate(chosen), np.concatenate(margins)


def _assign_table(row: IntArray, column: IntArray, gain: FloatArray) -> tuple[IntArray, FloatArray]:
    """The best pairs (k, 2) of rows and columns, by a table of all, and their margins."""
    table = np.zeros((int(row.max()) + 1, int(column.max()) + 1))
    table[row, column] = gain
    best = np.stack(linear_sum_assignment(-table), axis=1)
    best = best[table[best[:, 0], best[:, 1]] > 0]
    return best, _margins(row, column, gain, best)


def _assign_sparse(row: IntArray, column: IntArray, gain: FloatArray) -> tuple[IntArray, FloatArray]:
    """As `_assign_table`, in memory that grows with the pairs: those of a long flight may hang together throughout.

    Every row has a column of its own beside the others, for which it gains nothing.
    """
    rows, columns = int(row.max()) + 1, int(column.max()) + 1
    own = np.arange(rows)
    weight = 1 + gain.max() - np.concatenate([gain, np.zeros(rows)])  # a sparse zero would be no edge
    nodes = (np.concatenate([row, own]), np.concatenate([column, columns + own]))
    matched = min_weight_full_bipartite_matching(coo_array((weight, nodes), shape=(rows, columns + rows)).tocsr())[1]
    order = np.flatnonzero(matched[row] == column)
    order = order[np.argsort(row[order])]
    best = np.column_stack([row[order], column[order]])
    return best, _margins(row, column, gain, best)


def _margins(row: IntArray, column: IntArray, gain: FloatArray, best: IntArray) -> FloatArray:
    """By how much the total gain falls without each of the best pairs (k, 2), the others around it assigned again."""
    rows, columns = int(row.max()) + 1, int(column.max()) + 1
    order, order_of_starts = (np.argsort(one, kind="stable") for one in (row, column))
    begins = np.searchsorted(row[order], np.arange(rows + 1))
    begins_of_starts = np.searchsorted(column[order_of_starts], np.arange(columns + 1))
    beside = (begins, column[order], begins_of_starts, row[order_of_starts])
    partner = (np.full(rows, -1), np.full(columns, -1))
    partner[0][best[:, 0]], partner[1][best[:, 1]] = best[:, 1], best[:, 0]
    is_best = partner[0][row] == column
    best_of_row, best_of_column = np.zeros(rows), np.zeros(columns)
    np.maximum.at(best_of_row, row[~is_best], gain[~is_best])
    np.maximum.at(best_of_column, column[~is_best], gain[~is_best])
    own = np.zeros(rows)
    own[row[is_best]] = gain[is_best]
    bound = own[best[:, 0]] - best_of_row[best[:, 0]] - best_of_column[best[:, 1]]
    margins = np.maximum(bound, 0.0)
    gains, at = gain[order], (np.full(rows, -1), np.full(columns, -1))
    for number in np.flatnonzero(bound < _SURE_MARGIN).tolist():
        near, whole = _neighbourhood(best[number, 0], best[number, 1], beside, partner, gains, at)
        near[0, 0] = 0  # the pair itself: it is the first of the neighbourhood
        other = linear_sum_assignment(-near)
        margins[number] = max(whole - float(near[other].sum()), 0.0)
    return margins


@kernel
def _neighbourhood(end, start, beside, partner, gains, at) -> tuple[FloatArray, float]:  # type: ignore[no-untyped-def]
    """The gains (n, m) of ends and starts around a pair, the nearest by candidates first, each with its partner; and
    the sum of those of partners.

    ``beside``: where the candidates of each end begin, and they; then of each start. ``gains`` as those of the ends.
    ``partner`` of each end, and start; -1 is none. ``at`` is scratch, the place of each end, and start; -1 and so left.
    """
    found = ([end], [start])
    at[0][end], at[1][start] = 0, 0
    front = [(0, end), (1, start)]
    while len(front) and len(found[0]) + len(found[1]) < _NEIGHBOURHOOD:
        following = [(0, end) for _ in range(0)]
        for side, one in front:
            begins, others, across = beside[2 * side], beside[2 * side + 1], 1 - side
            for k in range(begins[one], begins[one + 1]):
                other = others[k]
                if at[across][other] < 0:
                    at[across][other] = len(found[across])
                    found[across].append(other)
                    following.append((across, other))
                    back = partner[across][other]
                    if back >= 0 and at[side][back] < 0:
                        at[side][back] = len(found[side])
                        found[side].append(back)
                        following.append((side, back))
        front = following
    ends, starts = found
    begins, starts_beside = beside[0], beside[1]
    near, whole = np.zeros((len(ends), len(starts))), 0.0
    for i in range(len(ends)):
        for k in range(begins[ends[i]], begins[ends[i] + 1]):
            j = starts_beside[k]
            if at[1][j] >= 0:
                near[i, at[1][j]] = gains[k]
                if j == partner[0][ends[i]]:
                    whole += gains[k]
    for one in ends:
        at[0][one] = -1
    for one in starts:
        at[1][one] = -1
    return near, whole


def assign_tracks(detection_ids: IntArray) -> IntArray:
    """The track of each tracklet: the smallest detection id of its connected component.

    ``detection_ids`` (n, 3) of each tracklet; those that share a detection belong to one track.

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
