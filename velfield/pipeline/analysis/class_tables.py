"""Counts of vehicles by class: of the picture, of movements, from origins to destinations, and on lanes."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from schemas.analysis import AnalysisTable, Cell
from schemas.arrays import FloatArray, IntArray
from velfield.analysis.intervals import MIN_VEHICLES, Estimate
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.analysis.vehicle_classes import COUNTED_CLASSES, VehicleClasses
from velfield.pipeline.analysis.cells import Column, estimate_cell, make_table


@dataclass(frozen=True)
class _Group:
    """Some of the traffic: how many vehicles, of which some are measured, and the shares of `COUNTED_CLASSES`."""

    kind: str
    name: str
    vehicles: float
    measured: int
    shares: Sequence[Estimate | None]
    place_m: FloatArray | None


def class_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Vehicles by class."""

    def vehicles(number: int, name: str) -> Column[_Group]:
        def value(group: _Group) -> Cell:
            return estimate_cell(group.shares[number], group.vehicles)

        return Column(name.replace(" ", "_"), name.capitalize(), "veh", value)

    columns: list[Column[_Group]] = [
        Column("of", "Of", "", lambda group: group.kind),
        Column("where", "Where", "", lambda group: group.name),
        Column("vehicles", "Vehicles", "", lambda group: group.vehicles, 1),
        Column("measured", "Measured", "", lambda group: group.measured),
        *(vehicles(number, name) for number, name in enumerate(COUNTED_CLASSES)),
    ]
    note = (
        "By the shares of the classes under which the measured lengths and widths are most likely: a vehicle whose "
        "dimensions fit two classes counts in part for either. Intervals are of the shares in the long run, and wider "
        "where dimensions do not separate the classes. Vehicles that were not measured are taken to be as the others. "
        f"Counts take {MIN_VEHICLES} measured vehicles."
    )
    if analysis.classes is None:
        note = "Lengths and widths in metres are not known of these tracks."
    rows = _groups(analysis, analysis.classes) if analysis.classes else ()
    title = "Vehicles by class"
    return make_table(
        analysis, "classes", "Movements", title, note, columns, rows, lambda group: group.place_m, named_by=4
    )


def _groups(analysis: TrafficAnalysis, classes: VehicleClasses) -> Iterator[_Group]:
    def group(kind: str, name: str, vehicles: float, tracks: IntArray, place_m: FloatArray | None) -> _Group:
        measured = int(np.isin(tracks, classes.measured).sum())
        return _Group(kind, name, vehicles, measured, classes.estimate_shares(tracks), place_m)

    n = len(analysis.trajectories)
    yield group("picture", "all vehicles that drive", float(n), np.arange(n), None)
    for found in analysis.movements:
        for m in found.movements:
            name = f"{analysis.junction_kind(m.junction)} {m.junction}, {m.arm_in} to {m.arm_out}"
            yield group("movement", name, m.seen + m.inferred, found.tracks(m), m.line_m)
    scene = analysis.scene
    if scene is not None:
        for r in scene.relations:
            trips = scene.trips
            rows = (trips.origin == r.origin.number) & (trips.destination[:, r.destination.number] == 1.0)
            line_m = np.array([r.origin.xy_m, r.destination.xy_m])
            name = f"{r.origin.name} to {r.destination.name}"
            yield group("origin to destination", name, r.vehicles, trips.track[rows], line_m)
    for lane in analysis.lanes:
        passing = analysis.lane_traffic.passings(lane.number, lane.length_m / 2)
        yield group("lane", f"lane {lane.number}, at its middle", float(len(passing)), passing.track, lane.xy_m)
