"""Answers as tables (`schemas.analysis.AnalysisTable`), which the page, the report and the workbook show."""

from collections.abc import Iterable, Iterator

import numpy as np

from schemas.analysis import AnalysisColumn, AnalysisRow, AnalysisTable, Cell, EstimateRecord, GeometryRecord
from schemas.arrays import FloatArray
from velfield.analysis.flow.volume import level_of_service
from velfield.analysis.intervals import Estimate
from velfield.analysis.signals.cycles import queues, stopping_share
from velfield.analysis.signals.phases import START_DELAY_S
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.pipeline.analysis.lanes_record import points_px

KM_PER_H = 3.6
Columns = dict[str, tuple[str, str]]
"""Name -> title and unit."""


def all_tables(analysis: TrafficAnalysis) -> Iterator[AnalysisTable]:
    """Every question's table, in the order of the report."""
    yield from (
        lane_table(analysis),
        profile_table(analysis),
        movement_table(analysis),
        reversal_table(analysis),
        limit_table(analysis),
        reduction_table(analysis),
        signal_table(analysis),
        stream_table(analysis),
        flow_table(analysis),
        conflict_table(analysis),
        unusual_table(analysis),
        doubtful_table(analysis),
    )


def lane_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Lanes."""
    graph = analysis.lanes
    columns: Columns = {
        "lane": ("Lane", ""),
        "tracks": ("Tracks", ""),
        "length": ("Length", "m"),
        "width": ("Width", "m"),
        "width_source": ("Width from", ""),
        "successors": ("Leads to lanes", ""),
    }
    rows = (
        _row(
            {
                "lane": lane.number,
                "tracks": lane.tracks,
                "length": round(lane.length_m, 1),
                "width": round(lane.width_m, 2),
                "width_source": lane.width_source,
                "successors": " ".join(map(str, graph.successors[lane.number])),
            },
            _line(lane.xy_m, analysis),
        )
        for lane in graph
    )
    note = "Lanes that fewer than three tracks drove are not found."
    return _table("lanes", "Lanes", "Lanes", note, columns, rows)


def profile_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Speed profiles."""
    columns: Columns = {
        "lane": ("Lane", ""),
        "along": ("Distance along it", "m"),
        "vehicles": ("Vehicles", ""),
        **{f"p{q}": (f"Speed p{q}", "km/h") for q in (15, 50, 85)},
    }
    rows = (
        _row(
            {
                "lane": station.lane,
                "along": round(station.along_m, 1),
                "vehicles": station.vehicles,
                "p15": _cell(station.p15, KM_PER_H),
                "p50": _cell(station.p50, KM_PER_H),
                "p85": _cell(station.p85, KM_PER_H),
            },
            _point(station.xy_m, analysis),
        )
        for lane in analysis.lanes
        for station in analysis.profile(lane.number)
    )
    note = "Every vehicle once at each station of 10 m."
    return _table("speed_profile", "Speed", "Speed along lanes", note, columns, rows)


def movement_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Turning counts."""
    columns: Columns = {
        "junction": ("Junction", ""),
        "kind": ("Kind", ""),
        "from": ("From", ""),
        "to": ("To", ""),
        "turn": ("Turn", ""),
        "seen": ("Vehicles seen", ""),
        "inferred": ("Vehicles inferred", ""),
        "share": ("Share of the entry", "%"),
        "flow": ("Flow", "veh/h"),
        "travel_time": ("Travel time", "s"),
        "delay": ("Delay", "s"),
        "los": ("Level of service", ""),
    }
    rows = []
    for found in analysis.movements:
        signal = analysis.signals.get(found.junction.number)
        signalised = bool(signal and signal.signalised)
        for m in found.movements:
            los = None if m.delay_s is None else level_of_service(m.delay_s.value, signalised=signalised)
            cells: dict[str, Cell] = {
                "junction": m.junction,
                "kind": found.junction.kind,
                "from": m.arm_in,
                "to": m.arm_out,
                "turn": m.turn,
                "seen": m.seen,
                "inferred": round(m.inferred, 1),
                "share": _cell(m.share, 100.0),
                "flow": _cell(m.flow_veh_per_h),
                "travel_time": _cell(m.travel_time_s),
                "delay": _cell(m.delay_s),
                "los": los,
            }
            rows.append(_row(cells, _line(m.line_m, analysis)))
    note = (
        "Arms are named by the side of the image. Inferred: a track is cut, and its other end follows from what enters "
        "and leaves (Furness). Delay is against the fastest tenth of the movement. Levels of service: Highway Capacity "
        "Manual, 6th edition, Exhibit 19-8 at signals, 20-2 and 22-8 elsewhere."
    )
    return _table("movements", "Movements", "Turning counts", note, columns, rows)


def reversal_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """U-turns."""
    columns: Columns = {"track": ("Track", ""), "time": ("Time", "s"), "side": ("To the", "")}
    rows = (
        _row(
            {
                "track": int(analysis.trajectories.track_id[found.track]),
                "time": round(found.time_s, 1),
                "side": "left" if found.left else "right",
            },
            _point(found.xy_m, analysis),
        )
        for found in analysis.reversals
    )
    return _table(
        "u_turns", "Movements", "U-turns", "Reversals within 36 m, outside circles and car parks.", columns, rows
    )


def limit_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Speed limits."""
    columns: Columns = {
        "lanes": ("Lanes", ""),
        "limit": ("Limit, inferred", "km/h"),
        "free_speed": ("Free-flow speed", "km/h"),
        "p85": ("Free-flow speed p85", "km/h"),
    }
    rows = (
        _row(
            {
                "lanes": " ".join(map(str, road.lanes)),
                "limit": road.limit_km_per_h,
                "free_speed": _cell(road.speed_m_per_s, KM_PER_H),
                "p85": _cell(road.p85_m_per_s, KM_PER_H),
            },
            _line(analysis.lanes.lanes[road.lanes[0]].xy_m, analysis),
        )
        for road in analysis.free_flow
    )
    note = (
        "Median speed of vehicles that keep their speed over 30 m, 4 s and more behind the one before; speeds of those "
        "that follow within 3 s are lower bounds. The limit is the multiple of 10 km/h nearest to it."
    )
    return _table("free_flow", "Speed", "Free flow and speed limit", note, columns, rows)


