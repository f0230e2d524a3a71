"""The lane graph: lanes, connections from lane to lane, and junctions."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from schemas.analysis import JunctionKind, Turn, WidthSource
from schemas.arrays import FloatArray, IntArray

LANE_MAX_M = 5.0
"""Neighbouring lanes of the same direction are no farther apart."""


@dataclass(frozen=True)
class Lane:
    """A lane between two places where lanes meet or part."""

    number: int
    """Number of the lane in its graph."""
    xy_m: FloatArray
    """(n, 2) centre line in the direction of travel; it begins where its strongest predecessor ends."""
    tracks: int
    """Number of tracks that drove on it."""
    width_m: float
    width_source: WidthSource
    """Distance to the neighbouring lane of the same direction; without one, the spread of the paths across it and a
    car's width."""
    left: int | None = None
    right: int | None = None
    """Neighbouring lanes of the same direction, None: none there."""

    @cached_property
    def along_m(self) -> FloatArray:
        """(n,) distance of each point along the centre line."""
        return np.concatenate([[0.0], np.hypot(*np.diff(self.xy_m, axis=0).T).cumsum()])

    @property
    def length_m(self) -> float:
        """Length of the centre line."""
        return float(self.along_m[-1])

    @cached_property
    def direction_rad(self) -> FloatArray:
        """(n,) direction of travel at each point."""
        step = np.gradient(self.xy_m, axis=0)
        return np.asarray(np.arctan2(step[:, 1], step[:, 0]))

    def at(self, along_m: float | FloatArray) -> FloatArray:
        """(2,) position at a distance along the centre line, (n, 2) at distances (n,)."""
        return np.stack([np.interp(along_m, self.along_m, self.xy_m[:, k]) for k in (0, 1)], axis=-1)


@dataclass(frozen=True)
class Connection:
    """From one lane to the next: ``tracks`` went that way, ``share`` of those that left the lane."""

    start: int
    end: int
    tracks: int
    share: float
    turn: Turn


@dataclass(frozen=True)
class Junction:
    """Where lanes cross, merge or diverge."""

    number: int
    kind: JunctionKind
    """Number of the junction in its graph; its kind."""
    centre_m: FloatArray
    """(2,)."""
    hull_m: FloatArray
    """(n, 2) corners of the convex area in which the lanes meet."""
    lanes_in: tuple[int, ...]
    lanes_out: tuple[int, ...]
    lanes_inside: tuple[int, ...]
    """Numbers of the lanes that reach it, that leave it, and that lie in it."""


@dataclass(frozen=True)
class LaneSamples:
    """Samples of tracks on lanes, in the order of each track's path."""

    track: IntArray
    lane: IntArray
    """(k,) numbers of the track and of the lane."""
    along_m: FloatArray
    offset_m: FloatArray
    """(k,) distance along the lane, and to the right of its centre line."""
    time_s: FloatArray
    speed_m_per_s: FloatArray
    """(k,) when, and how fast."""

    def __len__(self) -> int:
        return len(self.track)


@dataclass(frozen=True)
class LaneGraph:
    """All lanes of a flight."""

    lanes: tuple[Lane, ...]
    connections: tuple[Connection, ...]
    junctions: tuple[Junction, ...]
    samples: LaneSamples = field(repr=False)

    def __iter__(self) -> Iterator[Lane]:
        return iter(self.lanes)

    def __len__(self) -> int:
        return len(self.lanes)

    @cached_property
    def successors(self) -> list[list[int]]:
        """Lanes after each lane, the most driven first."""
        out: list[list[int]] = [[] for _ in self.lanes]
        for link in sorted(self.connections, key=lambda c: -c.tracks):
            out[link.start].append(link.end)
        return out

    @cached_property
    def predecessors(self) -> list[list[int]]:
        """Lanes before each lane, the most driven first."""
        out: list[list[int]] = [[] for _ in self.lanes]
        for link in sorted(self.connections, key=lambda c: -c.tracks):
            out[link.end].append(link.start)
        return out

    @property
    def entries(self) -> list[int]:
        """Lanes without a predecessor."""
        return [lane.number for lane in self.lanes if not self.predecessors[lane.number]]

    @property
    def exits(self) -> list[int]:
        """Lanes without a successor."""
        return [lane.number for lane in self.lanes if not self.successors[lane.number]]
