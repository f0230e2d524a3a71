"""Scores of a lane graph against the plan: centre lines, and topology by the TOPO measure.

TOPO (Biagioni and Eriksson, "Inferring road maps from GPS traces", 2012): from a seed on both graphs everything is
marked that can be reached within a distance; the marks of the two are matched one to one. A graph with a missing
connection, or one too many, reaches too little, or too much.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from schemas.arrays import FloatArray, IntArray

_REACH_M, _MARK_M, _MATCH_M = 60.0, 5.0, 2.0
_SAME_RAD = np.radians(30)


@dataclass(frozen=True)
class DirectedGraph:
    """Paths (n_i, 2) in metres, and the numbers of the paths after each."""

    paths: Sequence[FloatArray]
    successors: Sequence[Sequence[int]]


@dataclass(frozen=True)
class LaneScore:
    """``precision``, ``recall`` and ``f1`` of the topology; median and 95th percentile of the distance of found centre
    lines from true ones, m."""

    precision: float
    recall: float
    centre_median_m: float
    centre_p95_m: float

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        total = self.precision + self.recall
        return 2 * self.precision * self.recall / total if total else 0.0


def score_lanes(found: DirectedGraph, true: DirectedGraph, *, seeds: int = 200, seed: int = 0) -> LaneScore:
    """Score a found graph of lanes against the true one.

    Parameters
    ----------
    found, true
        The graphs; the true one holds what traffic drove on, within the image.
    seeds
        Number of places from which the graphs are explored.
    """
    rng = np.random.default_rng(seed)
    found_points, true_points = _sample_points(found), _sample_points(true)
    distance = _across(true_points, found_points)
    matched = found_extra = true_extra = 0
    for k in rng.choice(len(true_points), min(seeds, len(true_points)), replace=False):
        reach_true = _explore(true, true_points, int(k))
        gap, start = _nearest(found_points, true_points[[k]])
        marks = _explore(found, found_points, int(start[0])) if gap[0] < 2 * _MATCH_M else true_points[:0]
        pairs = _match(marks, reach_true)
        matched += pairs
        found_extra += len(marks) - pairs
        true_extra += len(reach_true) - pairs
    known = distance[np.isfinite(distance)]
    return LaneScore(
        matched / max(matched + found_extra, 1),
        matched / max(matched + true_extra, 1),
        float(np.median(known)) if len(known) else np.nan,
        float(np.quantile(known, 0.95)) if len(known) else np.nan,
    )


def _sample_points(graph: DirectedGraph) -> FloatArray:
    """Points every metre of all paths: x, y, direction, path, distance along it (n, 5)."""
    rows = []
    for number, path in enumerate(graph.paths):
        along = np.concatenate([[0.0], np.hypot(*np.diff(path, axis=0).T).cumsum()])
        s = np.arange(0.0, along[-1], 1.0)
        xy = np.column_stack([np.interp(s, along, path[:, k]) for k in (0, 1)])
        ahead = np.column_stack([np.interp(s + 1.0, along, path[:, k]) for k in (0, 1)])
        behind = np.column_stack([np.interp(s - 1.0, along, path[:, k]) for k in (0, 1)])
        direction = np.arctan2(*(ahead - behind).T[::-1])
        rows.append(np.column_stack([xy, direction, np.full(len(s), number), s]))
    return np.concatenate(rows) if rows else np.empty((0, 5))


def _nearest(points: FloatArray, queries: FloatArray) -> tuple[FloatArray, IntArray]:
    """Distance to, and number of, the nearest point of the same direction; infinite where there is none near."""
    if not len(points):
        return np.full(len(queries), np.inf), np.full(len(queries), -1)
    near, number = cKDTree(points[:, :2]).query(queries[:, :2], k=min(24, len(points)))
    near, number = np.atleast_2d(near), np.atleast_2d(number)
    turn = np.abs(np.angle(np.exp(1j * (points[number, 2] - queries[:, None, 2]))))
    distance = np.where(turn < _SAME_RAD, near, np.inf)
    best = distance.argmin(axis=1)
    rows = np.arange(len(queries))
    return distance[rows, best], number[rows, best]


def _across(points: FloatArray, queries: FloatArray) -> FloatArray:
    """Distance of each query from the path through the point nearest to it, across it; infinite where none is near."""
    near, number = _nearest(points, queries)
    d = queries[:, :2] - points[number, :2] if len(points) else np.zeros((len(queries), 2))
    direction = points[number, 2] if len(points) else np.zeros(len(queries))
    across = np.abs(d[:, 1] * np.cos(direction) - d[:, 0] * np.sin(direction))
    return np.where(near < 2 * _MATCH_M, across, np.inf)


def _explore(graph: DirectedGraph, points: FloatArray, start: int) -> FloatArray:
    """Marks (n, 3) every few metres that are reached from a point downstream."""
    first = np.searchsorted(points[:, 3], np.arange(len(graph.paths) + 1))
    marks: list[FloatArray] = []
    queue = [(int(points[start, 3]), float(points[start, 4]), 0.0)]
    seen: set[int] = set()
    while queue:
        path, begin, driven = queue.pop()
        part = points[first[path] : first[path + 1]]
        part = part[part[:, 4] >= begin]
        length = (part[-1, 4] - begin + 1.0) if len(part) else 0.0
        at = driven + part[:, 4] - begin
        marks.append(part[(at <= _REACH_M) & (np.floor(at / _MARK_M) != np.floor((at - 1.0) / _MARK_M)), :3])
        if driven + length < _REACH_M:
            for after in graph.successors[path]:
                if after not in seen:
                    seen.add(after)
                    queue.append((after, 0.0, driven + length))
    return np.concatenate(marks) if marks else np.empty((0, 3))


def _match(a: FloatArray, b: FloatArray) -> int:
    """Pairs of marks within reach of each other along the road and across it, one to one."""
    if not len(a) or not len(b):
        return 0
    d = a[:, None, :2] - b[None, :, :2]
    c, s = np.cos(b[None, :, 2]), np.sin(b[None, :, 2])
    along, across = np.abs(d[..., 0] * c + d[..., 1] * s), np.abs(d[..., 1] * c - d[..., 0] * s)
    near = (along < _MARK_M) & (across < _MATCH_M)
    near &= np.abs(np.angle(np.exp(1j * (a[:, None, 2] - b[None, :, 2])))) < _SAME_RAD
    rows, columns = linear_sum_assignment(~near)
    return int(near[rows, columns].sum())
