"""Answers as tables (`schemas.analysis.AnalysisTable`), which the page, the report and the workbook show."""

from collections.abc import Iterator

import numpy as np

from schemas.analysis import AnalysisTable, Cell
from velfield.analysis.flow.volume import level_of_service
from velfield.analysis.signals.cycles import queues, stopping_share
from velfield.analysis.signals.phases import START_DELAY_S
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
from velfield.pipeline.analysis.class_tables import class_table, heavy_cell
from velfield.pipeline.analysis.flow_tables import diagram_table, growth_table, offset_table
from velfield.pipeline.analysis.scene_tables import scene_tables, time_tables


def all_tables(analysis: TrafficAnalysis) -> Iterator[AnalysisTable]:
    """Every question's table, in the order of the report."""
    yield from (
        lane_table(analysis),
        profile_table(analysis),
        movement_table(analysis),
        *scene_tables(analysis),
        *time_tables(analysis),
        class_table(analysis),
        reversal_table(analysis),
        limit_table(analysis),
        reduction_table(analysis),
        signal_table(analysis),
        stream_table(analysis),
        growth_table(analysis),
        offset_table(analysis),
        flow_table(analysis),
        diagram_table(analysis),
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
        make_row(
            {
                "lane": lane.number,
                "tracks": lane.tracks,
                "length": round(lane.length_m, 1),
                "width": round(lane.width_m, 2),
                "width_source": lane.width_source,
                "successors": " ".join(map(str, graph.successors[lane.number])),
            },
            line_geometry(lane.xy_m, analysis),
        )
        for lane in graph
    )
    note = "Lanes that fewer than three tracks drove are not found."
    return make_table("lanes", "Lanes", "Lanes", note, columns, rows)


