"""The lane graph of a run and the trips on it, in metres with y upwards: what the formats of roads are written from."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from schemas.arrays import FloatArray
from velfield.analysis.flow.passings import LaneTraffic
from velfield.analysis.flow.volume import lane_flow
from velfield.analysis.trajectories import TrackId
from velfield.errors import InputError
from velfield.exports.georeference import Georeference
from velfield.exports.roads.parts import cut_at_intersections
from velfield.run.run import Run


@dataclass(frozen=True)
class RoadLane:
    """A lane, or a part of one between intersections."""

    number: int
    name: str
    """Number in the network; ``lane2``, or ``lane2#0``, ``lane2#1`` of lane 2 in several parts."""
    xy_m: FloatArray
    """(n, 2) centre line in the direction of travel, x to the right of the map, y upwards."""
    width_m: float
    """Of the lane."""
    speed_m_per_s: float | None
    """Space-mean speed of the vehicles on it; None where too few were seen."""
    high_speed_m_per_s: float
    """85th percentile of the speeds along the whole lane."""
    vehicles: int
    """Number of tracks on it."""
    begins_at: int | None = None
    ends_at: int | None = None
    """Numbers of the intersections at which it begins and ends; None: at none."""


@dataclass(frozen=True)
class Trip:
    """A vehicle that drove along connected lanes, from a time in s since the first track's."""

    track_id: TrackId
    depart_s: float
    lanes: tuple[int, ...]
    speed_m_per_s: float


@dataclass(frozen=True)
class RoadNetwork:
    """Lanes, connections (from, to), trips in order of time, and the time that is seen, s; ``signalised``: numbers of
    the intersections with a signal."""

    lanes: tuple[RoadLane, ...]
    connections: tuple[tuple[int, int], ...]
    trips: tuple[Trip, ...]
    duration_s: float
    signalised: frozenset[int] = frozenset()


def road_network(run: Run) -> RoadNetwork:
    """The network of a run.

    Raises
    ------
    InputError
        The ground sample distance is not known, or no lanes were found.
    """
    gsd_m = run.gsd_m
    traffic, trajectories = run.analysis.traffic, run.analysis.trajectories
    graph = traffic.lanes
    if not len(graph):
        raise InputError("no lanes were found in the tracks of this run; a longer flight shows more traffic")
    meet = {j.number: j.hull_m for j in graph.junctions if traffic.junction_kind(j.number) == "intersection"}
    parts, georeference = cut_at_intersections(graph, meet), Georeference.from_grid(run.grid)
    on_parts, lanes = LaneTraffic(parts.graph), []
    for lane, of, name, (begins_at, ends_at) in zip(parts.graph, parts.lanes, parts.names, parts.ends, strict=True):
        mean = lane_flow(on_parts, lane.number, trajectories.observed_s).space_mean_speed_m_per_s
        high = np.percentile(graph.samples.speed_m_per_s[graph.samples.lane == of], 85)
        lanes.append(
            RoadLane(
                number=lane.number,
                name=name,
                xy_m=georeference.to_metres(lane.xy_m / gsd_m),
                width_m=float(np.clip(lane.width_m, 2.0, 6.0)),
                speed_m_per_s=mean.value if mean else None,
                high_speed_m_per_s=float(max(high, 1.0)),
                vehicles=lane.tracks,
                begins_at=begins_at,
                ends_at=ends_at,
            )
        )
    samples, connections = parts.graph.samples, parts.connections
    first_s = float(trajectories.time_s.min()) if len(trajectories.time_s) else 0.0
    trips = _trips(samples.track, samples.lane, samples.time_s - first_s, samples.speed_m_per_s, set(connections))
    named = tuple(replace(trip, track_id=trajectories.id_of(int(trip.track_id))) for trip in trips)
    signalised = frozenset(number for number in meet if traffic.is_signalised(number))
    return RoadNetwork(tuple(lanes), connections, named, float(np.diff(trajectories.window_s)[0]), signalised)


def _trips(
    track: FloatArray | np.ndarray,
    lane: np.ndarray,
    time_s: FloatArray,
    speed: FloatArray,
    connections: set[tuple[int, int]],
) -> list[Trip]:
    """The longest connected sequence of lanes of each track, by the number of its samples."""
    trips = []
    for number in np.unique(track):
        rows = np.flatnonzero(track == number)
        rows = rows[np.argsort(time_s[rows], kind="stable")]
        starts = np.flatnonzero(np.r_[True, np.diff(lane[rows]) != 0])
        visited = [int(one) for one in lane[rows[starts]]]
        cuts = [
            0,
            *(k for k in range(1, len(visited)) if (visited[k - 1], visited[k]) not in connections),
            len(visited),
        ]
        ends = [*starts.tolist(), len(rows)]
        first, last = max(pairwise(cuts), key=lambda part: ends[part[1]] - ends[part[0]])
        row = rows[starts[first]]
        trips.append(Trip(int(number), float(time_s[row]), tuple(visited[first:last]), float(speed[row])))
    return sorted(trips, key=lambda trip: trip.depart_s)
