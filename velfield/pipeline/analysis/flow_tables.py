"""Tables of the fundamental diagram, of queues in red and of offsets between signals."""

import numpy as np

from schemas.analysis import AnalysisTable, Cell
from velfield.analysis.flow.volume import flow_slices
from velfield.analysis.signals.coordination import find_offsets, queue_growth
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.pipeline.analysis.cells import (
    KM_PER_H,
    Columns,
    estimate_cell,
    line_geometry,
    make_row,
    make_table,
    point_geometry,
)

_SLICE_S, _MAX_SLICES = 60.0, 60
_MIN_VEHICLES = 3
"""A slice with fewer vehicles is no point of the diagram."""


def diagram_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Density, flow and speed of each lane by slice of time: the points of its fundamental diagram."""
    columns: Columns = {
        "lane": ("Lane", ""),
        "begin": ("Slice from", "s"),
        "vehicles": ("Vehicles", ""),
        "density": ("Density", "veh/km"),
        "flow": ("Flow", "veh/h"),
        "speed": ("Space-mean speed", "km/h"),
    }
    begin, end = analysis.window_s
    slice_s = max(_SLICE_S, (end - begin) / _MAX_SLICES)
    rows = []
    for lane in analysis.lanes:
        found = flow_slices(analysis.lane_traffic, lane.number, begin, end, slice_s=slice_s)
        samples = analysis.lane_traffic.samples(lane.number)
        width = (end - begin) / len(found.start_s) if end > begin else 1.0
        number = np.clip(((samples.time_s - begin) / width).astype(np.int64), 0, len(found.start_s) - 1)
        tracks = int(samples.track.max(initial=0)) + 1
        vehicles = np.bincount(np.unique(number * tracks + samples.track) // tracks, minlength=len(found.start_s))
        # on a lane of a metre or two vehicles have one sample each, and no speed
        for k in np.flatnonzero((vehicles >= _MIN_VEHICLES) & np.isfinite(found.speed_m_per_s)).tolist():
            cells: dict[str, Cell] = {
                "lane": lane.number,
                "begin": round(float(found.start_s[k]), 1),
                "vehicles": int(vehicles[k]),
                "density": round(float(found.density_veh_per_km[k]), 2),
                "flow": round(float(found.flow_veh_per_h[k]), 1),
                "speed": round(float(found.speed_m_per_s[k]) * KM_PER_H, 2),
            }
            rows.append(make_row(cells, line_geometry(lane.xy_m, analysis)))
    note = (
        f"Edie's definitions over each lane and slices of {slice_s:.0f} s with {_MIN_VEHICLES} vehicles or more; a row "
        "is a point of the lane's diagram."
    )
    return make_table("fundamental_diagram", "Flow", "Fundamental diagram of lanes", note, columns, rows)


def growth_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Queues against the time in red."""
    columns: Columns = {
        "junction": ("Junction", ""),
        "lane": ("Lane", ""),
        "after_red": ("After the onset of red", "s"),
        "vehicles": ("Queue", "veh"),
        "length": ("Queue", "m"),
    }
    rows = []
    for signal in analysis.signals.values():
        for g in queue_growth(signal):
            cells: dict[str, Cell] = {
                "junction": g.junction,
                "lane": g.lane,
                "after_red": round(g.after_red_s, 1),
                "vehicles": estimate_cell(g.vehicles),
                "length": estimate_cell(g.length_m),
            }
            rows.append(make_row(cells, point_geometry(analysis.lanes.junctions[g.junction].centre_m, analysis)))
    note = "Mean over the cycles of the flight; n is their number. Of streams whose onset of red is known."
    return make_table("queue_growth", "Signals", "Queues in red", note, columns, rows)


def offset_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Offsets between the signals of junctions that follow each other."""
    columns: Columns = {
        "from": ("From junction", ""),
        "to": ("To junction", ""),
        "from_lane": ("From lane", ""),
        "to_lane": ("To lane", ""),
        "distance": ("Distance", "m"),
        "cycle": ("Cycle", "s"),
        "offset": ("Offset of green", "s"),
    }
    offsets, reason = find_offsets(analysis.signals, analysis.lanes)
    rows = (
        make_row(
            {
                "from": o.junction_a,
                "to": o.junction_b,
                "from_lane": o.lane_a,
                "to_lane": o.lane_b,
                "distance": round(o.distance_m, 1),
                "cycle": estimate_cell(o.cycle_s),
                "offset": estimate_cell(o.offset_s),
            },
            line_geometry(
                np.array([analysis.lanes.junctions[k].centre_m for k in (o.junction_a, o.junction_b)]), analysis
            ),
        )
        for o in offsets
    )
    note = reason or "Of junctions whose cycles agree within their intervals, from the green of the one to the next's."
    return make_table("offsets", "Signals", "Offsets between junctions", note, columns, rows)
