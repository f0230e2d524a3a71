"""Junctions: where lanes cross, merge or diverge, grouped by their distance."""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial import ConvexHull, cKDTree

from schemas.analysis import JunctionKind
from schemas.arrays import FloatArray, IntArray, Mask
from velfield.analysis.lanes.model import LANE_MAX_M, Connection, Junction, Lane

_NEAR_M = 15.0
"""Meeting points nearer to each other are of one junction: a median is up to 14 m wide."""
_MARGIN_M, _HALF_LANE_M = 4.0, 2.0
"""Margin of a junction's area around its meeting points; and to the side of a lane's centre line in it, as vehicles
beside the centre line pass it, too."""
_PARTED_M, _PARTING_M = 3.5, 25.0
"""Where lanes part the junction reaches to where they lie so far apart: nearer, a vehicle's place does not tell on
which of them it is. It reaches no farther than this."""
_CROSSING_RAD = np.radians(25)
"""Lanes whose directions differ less do not cross: they merge or run beside each other."""
_MAX_RING_M = 220.0
"""Circumference of the largest roundabout."""


def find_junctions(lanes: Sequence[Lane], connections: Sequence[Connection]) -> tuple[Junction, ...]:
    """Junctions of a lane graph, by number from the image's top."""
    rings = _rings(lanes, connections)
    in_ring = {lane for ring in rings for lane in ring}
    points, kinds = _meeting_points(lanes, connections, in_ring)
    groups: list[tuple[FloatArray, JunctionKind]] = [
        (np.concatenate([lanes[k].xy_m for k in ring]), "roundabout") for ring in rings
    ]
    for label in np.unique(_cluster(points)) if len(points) else []:
        inside = _cluster(points) == label
        groups.append((points[inside], _kind(kinds[inside])))
    groups.sort(key=lambda group: (group[0][:, 1].mean(), group[0][:, 0].mean()))
    made: list[Junction] = []
    for xy, kind in groups:
        if kind in ("merge", "diverge"):
            xy = np.concatenate([xy, _parted(xy, lanes, connections)])
        hull = _with_whole_lanes(buffered_hull(xy, _MARGIN_M), lanes)
        if kind in ("intersection", "crossing"):
            hull = _with_lanes_beside(hull, lanes)
        lanes_in, lanes_out, inside_ = _members(lanes, hull)
        made.append(
            Junction(
                number=len(made),
                kind=kind,
                centre_m=hull.mean(axis=0),
                hull_m=hull,
                lanes_in=lanes_in,
                lanes_out=lanes_out,
                lanes_inside=inside_,
            )
        )
    return tuple(made)


def _parted(xy_m: FloatArray, lanes: Sequence[Lane], connections: Sequence[Connection]) -> FloatArray:
    """Points (n, 2) of the lanes that part, or join, at one of the points (k, 2), to where they lie apart."""
    out = [np.empty((0, 2))]
    for along in (1, -1):
        beside: dict[int, list[FloatArray]] = {}
        for link in connections:
            at, to = (link.start, link.end)[::along]
            beside.setdefault(at, []).append(lanes[to].xy_m[::along])
        for at, lines in beside.items():
            place = lanes[at].xy_m[-1 if along == 1 else 0]
            if len(lines) > 1 and np.hypot(*(xy_m - place).T).min() < 1e-6:
                for line in lines:
                    near = line[np.hypot(*(line - place).T) < _PARTING_M]
                    others = np.concatenate([other for other in lines if other is not line])
                    apart = np.asarray(cKDTree(others).query(near)[0]) > _PARTED_M
                    out.append(near[: int(np.argmax(apart))] if apart.any() else near[:0])
    return np.concatenate(out)


def _with_whole_lanes(hull_m: FloatArray, lanes: Sequence[Lane]) -> FloatArray:
    """The hull (n, 2), widened to hold the whole width of the lanes that run through it."""
    points = [hull_m]
    for lane in lanes:
        inside = inside_hull(lane.xy_m, hull_m)
        across = np.column_stack([-np.sin(lane.direction_rad), np.cos(lane.direction_rad)])[inside] * _HALF_LANE_M
        points += [lane.xy_m[inside] - across, lane.xy_m[inside] + across]
    every = np.concatenate(points)
    return np.asarray(every[ConvexHull(every).vertices])


