"""Diagrams of a traffic analysis, each drawn into axes: legible in black and white, most important first."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from schemas.arrays import FloatArray, GreyImage
from schemas.export import PER_M_PER_S, SpeedUnit
from velfield.analysis.approaches import ApproachDelay, approach_delays, arms_without_delay, lane_names
from velfield.analysis.flow.conflicts import LIKELY
from velfield.analysis.flow.volume import flow_slices
from velfield.analysis.movements.movements import MIN_PASSES, JunctionMovements
from velfield.analysis.signals.cycles import StreamSignal, queues
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.errors import count_text, list_text
from velfield.report.colours import TONES
from velfield.report.traffic.place import draw_junctions_aside, draw_map, draw_place, place_caption, place_labels
from velfield.report.traffic.turning import draw_turning, turning_height_in

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDTH_IN = 7.2
"""Width of a diagram in the report."""
_STROKES = ("-", "--", "-.", ":")
_MARKS = "os^Dvx"
_RED = "#c62828"
_MAX_JUNCTIONS = 4
_SHOWN_S, _SLICE_S = 300.0, 60.0
_LEAST_PART_S = 15.0
"""A shorter part of a minute shows no flow."""
_BESIDE_M, _AHEAD_RAD = 2.5, np.radians(45)


@dataclass(frozen=True)
class Diagram:
    """A picture of the report: ``draw`` fills axes that are ``height_in`` high on a page `WIDTH_IN` wide; ``bare``: it
    has no labels outside them."""

    name: str
    title: str
    caption: str
    draw: Callable[["Axes"], None]
    height_in: float = 3.2
    bare: bool = False


def traffic_diagrams(
    analysis: TrafficAnalysis, picture: GreyImage | None, *, unit: SpeedUnit = "km/h"
) -> Iterator[Diagram]:
    """The diagrams that the data allow: the place first, then junctions, signals, speeds, flows and conflicts."""
    labels = place_labels(analysis, picture)
    yield Diagram(
        "place",
        "The place",
        place_caption(analysis, labels),
        partial(draw_place, analysis=analysis, picture=picture, labels=labels),
        4.0,
        bare=True,
    )
    junctions = sorted(
        (m for m in analysis.movements if analysis.ways_meet(m.junction.number) and m.movements),
        key=lambda found: -found.volume,
    )[:_MAX_JUNCTIONS]
    for found in junctions:
        yield Diagram(
            f"turning-{found.junction.number}",
            f"Junction {found.junction.number}: where vehicles go",
            "Arrows are as wide as the flow. Vehicles counted, and their share of those that enter by the arm; by rare "
            f"ways, if any: fewer than {MIN_PASSES} were seen to go. "
            f"Arms are named by where they lead to ({analysis.arm_names.legend}).",
            partial(draw_turning, found=found),
            turning_height_in(found, 0.88 * WIDTH_IN),
            bare=True,
        )
        delays = approach_delays(analysis, found)
        if delays:
            unknown = arms_without_delay(found, delays)
            beyond = " Or worse: the queue ends out of view." if any("or worse" in d.level for d in delays) else ""
            yield Diagram(
                f"delay-{found.junction.number}",
                f"Junction {found.junction.number}: delay and level of service by approach",
                "Mean delay against vehicles that pass freely, in view, up to 150 m before the junction, of those that "
                f"were seen for 60 m; black lines: its 90 % interval.{beyond} Level of service by the Highway Capacity "
                "Manual, 7th edition (A: best, F: worst), between the dashed lines."
                + (f" From {list_text(unknown)} too few were seen so far, or went freely." if unknown else ""),
                partial(draw_delays, delays=delays),
                1.1 + 0.32 * len(delays),
            )
        yield from _signal_diagrams(analysis, found)
    yield from _road_diagrams(analysis, junctions, unit)
    likely, turns = sum(c.likely for c in analysis.conflicts), len(analysis.reversals)
    if likely or turns:
        yield Diagram(
            "conflicts",
            "Where vehicles come near to each other, and where they turn round",
            f"{count_text(likely, 'pair')} of vehicles that would have met within 1.5 s, or that passed a place within "
            f"1.5 s of each other, with a probability of {LIKELY} or more; {count_text(turns, 'U-turn')}.",
            partial(draw_conflicts, analysis=analysis, picture=picture),
            4.6,
            bare=True,
        )


def _signal_diagrams(analysis: TrafficAnalysis, found: JunctionMovements) -> Iterator[Diagram]:
    signal = analysis.signals.get(found.junction.number)
    streams = [s for s in signal.streams if s.stream.stop_line_m is not None] if signal else []
    streams.sort(key=lambda s: -len(s.stream.stop_track))
    if not streams:
        return
    number, names = found.junction.number, lane_names(found)
    busiest = streams[0]
    name = names.get(busiest.stream.approach.lane, f"lane {busiest.stream.approach.lane}")
    yield Diagram(
        f"time-space-{number}",
        f"Junction {number}: vehicles on the approach {name}",
        "Each line is a vehicle; where it is level the vehicle has stopped. Thick red bar at the stop line (0 m): the "
        "signal is red, as inferred from the vehicles that stop and go.",
        partial(draw_time_space, analysis=analysis, stream=busiest),
    )
    yield Diagram(
        f"queue-{number}",
        f"Junction {number}: queues by approach against time",
        "Vehicles that stand from the stop line on, to the first gap: none some seconds after green, when those at the "
        "line have gone. Where a queue ends out of view it is a lower bound.",
        partial(draw_queues, analysis=analysis, streams=streams, names=names),
    )


def _road_diagrams(analysis: TrafficAnalysis, junctions: list[JunctionMovements], unit: SpeedUnit) -> Iterator[Diagram]:
    lane = max(analysis.lanes, key=lambda lane: lane.tracks * lane.length_m, default=None)
    if lane is not None and any(station.p50 for station in analysis.profile(lane.number)):
        yield Diagram(
            "speed-profile",
            f"Speed along lane {lane.number}, the busiest",
            "Half of the vehicles are slower than the median, and 15 and 85 % slower than the lines so named, which "
            "are drawn where there are enough vehicles.",
            partial(draw_speed_profile, analysis=analysis, lane=lane.number, unit=unit),
        )
    points = fundamental_points(analysis)
    if len(points) >= 5 and analysis.trajectories.duration_s >= 2 * _SLICE_S:
        yield Diagram(
            "fundamental",
            "Flow against density",
            f"A point is a lane in {_SLICE_S:.0f} s; the slope of the line from the origin to it is its speed, stops "
            "included. Dashed: the speed that 85 % of the points do not exceed.",
            partial(draw_fundamental, points=points, per_m_per_s=PER_M_PER_S[unit], unit=unit),
        )
    for found in junctions[:1]:
        if analysis.trajectories.duration_s >= 2 * _SLICE_S:
            yield Diagram(
                "flow",
                f"Junction {found.junction.number}: vehicles that enter, by minute",
                _flow_caption(analysis),
                partial(draw_flow, analysis=analysis, found=found),
            )


def draw_delays(axes: "Axes", *, delays: list[ApproachDelay]) -> None:
    """Delay by approach with levels of service."""
    limits = delays[0].limits_s
    ends = [(d.delay_s.low,) * 3 if d.partly else (d.delay_s.value, d.delay_s.low, d.delay_s.high) for d in delays]
    top = max(*(1.8 * high for _, _, high in ends), *limits[1:2], 1.0)
    for limit in limits:
        if limit < top:
            axes.axvline(limit, color="#8a929b", linestyle="--", linewidth=0.8, zorder=0)
    for k, (delay, (value, low, high)) in enumerate(zip(delays, ends, strict=True)):
        axes.barh(k, value, color="#5b6770", height=0.6)
        axes.plot([low, high], [k, k], color="#1b1f24", linewidth=1.5)
        label = f"{delay.level}   {delay.value_text}, of {delay.delay_s.n} vehicles"
        axes.text(high + 0.01 * top, k, label, va="center", fontsize=9, fontweight="bold",
                  bbox={"facecolor": "white", "edgecolor": "none", "pad": 1})  # fmt: skip
    for letter, low, high in zip("ABCDEF", (0.0, *limits), (*limits, top), strict=False) if limits else ():
        if low < top:
            axes.text((low + min(high, top)) / 2, 1.01, letter, transform=axes.get_xaxis_transform(), ha="center",
                      va="bottom", fontsize=8, color="#4b545d")  # fmt: skip
    axes.set(yticks=range(len(delays)), yticklabels=[f"from {d.arm}" for d in delays], xlabel="delay, s", xlim=(0, top))
    axes.invert_yaxis()


def _window(analysis: TrafficAnalysis) -> tuple[float, float]:
    begin, end = analysis.window_s
    middle = (begin + end) / 2
    return max(begin, middle - _SHOWN_S / 2), min(end, middle + _SHOWN_S / 2)


def red_times(stream: StreamSignal, cycle_s: float) -> list[tuple[float, float]]:
    """Begin and end of red of each cycle, that after the last green too; none where the onset of red is not known."""
    if stream.red_phase_s is None:
        return []
    length = (stream.green_phase_s.value - stream.red_phase_s.value) % cycle_s
    return [(float(green - length), float(green)) for green in (*stream.green_s, *stream.green_s[-1:] + cycle_s)]


def _cycle_s(analysis: TrafficAnalysis, stream: StreamSignal) -> float:
    cycle = analysis.signals[stream.stream.approach.junction].cycle_s
    return cycle.value if cycle else np.inf


def draw_time_space(axes: "Axes", *, analysis: TrafficAnalysis, stream: StreamSignal) -> None:
    """Distance to the stop line against time of every vehicle on an approach, with red at the line."""
    from matplotlib.collections import LineCollection

    path, line = stream.stream.approach.path_m, stream.stream.stop_line_m or 0.0
    begin, end = _window(analysis)
    samples = analysis.samples
    rows = np.flatnonzero((samples.time_s >= begin) & (samples.time_s <= end))
    found = cKDTree(path).query(samples.xy_m[rows], distance_upper_bound=_BESIDE_M)
    away, place = np.asarray(found[0]), np.asarray(found[1])
    near = np.isfinite(away)
    rows, place = rows[near], place[near]
    step = np.gradient(path, axis=0)
    along_rad = np.arctan2(step[:, 1], step[:, 0])
    turned = np.angle(np.exp(1j * (samples.direction_rad[rows] - along_rad[place])))
    rows, place = rows[np.abs(turned) < _AHEAD_RAD], place[np.abs(turned) < _AHEAD_RAD]
    new = np.flatnonzero((np.diff(samples.track[rows]) != 0) | (np.abs(np.diff(place)) > 15)) + 1
    points = np.column_stack([samples.time_s[rows], place - line])
    axes.add_collection(LineCollection(np.split(points, new), colors="#30363d", linewidths=0.8))
    for red in red_times(stream, _cycle_s(analysis, stream)):
        axes.plot(red, [0, 0], color=_RED, linewidth=5, solid_capstyle="butt")
    low = float(points[:, 1].min(initial=-20.0))
    axes.set(xlim=(begin, end), ylim=(max(low, -120), 40), xlabel="time, s", ylabel="distance past the stop line, m")


def _legend_above(axes: "Axes", columns: int, *, spacing: float = 2.0) -> None:
    axes.legend(
        ncols=columns, frameon=False, fontsize=9, loc="lower left", bbox_to_anchor=(0, 1.0), columnspacing=spacing
    )


def draw_queues(axes: "Axes", *, analysis: TrafficAnalysis, streams: list[StreamSignal], names: dict[int, str]) -> None:
    """Vehicles that stand, by approach, against time."""
    from matplotlib.ticker import MaxNLocator

    begin, end = _window(analysis)
    times = np.arange(begin, end, 1.0)
    of = [names.get(s.stream.approach.lane, f"lane {s.stream.approach.lane}") for s in streams]
    arms = [name.split(",")[0] for name in of]
    order = sorted(range(len(streams)), key=lambda k: arms[:k].count(arms[k]))  # each approach before second lanes
    for k, chosen in enumerate(order[: len(TONES)]):
        stream = streams[chosen]
        counts = [q.vehicles.value for q in queues(stream.stream, times)]
        axes.step(times, counts, where="post", color=TONES[k], linestyle=_STROKES[k % 4], linewidth=1.5,
                  label=of[chosen].removeprefix("from "))  # fmt: skip
    axes.set(xlabel="time, s", ylabel="standing vehicles", ylim=(0, None), xlim=(begin, end))
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    _legend_above(axes, 6, spacing=0.8)


def draw_speed_profile(axes: "Axes", *, analysis: TrafficAnalysis, lane: int, unit: SpeedUnit) -> None:
    """p15, p50 and p85 of speed along a lane, with the band of p50."""
    factor, stations = PER_M_PER_S[unit], [s for s in analysis.profile(lane) if s.p50]
    at = [s.along_m for s in stations]
    low, high = ([getattr(s.p50, end) * factor for s in stations] for end in ("low", "high"))
    axes.fill_between(at, low, high, color="#d5d9de", label="90 % interval of the median")
    for name, label, stroke in (("p85", "85 %", "--"), ("p50", "median", "-"), ("p15", "15 %", ":")):
        known = [(s.along_m, getattr(s, name).value * factor) for s in stations if getattr(s, name)]
        if known:
            axes.plot(*np.array(known).T, color="#1b1f24", linestyle=stroke, label=label)
    axes.set(xlabel="along the lane, m", ylabel=f"speed, {unit}", ylim=(0, None))
    _legend_above(axes, 4)


def fundamental_points(analysis: TrafficAnalysis) -> FloatArray:
    """(n, 4): lane, density (veh/km), flow (veh/h), speed (m/s) of each lane and slice with traffic."""
    rows = []
    for lane in analysis.lanes:
        found = flow_slices(analysis.lane_traffic, lane.number, analysis.trajectories.observed_s, slice_s=_SLICE_S)
        columns = found.density_veh_per_km, found.flow_veh_per_h, found.speed_m_per_s
        rows.append(np.column_stack([np.full(len(found.points), lane.number), *(c[found.points] for c in columns)]))
    return np.concatenate(rows) if rows else np.empty((0, 4))


def draw_fundamental(axes: "Axes", *, points: FloatArray, per_m_per_s: float, unit: SpeedUnit) -> None:
    """Flow against density, the lanes apart by their marks; a lane's speed is the slope from the origin."""
    lanes, of = np.unique(points[:, 0], return_inverse=True)
    shown = lanes[np.argsort(-np.bincount(of, points[:, 2]), kind="stable")][: len(_MARKS)]  # with the most vehicles
    for k, lane in enumerate(shown):
        mine = points[points[:, 0] == lane]
        axes.plot(mine[:, 1], mine[:, 2], _MARKS[k], color=TONES[k], markersize=5, alpha=0.8, label=f"lane {lane:.0f}")
    speed = float(np.quantile(points[:, 3], 0.85))
    right = float(points[:, 1].max())
    top = float(points[:, 2].max()) * 1.15
    edge = min(right, top / max(speed * 3.6, 1e-9))
    axes.plot([0, edge], [0, edge * speed * 3.6], color="#8a929b", linestyle="--")
    middle = (0.55 * edge, 0.55 * edge * speed * 3.6)
    axes.annotate(f"{speed * per_m_per_s:.0f} {unit} ", middle, fontsize=9, ha="right", va="bottom")
    axes.set(xlabel="density, vehicles a km", ylabel="flow, vehicles an hour", xlim=(0, right * 1.05), ylim=(0, top))
    _legend_above(axes, 6, spacing=1.0)


