"""Gates: where lanes cross the border of a junction, grouped into its arms."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from schemas.arrays import FloatArray, IntArray
from velfield.analysis.lanes.junctions import inside_hull
from velfield.analysis.lanes.model import Junction, LaneGraph

_ARM_M = 17.0
"""Gates of one arm are nearer to each other: a median may lie between them."""
ROAD_M = 20
"""Arms are told apart so far outside the junction: at a roundabout the entry and the exit of a road diverge."""
_REACH_M, _ASIDE_M = 6.0, 2.5
"""A vehicle crosses the border at a gate that is no farther from it, and hardly more than half a lane to the side."""
_BESIDE_M = 4.5
"""A lane that too few vehicles drove has no gate: of its road is who comes, or goes, no farther beside a gate."""
_ARM_RAD = np.radians(35)
"""Axes of one arm's gates differ by less."""
_COMPASS = ("E", "SE", "S", "SW", "W", "NW", "N", "NE")
"""Names by direction, every 45° clockwise from the right of an image whose top is north."""


End: TypeAlias = tuple[int, bool, FloatArray, float]
"""A lane, whether it leads inwards, its position, m, and its direction, rad."""


@dataclass(frozen=True)
class Gate:
    """Where a lane crosses the border of a junction: ``inwards`` or outwards, at ``xy_m`` in ``direction_rad``."""

    lane: int
    inwards: bool
    xy_m: FloatArray
    direction_rad: float
    arm: int


@dataclass(frozen=True)
class Arm:
    """A road that ends at a junction: ``name`` by where it leads to (`ArmNames`), its gates' middle ``xy_m``,
    ``outward_rad`` its direction away from the junction."""

    number: int
    name: str
    xy_m: FloatArray
    outward_rad: float


@dataclass(frozen=True)
class ArmNames:
    """How arms are named: by the compass, or by sides of the image (N: its top) where north is not known."""

    north_rad: float | None = None
    """Direction of north in the image, from x towards y (down); None: not known."""
    given: Mapping[str, str] = field(default_factory=dict)
    """The user's names by these ones: ``{"3.W": "Mill Road"}`` of an arm of junction 3, ``{"W": "Mill Road"}`` of a
    road by which vehicles enter or leave the scene."""

    @property
    def legend(self) -> str:
        """What N stands for."""
        return "north is not known: N is the top of the image, W its left" if self.north_rad is None else "N is north"

    def side(self, direction_rad: float) -> str:
        """Name of a direction in the image, rad from x towards y (down).

        Examples
        --------
        >>> ArmNames().side(np.pi / 2), ArmNames(north_rad=np.pi / 2).side(np.pi / 2)
        ('S', 'N')
        """
        turned = 0.0 if self.north_rad is None else self.north_rad + np.pi / 2
        return _COMPASS[round((direction_rad - turned) / (np.pi / 4)) % 8]

    def of(
        self,
        outward_rad: Mapping[int, float],
        xy_m: Mapping[int, FloatArray],
        inside: Collection[int] = (),
        *,
        place: str = "",
    ) -> dict[int, str]:
        """Names of arms by their numbers: the direction that each leads to, or ``inside``.

        Several arms of one direction are numbered from the top, or from the left: ``N1``, ``N2``.

        Parameters
        ----------
        outward_rad
            Direction of each arm away from the traffic, rad.
        xy_m
            (2,) position of each arm.
        inside
            Arms that lead to a place within the scene.
        place
            Put before a name to look it up in ``given``.

        Examples
        --------
        >>> at = {0: np.array([30.0, 0.0]), 1: np.array([10.0, 0.0]), 2: np.array([90.0, 40.0])}
        >>> ArmNames().of({0: -1.6, 1: -1.5, 2: 0.0}, at)
        {0: 'N2', 1: 'N1', 2: 'E'}
        >>> ArmNames(north_rad=0.0, given={"W1": "Mill Road"}).of({0: -1.6, 1: -1.5, 2: 0.0}, at)
        {0: 'W2', 1: 'Mill Road', 2: 'N'}
        """
        side = {k: "inside" if k in inside else self.side(a) for k, a in outward_rad.items()}
        names = dict(side)
        for name in set(side.values()):
            members = [k for k in side if side[k] == name]
            across = (1, 0) if np.ptp([xy_m[k][1] for k in members]) > np.ptp([xy_m[k][0] for k in members]) else (0, 1)
            members.sort(key=lambda k: tuple(xy_m[k][list(across)]))
            if len(members) > 1:
                names.update((k, f"{name}{number}") for number, k in enumerate(members, 1))
        return {k: self.given.get(place + name, name) for k, name in names.items()}


