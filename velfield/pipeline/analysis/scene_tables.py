"""Tables of origins and destinations of the whole scene, and of counts by slice of time."""

from collections.abc import Iterator

import numpy as np

from schemas.analysis import AnalysisTable, Cell
from velfield.analysis.movements.scene import OriginDestination, Relation
from velfield.analysis.movements.time_slices import SliceCount
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.pipeline.analysis.cells import (
    Columns,
    estimate_cell,
    line_geometry,
    make_row,
    make_table,
    point_geometry,
    polygon_geometry,
)


def scene_tables(analysis: TrafficAnalysis) -> Iterator[AnalysisTable]:
    """The matrix of origins and destinations, and what is known of each pair."""
    yield matrix_table(analysis)
    yield relation_table(analysis)
    yield car_park_table(analysis)


def matrix_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Vehicles, seen and inferred, by origin (rows) and destination (columns)."""
    scene = analysis.scene
    columns: Columns = {"from": ("From", "")}
    if scene is None:
        return make_table("origins", "Movements", "Origins and destinations, vehicles", "", columns, ())
    exits = [arm for arm in scene.arms if any(gate.arm == arm.number and not gate.inwards for gate in scene.gates)]
    columns |= {f"to_{arm.name}": (f"To {arm.name}", "") for arm in exits} | {"all": ("All", "")}
    vehicles = {(r.origin.number, r.destination.number): r.vehicles for r in scene.relations}
    rows = []
    for arm in scene.arms:
        if any(gate.arm == arm.number and gate.inwards for gate in scene.gates):
            counts = [vehicles.get((arm.number, to.number), 0.0) for to in exits]
            cells: dict[str, Cell] = {"from": arm.name}
            cells |= {f"to_{to.name}": round(n, 1) for to, n in zip(exits, counts, strict=True)}
            entered = int((scene.trips.origin == arm.number).sum())
            rows.append(make_row({**cells, "all": entered}, point_geometry(arm.xy_m, analysis)))
    return make_table("origins", "Movements", "Origins and destinations, vehicles", _note(scene), columns, rows)


def _note(scene: OriginDestination) -> str:
    trips = scene.trips
    seen, remain = int(trips.seen.sum()), int(trips.remains.sum())
    cut = len(trips.track) - seen - remain
    return (
        f"{len(trips.track)} vehicles entered the picture: {seen} were seen to leave, {cut} have tracks that are cut, "
        f"{remain} were still there at the end. Not counted: {scene.before} tracks there at the start, and "
        f"{scene.unknown} that begin inside, most of them the rest of one that was cut."
    )


def relation_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Each pair of an origin and a destination."""
    columns: Columns = {
        "from": ("From", ""),
        "to": ("To", ""),
        "seen": ("Vehicles seen whole", ""),
        "cut": ("Of cut tracks, joined or inferred", ""),
        "remaining": ("Inferred of those still there at the end", ""),
        "share": ("Share of the entry", "%"),
        "flow": ("Flow", "veh/h"),
        "travel_time": ("Travel time", "s"),
    }
    relations = analysis.scene.relations if analysis.scene else ()
    rows = (make_row(_relation_cells(r), line_geometry(_between(r), analysis)) for r in relations)
    note = (
        "Arms are named by the side of the image that they lead to; “inside” is a yard or a garage. A vehicle whose "
        "track is cut, and not found again, is taken to go where the others went that drove where it was lost."
    )
    return make_table("origin_destination", "Movements", "From origin to destination", note, columns, rows)


def _relation_cells(r: Relation) -> dict[str, Cell]:
    return {
        "from": r.origin.name,
        "to": r.destination.name,
        "seen": r.seen,
        "cut": round(r.cut, 1),
        "remaining": round(r.remaining, 1),
        "share": estimate_cell(r.share, 100.0),
        "flow": estimate_cell(r.flow_veh_per_h),
        "travel_time": estimate_cell(r.travel_time_s),
    }


def _between(r: Relation) -> np.ndarray:
    return np.array([r.origin.xy_m, r.destination.xy_m])


def car_park_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Through traffic of car parks."""
    columns: Columns = {
        "parked": ("Parked vehicles", ""),
        "entered": ("Vehicles that drive in", ""),
        "through": ("Of these, through without a stop", ""),
        "share": ("Share", "%"),
        "flow": ("Flow", "veh/h"),
        "time": ("Time inside", "s"),
    }
    rows = (
        make_row(
            {
                "parked": park.parked,
                "entered": park.entered,
                "through": park.through,
                "share": estimate_cell(park.through_share, 100.0),
                "flow": estimate_cell(park.through_veh_per_h),
                "time": estimate_cell(park.time_s),
            },
            polygon_geometry(park.hull_m, analysis),
        )
        for park in analysis.car_parks
    )
    note = (
        "Areas of six parked vehicles or more, 10 m wide or more, kerbs left out, and who drives 15 m or more in them."
    )
    if analysis.parked is None:
        note = "Parked vehicles are not known of these tracks."
    return make_table("car_parks", "Movements", "Through traffic of car parks", note, columns, rows)


def time_tables(analysis: TrafficAnalysis) -> Iterator[AnalysisTable]:
    """Counts by slice of time, where the flight is longer than two slices."""
    if not len(analysis.slice_edges_s):
        return
    note = f"Slices of {analysis.slice_s:g} s, by the time of entry."
    columns: Columns = {"junction": ("Junction", ""), **_SLICE_COLUMNS}
    lines = {(m.junction, m.arm_in, m.arm_out): m.line_m for found in analysis.movements for m in found.movements}
    rows = (
        make_row(
            {"junction": c.junction, **_slice_cells(c)},
            line_geometry(lines[c.junction or 0, c.arm_in, c.arm_out], analysis),
        )
        for c in analysis.counts_by_time
    )
    yield make_table("movements_by_time", "Movements", "Turning counts by time", note, columns, rows)
    arms = {arm.name: arm.xy_m for arm in analysis.scene.arms} if analysis.scene else {}
    rows = (
        make_row(_slice_cells(c), line_geometry(np.array([arms[c.arm_in], arms[c.arm_out]]), analysis))
        for c in analysis.scene_by_time
    )
    yield make_table(
        "origin_destination_by_time", "Movements", "From origin to destination by time", note, _SLICE_COLUMNS, rows
    )


_SLICE_COLUMNS: Columns = {
    "from": ("From", ""),
    "to": ("To", ""),
    "begin": ("Slice from", "s"),
    "end": ("to", "s"),
    "seen": ("Vehicles seen", ""),
    "inferred": ("Vehicles inferred", ""),
    "flow": ("Flow", "veh/h"),
}


def _slice_cells(c: SliceCount) -> dict[str, Cell]:
    return {
        "from": c.arm_in,
        "to": c.arm_out,
        "begin": round(c.begin_s, 1),
        "end": round(c.end_s, 1),
        "seen": c.seen,
        "inferred": round(c.inferred, 1),
        "flow": estimate_cell(c.flow_veh_per_h),
    }
