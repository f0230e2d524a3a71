"""Tables of origins and destinations of the whole scene, and of counts by slice of time."""

from collections.abc import Iterator

import numpy as np

from schemas.analysis import AnalysisTable
from velfield.analysis.movements.car_parks import CarPark
from velfield.analysis.movements.gates import Arm
from velfield.analysis.movements.scene import OriginDestination, Relation
from velfield.analysis.movements.time_slices import SliceCount
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.errors import count_text
from velfield.pipeline.analysis.cells import Column, estimates, make_table


def scene_tables(analysis: TrafficAnalysis) -> Iterator[AnalysisTable]:
    """The matrix of origins and destinations, and what is known of each pair."""
    yield matrix_table(analysis)
    yield relation_table(analysis)
    yield car_park_table(analysis)


def matrix_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Vehicles, seen and inferred, by origin (rows) and destination (columns)."""
    scene, title = analysis.scene, "Origins and destinations, vehicles"
    columns: list[Column[Arm]] = [Column("from", "From", "", lambda arm: arm.name)]
    if scene is None:
        return make_table(analysis, "origins", "Movements", title, "", columns, (), lambda arm: arm.xy_m)
    entries, exits = (
        [arm for arm in scene.arms if any(g.arm == arm.number and g.inwards == inwards for g in scene.gates)]
        for inwards in (True, False)
    )
    vehicles = {(r.origin.number, r.destination.number): r.vehicles for r in scene.relations}
    trips = scene.trips

    def column(to: Arm) -> Column[Arm]:
        number = to.number
        return Column(f"to_{to.name}", f"To {to.name}", "", lambda arm: vehicles.get((arm.number, number), 0.0), 1)

    def entered(arm: Arm) -> int:
        return int((trips.origin == arm.number).sum())

    def unknown(arm: Arm) -> float:
        return max(entered(arm) - sum(vehicles.get((arm.number, to.number), 0.0) for to in exits), 0.0)

    columns += map(column, exits)
    columns += [Column("unknown", "By other roads, or not known", "", unknown, 1), Column("all", "All", "", entered)]
    note = _note(scene)
    return make_table(analysis, "origins", "Movements", title, note, columns, entries, lambda arm: arm.xy_m)


def _note(scene: OriginDestination) -> str:
    trips = scene.trips
    seen, remain, elsewhere = (int(of.sum()) for of in (trips.seen, trips.remains, trips.elsewhere))
    cut = len(trips.track) - seen - remain - elsewhere
    rare = f"left by roads that fewer than three took: {elsewhere}; " if elsewhere else ""
    return (
        f"{count_text(len(trips.track), 'vehicle')} entered the picture; seen to leave: {seen}; {rare}"
        f"cut tracks: {cut}; still there at the end: {remain}. Not counted: {count_text(scene.before, 'track')} there "
        f"at the start, and {scene.unknown} that begin inside, most of them the rest of one that was cut."
    )


def relation_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Each pair of an origin and a destination."""
    columns: list[Column[Relation]] = [
        Column("from", "From", "", lambda r: r.origin.name),
        Column("to", "To", "", lambda r: r.destination.name),
        Column("seen", "Vehicles seen whole", "", lambda r: r.seen),
        Column("cut", "Of cut tracks, joined or inferred", "", lambda r: r.cut, 1),
        Column("remaining", "Inferred of those still there at the end", "", lambda r: r.remaining, 1),
        estimates("share", "Share of the entry", "%", lambda r: r.share, 100.0),
        estimates("flow", "Flow", "veh/h", lambda r: r.flow_veh_per_h),
        estimates("travel_time", "Travel time", "s", lambda r: r.travel_time_s),
    ]
    note = (
        f"Arms are named by where they lead to ({analysis.arm_names.legend}); “inside” is a yard or a garage. "
        "The destination of a vehicle whose track ends within the picture is inferred from those that passed the place "
        "where it ended."
    )
    relations = analysis.scene.relations if analysis.scene else ()
    return make_table(
        analysis, "origin_destination", "Movements", "From origin to destination", note, columns, relations,
        lambda r: np.array([r.origin.xy_m, r.destination.xy_m]),
    )  # fmt: skip


def car_park_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Through traffic of car parks."""
    columns: list[Column[CarPark]] = [
        Column("parked", "Parked vehicles", "", lambda park: park.parked),
        Column("entered", "Vehicles that drive in", "", lambda park: park.entered),
        Column("through", "Of these, through without a stop", "", lambda park: park.through),
        estimates("share", "Share", "%", lambda park: park.through_share, 100.0),
        estimates("flow", "Flow", "veh/h", lambda park: park.through_veh_per_h),
        estimates("time", "Time inside", "s", lambda park: park.time_s),
    ]
    note = (
        "Areas of six parked vehicles or more, 10 m wide or more, kerbs left out, and who drives 15 m or more in them. "
        "Only looks tell that what never moves is a vehicle: roof gear, sheds and trees may be among the parked ones."
    )
    if analysis.parked is None:
        note = "Parked vehicles are not known of these tracks."
    return make_table(
        analysis, "car_parks", "Movements", "Through traffic of car parks", note, columns, analysis.car_parks,
        lambda park: park.hull_m, is_area=True,
    )  # fmt: skip


def time_tables(analysis: TrafficAnalysis) -> Iterator[AnalysisTable]:
    """Counts by slice of time, where the flight is longer than two slices."""
    if not len(analysis.slice_edges_s):
        return
    note = f"Slices of {analysis.slice_s:g} s, by the time of entry."
    columns: list[Column[SliceCount]] = [
        Column("from", "From", "", lambda c: c.arm_in),
        Column("to", "To", "", lambda c: c.arm_out),
        Column("begin", "Slice from", "s", lambda c: c.begin_s, 1),
        Column("end", "to", "s", lambda c: c.end_s, 1),
        Column("seen", "Vehicles seen", "", lambda c: c.seen),
        Column("inferred", "Vehicles inferred", "", lambda c: c.inferred, 1),
        estimates("flow", "Flow", "veh/h", lambda c: c.flow_veh_per_h),
    ]
    junction: Column[SliceCount] = Column("junction", "Junction", "", lambda c: c.junction)
    lines = {(m.junction, m.arm_in, m.arm_out): m.line_m for found in analysis.movements for m in found.movements}
    yield make_table(
        analysis, "movements_by_time", "Movements", "Turning counts by time", note, [junction, *columns],
        analysis.counts_by_time, lambda c: lines[c.junction or 0, c.arm_in, c.arm_out],
    )  # fmt: skip
    arms = {arm.name: arm.xy_m for arm in analysis.scene.arms} if analysis.scene else {}
    yield make_table(
        analysis, "origin_destination_by_time", "Movements", "From origin to destination by time", note, columns,
        analysis.scene_by_time, lambda c: np.array([arms[c.arm_in], arms[c.arm_out]]),
    )  # fmt: skip
