"""Counts of vehicles by class: of the picture, of movements, from origins to destinations, and on lanes."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from schemas.analysis import AnalysisTable, Cell, GeometryRecord
from schemas.arrays import IntArray
from velfield.analysis.intervals import Estimate
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.analysis.vehicle_classes import COUNTED_CLASSES, HEAVY
from velfield.pipeline.analysis.cells import Column, estimate_cell, line_geometry, make_table


@dataclass(frozen=True)
class _Group:
    """Some of the traffic: how many vehicles, and the numbers of the tracks that are known to be of it."""

    kind: str
    name: str
    vehicles: float
    tracks: IntArray
    geometry: GeometryRecord | None


def class_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Vehicles by class."""
    classes = analysis.classes
    groups = [] if classes is None else list(_groups(analysis))
    shares = {group.name: classes.estimate_shares(group.tracks) for group in groups if classes}
    measured = classes.measured if classes else np.empty(0, np.int64)

    def vehicles(number: int, name: str) -> Column[_Group]:
        def value(group: _Group) -> Cell:
            return estimate_cell(shares[group.name][number], group.vehicles)

        return Column(name.replace(" ", "_"), name.capitalize(), "veh", value)

    columns: list[Column[_Group]] = [
        Column("of", "Of", "", lambda group: group.kind),
        Column("where", "Where", "", lambda group: group.name),
        Column("vehicles", "Vehicles", "", lambda group: group.vehicles, 1),
        Column("measured", "Measured", "", lambda group: int(np.isin(group.tracks, measured).sum())),
        *(vehicles(number, name) for number, name in enumerate(COUNTED_CLASSES)),
    ]
    note = (
        "By the shares of the classes under which the measured lengths and widths are most likely: a vehicle whose "
        "dimensions fit two classes counts in part for either. Intervals are of the shares in the long run, and wider "
        "where dimensions do not separate the classes. Vehicles that were not measured are taken to be as the others."
    )
    if classes is None:
        note = "Lengths and widths in metres are not known of these tracks."
    return make_table("classes", "Movements", "Vehicles by class", note, columns, groups, lambda group: group.geometry)


def heavy_share(analysis: TrafficAnalysis, tracks: IntArray) -> Estimate | None:
    """Share of lorries and buses among the vehicles of some tracks."""
    return analysis.classes.estimate_shares(tracks)[HEAVY] if analysis.classes else None


def _groups(analysis: TrafficAnalysis) -> Iterator[_Group]:
    n = len(analysis.trajectories)
    yield _Group("picture", "all tracks that move", float(n), np.arange(n), None)
    for found in analysis.movements:
        for m in found.movements:
            name = f"{found.junction.kind} {m.junction}, {m.arm_in} to {m.arm_out}"
            geometry = line_geometry(m.line_m, analysis)
            yield _Group("movement", name, m.seen + m.inferred, found.tracks(m), geometry)
    scene = analysis.scene
    if scene is not None:
        for r in scene.relations:
            trips = scene.trips
            rows = (trips.origin == r.origin.number) & (trips.destination[:, r.destination.number] == 1.0)
            geometry = line_geometry(np.array([r.origin.xy_m, r.destination.xy_m]), analysis)
            name = f"{r.origin.name} to {r.destination.name}"
            yield _Group("origin to destination", name, r.vehicles, trips.track[rows], geometry)
    for lane in analysis.lanes:
        passing = analysis.lane_traffic.passings(lane.number, lane.length_m / 2)
        geometry = line_geometry(lane.xy_m, analysis)
        yield _Group("lane", f"lane {lane.number}, at its middle", float(len(passing)), passing.track, geometry)
