"""Answers as tables (`schemas.analysis.AnalysisTable`), which the page, the report and the workbook show."""

from collections.abc import Iterable, Iterator

import numpy as np

from schemas.analysis import AnalysisTable
from schemas.arrays import FloatArray
from schemas.export import SpeedUnit
from velfield.analysis.answers import TWO_LEVELS, speed_limits
from velfield.analysis.approaches import ApproachDelay, ArmQueue, approach_delays, longest_queues
from velfield.analysis.flow.conflicts import HARD_BRAKING_M_PER_S2, Conflict
from velfield.analysis.flow.speeds import SIGNS, FreeFlow, Reduction, Station
from velfield.analysis.flow.volume import LaneFlow, delay_level
from velfield.analysis.intervals import MIN_VEHICLES
from velfield.analysis.lanes.model import Lane
from velfield.analysis.movements.movements import JunctionMovements, Movement
from velfield.analysis.movements.reversals import Reversal
from velfield.analysis.signals.cycles import JunctionSignal, Queue, StreamSignal, stopping_share
from velfield.analysis.signals.phases import START_DELAY_S
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.analysis.unusual import DoubtfulPlace, Unusual
from velfield.pipeline.analysis.cells import KM_PER_H, Column, estimates, in_speed_unit, make_table
from velfield.pipeline.analysis.class_tables import class_table
from velfield.pipeline.analysis.flow_tables import diagram_table, growth_table, offset_table
from velfield.pipeline.analysis.scene_tables import scene_tables, time_tables


def all_tables(analysis: TrafficAnalysis, *, unit: SpeedUnit = "km/h") -> Iterator[AnalysisTable]:
    """Every question's table, in the order of the report, with speeds in a unit: km/h or mph."""
    yield from (in_speed_unit(table, unit) for table in _tables(analysis, unit))


