"""Origins and destinations of the whole scene: where vehicles enter the picture, and where they leave it.

A lane that follows no other, and on which most tracks begin, is an entry; one that leads to no other, and on which most
tracks end, an exit. Where an exit faces an entry, something hides the road between them (a tree, a bridge): neither is
one. Tracks of a vehicle that is lost and found again where it must have gone are one (`cut_tracks`). Of the others a
track that is cut inside the picture is lost on a lane; where those of known destination went from there shows where it
went.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from scipy.spatial import ConvexHull

from schemas.arrays import FloatArray, IntArray, Mask
from velfield.analysis.intervals import Estimate, estimate_mean, estimate_rate, estimate_share
from velfield.analysis.lanes.junctions import buffered_hull
from velfield.analysis.lanes.model import LaneGraph
from velfield.analysis.movements.cut_tracks import CutTracks
from velfield.analysis.movements.gates import Arm, ArmNames, End, Gate, group_gates
from velfield.analysis.observed import ObservedSlices
from velfield.analysis.trajectories import PathSamples, Trajectories, within

_INWARDS_M, _OUTWARDS_M, _ASIDE_M = 20.0, 15.0, 2.5
"""A track that begins so far behind an entry, or ahead of it, and so far beside its lane, was seen to enter there."""
_REACH_M = float(np.hypot(max(_INWARDS_M, _OUTWARDS_M), _ASIDE_M))
_TURN_RAD = np.radians(35)
_MIN_FRACTION = 0.5
"""Minimum fraction of an entry's tracks, on its first 20 m, that start there."""
_HIDDEN_M = 40.0
"""A place that is hidden from above is no longer."""
_INSIDE_M = 25.0
"""A gate farther from the scene's border is within it: a yard, or a garage."""
_EDGE_M = 8.0
"""A track that ends so near to the edge of the picture, on its way there, is not cut."""
_CUT_BY_TIME_S = 1.0
"""A track that begins so soon after the first frame, or ends so soon before the last one, is cut by time."""
_MIN_WHOLE = 3
"""Fewer vehicles of known destination do not show where those that are cut went."""
_DISPERSION_SLICE_S = 120.0
_YARD_M_PER_S = 6.0


@dataclass(frozen=True)
class Trips:
    """Vehicles that entered the scene while it was filmed, one row each."""

    track: IntArray
    origin: IntArray
    """Numbers of the track that enters, and of the arm."""
    entry_s: FloatArray
    exit_s: FloatArray
    """When the vehicle's track begins at the entry, and ends at the exit; NaN: it ends elsewhere."""
    destination: FloatArray
    """(n, arms) probability of each destination: 1 where the vehicle was seen to leave."""
    seen: Mask
    """From entry to exit, by one track."""
    elsewhere: Mask
    """Seen to leave the picture, by no arm: by a road that fewer than three vehicles took."""
    remains: Mask
    """Not seen to leave, but still in the picture at the end; of the others that are not ``seen``, the track is cut."""


@dataclass(frozen=True)
class Relation:
    """Vehicles from one arm of the scene to another."""

    origin: Arm
    destination: Arm
    seen: int
    cut: float
    remaining: float
    """Vehicles seen from entry to exit; those whose track is cut, joined or inferred; and inferred of those still in
    the picture at the end."""
    share: Estimate | None
    """Fraction of the vehicles that enter by the arm."""
    flow_veh_per_h: Estimate | None
    travel_time_s: Estimate | None
    """Median travel time of the observed vehicles, s."""

    @property
    def vehicles(self) -> float:
        """Seen and inferred."""
        return self.seen + self.cut + self.remaining