def _with_lanes_beside(hull_m: FloatArray, lanes: Sequence[Lane]) -> FloatArray:
    """The hull (n, 2), widened by the lanes of the same carriageways that run past it.

    At a T-junction nothing crosses the far lane straight on: its vehicles stop at one line with those that turn.
    """
    beside = {(lane.number, other) for lane in lanes for other in (lane.left, lane.right) if other is not None}
    beside |= {(b, a) for a, b in beside}
    while True:
        touches = [inside_hull(lane.xy_m, hull_m).any() for lane in lanes]
        near = {b for a, b in beside if touches[a] and not touches[b] and _near(lanes[a], lanes[b], hull_m)}
        past = [part for k in sorted(near) if len(part := _part_past(lanes[k], hull_m))]
        if not past:
            return hull_m
        every = np.concatenate([hull_m, *(buffered_hull(part, _HALF_LANE_M) for part in past)])
        hull_m = _with_whole_lanes(every[ConvexHull(every).vertices], lanes)


def _near(lane: Lane, other: Lane, hull_m: FloatArray) -> bool:
    """Whether two neighbouring lanes are a lane apart where the first comes to the hull (n, 2), or has left it."""
    at = lane.along_m[inside_hull(lane.xy_m, hull_m)]
    near = (lane.along_m > at[0] - _PARTING_M) & (lane.along_m < at[-1] + _PARTING_M)
    return bool(np.min(cKDTree(other.xy_m).query(lane.xy_m[near])[0]) < LANE_MAX_M)


def _part_past(lane: Lane, hull_m: FloatArray) -> FloatArray:
    """Points (k, 2) of a lane beside the hull (n, 2); none of one that begins behind it, or ends before it."""
    along = np.asarray(cKDTree(lane.xy_m).query(hull_m)[1])
    part = lane.xy_m[along.min() : along.max() + 1]
    return part if lane.along_m[along.max()] - lane.along_m[along.min()] > LANE_MAX_M else part[:0]


def _kind(kinds: IntArray) -> JunctionKind:
    if (kinds == 0).all():
        return "crossing"
    if (kinds == 0).any():
        return "intersection"
    return "merge" if (kinds == 1).sum() >= (kinds == 2).sum() else "diverge"


def _meeting_points(
    lanes: Sequence[Lane], connections: Sequence[Connection], in_ring: set[int]
) -> tuple[FloatArray, IntArray]:
    """Positions (n, 2) and kinds (n,): 0 crossing, 1 merge, 2 diverge; those of roundabouts are left out."""
    points, kinds = [], []
    ends = [link.end for link in connections]
    starts = [link.start for link in connections]
    for lane in lanes:
        if lane.number in in_ring:
            continue
        if ends.count(lane.number) > 1:
            points.append(lane.xy_m[0])
            kinds.append(1)
        after = [link.end for link in connections if link.start == lane.number]
        if starts.count(lane.number) > 1 and not in_ring.intersection(after):
            points.append(lane.xy_m[-1])
            kinds.append(2)
    crossings = [crossing.xy_m for crossing in find_crossings(lanes, frozenset(in_ring))]
    points += crossings
    kinds += [0] * len(crossings)
    return np.array(points, np.float64).reshape(-1, 2), np.array(kinds, np.int64)


@dataclass(frozen=True)
class Crossing:
    """Where the centre lines of two lanes cross: distances along both, and the angle between them."""

    lane: int
    other: int
    along_m: float
    other_along_m: float
    angle_rad: float
    xy_m: FloatArray


def find_crossings(lanes: Sequence[Lane], left_out: frozenset[int] = frozenset()) -> list[Crossing]:
    """Where centre lines of different directions cross."""
    used = [lane for lane in lanes if lane.number not in left_out]
    if not used:
        return []
    start, end = (np.concatenate([lane.xy_m[part] for lane in used]) for part in (slice(None, -1), slice(1, None)))
    begin = np.concatenate([lane.along_m[:-1] for lane in used])
    of = np.repeat([lane.number for lane in used], [len(lane.xy_m) - 1 for lane in used])
    length = np.hypot(*(end - start).T)
    pairs = cKDTree((start + end) / 2).query_pairs(float(length.max()) + 0.1, output_type="ndarray")
    i, j = pairs[of[pairs[:, 0]] != of[pairs[:, 1]]].T
    p, q = end[i] - start[i], end[j] - start[j]
    between = start[j] - start[i]
    cross = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    steep = np.abs(cross) > np.sin(_CROSSING_RAD) * length[i] * length[j]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (between[:, 0] * q[:, 1] - between[:, 1] * q[:, 0]) / cross
        u = (between[:, 0] * p[:, 1] - between[:, 1] * p[:, 0]) / cross
        hit: Mask = steep & (t > 0) & (t < 1) & (u > 0) & (u < 1)
    angle = np.arctan2(cross, (p * q).sum(axis=1))
    return [
        Crossing(
            int(of[i[k]]),
            int(of[j[k]]),
            float(begin[i[k]] + t[k] * length[i[k]]),
            float(begin[j[k]] + u[k] * length[j[k]]),
            float(angle[k]),
            start[i[k]] + t[k] * p[k],
        )
        for k in np.flatnonzero(hit)
    ]


