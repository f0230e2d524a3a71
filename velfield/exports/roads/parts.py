"""Lanes cut at intersections: what formats of roads need, where lanes that cross meet in a node."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from schemas.arrays import FloatArray
from velfield.analysis.lanes.find import MIN_TRACKS
from velfield.analysis.lanes.junctions import inside_hull
from velfield.analysis.lanes.model import Lane, LaneGraph, LaneSamples


@dataclass(frozen=True)
class LaneParts:
    """Parts of lanes outside intersections."""

    graph: LaneGraph
    """The parts as lanes, numbered anew, with the samples on them; without connections and junctions."""
    lanes: tuple[int, ...]
    """Number of the lane of each part."""
    names: tuple[str, ...]
    """``lane2``; ``lane2#0``, ``lane2#1`` of a lane in several parts."""
    ends: tuple[tuple[int | None, int | None], ...]
    """Numbers of the intersections at which each part begins and ends; None: at none."""
    connections: tuple[tuple[int, int], ...]
    """Pairs of parts (from, to) along which vehicles drive."""


def cut_at_intersections(graph: LaneGraph, hulls_m: Mapping[int, FloatArray]) -> LaneParts:
    """The parts of a graph's lanes outside the areas (k, 2) of intersections, given by their numbers.

    Parts are connected where their lanes are, where they follow each other on one lane, and through an intersection
    where at least `MIN_TRACKS` vehicles went from the one to the other. Lanes within an intersection have no part.
    """
    parts: list[Lane] = []
    names: list[str] = []
    ends: list[tuple[int | None, int | None]] = []
    of_lane: list[list[int]] = []
    part, along = np.full(len(graph.samples), -1), graph.samples.along_m.copy()
    for lane in graph:
        at = np.full(len(lane.xy_m), -1)
        for k, hull in hulls_m.items():
            at[inside_hull(lane.xy_m, hull)] = k
        runs = np.split(np.arange(len(at)), np.flatnonzero(np.diff(at)) + 1)
        outside = [run for run in runs if at[run[0]] < 0]
        of_lane.append(list(range(len(parts), len(parts) + len(outside))))
        for k, run in enumerate(outside):
            first, last = max(int(run[0]) - 1, 0), min(int(run[-1]) + 1, len(at) - 1)  # to the intersection's border
            begin, end = lane.along_m[first], lane.along_m[last]
            rows = (graph.samples.lane == lane.number) & (graph.samples.along_m >= begin)
            rows &= graph.samples.along_m <= end
            part[rows] = len(parts)
            along[rows] -= begin
            names.append(f"lane{lane.number}" + (f"#{k}" if len(outside) > 1 else ""))
            ends.append((int(at[first]) if at[first] >= 0 else None, int(at[last]) if at[last] >= 0 else None))
            parts.append(replace(lane, number=len(parts), xy_m=lane.xy_m[first : last + 1], left=None, right=None))
    samples = _on_parts(graph.samples, part, along)
    tracks = np.bincount(np.unique(np.column_stack([samples.lane, samples.track]), axis=0)[:, 0], minlength=len(parts))
    cut = LaneGraph(tuple(replace(p, tracks=int(n)) for p, n in zip(parts, tracks, strict=True)), (), (), samples)
    linked = {pair for mine in of_lane for pair in pairwise(mine)}
    linked |= {
        (of_lane[one.start][-1], of_lane[one.end][0])
        for one in graph.connections
        if of_lane[one.start] and of_lane[one.end]
    }
    linked |= _driven(samples, ends)
    return LaneParts(
        cut,
        tuple(n for n, mine in enumerate(of_lane) for _ in mine),
        tuple(names),
        tuple(ends),
        tuple(sorted(linked)),
    )


def _on_parts(samples: LaneSamples, part: np.ndarray, along_m: FloatArray) -> LaneSamples:
    made = replace(samples, lane=part, along_m=along_m)
    return LaneSamples(*(getattr(made, name)[part >= 0] for name in LaneSamples.__dataclass_fields__))


def _driven(samples: LaneSamples, ends: Sequence[tuple[int | None, int | None]]) -> set[tuple[int, int]]:
    """Pairs of parts that enough vehicles drove one after the other, through one intersection."""
    goes_on = np.flatnonzero((np.diff(samples.track) == 0) & (np.diff(samples.lane) != 0))
    counts = Counter(zip(samples.lane[goes_on].tolist(), samples.lane[goes_on + 1].tolist(), strict=True))
    return {
        (a, b)
        for (a, b), n in counts.items()
        if n >= MIN_TRACKS and ends[a][1] is not None and ends[a][1] == ends[b][0]
    }
