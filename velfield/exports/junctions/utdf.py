"""Junctions as Synchro's Universal Traffic Data Format, version 8: volumes, lanes and phases, in one CSV file.

Each intersection and roundabout is a node, each of its arms an external node of its own. A node's INTID is the number
of its junction + 1; its DESCRIPTION has the number itself. Distances are in metres.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from schemas.arrays import FloatArray
from schemas.export import ExportOptions
from velfield.analysis.movements.gates import Arm
from velfield.analysis.movements.movements import JunctionMovements, Movement
from velfield.analysis.signals.cycles import JunctionSignal, green_duration_s
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.errors import InputError
from velfield.exports.junctions.turning_counts import TURN_LETTERS
from velfield.run.run import Run

FILE_NAME = "synchro.csv"
BOUNDS = ("NB", "NE", "EB", "SE", "SB", "SW", "WB", "NW")
"""Directions of travel of approaches, clockwise."""
_SIDES = ("S", "SW", "W", "NW", "N", "NE", "E", "SE")
"""Sides of the image from which these come."""
_SHARES_LANE = 0.1
"""A lane is of the turns that at least this fraction of its vehicles take."""
_SIGNAL, _EXTERNAL, _NO_SIGNAL, _ROUNDABOUT = 0, 1, 3, 4
_PHASES = 8
_ARM_M = 100.0

Rows = Iterator[list[object]]


def encode(run: Run, _path: Path, _options: ExportOptions) -> bytes:
    """See `velfield.exports.export.ExportModule`.

    Raises
    ------
    InputError
        The ground sample distance is not known, or no junction with movements was found.
    """
    return utdf(run.analysis.traffic, height_m=run.grid.height_px * run.gsd_m).encode()


def utdf(analysis: TrafficAnalysis, *, height_m: float) -> str:
    """The file's text; y is up from the lower border of a map of that height."""
    nodes = [
        _Node(analysis, found, height_m)
        for found in analysis.movements
        if analysis.ways_meet(found.junction.number) and found.movements
    ]
    if not nodes:
        raise InputError(
            "found no intersection or roundabout at which turns were seen, expected one: Synchro has volumes of no "
            "other junction; --format turning_counts has merges too"
        )
    columns = list(dict.fromkeys(name for node in nodes for name in node.lane_columns))
    sections: list[tuple[str, str, list[str], Rows]] = [
        ("Network", "Network Settings", ["RECORDNAME", "DATA"], iter([["UTDFVERSION", 8], ["Metric", 1]])),
        ("Nodes", "Node Data", ["INTID", "TYPE", "X", "Y", "Z", "DESCRIPTION"], _each(node.nodes() for node in nodes)),
        ("Links", "Link Data", ["RECORDNAME", "INTID", *BOUNDS], _each(node.links() for node in nodes)),
        (
            "Lanes", "Lane Group Data", ["RECORDNAME", "INTID", *columns, "PED", "HOLD"],
            _each(node.lanes(columns) for node in nodes),
        ),
        (
            "Timeplans", "Timing Plan Settings", ["RECORDNAME", "INTID", "DATA"],
            _each(node.time_plan() for node in nodes),
        ),
        (
            "Phases", "Phasing Data", ["RECORDNAME", "INTID", *(f"D{k}" for k in range(1, _PHASES + 1))],
            _each(node.phases() for node in nodes),
        ),
    ]  # fmt: skip
    lines = []
    for name, title, head, rows in sections:
        lines += [f"[{name}]", title, ",".join(head)]
        lines += [",".join("" if cell is None else f"{cell}" for cell in row) for row in rows]
        lines.append("")
    return "\n".join(lines)


def _each(parts: Iterator[Rows]) -> Rows:
    for rows in parts:
        yield from rows