def profile_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Speed profiles."""
    columns: Columns = {
        "lane": ("Lane", ""),
        "along": ("Distance along it", "m"),
        "vehicles": ("Vehicles", ""),
        **{f"p{q}": (f"Speed p{q}", "km/h") for q in (15, 50, 85)},
    }
    profiles = {lane.number: analysis.profile(lane.number) for lane in analysis.lanes}
    known = [lane for lane, stations in profiles.items() if any(station.p50 is not None for station in stations)]
    rows = (
        make_row(
            {
                "lane": station.lane,
                "along": round(station.along_m, 1),
                "vehicles": station.vehicles,
                "p15": estimate_cell(station.p15, KM_PER_H),
                "p50": estimate_cell(station.p50, KM_PER_H),
                "p85": estimate_cell(station.p85, KM_PER_H),
            },
            point_geometry(station.xy_m, analysis),
        )
        for lane in known
        for station in profiles[lane]
    )
    note = "Every vehicle once at each station of 10 m."
    if len(known) < len(profiles):
        others = ", ".join(str(lane) for lane in profiles if lane not in known)
        note += f" Of too few vehicles for any, and left out: lanes {others}."
    return make_table("speed_profile", "Speed", "Speed along lanes", note, columns, rows)


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
        "heavy": ("Lorries and buses", "%"),
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
                "share": estimate_cell(m.share, 100.0),
                "flow": estimate_cell(m.flow_veh_per_h),
                "heavy": heavy_cell(analysis, found.tracks(m)),
                "travel_time": estimate_cell(m.travel_time_s),
                "delay": estimate_cell(m.delay_s),
                "los": los,
            }
            rows.append(make_row(cells, line_geometry(m.line_m, analysis)))
    note = (
        "Arms are named by the side of the image. Inferred: a track is cut, and its other end follows from what enters "
        "and leaves (Furness). Delay is against the fastest tenth of the movement. Levels of service: Highway Capacity "
        "Manual, 7th edition, Exhibit 19-8 at signals, 20-2 and 22-8 elsewhere."
    )
    return make_table("movements", "Movements", "Turning counts", note, columns, rows)


def reversal_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """U-turns."""
    columns: Columns = {"track": ("Track", ""), "time": ("Time", "s"), "side": ("To the", "")}
    rows = (
        make_row(
            {
                "track": int(analysis.trajectories.track_id[found.track]),
                "time": round(found.time_s, 1),
                "side": "left" if found.left else "right",
            },
            point_geometry(found.xy_m, analysis),
        )
        for found in analysis.reversals
    )
    return make_table(
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
        make_row(
            {
                "lanes": " ".join(map(str, road.lanes)),
                "limit": road.limit_km_per_h,
                "free_speed": estimate_cell(road.speed_m_per_s, KM_PER_H),
                "p85": estimate_cell(road.p85_m_per_s, KM_PER_H),
            },
            line_geometry(analysis.lanes.lanes[road.lanes[0]].xy_m, analysis),
        )
        for road in analysis.free_flow
    )
    note = (
        "Median speed of vehicles that keep their speed over 30 m, 4 s and more behind the one before; speeds of those "
        "that follow within 3 s are lower bounds. The limit is the multiple of 10 km/h nearest to it."
    )
    return make_table("free_flow", "Speed", "Free flow and speed limit", note, columns, rows)


def reduction_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Table of the speed reduction at junctions."""
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
        make_row(
            {
                "junction": r.junction,
                "lane": r.lane,
                "before": estimate_cell(r.before_m_per_s, KM_PER_H),
                "lowest": estimate_cell(r.lowest_m_per_s, KM_PER_H),
                "reduction": estimate_cell(r.reduction_m_per_s, KM_PER_H),
                "after": estimate_cell(r.after_m_per_s, KM_PER_H),
                "recovery": estimate_cell(r.recovery_m),
            },
            point_geometry(analysis.lanes.junctions[r.junction].centre_m, analysis),
        )
        for r in analysis.reductions
    )
    note = "Of vehicles that neither stop nor give way."
    return make_table("speed_reduction", "Speed", "Speed reduction at junctions", note, columns, rows)


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
            "cycle": estimate_cell(signal.cycle_s),
            "phases": " | ".join(" ".join(map(str, lanes)) for lanes in signal.phases),
        }
        rows.append(make_row(cells, point_geometry(junction.centre_m, analysis)))
    note = (
        "From the starts of vehicles at stop lines. A signal that traffic actuates has no fixed cycle and is not found."
    )
    return make_table("signals", "Signals", "Signals", note, columns, rows)


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
                "green": estimate_cell(stream.green_phase_s),
                "red": estimate_cell(stream.red_phase_s),
                "lost": estimate_cell(stream.start_up_lost_s),
                "saturation": estimate_cell(stream.saturation_veh_per_h),
                "queue": round(float(vehicles.mean()), 1) if len(vehicles) else None,
                "queue_max": int(vehicles.max()) if len(vehicles) else None,
                "queue_max_m": round(max(queue.length_m for queue in found), 1) if found else None,
                "stops": estimate_cell(stopping_share(stream.stream), 100.0),
            }
            at = path[int(np.clip(stream.stream.stop_line_m or 0, 0, len(path) - 1))]
            rows.append(make_row(cells, point_geometry(at, analysis)))
    note = (
        "Second 0 of the cycle is the first frame of the flight. A vehicle is taken to start "
        f"{START_DELAY_S:.1f} s after its green."
    )
    return make_table("streams", "Signals", "Streams at signals", note, columns, rows)


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
        make_row(
            {
                "lane": flow.lane,
                "flow": estimate_cell(flow.flow_veh_per_h),
                "density": estimate_cell(flow.density_veh_per_km),
                "speed": estimate_cell(flow.space_mean_speed_m_per_s, KM_PER_H),
                "headway": estimate_cell(flow.headway_s),
                "gap": estimate_cell(flow.gap_s),
            },
            line_geometry(analysis.lanes.lanes[flow.lane].xy_m, analysis),
        )
        for flow in analysis.flows
    )
    note = "Density and speed by Edie's definitions over the lane; flow and headways at its middle."
    return make_table("flow", "Flow", "Flow by lane", note, columns, rows)


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
        make_row(
            {
                "kind": c.kind,
                "first": int(ids[c.first]),
                "second": int(ids[c.second]),
                "time": round(c.time_s, 1),
                "value": round(c.value_s, 2),
                "sd": round(c.sd_s, 2),
                "probability": round(100 * c.probability, 1),
            },
            point_geometry(c.xy_m, analysis),
        )
        for c in sorted(analysis.conflicts, key=lambda c: -c.probability)
        if c.probability >= 0.05
    )
    note = "Following: least time to collision behind a leader. Crossing and merging: post-encroachment time."
    return make_table("conflicts", "Conflicts", "Conflicts", note, columns, rows)


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
        make_row(
            {
                "kind": u.kind,
                "track": int(analysis.trajectories.track_id[u.track]),
                "frame": u.frame,
                "time": round(u.time_s, 1),
                "detail": u.detail,
            },
            point_geometry(u.xy_m, analysis),
        )
        for u in analysis.unusual
    )
    return make_table(
        "unusual", "Unusual", "Unusual tracks", "Look at them: an error of tracking is one too.", columns, rows
    )


def doubtful_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Doubtful places."""
    columns: Columns = {"short_tracks": ("Short tracks", ""), "tracks": ("Tracks", "")}
    rows = (
        make_row({"short_tracks": place.short_tracks, "tracks": place.tracks}, point_geometry(place.xy_m, analysis))
        for place in analysis.doubtful_places
    )
    note = "Squares of 12 m in which most tracks are shorter than 15 m, as false ones in dense car parks are."
    return make_table("doubtful", "Unusual", "Places where false motion is likely", note, columns, rows)