@dataclass(frozen=True)
class Gates:
    """Gates and arms of a junction."""

    gates: tuple[Gate, ...]
    arms: tuple[Arm, ...]
    roads_m: FloatArray
    """(n, 2) position of the lane of each gate, `ROAD_M` outside the junction."""

    @property
    def arms_in(self) -> dict[int, str]:
        """Names of the arms by which the lanes lead in, by lane."""
        return {gate.lane: self.arms[gate.arm].name for gate in self.gates if gate.inwards}

    def nearest(self, xy_m: FloatArray, direction_rad: FloatArray, road_xy_m: FloatArray, *, inwards: bool) -> IntArray:
        """Number of the gate (n,) nearest to each crossing of its direction, -1: none near.

        The lane beside a gate's may touch the area of the junction, and have no gate: its vehicles are no gate's. Where
        roads part at the border, gates are near each other: ``road_xy_m`` (n, 2), where the vehicle is `ROAD_M`
        outside, tells them apart.
        """
        return self._best(xy_m, direction_rad, inwards, _ASIDE_M, _REACH_M, road_xy_m)

    def of_road(self, xy_m: FloatArray, direction_rad: FloatArray, *, inwards: bool) -> IntArray:
        """Number of a gate (n,) of the road that vehicles are on `ROAD_M` before a junction, or behind it; -1: none.

        Who turns may cut the corner, or use a lane that too few drove to be found: he crosses the border at no gate.
        """
        return self._best(xy_m, direction_rad, inwards, _BESIDE_M, ROAD_M + _ARM_M)

    def _best(
        self,
        xy_m: FloatArray,
        direction_rad: FloatArray,
        inwards: bool,
        aside_m: float,
        reach_m: float,
        road_xy_m: FloatArray | None = None,
    ) -> IntArray:
        """Number of the nearest gate (n,) of like direction that is less than so far away, and to the side."""
        rows = [k for k, gate in enumerate(self.gates) if gate.inwards == inwards]
        if not rows or not len(xy_m):
            return np.full(len(xy_m), -1)
        at = np.array([self.gates[k].xy_m for k in rows])
        heading = np.array([self.gates[k].direction_rad for k in rows])
        dx, dy = (xy_m[:, None] - at[None]).transpose(2, 0, 1)
        distance, aside = np.hypot(dx, dy), np.abs(dy * np.cos(heading) - dx * np.sin(heading))
        turn = np.abs(np.angle(np.exp(1j * (direction_rad[:, None] - heading[None]))))
        distance = np.where((turn < _ARM_RAD) & (aside < aside_m) & (distance < reach_m), distance, np.inf)
        if road_xy_m is not None:
            distance = distance + np.hypot(*(road_xy_m[:, None] - self.roads_m[rows][None]).transpose(2, 0, 1))
        best = distance.argmin(axis=1)
        return np.where(np.isfinite(distance.min(axis=1)), np.array(rows)[best], -1)


def find_gates(graph: LaneGraph, junction: Junction, names: ArmNames | None = None) -> Gates:
    """Gates and arms of a junction."""
    found: list[End] = []
    roads: list[End] = []
    for lane in graph:
        inside = inside_hull(lane.xy_m, junction.hull_m)
        for k in np.flatnonzero(inside[:-1] != inside[1:]):
            inwards = bool(inside[k + 1])
            found.append((lane.number, inwards, *_middle(lane.xy_m, int(k))))
            outside = np.flatnonzero(~inside[: k + 1] if inwards else ~inside[k + 1 :]) + (0 if inwards else k + 1)
            way = outside[np.abs(lane.along_m[outside] - lane.along_m[k]) < ROAD_M]
            far = min(int(way[0] if inwards else way[-1]), len(lane.xy_m) - 2)
            roads.append((lane.number, inwards, *_middle(lane.xy_m, far)))
    arms = group_gates(found, roads)
    numbers = sorted(set(arms.tolist()))
    middles = [
        np.mean([f[2] for f, arm in zip(found, arms, strict=True) if arm == number], axis=0) for number in numbers
    ]
    outward = [_outward([f for f, arm in zip(roads, arms, strict=True) if arm == number]) for number in numbers]
    order = sorted(range(len(numbers)), key=lambda k: float((outward[k] + np.pi / 2) % (2 * np.pi)))
    rank = {numbers[k]: i for i, k in enumerate(order)}
    gates = tuple(Gate(*f, arm=rank[int(arm)]) for f, arm in zip(found, arms, strict=True))
    name = (names or ArmNames()).of(
        {i: outward[k] for i, k in enumerate(order)},
        {i: middles[k] for i, k in enumerate(order)},
        place=f"{junction.number}.",
    )
    made = tuple(Arm(i, name[i], middles[k], outward[k]) for i, k in enumerate(order))
    return Gates(gates, made, np.array([road[2] for road in roads]).reshape(-1, 2))


def _middle(xy_m: FloatArray, k: int) -> tuple[FloatArray, float]:
    """Middle and direction of the ``k``-th step of a line."""
    step = xy_m[k + 1] - xy_m[k]
    return (xy_m[k] + xy_m[k + 1]) / 2, float(np.arctan2(step[1], step[0]))


def _outward(gates: list[End]) -> float:
    """Mean direction away from the junction, rad: along lanes out, against lanes in."""
    return float(np.angle(sum(np.exp(1j * (direction + np.pi * inwards)) for _, inwards, _, direction in gates)))


def group_gates(*places: list[End]) -> IntArray:
    """Number of each gate's arm: gates near each other, of one axis, are of one arm.

    Parameters
    ----------
    places
        Of each gate, farther and farther out. Gates are of one arm that are near each other in one of these lists, and
        of one axis in the last: roads that part at the border lead elsewhere.
    """
    n = len(places[0])
    label = np.arange(n)
    for i in range(n):
        for j in range(i):
            near = any(_of_one_road(found[i], found[j]) for found in places)
            if near and _between(places[-1][i], places[-1][j]) < _ARM_RAD:
                label[label == label[i]] = label[j]
    return label


def _of_one_road(a: End, b: End) -> bool:
    return bool(np.hypot(*(a[2] - b[2])) < _ARM_M and _between(a, b) < _ARM_RAD)


def _between(a: End, b: End) -> float:
    """Angle between the directions in which two gates lead outwards, rad."""
    return abs(float(np.angle(np.exp(1j * (a[3] + np.pi * a[1] - b[3] - np.pi * b[1])))))