@dataclass(frozen=True)
class OriginDestination:
    """Origins and destinations of a scene."""

    arms: tuple[Arm, ...]
    gates: tuple[Gate, ...]
    """Where roads leave the scene, and their lanes."""
    trips: Trips
    """Vehicles that entered while it was filmed."""
    before: int
    unknown: int
    """Tracks of vehicles that were there in the first frame, and those that began inside later: cut ones, mostly."""
    observed_s: FloatArray
    """(k, 2) begins and ends of the times that are seen."""

    @cached_property
    def relations(self) -> tuple[Relation, ...]:
        """All pairs of arms between which a vehicle drove, the most driven first."""
        trips = self.trips
        slices = ObservedSlices.of(self.observed_s, _DISPERSION_SLICE_S)
        out = []
        for i, j in product(range(len(self.arms)), repeat=2):
            rows = trips.origin == i
            weight = np.where(rows, trips.destination[:, j], 0.0)
            if weight.sum() < 0.5:
                continue
            known = rows & np.isfinite(trips.exit_s)
            seen = trips.seen & rows & (trips.destination[:, j] == 1.0)
            n, entering = int(known.sum()), float(trips.destination[rows].sum() + trips.elsewhere[rows].sum())
            out.append(
                Relation(
                    self.arms[i],
                    self.arms[j],
                    int(seen.sum()),
                    float(weight[~trips.seen & ~trips.remains].sum()),
                    float(weight[trips.remains].sum()),
                    estimate_share(weight.sum() / entering * n, n),
                    estimate_rate(slices.sums(trips.entry_s, weight), slices.hours),
                    estimate_mean((trips.exit_s - trips.entry_s)[seen], trips.entry_s[seen]),
                )
            )
        return tuple(sorted(out, key=lambda relation: -relation.vehicles))


def find_origins_destinations(
    trajectories: Trajectories,
    samples: PathSamples,
    graph: LaneGraph,
    cut_tracks: CutTracks,
    names: ArmNames | None = None,
) -> OriginDestination | None:
    """Origins and destinations of a flight; None where no road enters the scene and leaves it.

    Parameters
    ----------
    trajectories, samples
        Tracks of moving vehicles, and points along them.
    graph
        Their lanes.
    cut_tracks
        The tracks joined into vehicles.
    names
        How arms are named; None: by sides of the image.
    """
    if not len(graph) or not len(samples):
        return None
    gates, arms = find_scene_gates(trajectories, samples, graph, names)
    if not any(gate.inwards for gate in gates) or all(gate.inwards for gate in gates):
        return None
    return trace_trips(cut_tracks, graph, gates, arms)


def find_scene_gates(
    trajectories: Trajectories, samples: PathSamples, graph: LaneGraph, names: ArmNames | None = None
) -> tuple[tuple[Gate, ...], tuple[Arm, ...]]:
    """Entries and exits of the scene, and the arms that they are of."""
    ends = [(lane, True) for lane in graph.entries] + [(lane, False) for lane in graph.exits]
    found = []
    for lane, inwards in ends:
        line = graph.lanes[lane]
        k = 0 if inwards else -1
        found.append((lane, inwards, line.xy_m[k], float(line.direction_rad[k])))
    facing = {k for i, a in enumerate(found) for j, b in enumerate(found) if _faces(a, b) for k in (i, j)}
    found = [end for k, end in enumerate(found) if k not in facing]
    used = [end for end in found if _mostly_ends(end, trajectories, samples, graph)]
    if not used:
        return (), ()
    label = group_gates(used)
    middle = {int(k): np.mean([g[2] for g, of in zip(used, label, strict=True) if of == k], axis=0) for k in label}
    outward = {
        int(k): float(
            np.angle(sum(np.exp(1j * (g[3] + np.pi * g[1])) for g, of in zip(used, label, strict=True) if of == k))
        )
        for k in label
    }
    inside = {k for k in middle if _from_border_m(middle[k], graph) > _INSIDE_M}
    name = (names or ArmNames()).of(outward, middle, inside)
    order = sorted(name, key=lambda k: (k in inside, (outward[k] + np.pi / 2) % (2 * np.pi), name[k]))
    rank = {k: i for i, k in enumerate(order)}
    gates = tuple(Gate(*end, arm=rank[int(of)]) for end, of in zip(used, label, strict=True))
    return gates, tuple(Arm(i, name[k], middle[k], outward[k]) for i, k in enumerate(order))


def _faces(a: End, b: End) -> bool:
    """Whether the road goes on from an exit to an entry ahead of it."""
    if a[1] or not b[1]:
        return False
    d = b[2] - a[2]
    c, s = np.cos(a[3]), np.sin(a[3])
    ahead, aside = d[0] * c + d[1] * s, abs(d[1] * c - d[0] * s)
    turn = abs(float(np.angle(np.exp(1j * (b[3] - a[3])))))
    return bool(-3.0 < ahead < _HIDDEN_M and aside < 2.0 + 0.2 * max(ahead, 0.0) and turn < _TURN_RAD)


