"""The road network: lanes as smooth paths, i.e. edges between nodes, with signals, priority rules and sources.

Metres, x right, y down; right-hand traffic. Of the edges that meet at a node at most one kind has priority (lanes,
intersection boxes, the ring of a roundabout); turns yield to it and wait where their path is still clear of its path.
"""

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from schemas.arrays import FloatArray

EdgeKind = Literal["avenue", "street", "box", "turn", "ring", "aisle"]

STEP_M = 0.5
"""Spacing of the points of an edge's path."""

CLEAR_M = 2.6
"""Paths farther apart than this do not conflict."""

LATERAL_M_PER_S2 = 2.4
"""Lateral acceleration that drivers accept in a turn."""


@dataclass(frozen=True)
class Node:
    """Where edges meet: a position and the direction of travel, rad."""

    x: float
    y: float
    direction: float


@dataclass(frozen=True)
class Edge:
    """A section of a lane.

    ``path`` (n, 2) m, about ``STEP_M`` apart; ``speed_m_per_s`` the limit; ``weight`` of its choice where lanes
    diverge; ``signal`` the signal group at its end, -1: none; ``yields``: gives way at its end.
    """

    start: int
    end: int
    kind: EdgeKind
    path: FloatArray
    speed_m_per_s: float
    weight: float
    signal: int = -1
    yields: bool = False

    @property
    def length_m(self) -> float:
        """Length of the path."""
        return float(np.hypot(*np.diff(self.path, axis=0).T).sum())


@dataclass
class RoadNetwork:
    """All lanes and signals of a city: ``signal_offsets_s`` one an intersection; group = 2 * intersection + axis."""

    nodes: list[Node] = field(default_factory=list)
    edges: list[Edge] = field(default_factory=list)
    sources: list[tuple[int, float]] = field(default_factory=list)
    signal_offsets_s: list[float] = field(default_factory=list)

    def node(self, x: float, y: float, direction: float) -> int:
        """Add a node and return its number."""
        self.nodes.append(Node(x, y, direction))
        return len(self.nodes) - 1

    def straight(self, a: int, b: int, kind: EdgeKind, speed: float, *, signal: int = -1) -> None:
        """Add a straight edge from node ``a`` to node ``b``."""
        p, q = self.nodes[a], self.nodes[b]
        n = max(int(np.hypot(q.x - p.x, q.y - p.y) / STEP_M), 2)
        path = np.column_stack([np.linspace(p.x, q.x, n + 1), np.linspace(p.y, q.y, n + 1)])
        self.edges.append(Edge(a, b, kind, path, speed, 1.0, signal))

    def turn(self, a: int, b: int, *, weight: float, speed: float | None = None, yields: bool = True) -> None:
        """Add a curved edge from node ``a`` to node ``b``, tangent to both, its speed limited by lateral
        acceleration."""
        path = smooth_curve(self.nodes[a], self.nodes[b])
        limit = min(speed or 14.0, float(np.sqrt(LATERAL_M_PER_S2 * min_radius_m(path))))
        self.edges.append(Edge(a, b, "turn", path, max(limit, 3.0), weight, yields=yields))

    def arc(self, a: int, b: int, centre: tuple[float, float], angles: tuple[float, float], speed: float) -> None:
        """Add an arc of a roundabout from the first of ``angles`` to the second, rad."""
        p = self.nodes[a]
        radius = float(np.hypot(p.x - centre[0], p.y - centre[1]))
        n = max(int(abs(angles[1] - angles[0]) * radius / STEP_M), 2)
        theta = np.linspace(*angles, n + 1)
        path = np.column_stack([centre[0] + radius * np.cos(theta), centre[1] + radius * np.sin(theta)])
        self.edges.append(Edge(a, b, "ring", path, speed, 1.0))

    def out_edges(self) -> list[list[int]]:
        """Edges that leave each node."""
        return self._by_node([edge.start for edge in self.edges])

    def in_edges(self) -> list[list[int]]:
        """Edges that reach each node."""
        return self._by_node([edge.end for edge in self.edges])

    def _by_node(self, node_of_edge: list[int]) -> list[list[int]]:
        found: list[list[int]] = [[] for _ in self.nodes]
        for number, node in enumerate(node_of_edge):
            found[node].append(number)
        return found