class _Node:
    """A junction in the terms of the format."""

    def __init__(self, analysis: TrafficAnalysis, found: JunctionMovements, height_m: float) -> None:
        self.analysis, self.found, self.height_m = analysis, found, height_m
        self.number = found.junction.number + 1
        self.bounds = _assign_bounds([arm.name for arm in found.gates.arms])
        self.far = {arm.name: 100 * self.number + arm.number + 1 for arm in found.gates.arms}
        self.groups: defaultdict[str, list[Movement]] = defaultdict(list)
        for m in sorted(found.movements, key=lambda m: -(m.seen + m.inferred)):
            self.groups[self.bounds[m.arm_in] + TURN_LETTERS[m.turn]].append(m)
        signal = analysis.signals.get(found.junction.number)
        self.signal: JunctionSignal | None = signal if signal and signal.signalised else None

    @property
    def lane_columns(self) -> list[str]:
        """Lane groups, by approach."""
        return sorted(self.groups, key=lambda name: (BOUNDS.index(name[:2]), "LTRU".index(name[2])))

    def nodes(self) -> Rows:
        """The junction, and the ends of its arms."""
        junction = self.found.junction
        kind = _SIGNAL if self.signal else _ROUNDABOUT if junction.kind == "roundabout" else _NO_SIGNAL
        yield [self.number, kind, *self._place(junction.centre_m), 0, f"junction {junction.number}"]
        for arm in self.found.gates.arms:
            yield [self.far[arm.name], _EXTERNAL, *self._place(_end_m(arm)), 0, f"arm {arm.name}"]

    def links(self) -> Rows:
        """The arms as links to the junction, and from it."""
        arms = self.found.gates.arms
        lanes = [sum(g.inwards and g.arm == arm.number for g in self.found.gates.gates) for arm in arms]
        centre = self.found.junction.centre_m
        length = [round(float(np.hypot(*(_end_m(arm) - centre)))) for arm in arms]
        for name, values in (
            ("Up ID", list(self.far.values())), ("Lanes", lanes), ("Name", [arm.name for arm in arms]),
            ("Distance", length),
        ):  # fmt: skip
            by_bound = {self.bounds[arm.name]: value for arm, value in zip(arms, values, strict=True)}
            yield [name, self.number, *(by_bound.get(bound) for bound in BOUNDS)]
        for arm, metres in zip(arms, length, strict=True):
            leaves = BOUNDS[(BOUNDS.index(self.bounds[arm.name]) + 4) % 8]
            for name, value in (("Up ID", self.number), ("Name", arm.name), ("Distance", metres)):
                yield [name, self.far[arm.name], *(value if bound == leaves else None for bound in BOUNDS)]

    def lanes(self, columns: list[str]) -> Rows:
        """Volumes, lanes and phases by lane group."""
        number, shared = self._lane_counts()
        hours = self.analysis.trajectories.duration_s / 3600
        phase = self._phase_of_arm()

        def heavy(movements: list[Movement]) -> float | None:
            share = self.analysis.heavy_share(np.concatenate([self.found.tracks(m) for m in movements]))
            return round(100 * share.value) if share else None

        rows: dict[str, Mapping[str, object]] = {
            "Up Node": {k: self.far[g[0].arm_in] for k, g in self.groups.items()},
            "Dest Node": {k: self.far[g[0].arm_out] for k, g in self.groups.items()},
            "Lanes": {k: number.get(k, 0) for k in self.groups},
            "Shared": {k: shared.get(k, 0) for k in self.groups},
            "Volume": {k: round(sum(m.seen + m.inferred for m in g) / hours) for k, g in self.groups.items()},
            "HeavyVehicles": {k: heavy(g) for k, g in self.groups.items()},
        }
        if self.signal:
            rows["Phase1"] = {k: phase.get(g[0].arm_in) for k, g in self.groups.items()}
        for name, values in rows.items():
            yield [name, self.number, *(values.get(column) for column in columns), None, None]

    def time_plan(self) -> Rows:
        """The cycle, fixed; its start is second 0 of the video."""
        if self.signal and self.signal.cycle_s:
            for name, value in (
                ("Control Type", 0), ("Cycle Length", round(self.signal.cycle_s.value, 1)), ("Offset", 0),
            ):  # fmt: skip
                yield [name, self.number, value]

    def phases(self) -> Rows:
        """Greens of the phases: from their onset to where crossings end, yellow included."""
        if not self.signal or not self.signal.cycle_s:
            return
        cycle = self.signal.cycle_s.value
        start: list[float | None] = [None] * _PHASES
        end: list[float | None] = [None] * _PHASES
        green: list[float | None] = [None] * _PHASES
        for k, lanes in enumerate(self.signal.phases[:_PHASES]):
            streams = [s for s in self.signal.streams if s.stream.approach.lane in lanes]
            onset, lasts = streams[0].green_phase_s.value, green_duration_s(streams, cycle)
            start[k] = round(onset % cycle, 1)
            if lasts is not None:
                green[k], end[k] = round(lasts, 1), round((onset + lasts) % cycle, 1)
        for name, values in (("MaxGreen", green), ("Start", start), ("End", end)):
            yield [name, self.number, *values]

    def _place(self, xy_m: FloatArray) -> tuple[float, float]:
        return round(float(xy_m[0]), 1), round(self.height_m - float(xy_m[1]), 1)

    def _lane_counts(self) -> tuple[dict[str, int], dict[str, int]]:
        """Lanes of each lane group, and the code of what its lanes share: 1 left, 2 right, 3 both. A shared lane is of
        the group straight on, if there is one."""
        passes, gates = self.found.passes, self.found.gates.gates
        arm = np.array([gate.arm for gate in gates] + [-1])
        turn = {(m.arm_in, m.arm_out): TURN_LETTERS[m.turn] for m in self.found.movements}
        name = [a.name for a in self.found.gates.arms]
        lanes: defaultdict[str, int] = defaultdict(int)
        shared: defaultdict[str, int] = defaultdict(int)
        for k, gate in enumerate(gates):
            out = arm[passes.gate_out[passes.gate_in == k]]
            turns = [turn[name[gate.arm], name[o]] for o in out if o >= 0 and (name[gate.arm], name[o]) in turn]
            used = [t for t in "TLRU" if turns.count(t) >= max(_SHARES_LANE * len(turns), 1)]
            if gate.inwards and used:
                group = self.bounds[name[gate.arm]] + used[0]
                lanes[group] += 1
                shared[group] |= ("L" in used[1:] or "U" in used[1:]) | 2 * ("R" in used[1:])
        return lanes, shared

    def _phase_of_arm(self) -> dict[str, int]:
        """Number of the phase of each arm's lanes."""
        lane_arm = {g.lane: self.found.gates.arms[g.arm].name for g in self.found.gates.gates if g.inwards}
        phases = self.signal.phases if self.signal else ()
        return {lane_arm[lane]: k for k, lanes in enumerate(phases, start=1) for lane in lanes if lane in lane_arm}


def _end_m(arm: Arm) -> FloatArray:
    """(2,) where an arm's external node lies: ``_ARM_M`` beyond its gates, the way its road leads.

    Gates are only metres from a junction's centre: the direction from there to them is not that of the road.
    """
    return np.asarray(arm.xy_m + _ARM_M * np.array([np.cos(arm.outward_rad), np.sin(arm.outward_rad)]))


def _assign_bounds(arms: list[str]) -> dict[str, str]:
    """Direction of travel of each arm's approach; where two are of one side the second has the nearest that is free.

    Examples
    --------
    >>> _assign_bounds(["S", "N1", "N2", "W"])
    {'S': 'NB', 'N1': 'SB', 'N2': 'SW', 'W': 'EB'}
    """
    out: dict[str, str] = {}
    for arm in arms:
        at = _SIDES.index(arm.rstrip("0123456789"))
        free = [BOUNDS[(at + step) % 8] for step in (0, 1, -1, 2, -2, 3, -3, 4)]
        out[arm] = next((bound for bound in free if bound not in out.values()), free[0])
    return out