def _mostly_ends(end: End, trajectories: Trajectories, samples: PathSamples, graph: LaneGraph) -> bool:
    """Whether most tracks at a lane's start begin there (at its end: end there), but those that time cuts; within the
    picture slowly, as at a yard: where vehicles come up at speed they were not seen before."""
    _, inwards, xy, direction = end
    near = within(samples.xy_m, xy - _REACH_M, xy + _REACH_M)
    here = _at_gate(samples.xy_m[near], samples.direction_rad[near], xy, direction, inwards=inwards)
    here = np.unique(samples.track[near[here]])
    # a vehicle that waits at a stop line when the flight begins or ends neither comes up nor goes there
    first = trajectories.first[:-1] if inwards else trajectories.first[1:] - 1
    here = here[~trajectories.is_cut_by_time(trajectories.time_s[first[here]], _CUT_BY_TIME_S, begins=inwards)]
    rows = _terminal(samples, len(trajectories), first=inwards)[here]
    ends = _at_gate(samples.xy_m[rows], samples.direction_rad[rows], xy, direction, inwards=inwards)
    if ends.sum() < _MIN_WHOLE or ends.sum() < _MIN_FRACTION * len(ends):
        return False
    slow = float(np.median(samples.speed_m_per_s[rows[ends]])) < _YARD_M_PER_S
    # of a side street that ends at the picture's edge between longer ones the hull of the lanes says nothing
    low, high = samples.bounds_m
    at_edge = float(min((xy - low).min(), (high - xy).min())) <= _INSIDE_M
    return slow or at_edge or _from_border_m(xy, graph) <= _INSIDE_M


def _terminal(samples: PathSamples, n: int, *, first: bool) -> IntArray:
    """Row of the first (or last) sample of each of n tracks; of one without any, another's."""
    if first:
        return np.minimum(np.searchsorted(samples.track, np.arange(n)), len(samples) - 1)
    return np.maximum(np.searchsorted(samples.track, np.arange(n), side="right") - 1, 0)


def _at_gate(
    xy_m: FloatArray, direction_rad: FloatArray, gate_m: FloatArray, gate_rad: float, *, inwards: bool
) -> Mask:
    """Whether positions (n, 2) with directions (n,) are at a gate."""
    d = xy_m - gate_m
    c, s = np.cos(gate_rad), np.sin(gate_rad)
    ahead, aside = d[:, 0] * c + d[:, 1] * s, np.abs(d[:, 1] * c - d[:, 0] * s)
    low, high = (-_OUTWARDS_M, _INWARDS_M) if inwards else (-_INWARDS_M, _OUTWARDS_M)
    turn = np.abs(np.angle(np.exp(1j * (direction_rad - gate_rad))))
    return np.asarray((ahead > low) & (ahead < high) & (aside < _ASIDE_M) & (turn < _TURN_RAD))


def _from_border_m(xy_m: FloatArray, graph: LaneGraph) -> float:
    """Distance from the convex hull of all lanes' border, inwards, m."""
    hull = ConvexHull(buffered_hull(np.concatenate([lane.xy_m for lane in graph]), 1.0))
    return float(-(hull.equations[:, :2] @ xy_m + hull.equations[:, 2]).max())


def trace_trips(
    vehicles: CutTracks, graph: LaneGraph, gates: tuple[Gate, ...], arms: tuple[Arm, ...]
) -> OriginDestination:
    """Arms by which vehicles enter and leave, and the inferred destinations of vehicles whose tracks are cut."""
    trajectories, samples = vehicles.trajectories, vehicles.samples
    n = len(trajectories)
    origin, entry = _terminal_arms(samples, n, gates, first=True)
    destination, leaves = _terminal_arms(samples, n, gates, first=False)
    begins, ends = trajectories.time_s[trajectories.first[:-1]], trajectories.time_s[trajectories.first[1:] - 1]
    before = trajectories.is_cut_by_time(begins, _CUT_BY_TIME_S, begins=True)
    entered = (origin >= 0) & ~before
    known = (origin >= 0) & (destination >= 0)
    probability = np.zeros((n, len(arms)))
    probability[destination >= 0, destination[destination >= 0]] = 1.0
    lost = destination < 0
    elsewhere = lost & _leaves_the_picture(samples, n)
    _infer(probability, origin, destination, known, np.flatnonzero(entered & lost & ~elsewhere), graph, vehicles)
    remains = lost & ~elsewhere & trajectories.is_cut_by_time(ends, _CUT_BY_TIME_S, begins=False)
    rows = np.flatnonzero(entered)
    trips = Trips(
        vehicles.track[vehicles.first[rows]],
        origin[rows],
        entry[rows],
        np.where(lost & ~elsewhere, np.nan, leaves)[rows],
        probability[rows],
        ~lost[rows] & (np.diff(vehicles.first)[rows] == 1),
        elsewhere[rows],
        remains[rows],
    )
    unknown = int(((origin < 0) & ~before).sum())
    return OriginDestination(arms, gates, trips, int(before.sum()), unknown, trajectories.observed_s)