def _cluster(points: FloatArray) -> IntArray:
    if len(points) == 1:
        return np.ones(1, np.int64)
    return np.asarray(fcluster(linkage(points, "single"), _NEAR_M, "distance"), np.int64)


def _rings(lanes: Sequence[Lane], connections: Sequence[Connection]) -> list[list[int]]:
    """Closed courses of lanes short enough for a roundabout that turn once round."""
    after: dict[int, list[int]] = {}
    for link in connections:
        after.setdefault(link.start, []).append(link.end)
    found: list[list[int]] = []
    used: set[int] = set()
    for lane in lanes:
        if lane.number in used or lane.length_m > _MAX_RING_M:
            continue
        ring = _ring_from(lane.number, after, lanes)
        if ring and not used.intersection(ring) and _is_round(np.concatenate([lanes[k].xy_m for k in ring])):
            found.append(ring)
            used.update(ring)
    return found


def _ring_from(start: int, after: dict[int, list[int]], lanes: Sequence[Lane]) -> list[int] | None:
    """The shortest closed course through a lane, by length, if it is short enough."""
    queue: list[tuple[float, int, list[int]]] = [(lanes[start].length_m, start, [start])]
    seen: set[int] = set()
    while queue:
        length, lane, path = heapq.heappop(queue)
        for end in after.get(lane, []):
            if end == start:
                return path
            if end not in seen and length + lanes[end].length_m <= _MAX_RING_M:
                seen.add(end)
                heapq.heappush(queue, (length + lanes[end].length_m, end, [*path, end]))
    return None


def _is_round(xy: FloatArray) -> bool:
    """Whether the distances from the centre vary little: a block that one can drive around is no circle."""
    low, high = xy.min(axis=0), xy.max(axis=0)
    radius = np.hypot(*(xy - (low + high) / 2).T)
    return bool(np.std(radius) < 0.22 * np.mean(radius) and np.mean(radius) < 40)


def buffered_hull(xy: FloatArray, margin_m: float) -> FloatArray:
    """Corners (n, 2) of the convex hull of discs around the points."""
    ring = margin_m * np.array([[np.cos(t), np.sin(t)] for t in np.linspace(0, 2 * np.pi, 12, endpoint=False)])
    cloud = (xy[:, None] + ring).reshape(-1, 2)
    return np.asarray(cloud[ConvexHull(cloud).vertices])


def inside_hull(xy: FloatArray, hull: FloatArray) -> Mask:
    """Whether positions (n, 2) lie within a convex polygon of corners (k, 2), given in either sense."""
    edge = np.roll(hull, -1, axis=0) - hull
    area = float(np.sum(hull[:, 0] * np.roll(hull[:, 1], -1) - hull[:, 1] * np.roll(hull[:, 0], -1)))
    out = np.ones(len(xy), bool)
    for corner, (dx, dy) in zip(hull, edge, strict=True):
        out &= np.sign(area) * (dx * (xy[:, 1] - corner[1]) - dy * (xy[:, 0] - corner[0])) >= 0
    return out


def _members(lanes: Sequence[Lane], hull: FloatArray) -> tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]:
    """Lanes that cross the border inwards, outwards, and those that lie within."""
    into, out, within = [], [], []
    for lane in lanes:
        inside = inside_hull(lane.xy_m, hull)
        if inside.all():
            within.append(lane.number)
            continue
        if (~inside[:-1] & inside[1:]).any():
            into.append(lane.number)
        if (inside[:-1] & ~inside[1:]).any():
            out.append(lane.number)
    return tuple(into), tuple(out), tuple(within)