class Lane:
    """A straight lane to which others connect: get its nodes by ``at`` and ``at_point``, then ``finish`` it into
    edges."""

    def __init__(
        self, net: RoadNetwork, start: tuple[float, float], end: tuple[float, float], kind: EdgeKind, speed: float
    ) -> None:
        self._net, self._kind, self._speed = net, kind, speed
        self._start = np.array(start)
        along = np.array(end) - self._start
        self.length = float(np.hypot(*along))
        self._unit = along / self.length
        self.direction = float(np.arctan2(along[1], along[0]))
        self._cuts: dict[float, int] = {}
        self._boxes: dict[float, int] = {}
        self.at(0.0)
        self.at(self.length)

    def at(self, s: float) -> int:
        """The node ``s`` metres along the lane."""
        s = round(min(max(s, 0.0), self.length), 3)
        if s not in self._cuts:
            x, y = self._start + s * self._unit
            self._cuts[s] = self._net.node(float(x), float(y), self.direction)
        return self._cuts[s]

    def at_point(self, x: float, y: float) -> int:
        """The node of the lane nearest to (x, y)."""
        return self.at(float((np.array([x, y]) - self._start) @ self._unit))

    def box(self, x: float, y: float, group: int) -> None:
        """Make the edge from the node nearest to (x, y) an intersection box, entered on green only."""
        self._boxes[self.at_point(x, y)] = group

    def finish(self) -> None:
        """Add the edges between the lane's nodes."""
        numbers = [self._cuts[s] for s in sorted(self._cuts)]
        for a, b in pairwise(numbers):
            kind: EdgeKind = "box" if a in self._boxes else self._kind
            self._net.straight(a, b, kind, self._speed, signal=self._boxes.get(b, -1))


def smooth_curve(a: Node, b: Node) -> FloatArray:
    """Cubic Bezier curve from ``a`` to ``b``, tangent to both directions, close to an arc; points about ``STEP_M``
    apart (n, 2)."""
    p, q = np.array([a.x, a.y]), np.array([b.x, b.y])
    u, v = np.array([np.cos(a.direction), np.sin(a.direction)]), np.array([np.cos(b.direction), np.sin(b.direction)])
    distance = float(np.hypot(*(q - p)))
    turn = abs(float(np.angle(np.exp(1j * (b.direction - a.direction)))))
    if turn < 0.2:
        handle = 0.45 * distance
    else:
        handle = 4 / 3 * np.tan(turn / 4) * distance / (2 * np.sin(turn / 2))
    t = np.linspace(0, 1, 400)[:, None]
    dense = (
        (1 - t) ** 3 * p + 3 * t * (1 - t) ** 2 * (p + handle * u) + 3 * t**2 * (1 - t) * (q - handle * v) + t**3 * q
    )
    along = np.concatenate([[0.0], np.hypot(*np.diff(dense, axis=0).T).cumsum()])
    s = np.linspace(0, along[-1], max(int(along[-1] / STEP_M), 4) + 1)
    return np.column_stack([np.interp(s, along, dense[:, 0]), np.interp(s, along, dense[:, 1])])


def min_radius_m(path: FloatArray) -> float:
    """Minimum radius of curvature along a path, from the changes of direction between its steps."""
    step = np.diff(path, axis=0)
    turn = np.abs(np.diff(np.unwrap(np.arctan2(step[:, 1], step[:, 0]))))
    length = np.hypot(step[:, 0], step[:, 1])[1:]
    return float(1 / max((turn / length).max(), 1e-6))


def clear_until_m(path: FloatArray, other: FloatArray, *, from_end: bool) -> float:
    """Distance along ``path``, m, at which two paths begin, or cease, to conflict (to be within ``CLEAR_M``).

    With ``from_end`` they merge at their ends: the last position that is clear; otherwise they diverge at their starts:
    the first position that is clear.
    """
    distance, _ = cKDTree(other).query(path)
    near = np.flatnonzero(distance < CLEAR_M)
    along = np.concatenate([[0.0], np.hypot(*np.diff(path, axis=0).T).cumsum()])
    if len(near) == 0:
        return float(along[-1] if from_end else 0.0)
    if from_end:
        return float(along[max(near[0] - 1, 0)])
    return float(along[min(near[-1] + 1, len(along) - 1)])