def draw_flow(axes: "Axes", *, analysis: TrafficAnalysis, found: JunctionMovements) -> None:
    """Vehicles that enter a junction in each minute, by arm; in a part of one, as many as a whole one would have."""
    begin, end = analysis.window_s
    edges = np.append(np.arange(begin, end - 1e-9, _SLICE_S), end)
    seen = analysis.trajectories.observed_within(edges)
    passes, gates = found.passes, found.gates
    arm = np.array([gate.arm for gate in gates.gates] + [-1])[passes.gate_in]
    for k, one in enumerate(gates.arms):
        counts = np.histogram(passes.entry_s[(arm == one.number) & np.isfinite(passes.entry_s)], edges)[0]
        if counts.any():
            minutes = np.where(seen >= _LEAST_PART_S, counts * _SLICE_S / np.maximum(seen, 1e-9), np.nan)
            minutes = np.append(minutes, minutes[-1])
            axes.step(edges / 60, minutes, where="post", color=TONES[k % 6], linestyle=_STROKES[k % 4],
                      linewidth=1.6, label=f"from {one.name}")  # fmt: skip
    axes.set(xlabel="time, min", ylabel="vehicles a minute", xlim=(begin / 60, end / 60), ylim=(0, None))
    _legend_above(axes, 6)


