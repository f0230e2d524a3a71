"""Turns from the middle of one way to the middle of another: too short and too rarely driven to have a ridge.

A turn of few vehicles is 5 to 20 m long; which of them a node of the ridges holds depends on errors of a decimetre.
Who leaves one way for another is known without: by the ways on which they drive long before it and long after it.
"""

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from schemas.arrays import FloatArray, IntArray, Mask
from velfield.analysis.lanes.graph import count_once
from velfield.analysis.lanes.ridges import NODE_SPACING_M, Nodes
from velfield.analysis.trajectories import PathSamples

_WAY_M = 25.0
"""A chain of nodes so long is a way; what is shorter may be the turn from one to the other."""
_ON_WAY = 6
"""A vehicle that drives on a way has so many samples on it, which are 1 m apart."""
_TURN_MAX = 25
"""A turn has no more samples between the ways: a quarter of a circle of 16 m radius."""
_MARGIN = 2
"""The first and the last so many samples of a turn lie within reach of the ways."""
_TURN_RAD = np.radians(40), np.radians(130)
"""Change of direction of half of the vehicles that go from a way to another: of fewer degrees they change lanes, or
the ways part; of more they reverse."""
_SAME_PLACE_NODES = 8
"""Vehicles that leave a way farther apart for the same other do so at two places."""


@dataclass(frozen=True)
class _Passes:
    """Tracks that go from one way to another: rows ``first`` to ``last`` of their samples, and the ``turn`` (n,) that
    each takes; whether enough take each turn, ``often`` (turns,)."""

    first: IntArray
    last: IntArray
    turn: IntArray
    often: Mask

    @property
    def rows(self) -> tuple[IntArray, IntArray, FloatArray]:
        """Rows (m,) of the turns' samples, the number of the track's pass, and the share of the turn behind each."""
        length = self.last - self.first + 1
        begin, of = np.repeat(np.cumsum(length) - length, length), np.repeat(np.arange(len(length)), length)
        within = np.arange(len(of)) - begin
        return self.first[of] + within, of, within / length[of]


def add_turns(
    nodes: Nodes, node: IntArray, samples: PathSamples, chains: list[IntArray], *, min_tracks: int
) -> tuple[Nodes, IntArray]:
    """Nodes along the mean path of the vehicles that take each turn, and the node (n,) of each sample.

    Parameters
    ----------
    nodes, chains
        The ridges' nodes, and the numbers of those of each chain.
    node
        (n,) node of each sample, -1: none.
    min_tracks
        Fewest tracks of a turn.
    """
    ways = [chain for chain in chains if np.hypot(*np.diff(nodes.xy_m[chain], axis=0).T).sum() >= _WAY_M]
    passes = _find_passes(nodes, node, samples, ways, min_tracks)
    rows, of, share = passes.rows
    n = len(passes.often)
    total_m = np.bincount(passes.turn, passes.last - passes.first, n)
    mean_m = total_m / np.maximum(np.bincount(passes.turn, minlength=n), 1)
    parts = np.maximum(np.rint(mean_m / NODE_SPACING_M), 1).astype(np.int64)
    begin = len(nodes) + np.r_[0, np.cumsum(parts)].astype(np.int64)
    turn = passes.turn[of]
    new = begin[turn] + (share * parts[turn]).astype(np.int64)
    often = passes.often[turn]
    out = _take_over(node, rows[often], new[often], ways, int(begin[-1]))
    out[rows] = new
    xy, direction = _nodes_at(samples, rows, new - len(nodes), int(parts.sum()))
    made = replace(
        nodes,
        xy_m=np.concatenate([nodes.xy_m, xy]),
        direction_rad=np.concatenate([nodes.direction_rad, direction]),
        weight=np.bincount(out[out >= 0], minlength=int(begin[-1])).astype(np.float64),
    )
    return made, out