def reduction_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """What junctions take from speed."""
    columns: Columns = {
        "junction": ("Junction", ""),
        "lane": ("From lane", ""),
        "before": ("Speed 50 m before", "km/h"),
        "lowest": ("Lowest speed", "km/h"),
        "reduction": ("Reduction", "km/h"),
        "after": ("Speed after", "km/h"),
        "recovery": ("Recovers over", "m"),
    }
    rows = (
        _row(
            {
                "junction": r.junction,
                "lane": r.lane,
                "before": _cell(r.before_m_per_s, KM_PER_H),
                "lowest": _cell(r.lowest_m_per_s, KM_PER_H),
                "reduction": _cell(r.reduction_m_per_s, KM_PER_H),
                "after": _cell(r.after_m_per_s, KM_PER_H),
                "recovery": _cell(r.recovery_m),
            },
            _point(analysis.lanes.junctions[r.junction].centre_m, analysis),
        )
        for r in analysis.reductions
    )
    note = "Of vehicles that do not stop."
    return _table("speed_reduction", "Speed", "Speed reduction at junctions", note, columns, rows)


def signal_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Signals by junction."""
    columns: Columns = {
        "junction": ("Junction", ""),
        "kind": ("Kind", ""),
        "signal": ("Signal", ""),
        "cycle": ("Cycle", "s"),
        "phases": ("Lanes with green together", ""),
    }
    names = {True: "yes", False: "no", None: "too little data"}
    rows = []
    for number, signal in analysis.signals.items():
        junction = analysis.lanes.junctions[number]
        reason = (
            f": {signal.reason.removeprefix('too little data: ').removeprefix('no signal: ')}" if signal.reason else ""
        )
        cells: dict[str, Cell] = {
            "junction": number,
            "kind": junction.kind,
            "signal": names[signal.signalised] + reason,
            "cycle": _cell(signal.cycle_s),
            "phases": " | ".join(" ".join(map(str, lanes)) for lanes in signal.phases),
        }
        rows.append(_row(cells, _point(junction.centre_m, analysis)))
    note = (
        "From the starts of vehicles at stop lines. A signal that traffic actuates has no fixed cycle and is not found."
    )
    return _table("signals", "Signals", "Signals", note, columns, rows)


def stream_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Signals by stream."""
    columns: Columns = {
        "junction": ("Junction", ""),
        "lane": ("Lane", ""),
        "green": ("Green begins at", "s of the cycle"),
        "red": ("Red begins at", "s of the cycle"),
        "lost": ("Start-up lost time", "s"),
        "saturation": ("Saturation flow", "veh/h"),
        "queue": ("Queue at green", "veh"),
        "queue_max": ("Longest queue", "veh"),
        "queue_max_m": ("Longest queue", "m"),
        "stops": ("Vehicles that stop", "%"),
    }
    rows = []
    for number, signal in analysis.signals.items():
        for stream in signal.streams:
            found = queues(stream.stream, stream.green_s)
            vehicles = np.array([queue.vehicles for queue in found], np.float64)
            path = stream.stream.approach.path_m
            cells: dict[str, Cell] = {
                "junction": number,
                "lane": stream.stream.approach.lane,
                "green": _cell(stream.green_phase_s),
                "red": _cell(stream.red_phase_s),
                "lost": _cell(stream.start_up_lost_s),
                "saturation": _cell(stream.saturation_veh_per_h),
                "queue": round(float(vehicles.mean()), 1) if len(vehicles) else None,
                "queue_max": int(vehicles.max()) if len(vehicles) else None,
                "queue_max_m": round(max(queue.length_m for queue in found), 1) if found else None,
                "stops": _cell(stopping_share(stream.stream), 100.0),
            }
            at = path[int(np.clip(stream.stream.stop_line_m or 0, 0, len(path) - 1))]
            rows.append(_row(cells, _point(at, analysis)))
    note = (
        "Second 0 of the cycle is the first frame of the flight. A vehicle is taken to start "
        f"{START_DELAY_S:.1f} s after its green."
    )
    return _table("streams", "Signals", "Streams at signals", note, columns, rows)


