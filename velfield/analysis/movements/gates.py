"""Gates: where lanes cross the border of a junction, grouped into its arms."""

from dataclasses import dataclass

import numpy as np

from schemas.arrays import FloatArray, IntArray
from velfield.analysis.lanes.junctions import inside_hull
from velfield.analysis.lanes.model import Junction, LaneGraph

_ARM_M = 17.0
"""Gates of one arm are nearer to each other: a median may lie between them."""
_ARM_RAD = np.radians(35)
"""Axes of one arm's gates differ by less."""
COMPASS = ("E", "SE", "S", "SW", "W", "NW", "N", "NE")
"""Sides of the image by direction, every 45° from the right, clockwise."""


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
    """A road that ends at a junction: ``name`` by the side of the image it leads to, its gates' middle ``xy_m``."""

    number: int
    name: str
    xy_m: FloatArray


@dataclass(frozen=True)
class Gates:
    """Gates and arms of a junction."""

    gates: tuple[Gate, ...]
    arms: tuple[Arm, ...]

    def nearest(self, xy_m: FloatArray, direction_rad: FloatArray, *, inwards: bool, reach_m: float = 6.0) -> IntArray:
        """Number of the gate (n,) nearest to each crossing of its direction, -1: none near."""
        rows = [k for k, gate in enumerate(self.gates) if gate.inwards == inwards]
        if not rows or not len(xy_m):
            return np.full(len(xy_m), -1)
        at = np.array([self.gates[k].xy_m for k in rows])
        heading = np.array([self.gates[k].direction_rad for k in rows])
        distance = np.hypot(*(xy_m[:, None] - at[None]).transpose(2, 0, 1))
        turn = np.abs(np.angle(np.exp(1j * (direction_rad[:, None] - heading[None]))))
        distance = np.where(turn < _ARM_RAD, distance, np.inf)
        best = distance.argmin(axis=1)
        near = distance[np.arange(len(xy_m)), best] < reach_m
        return np.where(near, np.array(rows)[best], -1)


def find_gates(graph: LaneGraph, junction: Junction) -> Gates:
    """Gates and arms of a junction."""
    found: list[tuple[int, bool, FloatArray, float]] = []
    for lane in graph:
        inside = inside_hull(lane.xy_m, junction.hull_m)
        for k in np.flatnonzero(inside[:-1] != inside[1:]):
            middle = (lane.xy_m[k] + lane.xy_m[k + 1]) / 2
            step = lane.xy_m[k + 1] - lane.xy_m[k]
            found.append((lane.number, bool(inside[k + 1]), middle, float(np.arctan2(step[1], step[0]))))
    arms = group_gates(found)
    numbers = sorted(set(arms.tolist()))
    middles = [
        np.mean([f[2] for f, arm in zip(found, arms, strict=True) if arm == number], axis=0) for number in numbers
    ]
    outward = [_outward([f for f, arm in zip(found, arms, strict=True) if arm == number]) for number in numbers]
    order = sorted(range(len(numbers)), key=lambda k: float((outward[k] + np.pi / 2) % (2 * np.pi)))
    rank = {numbers[k]: i for i, k in enumerate(order)}
    gates = tuple(Gate(*f, arm=rank[int(arm)]) for f, arm in zip(found, arms, strict=True))
    names = _names([outward[k] for k in order])
    return Gates(gates, tuple(Arm(i, names[i], middles[k]) for i, k in enumerate(order)))


def _outward(gates: list[tuple[int, bool, FloatArray, float]]) -> float:
    """Mean direction away from the junction, rad: along lanes out, against lanes in."""
    return float(np.angle(sum(np.exp(1j * (direction + np.pi * inwards)) for _, inwards, _, direction in gates)))


def group_gates(found: list[tuple[int, bool, FloatArray, float]]) -> IntArray:
    """Number of each gate's arm: gates near each other, of one axis, are of one arm.

    Parameters
    ----------
    found
        For each gate: its lane, whether it leads inwards, its position, m, and its direction, rad.
    """
    n = len(found)
    label = np.arange(n)
    for i in range(n):
        for j in range(i):
            outward = found[i][3] + np.pi * found[i][1], found[j][3] + np.pi * found[j][1]
            turn = abs(float(np.angle(np.exp(1j * (outward[0] - outward[1])))))
            if np.hypot(*(found[i][2] - found[j][2])) < _ARM_M and turn < _ARM_RAD:
                label[label == label[i]] = label[j]
    return label


def _names(outward_rad: list[float]) -> list[str]:
    names: list[str] = []
    for angle in outward_rad:
        name = COMPASS[int(np.round(angle / (np.pi / 4))) % 8]
        names.append(name if name not in names else f"{name}{sum(other.startswith(name) for other in names) + 1}")
    return names