def _leaves_the_picture(samples: PathSamples, n: int) -> Mask:
    """Whether each track (n,) ends at the edge of the picture on its way out."""
    rows = _terminal(samples, n, first=False)
    low, high = samples.bounds_m
    way = np.column_stack([np.cos(samples.direction_rad[rows]), np.sin(samples.direction_rad[rows])])
    left_m = np.where(way > 0, high - samples.xy_m[rows], samples.xy_m[rows] - low)
    soon = (np.abs(way) > np.cos(_TURN_RAD)) & (left_m < _EDGE_M)
    return np.asarray((samples.track[rows] == np.arange(n)) & soon.any(axis=1))


def _terminal_arms(
    samples: PathSamples, n: int, gates: tuple[Gate, ...], *, first: bool
) -> tuple[IntArray, FloatArray]:
    """Arm (n,) at which each track begins (or ends), -1: none, and when."""
    rows = _terminal(samples, n, first=first)
    exists = samples.track[rows] == np.arange(n)
    xy, direction = samples.xy_m[rows], samples.direction_rad[rows]
    arm, nearest = np.full(n, -1), np.full(n, np.inf)
    for gate in gates:
        if gate.inwards is first:
            here = exists & _at_gate(xy, direction, gate.xy_m, gate.direction_rad, inwards=first)
            distance = np.where(here, np.hypot(*(xy - gate.xy_m).T), np.inf)
            arm = np.where(distance < nearest, gate.arm, arm)
            nearest = np.minimum(distance, nearest)
    return arm, samples.time_s[rows]


def _infer(
    probability: FloatArray,
    origin: IntArray,
    destination: IntArray,
    known: Mask,
    cut: IntArray,
    graph: LaneGraph,
    vehicles: CutTracks,
) -> None:
    """Destinations of the vehicles that are ``cut``, in place: as of the known ones from their origin that drove on the
    lane on which they are lost; without three of these, of all that drove on it; else of all of their origin."""
    lane_of, vehicle_of, count = graph.samples.lane, vehicles.vehicle[graph.samples.track], len(vehicles.trajectories)
    comes = np.flatnonzero(np.r_[True, (lane_of[1:] != lane_of[:-1]) | (vehicle_of[1:] != vehicle_of[:-1])])
    visits = np.unique(lane_of[comes] * np.int64(count) + vehicle_of[comes])
    borders = np.searchsorted(visits, np.arange(len(graph) + 1) * np.int64(count))
    last = vehicles.track[vehicles.first[cut + 1] - 1]
    row = np.searchsorted(graph.samples.track, last, side="right") - 1
    on_lane = (row >= 0) & (graph.samples.track[np.maximum(row, 0)] == last)
    shares: dict[tuple[int, int], FloatArray] = {}
    for vehicle, k, placed in zip(cut, row, on_lane, strict=True):
        lane = int(graph.samples.lane[k]) if placed else -1
        key = (lane, int(origin[vehicle]))
        if key not in shares:
            others = visits[borders[lane] : borders[lane + 1]] % count if placed else np.empty(0, np.int64)
            choices = (
                others[known[others] & (origin[others] == key[1])],
                others[destination[others] >= 0],
                np.flatnonzero(known & (origin == key[1])),
            )
            used = next((c for c in choices if len(c) >= _MIN_WHOLE), choices[2])
            counts = np.bincount(destination[used], minlength=probability.shape[1]).astype(np.float64)
            shares[key] = counts / max(counts.sum(), 1.0)
        probability[vehicle] = shares[key]