def flow_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Flow by lane."""
    columns: Columns = {
        "lane": ("Lane", ""),
        "flow": ("Flow", "veh/h"),
        "density": ("Density", "veh/km"),
        "speed": ("Space-mean speed", "km/h"),
        "headway": ("Headway", "s"),
        "gap": ("Gap of those that follow", "s"),
    }
    rows = (
        _row(
            {
                "lane": flow.lane,
                "flow": _cell(flow.flow_veh_per_h),
                "density": _cell(flow.density_veh_per_km),
                "speed": _cell(flow.space_mean_speed_m_per_s, KM_PER_H),
                "headway": _cell(flow.headway_s),
                "gap": _cell(flow.gap_s),
            },
            _line(analysis.lanes.lanes[flow.lane].xy_m, analysis),
        )
        for flow in analysis.flows
    )
    note = "Density and speed by Edie's definitions over the lane; flow and headways at its middle."
    return _table("flow", "Flow", "Flow by lane", note, columns, rows)


def conflict_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Conflicts."""
    columns: Columns = {
        "kind": ("Kind", ""),
        "first": ("First track", ""),
        "second": ("Second track", ""),
        "time": ("Time", "s"),
        "value": ("Time to collision, or post-encroachment time", "s"),
        "sd": ("Standard deviation", "s"),
        "probability": ("Probability that it is below 1.5 s", "%"),
    }
    ids = analysis.trajectories.track_id
    rows = (
        _row(
            {
                "kind": c.kind,
                "first": int(ids[c.first]),
                "second": int(ids[c.second]),
                "time": round(c.time_s, 1),
                "value": round(c.value_s, 2),
                "sd": round(c.sd_s, 2),
                "probability": round(100 * c.probability, 1),
            },
            _point(c.xy_m, analysis),
        )
        for c in sorted(analysis.conflicts, key=lambda c: -c.probability)
        if c.probability >= 0.05
    )
    note = "Following: least time to collision behind a leader. Crossing and merging: post-encroachment time."
    return _table("conflicts", "Conflicts", "Conflicts", note, columns, rows)


def unusual_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Unusual tracks."""
    columns: Columns = {
        "kind": ("Kind", ""),
        "track": ("Track", ""),
        "frame": ("Frame", ""),
        "time": ("Time", "s"),
        "detail": ("What", ""),
    }
    rows = (
        _row(
            {"kind": u.kind, "track": u.track, "frame": u.frame, "time": round(u.time_s, 1), "detail": u.detail},
            _point(u.xy_m, analysis),
        )
        for u in analysis.unusual
    )
    return _table(
        "unusual", "Unusual", "Unusual tracks", "Look at them: an error of tracking is one too.", columns, rows
    )


def doubtful_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Doubtful places."""
    columns: Columns = {"short_tracks": ("Short tracks", ""), "tracks": ("Tracks", "")}
    rows = (
        _row({"short_tracks": place.short_tracks, "tracks": place.tracks}, _point(place.xy_m, analysis))
        for place in analysis.doubtful_places
    )
    note = "Squares of 12 m in which most tracks are shorter than 15 m, as false ones in dense car parks are."
    return _table("doubtful", "Unusual", "Places where false motion is likely", note, columns, rows)


def _table(
    name: str, section: str, title: str, note: str, columns: Columns, rows: Iterable[AnalysisRow]
) -> AnalysisTable:
    made = tuple(AnalysisColumn(name=key, title=text, unit=unit) for key, (text, unit) in columns.items())
    return AnalysisTable(name=name, section=section, title=title, note=note, columns=made, rows=tuple(rows))


def _row(cells: dict[str, Cell], geometry: GeometryRecord) -> AnalysisRow:
    return AnalysisRow(cells=cells, geometry=geometry)


def _cell(estimate: Estimate | None, factor: float = 1.0) -> EstimateRecord:
    if estimate is None:
        return EstimateRecord()
    scaled = estimate.in_units(factor)
    value, low, high = (float(f"{number:.4g}") for number in (scaled.value, scaled.low, scaled.high))
    return EstimateRecord(value=value, low=low, high=high, n=estimate.n)


def _point(xy_m: FloatArray, analysis: TrafficAnalysis) -> GeometryRecord:
    return GeometryRecord(type="Point", xy_px=points_px(np.atleast_2d(xy_m), analysis.trajectories.gsd_m))


def _line(xy_m: FloatArray, analysis: TrafficAnalysis) -> GeometryRecord:
    return GeometryRecord(type="LineString", xy_px=points_px(xy_m, analysis.trajectories.gsd_m))
