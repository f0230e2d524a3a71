"""Counts by slice of time: movements through junctions, and from origins to destinations."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from schemas.arrays import FloatArray, IntArray
from velfield.analysis.intervals import Estimate, estimate_rate
from velfield.analysis.movements.movements import JunctionMovements
from velfield.analysis.movements.scene import OriginDestination

SLICE_S = 300.0
MIN_SLICES = 2
"""A shorter flight is not cut into slices."""


@dataclass(frozen=True)
class SliceCount:
    """Vehicles of one slice that go from one arm to another; ``junction`` is None for the whole scene."""

    junction: int | None
    arm_in: str
    arm_out: str
    begin_s: float
    end_s: float
    seen: int
    inferred: float
    flow_veh_per_h: Estimate | None


def slice_edges(begin_s: float, end_s: float, slice_s: float) -> FloatArray:
    """Borders (k + 1,) of the slices of a time, the last of which is at least half as long as the others; none where it
    is no longer than two.

    Examples
    --------
    >>> slice_edges(0.0, 700.0, 300.0).tolist(), slice_edges(0.0, 800.0, 300.0).tolist()
    ([0.0, 300.0, 700.0], [0.0, 300.0, 600.0, 800.0])
    >>> slice_edges(0.0, 600.0, 300.0).tolist()
    []
    """
    if end_s - begin_s <= MIN_SLICES * slice_s:
        return np.empty(0)
    whole = int((end_s - begin_s) / slice_s + 0.5)
    return np.append(begin_s + slice_s * np.arange(whole), end_s)


def movements_by_slice(
    junctions: Sequence[JunctionMovements], edges_s: FloatArray, seen_s: FloatArray
) -> list[SliceCount]:
    """Movements of each junction by slice of their entry, of which ``seen_s`` (k,) is seen: what is inferred of an
    entry's lost vehicles goes to the slices in which they were lost."""
    return [count for junction in junctions if len(edges_s) for count in _of_junction(junction, edges_s, seen_s)]


def _of_junction(found: JunctionMovements, edges_s: FloatArray, seen_s: FloatArray) -> Iterator[SliceCount]:
    passes, names = found.passes, [arm.name for arm in found.gates.arms]
    arm = np.array([gate.arm for gate in found.gates.gates] + [-1], np.int64)
    arm_in, arm_out = arm[passes.gate_in], arm[passes.gate_out]
    for movement in found.movements:
        i, j = names.index(movement.arm_in), names.index(movement.arm_out)
        whole = (arm_in == i) & (arm_out == j)
        seen, joined = (_histogram(passes.entry_s[whole & rows], edges_s) for rows in (~passes.joined, passes.joined))
        lost = _histogram(passes.entry_s[(arm_in == i) & (arm_out < 0)], edges_s)
        inferred = joined + (movement.inferred - joined.sum()) * lost / max(lost.sum(), 1.0)
        yield from _counts(movement.junction, names[i], names[j], edges_s, seen_s, seen, inferred)


def origins_by_slice(scene: OriginDestination | None, edges_s: FloatArray, seen_s: FloatArray) -> list[SliceCount]:
    """Vehicles from origins to destinations by slice of their entry."""
    if scene is None or not len(edges_s):
        return []
    trips = scene.trips
    out: list[SliceCount] = []
    for relation in scene.relations:
        i, j = relation.origin.number, relation.destination.number
        own = trips.origin == i
        seen = _histogram(trips.entry_s[own & trips.seen & (trips.destination[:, j] == 1.0)], edges_s)
        rows = own & ~trips.seen
        inferred = np.histogram(trips.entry_s[rows], edges_s, weights=trips.destination[rows, j])[0]
        out += _counts(None, relation.origin.name, relation.destination.name, edges_s, seen_s, seen, inferred)
    return out


def _histogram(time_s: FloatArray, edges_s: FloatArray) -> IntArray:
    return np.asarray(np.histogram(time_s[np.isfinite(time_s)], edges_s)[0])


def _counts(
    junction: int | None,
    arm_in: str,
    arm_out: str,
    edges_s: FloatArray,
    seen_s: FloatArray,
    seen: IntArray,
    inferred: FloatArray,
) -> Iterator[SliceCount]:
    for k, (begin, end) in enumerate(pairwise(edges_s)):
        if seen_s[k] < (end - begin) / 4:
            continue
        flow = estimate_rate(np.array([seen[k] + inferred[k]]), float(seen_s[k]) / 3600)
        yield SliceCount(junction, arm_in, arm_out, float(begin), float(end), int(seen[k]), float(inferred[k]), flow)
