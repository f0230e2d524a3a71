"""Counts of vehicles by class: of the picture, of movements, from origins to destinations, and on lanes."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from schemas.analysis import AnalysisTable, Cell, EstimateRecord, GeometryRecord
from schemas.arrays import IntArray
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.analysis.vehicle_classes import COUNTED_CLASSES, HEAVY
from velfield.pipeline.analysis.cells import Columns, estimate_cell, line_geometry, make_row, make_table


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
    names = {name: name.replace(" ", "_") for name in COUNTED_CLASSES}
    columns: Columns = {"of": ("Of", ""), "where": ("Where", ""), "vehicles": ("Vehicles", "")}
    columns |= {"measured": ("Measured", "")} | {key: (name.capitalize(), "veh") for name, key in names.items()}
    if classes is None:
        note = "Lengths and widths in metres are not known of these tracks."
        return make_table("classes", "Movements", "Vehicles by class", note, columns, ())
    rows = []
    for group in _groups(analysis):
        cells: dict[str, Cell] = {"of": group.kind, "where": group.name, "vehicles": round(group.vehicles, 1)}
        cells["measured"] = int(np.isin(group.tracks, classes.measured).sum())
        for key, share in zip(names.values(), classes.estimate_shares(group.tracks), strict=True):
            cells[key] = estimate_cell(share, group.vehicles)
        rows.append(make_row(cells, group.geometry))
    note = (
        "By the shares of the classes under which the measured lengths and widths are most likely: a vehicle whose "
        "dimensions fit two classes counts in part for either. Intervals are of the shares in the long run, and wider "
        "where dimensions do not separate the classes. Vehicles that were not measured are taken to be as the others."
    )
    return make_table("classes", "Movements", "Vehicles by class", note, columns, rows)


def heavy_cell(analysis: TrafficAnalysis, tracks: IntArray) -> EstimateRecord:
    """Share of lorries and buses among the vehicles of some tracks, %."""
    return estimate_cell(analysis.classes.estimate_shares(tracks)[HEAVY] if analysis.classes else None, 100.0)


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