def _flow_caption(analysis: TrafficAnalysis) -> str:
    begin, end = analysis.window_s
    part = (end - begin) % _SLICE_S
    out = "By the arm that they enter from, in whole minutes."
    if _SLICE_S - part < 0.5:
        return out
    if part >= _LEAST_PART_S:
        return f"{out} The last {part:.0f} s are a part of one: their vehicles count as so many a minute."
    return f"{out} The last {part:.0f} s are too short a part of one, and left out." if part >= 0.5 else out


def draw_conflicts(axes: "Axes", *, analysis: TrafficAnalysis, picture: GreyImage | None) -> None:
    """Conflicts by kind, and U-turns, on the map."""
    draw_map(axes, analysis, picture)
    draw_junctions_aside(axes, analysis)
    likely = [c for c in analysis.conflicts if c.likely]
    kinds = sorted({c.kind for c in likely})
    places: dict[str, list[FloatArray]] = {kind: [c.xy_m for c in likely if c.kind == kind] for kind in kinds}
    places["U-turn"] = [reversal.xy_m for reversal in analysis.reversals]
    for (kind, at), mark in zip(places.items(), _MARKS, strict=False):
        tone = _RED if kind != "U-turn" else TONES[0]
        if at:
            axes.plot(*np.array(at).T, mark, color=tone, markeredgecolor="white", markersize=8,
                      label=f"{kind}: {len(at)}")  # fmt: skip
    axes.legend(frameon=True, fontsize=9, loc="upper left")