def _find_passes(nodes: Nodes, node: IntArray, samples: PathSamples, ways: list[IntArray], min_tracks: int) -> _Passes:
    way_of, position = np.full(len(nodes) + 1, -1), np.zeros(len(nodes), np.int64)
    for number, chain in enumerate(ways):
        way_of[chain], position[chain] = number, np.arange(len(chain))
    rows = np.flatnonzero(way_of[node] >= 0)
    way, track = way_of[node[rows]], samples.track[rows]
    # a sample off the way ends the drive on it: the vehicle may waver between the way and the turn
    broken = (way[1:] != way[:-1]) | (track[1:] != track[:-1]) | (np.diff(rows) > 1)
    new = np.flatnonzero(np.r_[True, broken]) if len(rows) else rows
    end = np.r_[new[1:], len(rows)] if len(new) else new
    long = end - new >= _ON_WAY
    new, end = new[long], end[long] - 1
    a, b = end[:-1], new[1:]
    turned = np.abs(
        _between(nodes.direction_rad[node[rows[a - _MARGIN]]], nodes.direction_rad[node[rows[b + _MARGIN]]])
    )
    goes = (track[a] == track[b]) & (way[a] != way[b]) & (rows[b] - rows[a] <= _TURN_MAX)
    a, b, turned = a[goes], b[goes], turned[goes]
    pair, place = way[a] * np.int64(len(ways)) + way[b], position[node[rows[a]]]
    order = np.lexsort((place, pair))
    pair, place = pair[order], place[order]
    apart = (pair[1:] != pair[:-1]) | (place[1:] - place[:-1] > _SAME_PLACE_NODES)
    group = np.cumsum(np.r_[False, apart]) if len(order) else np.empty(0, np.int64)
    first, last = rows[a[order]] - _MARGIN + 1, rows[b[order]] + _MARGIN - 1
    n = int(group.max(initial=-1)) + 1
    angle = pd.Series(turned[order]).groupby(group).median().to_numpy(np.float64)
    is_turn = ((angle >= _TURN_RAD[0]) & (angle <= _TURN_RAD[1]))[group]
    often = count_once(samples.track[first], group, n) >= min_tracks
    turns, turn = np.unique(group[is_turn], return_inverse=True)
    return _Passes(first[is_turn], last[is_turn], turn, often[turns])


def _between(a_rad: FloatArray, b_rad: FloatArray) -> FloatArray:
    return np.asarray(np.angle(np.exp(1j * (b_rad - a_rad))))


def _nodes_at(samples: PathSamples, rows: IntArray, number: IntArray, n: int) -> tuple[FloatArray, FloatArray]:
    """Mean position (n, 2) and direction (n,) of the samples of each of n nodes."""
    count = np.maximum(np.bincount(number, minlength=n), 1)
    x, y, cos, sin = (
        np.bincount(number, values, n)
        for values in (*samples.xy_m[rows].T, np.cos(samples.direction_rad[rows]), np.sin(samples.direction_rad[rows]))
    )
    return np.column_stack([x, y]) / count[:, None], np.arctan2(sin, cos)


def _take_over(node: IntArray, rows: IntArray, new: IntArray, ways: list[IntArray], n: int) -> IntArray:
    """The node (k,) of each sample, after those of a ridge between the ways, which most of its samples' vehicles take
    to turn, became the turn's: of ``n`` with those of the turns."""
    old = node[rows]
    between = (old >= 0) & ~np.isin(old, np.concatenate(ways) if ways else [])
    pairs, count = np.unique(old[between] * np.int64(n) + new[between], return_counts=True)
    order = np.argsort(-count, kind="stable")
    owner, best = np.unique(pairs[order] // n, return_index=True)
    total, used = np.bincount(node[node >= 0], minlength=n), np.bincount(old[between], minlength=n)
    mostly = 2 * used[owner] > total[owner]
    to = np.arange(-1, n)
    to[owner[mostly] + 1] = pairs[order][best][mostly] % n
    return np.asarray(to[node + 1])
