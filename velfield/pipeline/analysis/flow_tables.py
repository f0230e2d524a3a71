"""Tables of the fundamental diagram, of queues in red and of offsets between signals."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from schemas.analysis import AnalysisTable
from schemas.arrays import FloatArray
from velfield.analysis.flow.volume import flow_slices
from velfield.analysis.intervals import MIN_VEHICLES
from velfield.analysis.lanes.model import Lane
from velfield.analysis.signals.coordination import Offset, QueueGrowth, find_offsets, queue_growth
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.pipeline.analysis.cells import KM_PER_H, Column, estimates, make_table

_SLICE_S, _MAX_SLICES = 60.0, 60


@dataclass(frozen=True)
class _Slice:
    """A lane in a slice of time."""

    lane: Lane
    begin_s: float
    vehicles: int
    density_veh_per_km: float
    flow_veh_per_h: float
    speed_m_per_s: float


def diagram_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Density, flow and speed of each lane by slice of time: the points of its fundamental diagram."""
    columns: list[Column[_Slice]] = [
        Column("lane", "Lane", "", lambda s: s.lane.number),
        Column("begin", "Slice from", "s", lambda s: s.begin_s, 1),
        Column("vehicles", "Vehicles", "", lambda s: s.vehicles),
        Column("density", "Density", "veh/km", lambda s: s.density_veh_per_km, 2),
        Column("flow", "Flow", "veh/h", lambda s: s.flow_veh_per_h, 1),
        Column("speed", "Space-mean speed", "km/h", lambda s: s.speed_m_per_s * KM_PER_H, 2),
    ]
    slice_s = max(_SLICE_S, analysis.trajectories.duration_s / _MAX_SLICES)
    note = (
        f"Edie's definitions over each lane and slices of about {slice_s:.0f} s with {MIN_VEHICLES} vehicles or more; "
        "a row is a point of the lane's diagram."
    )
    return make_table(
        analysis, "fundamental_diagram", "Flow", "Fundamental diagram of lanes", note, columns,
        _slices(analysis, slice_s), lambda s: s.lane.xy_m,
    )  # fmt: skip


def _slices(analysis: TrafficAnalysis, slice_s: float) -> Iterator[_Slice]:
    for lane in analysis.lanes:
        found = flow_slices(analysis.lane_traffic, lane.number, analysis.trajectories.observed_s, slice_s=slice_s)
        values = (
            found.slices.begin_s,
            found.vehicles,
            found.density_veh_per_km,
            found.flow_veh_per_h,
            found.speed_m_per_s,
        )
        for k in found.points:
            yield _Slice(lane, *(column[k].item() for column in values))


def growth_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Queues against the time in red."""
    columns: list[Column[QueueGrowth]] = [
        Column("junction", "Junction", "", lambda g: g.junction),
        Column("lane", "Lane", "", lambda g: g.lane),
        Column("after_red", "After the onset of red", "s", lambda g: g.after_red_s, 1),
        estimates("vehicles", "Queue", "veh", lambda g: g.vehicles),
        estimates("length", "Queue", "m", lambda g: g.length_m),
    ]
    rows = (g for signal in analysis.signals.values() for g in queue_growth(signal))
    note = "Mean over the cycles of the flight; n is their number. Of streams whose onset of red is known."
    return make_table(
        analysis, "queue_growth", "Signals", "Queues in red", note, columns, rows,
        lambda g: analysis.lanes.junctions[g.junction].centre_m,
    )  # fmt: skip


def offset_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Offsets between the signals of junctions that follow each other."""
    columns: list[Column[Offset]] = [
        Column("from", "From junction", "", lambda o: o.junction_a),
        Column("to", "To junction", "", lambda o: o.junction_b),
        Column("from_lane", "From lane", "", lambda o: o.lane_a),
        Column("to_lane", "To lane", "", lambda o: o.lane_b),
        Column("distance", "Distance", "m", lambda o: o.distance_m, 1),
        estimates("cycle", "Cycle", "s", lambda o: o.cycle_s),
        estimates("offset", "Offset of green", "s", lambda o: o.offset_s),
    ]
    offsets, reason = find_offsets(analysis.signals, analysis.lanes, analysis.trajectories.observed_s)
    note = reason or "Of junctions whose cycles agree within their intervals, from the green of the one to the next's."

    def place(o: Offset) -> FloatArray:
        return np.array([analysis.lanes.junctions[k].centre_m for k in (o.junction_a, o.junction_b)])

    return make_table(analysis, "offsets", "Signals", "Offsets between junctions", note, columns, offsets, place)