def _tables(analysis: TrafficAnalysis, unit: SpeedUnit) -> Iterator[AnalysisTable]:
    yield from (
        lane_table(analysis),
        profile_table(analysis),
        movement_table(analysis),
        approach_table(analysis),
        *scene_tables(analysis),
        *time_tables(analysis),
        class_table(analysis),
        reversal_table(analysis),
        limit_table(analysis, unit),
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
    columns: list[Column[Lane]] = [
        Column("lane", "Lane", "", lambda lane: lane.number),
        Column("tracks", "Tracks", "", lambda lane: lane.tracks),
        Column("length", "Length", "m", lambda lane: lane.length_m, 1),
        Column("width", "Width", "m", lambda lane: lane.width_m, 2),
        Column("width_source", "Width from", "", lambda lane: lane.width_source),
        Column("successors", "Leads to lanes", "", lambda lane: _numbers(graph.successors[lane.number])),
    ]
    note = "Lanes that fewer than three tracks drove are not found."
    return make_table(analysis, "lanes", "Lanes", "Lanes", note, columns, graph, lambda lane: lane.xy_m)


def profile_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Speed profiles."""
    columns: list[Column[Station]] = [
        Column("lane", "Lane", "", lambda s: s.lane),
        Column("along", "Distance along it", "m", lambda s: s.along_m, 1),
        Column("vehicles", "Vehicles", "", lambda s: s.vehicles),
        estimates("p15", "Speed p15", "km/h", lambda s: s.p15, KM_PER_H),
        estimates("p50", "Speed p50", "km/h", lambda s: s.p50, KM_PER_H),
        estimates("p85", "Speed p85", "km/h", lambda s: s.p85, KM_PER_H),
    ]
    profiles = {lane.number: analysis.profile(lane.number) for lane in analysis.lanes}
    known = [lane for lane, stations in profiles.items() if any(station.p50 is not None for station in stations)]
    note = "Every vehicle once at each station of 10 m."
    if len(known) < len(profiles):
        others = ", ".join(str(lane) for lane in profiles if lane not in known)
        note += f" Of too few vehicles for any, and left out: lanes {others}."
    stations = (station for lane in known for station in profiles[lane])
    title = "Speed along lanes"
    return make_table(analysis, "speed_profile", "Speed", title, note, columns, stations, lambda s: s.xy_m)


def movement_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Turning counts."""

    def service(m: Movement) -> str | None:
        if m.delay_s is None:
            return None
        signalised, part = analysis.is_signalised(m.junction), analysis.delay_is_partial(m.junction, m.arm_in)
        return delay_level(m.delay_s, signalised=signalised, partly=part) or None

    def partly(m: Movement) -> bool:
        return analysis.delay_is_partial(m.junction, m.arm_in)

    columns: list[Column[tuple[JunctionMovements, Movement]]] = [
        Column("junction", "Junction", "", lambda row: row[1].junction),
        Column("kind", "Kind", "", lambda row: analysis.junction_kind(row[1].junction)),
        Column("from", "From", "", lambda row: row[1].arm_in),
        Column("to", "To", "", lambda row: row[1].arm_out),
        Column("turn", "Turn", "", lambda row: row[1].turn),
        Column("seen", "Vehicles seen", "", lambda row: row[1].seen),
        Column("inferred", "Vehicles inferred", "", lambda row: row[1].inferred, 1),
        estimates("share", "Share of the entry", "%", lambda row: row[1].share, 100.0),
        estimates("flow", "Flow", "veh/h", lambda row: row[1].flow_veh_per_h),
        estimates("heavy", "Lorries and buses", "%", lambda row: analysis.heavy_share(row[0].tracks(row[1])), 100.0),
        estimates("travel_time", "Travel time", "s", lambda row: row[1].travel_time_s),
        estimates("delay", "Delay", "s", lambda row: None if partly(row[1]) else row[1].delay_s),
        Column(
            "delay_least",
            "Delay at least",
            "s",
            lambda row: row[1].delay_s.low if row[1].delay_s and partly(row[1]) else None,
            1,
        ),
        Column("los", "Level of service", "", lambda row: service(row[1])),
    ]
    rows = ((found, m) for found in analysis.movements for m in found.movements)
    note = (
        f"Arms are named by where they lead to ({analysis.arm_names.legend}). "
        "Inferred: a track is cut, and its other end follows from what enters "
        "and leaves (Furness). Delay is against the fastest tenth of those that do not stop, over the "
        "junction and up to 150 m before it; where queues end out of view it is at least that. Level of service: "
        "Highway Capacity Manual, 7th edition, Exhibit 19-8 at signals, 20-2 and 22-8 elsewhere; none where it is not "
        "known which."
    )
    title = "Turning counts"
    return make_table(analysis, "movements", "Movements", title, note, columns, rows, lambda row: row[1].line_m)


def approach_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Delay and longest queue by approach."""

    def least(queue: ArmQueue | None) -> float | None:
        return queue.queue.vehicles.low if queue and not queue.vehicles else None

    columns: list[Column[tuple[JunctionMovements, str, ApproachDelay | None, ArmQueue | None]]] = [
        Column("junction", "Junction", "", lambda row: row[0].junction.number),
        Column("from", "From", "", lambda row: row[1]),
        Column("vehicles", "Vehicles", "", lambda row: row[0].entered(row[1]), 1),
        estimates("delay", "Delay", "s", lambda row: row[2].estimate_s if row[2] else None),
        Column(
            "delay_least",
            "Delay at least",
            "s",
            lambda row: row[2].delay_s.low if row[2] and row[2].partly else None,
            1,
        ),
        Column("los", "Level of service", "", lambda row: (row[2].level or None) if row[2] else None),
        estimates("queue", "Longest queue", "vehicles", lambda row: row[3].vehicles if row[3] else None),
        Column("queue_least", "Longest queue at least", "vehicles", lambda row: least(row[3])),
        Column("queue_length", "Its length", "m", lambda row: row[3].queue.length_m if row[3] else None, 1),
    ]

    def rows() -> Iterator[tuple[JunctionMovements, str, ApproachDelay | None, ArmQueue | None]]:
        for found in analysis.movements:
            delays = {delay.arm: delay for delay in approach_delays(analysis, found)}
            longest = longest_queues(analysis, found)
            met = analysis.ways_meet(found.junction.number)
            for arm in dict.fromkeys(m.arm_in for m in found.movements) if met else ():
                yield found, arm, delays.get(arm), longest.get(arm)

    note = (
        "Of junctions where ways meet. Delay as in the turning counts, of all vehicles of the approach; where fewer "
        "than three do not stop, against the pace at which they come. Queues: of the lane with the longest, "
        "whenever it stood, where a signal's cycle is known. At least: a queue ends out of view, or is not known."
    )
    return make_table(
        analysis, "approaches", "Movements", "Delay and queues by approach", note, columns, rows(),
        lambda row: next(arm.xy_m for arm in row[0].gates.arms if arm.name == row[1]), named_by=2,
    )  # fmt: skip


def reversal_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """U-turns."""
    columns: list[Column[Reversal]] = [
        Column("track", "Track", "", lambda found: analysis.trajectories.id_of(found.track)),
        Column("time", "Time", "s", lambda found: found.time_s, 1),
        Column("side", "To the", "", lambda found: "left" if found.left else "right"),
    ]
    note = "Reversals within 36 m, outside car parks, and vehicles that leave a roundabout by the arm they came by."
    rows = analysis.reversals
    return make_table(analysis, "u_turns", "Movements", "U-turns", note, columns, rows, lambda found: found.xy_m)


def limit_table(analysis: TrafficAnalysis, unit: SpeedUnit = "km/h") -> AnalysisTable:
    """Speed limits, of signs in a unit."""

    def only(limits: list[float]) -> float | None:
        return limits[0] if len(limits) == 1 else None

    columns: list[Column[FreeFlow]] = [
        Column("lanes", "Lanes", "", lambda road: _numbers(road.lanes)),
        Column("limit", "Limit, inferred", unit, lambda road: only(speed_limits(analysis, road, unit))),
        estimates("free_speed", "Free-flow speed", "km/h", lambda road: road.speed_m_per_s, KM_PER_H),
        estimates("p85", "Free-flow speed p85", "km/h", lambda road: road.p85_m_per_s, KM_PER_H),
    ]
    note = (
        "Median speed of vehicles, 8 or more, that keep their speed over 30 m, 4 s and more behind the one before; "
        f"speeds of those that follow within 3 s are lower bounds. The limit is the multiple of {SIGNS[unit]:g} {unit} "
        "nearest to it."
    )
    return make_table(
        analysis, "free_flow", "Speed", "Free flow and speed limit", note, columns, analysis.free_flow,
        lambda road: analysis.lanes.lanes[road.lanes[0]].xy_m,
    )  # fmt: skip


def reduction_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Table of the speed reduction at junctions."""
    columns: list[Column[Reduction]] = [
        Column("junction", "Junction", "", lambda r: r.junction),
        Column("lane", "From lane", "", lambda r: r.lane),
        estimates("before", "Speed 50 m before", "km/h", lambda r: r.before_m_per_s, KM_PER_H),
        estimates("lowest", "Lowest speed", "km/h", lambda r: r.lowest_m_per_s, KM_PER_H),
        estimates("reduction", "Reduction", "km/h", lambda r: r.reduction_m_per_s, KM_PER_H),
        estimates("after", "Speed after", "km/h", lambda r: r.after_m_per_s, KM_PER_H),
        estimates("recovery", "Recovers over", "m", lambda r: r.recovery_m),
    ]
    note = f"Of vehicles that neither stop nor give way; {MIN_VEHICLES} are needed."
    return make_table(
        analysis, "speed_reduction", "Speed", "Speed reduction at junctions", note, columns, analysis.reductions,
        lambda r: analysis.lanes.junctions[r.junction].centre_m, named_by=2,
    )  # fmt: skip


def signal_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Signals by junction."""
    names = {True: "yes", False: "no", None: "too little data"}

    def said(signal: JunctionSignal) -> str:
        if analysis.junction_kind(signal.junction) == "crossing":
            return TWO_LEVELS
        reason = signal.reason.removeprefix("too little data: ").removeprefix("no signal: ")
        return names[signal.signalised] + (f": {reason}" if reason else "")

    columns: list[Column[JunctionSignal]] = [
        Column("junction", "Junction", "", lambda signal: signal.junction),
        Column("kind", "Kind", "", lambda signal: analysis.junction_kind(signal.junction)),
        Column("signal", "Signal", "", said),
        estimates("cycle", "Cycle", "s", lambda signal: signal.cycle_s),
        Column("phases", "Lanes with green together", "", lambda signal: " | ".join(map(_numbers, signal.phases))),
    ]
    note = (
        "From the starts of vehicles at stop lines. A signal that traffic actuates has no fixed cycle and is not found."
    )
    return make_table(
        analysis, "signals", "Signals", "Signals", note, columns, analysis.signals.values(),
        lambda signal: analysis.lanes.junctions[signal.junction].centre_m,
    )  # fmt: skip


def stream_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Signals by stream."""
    rows = [
        (signal.junction, stream, stream.queues) for signal in analysis.signals.values() for stream in signal.streams
    ]
    columns: list[Column[tuple[int, StreamSignal, list[Queue]]]] = [
        Column("junction", "Junction", "", lambda row: row[0]),
        Column("lane", "Lane", "", lambda row: row[1].stream.approach.lane),
        estimates("green", "Green begins at", "s of the cycle", lambda row: row[1].green_phase_s),
        estimates("red", "Red begins at", "s of the cycle", lambda row: row[1].red_phase_s),
        estimates("lost", "Start-up lost time", "s", lambda row: row[1].start_up_lost_s),
        estimates("saturation", "Saturation flow", "veh/h", lambda row: row[1].saturation_veh_per_h),
        Column("queue", "Queue at green", "veh", lambda row: _mean([q.vehicles.value for q in row[2]]), 1),
        estimates(
            "queue_max", "Longest queue at green", "veh", lambda row: _longest(row[2]).vehicles if row[2] else None
        ),
        Column(
            "queue_max_m", "Longest queue at green", "m", lambda row: _longest(row[2]).length_m if row[2] else None, 1
        ),
        Column("queue_open", "Queues that end out of view", "", lambda row: sum(q.reaches_edge for q in row[2])),
        estimates("stops", "Vehicles that stop", "%", lambda row: stopping_share(row[1].stream), 100.0),
    ]
    note = (
        "Second 0 of the cycle is the first frame of the flight. A vehicle is taken to start "
        f"{START_DELAY_S:.1f} s after its green. A queue that ends out of view is longer than it says."
    )

    def place(row: tuple[int, StreamSignal, list[Queue]]) -> FloatArray:
        path = row[1].stream.approach.path_m
        return np.asarray(path[int(np.clip(row[1].stream.stop_line_m or 0, 0, len(path) - 1))])

    return make_table(analysis, "streams", "Signals", "Streams at signals", note, columns, rows, place)


def flow_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Flow by lane."""
    columns: list[Column[LaneFlow]] = [
        Column("lane", "Lane", "", lambda flow: flow.lane),
        estimates("flow", "Flow", "veh/h", lambda flow: flow.flow_veh_per_h),
        estimates("density", "Density", "veh/km", lambda flow: flow.density_veh_per_km),
        estimates("speed", "Space-mean speed", "km/h", lambda flow: flow.space_mean_speed_m_per_s, KM_PER_H),
        estimates("headway", "Headway", "s", lambda flow: flow.headway_s),
        estimates("gap", "Gap of those that follow", "s", lambda flow: flow.gap_s),
    ]
    note = (
        "Density and speed by Edie's definitions over the lane; flow and headways at its middle. "
        f"Each takes {MIN_VEHICLES} vehicles, a flow and a density a minute, too."
    )
    return make_table(
        analysis, "flow", "Flow", "Flow by lane", note, columns, analysis.flows,
        lambda flow: analysis.lanes.lanes[flow.lane].xy_m,
    )  # fmt: skip


def conflict_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Conflicts."""
    columns: list[Column[Conflict]] = [
        Column("kind", "Kind", "", lambda c: c.kind),
        Column("first", "First track", "", lambda c: analysis.trajectories.id_of(c.first)),
        Column("second", "Second track", "", lambda c: analysis.trajectories.id_of(c.second)),
        Column("time", "Time", "s", lambda c: c.time_s, 1),
        Column("value", "Time to collision, or post-encroachment time", "s", lambda c: c.value_s, 2),
        Column("sd", "Standard deviation", "s", lambda c: c.sd_s, 2),
        Column("probability", "Probability that it is a conflict (below 1.5 s)", "%", lambda c: 100 * c.probability, 1),
    ]
    rows = [c for c in sorted(analysis.conflicts, key=lambda c: -c.probability) if c.probability >= 0.05]
    note = (
        "Following: least time to collision behind a leader; a conflict needs braking harder than "
        f"{HARD_BRAKING_M_PER_S2} m/s2, too. Crossing and merging: post-encroachment time."
    )
    return make_table(analysis, "conflicts", "Conflicts", "Conflicts", note, columns, rows, lambda c: c.xy_m)


def unusual_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Unusual tracks."""
    columns: list[Column[Unusual]] = [
        Column("kind", "Kind", "", lambda u: u.kind),
        Column("track", "Track", "", lambda u: analysis.trajectories.id_of(u.track)),
        Column("frame", "Frame", "", lambda u: u.frame),
        Column("time", "Time", "s", lambda u: u.time_s, 1),
        Column("detail", "What", "", lambda u: u.detail),
    ]
    note, rows = "Look at the clips: an error of tracking looks unusual too.", analysis.unusual
    return make_table(analysis, "unusual", "Unusual", "Unusual tracks", note, columns, rows, lambda u: u.xy_m)


def doubtful_table(analysis: TrafficAnalysis) -> AnalysisTable:
    """Doubtful places."""
    columns: list[Column[DoubtfulPlace]] = [
        Column("short_tracks", "Short tracks", "", lambda at: at.short_tracks),
        Column("tracks", "Tracks", "", lambda at: at.tracks),
    ]
    title, rows = "Places where false motion is likely", analysis.doubtful_places
    note = "Squares of 12 m in which most tracks are shorter than 15 m, as false ones in dense car parks are."
    return make_table(analysis, "doubtful", "Unusual", title, note, columns, rows, lambda at: at.xy_m)


def _numbers(numbers: Iterable[int]) -> str:
    return " ".join(map(str, numbers))


def _longest(found: list[Queue]) -> Queue:
    return max(found, key=lambda queue: queue.length_m)


def _mean(numbers: list[float]) -> float | None:
    return float(np.mean(numbers)) if numbers else None
