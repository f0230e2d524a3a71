"""Answers for people: a number with its interval, none and at most so many an hour, or what is missing for one."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from schemas.arrays import FloatArray
from schemas.export import PER_M_PER_S, SpeedUnit
from schemas.flight import STATIONARY_SPEED_M_PER_S
from velfield.analysis.approaches import (
    TURNS,
    approach_delays,
    arms_without_delay,
    lane_text,
    lanes_text,
    lanes_without_queue,
    longest_queues,
)
from velfield.analysis.flow.speeds import FreeFlow
from velfield.analysis.intervals import Estimate, estimate_event_rate
from velfield.analysis.lanes.junctions import inside_hull
from velfield.analysis.movements.movements import MIN_DELAY_S, MIN_DELAYED, JunctionMovements
from velfield.analysis.signals.cycles import JunctionSignal, StreamSignal, green_duration_s, least_green_s
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.analysis.trajectories import MOVES_M, Trajectories
from velfield.analysis.unusual import Unusual
from velfield.analysis.vehicle_classes import COUNTED_CLASSES
from velfield.errors import count_text, list_text

State = Literal["found", "none", "too little data"]
_SHORT_S, _FEW_TRACKS, _FEW_EVENTS = 60.0, 30, 3
"""In a shorter clip with fewer vehicles nothing is expected to be found; what it did not show may still be frequent."""
_EMPTY_S = 8.0
"""In the last so long of its green nobody may come by a lane of few vehicles."""
_AT_JUNCTION_M, _ON_LANE_M, _ROAD_M = 20.0, 10.0, 50.0
_FEW_STOP = 0.05
"""Of the vehicles on a lane: where no more than these stop, its mean speed is that of vehicles that drive."""
_NAMED, _SIGNS = 3, 2
"""Unusual tracks that a line names; of more speed limits than two the line names none."""
COVERED = "on ways that three vehicles or more drive"
"""Where conflicts are looked for."""
TWO_LEVELS = "too little data: nobody was seen to turn, and the roads may be on two levels"


@dataclass(frozen=True)
class Answer:
    """The answer to one question."""

    topic: str
    subject: str
    """The question (``signal``), and the place or group that it is asked of (``junction 3``; empty: the flight)."""
    state: State
    """``found``: there is a number, or a list; ``none``: seen to be absent; ``too little data``: ``text`` says what is
    missing."""
    text: str
    """The answer in words, with intervals and counts."""
    estimate: Estimate | None = None
    unit: str = ""
    """The number that the answer gives, with its interval; None where it gives several, or none."""
    at_most_per_h: float | None = None
    """Upper bound, for the state ``none``: the rate that is not exceeded with 90 % probability; None in clips of less
    than a minute."""


def find_answers(analysis: TrafficAnalysis, *, unit: SpeedUnit = "km/h") -> Iterator[Answer]:
    """The answer to every question, in the order in which they are printed; the largest groups of each first.

    Parameters
    ----------
    unit
        Unit of speeds: km/h or mph.
    """
    yield _lanes(analysis)
    if analysis.trajectories.duration_s < _SHORT_S or len(analysis.trajectories) < _FEW_TRACKS:
        yield Answer("duration", "", "too little data", too_short(analysis))
    yield _classes(analysis)
    yield from _movements(analysis)
    yield from _scene(analysis)
    yield from _lanes_without_junction(analysis)
    yield from _speeds(analysis, unit)
    for number, signal in analysis.signals.items():
        if analysis.junction_kind(number) == "crossing":
            yield Answer("signal", f"crossing {number}", "too little data", TWO_LEVELS)
        else:
            yield _signal(analysis, signal)
    for found in analysis.movements:
        yield from _delays(analysis, found)
        yield from _queues(analysis, found)
    places = _places([_near(analysis, r.xy_m) for r in analysis.reversals])
    yield _events("u-turns", analysis, len(analysis.reversals), places)
    yield _conflicts(analysis)
    yield from _unusual(analysis)


def seen_text(tracks: Trajectories) -> str:
    """The vehicles of an analysis, and in which time: ``130 vehicles that drive 6 m or more, in 7 s``."""
    drive = f"that drive{'s' if len(tracks) == 1 else ''} {MOVES_M:g} m or more"
    return f"{count_text(len(tracks), 'vehicle')} {drive}, in {duration_text(tracks.duration_s)}"


def too_short(analysis: TrafficAnalysis) -> str:
    """Explanation that a clip has too few moving vehicles for most questions, with their number and its duration."""
    lacks = "few" if len(analysis.trajectories) < _FEW_TRACKS else "short"
    return (
        f"{seen_text(analysis.trajectories)}: too {lacks} for most questions; a movement takes 3 vehicles, a free-flow "
        "speed 8 that nothing slows down, a flow one minute, a signal two whole cycles"
    )


def explain_none(topic: str, analysis: TrafficAnalysis) -> str:
    """Why a table is empty: how rare the events of ``topic`` are at most, too little data, or none found."""
    seconds, tracks = analysis.trajectories.duration_s, len(analysis.trajectories)
    if topic in ("u_turns", "conflicts"):
        return f"{_events(topic.replace('_', '-'), analysis, 0).text.capitalize()}."
    if seconds < _SHORT_S or tracks < _FEW_TRACKS:
        return f"Too little data: {seen_text(analysis.trajectories)}."
    return "None found."


def _lanes(analysis: TrafficAnalysis) -> Answer:
    graph, seen = analysis.lanes, seen_text(analysis.trajectories)
    if not len(graph):
        return Answer("lanes", "", "too little data", f"too little data: no lane that three of {seen} drove")
    crossings = sum(analysis.junction_kind(k) == "crossing" for k in range(len(graph.junctions)))
    places = count_text(len(graph.junctions) - crossings, "junction")
    places += f", {count_text(crossings, 'crossing')} where nobody was seen to turn" if crossings else ""
    length = f"{sum(lane.length_m for lane in graph) / 1000:.2f} km"
    text = f"{count_text(len(graph), 'lane')} of {length}, {places}, from {seen}"
    return Answer("lanes", "", "found", text)


def _place(analysis: TrafficAnalysis, junction: int) -> str:
    """Name of a junction; of roads that cross, perhaps on two levels, a crossing."""
    return f"{'crossing' if analysis.junction_kind(junction) == 'crossing' else 'junction'} {junction}"


def _classes(analysis: TrafficAnalysis) -> Answer:
    if analysis.classes is None or not len(analysis.classes.measured):
        text = "too little data: classes need lengths and widths in metres, which are not both known of these tracks"
        return Answer("classes", "", "too little data", text)
    shares = analysis.classes.estimate_shares(analysis.classes.measured)
    known = [(name, share) for name, share in zip(COUNTED_CLASSES, shares, strict=True) if share is not None]
    rest = ", ".join(f"{name} {100 * s.value:.1f} % ({100 * s.low:.1f} to {100 * s.high:.1f})" for name, s in known)
    text = f"of {count_text(len(analysis.classes.measured), 'measured vehicle')}: {rest or 'too little data'}"
    return Answer("classes", "", "found" if known else "too little data", text)


def _movements(analysis: TrafficAnalysis) -> Iterator[Answer]:
    kinds = {j.junction.number: analysis.junction_kind(j.junction.number) for j in analysis.movements}
    # Where lanes merge there is no choice.
    found = [m for j in analysis.movements if kinds[j.junction.number] != "merge" for m in j.movements]
    for m in sorted(found, key=lambda m: (not analysis.ways_meet(m.junction), -(m.seen + m.inferred))):
        share = _share_text(m.share, m.arm_in)
        subject = f"{_place(analysis, m.junction)}, {m.arm_in} to {m.arm_out}"
        text = f"{count_text(m.seen + m.inferred, 'vehicle')}{share}"
        yield Answer("movement", subject, "found", text, m.flow_veh_per_h, "veh/h")
    merges = [j for j in analysis.movements if kinds[j.junction.number] == "merge" and j.movements]
    if merges:
        at = [f"{count_text(j.volume, 'vehicle')} at junction {j.junction.number}" for j in merges]
        text = f"lanes only merge, each vehicle has one way to go: {', '.join(at)}; see the table Turning counts"
        yield Answer("merging", "", "found", text)


def _scene(analysis: TrafficAnalysis) -> Iterator[Answer]:
    for r in analysis.scene.relations if analysis.scene else ():
        if not r.seen:
            continue  # the table has what is inferred alone
        share = _share_text(r.share, r.origin.name)
        rest = ", the others in part" if r.seen < round(r.vehicles) else ""
        text = f"{count_text(r.vehicles, 'vehicle')}{share}; {r.seen} of them seen from edge to edge of the view{rest}"
        yield Answer("through", f"{r.origin.name} to {r.destination.name}", "found", text, r.share, "")


def _lanes_without_junction(analysis: TrafficAnalysis) -> Iterator[Answer]:
    """Vehicles on the lanes where no junction was found: they are in no movement."""
    hulls = [junction.hull_m for junction in analysis.lanes.junctions]
    lanes = [lane for lane in analysis.lanes if not any(inside_hull(lane.xy_m, hull).any() for hull in hulls)]
    for lane in sorted(lanes, key=lambda lane: -lane.tracks):
        ahead = lane.xy_m[-1] - lane.xy_m[len(lane.xy_m) // 2]
        side = analysis.arm_names.side(float(np.arctan2(ahead[1], ahead[0])))
        text = f"{count_text(lane.tracks, 'vehicle')} towards {side}; no junction was found on it"
        yield Answer("other lanes", f"lane {lane.number}", "found", text)


def _share_text(share: Estimate | None, origin: str) -> str:
    """What share vehicles are of those that come from an origin; nothing where it is not known.

    Examples
    --------
    >>> _share_text(Estimate(0.888, 0.817, 0.937, 75), "N")
    ', 89 % (82 to 94) of those from N'
    """
    if share is None or not share.value:
        return ""
    return f", {100 * share.value:.0f} % ({100 * share.low:.0f} to {100 * share.high:.0f}) of those from {origin}"


def _speeds(analysis: TrafficAnalysis, unit: SpeedUnit) -> Iterator[Answer]:
    known = [(road, road.speed_m_per_s) for road in analysis.free_flow if road.speed_m_per_s]
    for road, speed in sorted(known, key=lambda pair: -pair[1].n):
        factor, signs = PER_M_PER_S[unit], [f"{sign:.0f}" for sign in speed_limits(analysis, road, unit)]
        text = f"free flow {estimate_text(speed, unit, factor)}"
        text += f", as under a limit of {' or '.join(signs)} {unit}" if 0 < len(signs) <= _SIGNS else ""
        text += "; the limit is not known" if len(signs) > _SIGNS else ""
        yield Answer("speed", lanes_text(road.lanes), "found", text, speed.in_units(factor), unit)
    if not known:
        text = "too little data: no free-flow speed, as no road has 8 vehicles that go freely and steadily"
        yield Answer("speed", "", "too little data", text)
    unknown = sorted(lane for road in analysis.free_flow if not road.speed_m_per_s for lane in road.lanes)
    if known and (long := [lane for lane in unknown if analysis.lanes.lanes[lane].length_m >= _ROAD_M]):
        text = "too little data: fewer than 8 vehicles go freely and steadily"
        yield Answer("speed", lanes_text(long), "too little data", text)
    means = [(flow.lane, mean) for flow in analysis.flows if (mean := flow.space_mean_speed_m_per_s)]
    for lane, mean in sorted(means, key=lambda pair: -pair[1].n):
        samples = analysis.lane_traffic.samples(lane)
        stopped = len(np.unique(samples.track[samples.speed_m_per_s < STATIONARY_SPEED_M_PER_S]))
        text = f"mean {estimate_text(mean, unit, PER_M_PER_S[unit])}"
        text += ", stops and queues included" if stopped > _FEW_STOP * mean.n else ""
        yield Answer("mean speed", f"lane {lane}", "found", text, mean.in_units(PER_M_PER_S[unit]), unit)


def speed_limits(analysis: TrafficAnalysis, road: FreeFlow, unit: SpeedUnit) -> list[float]:
    """`FreeFlow.limits` of a road; none within a roundabout, where the bend limits the speed."""
    rings = [set(junction.lanes_inside) for junction in analysis.lanes.junctions if junction.kind == "roundabout"]
    return [] if any(ring.issuperset(road.lanes) for ring in rings) else road.limits(unit)


def _signal(analysis: TrafficAnalysis, signal: JunctionSignal) -> Answer:
    subject = f"junction {signal.junction}"
    if not signal.signalised or signal.cycle_s is None:
        state: State = "too little data" if signal.signalised is None else "none"
        return Answer("signal", subject, state, signal.reason)
    cycle = signal.cycle_s
    text = f"cycle {cycle.value:.1f} s ({cycle.low:.1f} to {cycle.high:.1f}), {count_text(len(signal.phases), 'phase')}"
    first_s = None
    for lanes in signal.phases:
        streams = [s for s in signal.streams if s.stream.approach.lane in lanes]
        lasts, least = green_duration_s(streams, cycle.value), least_green_s(streams, cycle.value)
        long = f" and yellow for {lasts:.0f} s" if lasts else f" and yellow for {least:.0f} s or more" if least else ""
        long += _shorter_greens(streams, cycle.value)
        begins_s = streams[0].green_phase_s.value
        first_s = begins_s if first_s is None else first_s
        later_s = (begins_s - first_s) % cycle.value
        after = f", beginning {later_s:.0f} s after the first green" if later_s else ""
        text += f"; {_from_arms(analysis, signal.junction, lanes)}green{long}{after}"
    known = {lane for lanes in signal.phases for lane in lanes}
    stop = (s.approach.lane for s in analysis.streams[signal.junction] if s.stop_line_m is not None)
    if unknown := sorted({*stop} - known):
        text += f"; {_from_arms(analysis, signal.junction, unknown)}green not known: too few are seen to start with it"
    return Answer("signal", subject, "found", text, signal.cycle_s, "s")


def _shorter_greens(streams: Sequence[StreamSignal], cycle_s: float) -> str:
    """The lanes of a phase whose green is seen to end before that of the others: ``, on lane 7 for 17 s``."""
    lasts = {
        s.stream.approach.lane: (
            (red.value - s.green_phase_s.value) % cycle_s,
            red.value - red.low,
            red.high - red.value,
        )
        for s in streams
        if (red := s.red_phase_s)
    }
    longest = max((value - below for value, below, _ in lasts.values()), default=0.0) - _EMPTY_S
    short = {lane: value for lane, (value, _, above) in sorted(lasts.items()) if value + above < longest}
    return "".join(f", on {lanes_text([lane])} for {value:.0f} s" for lane, value in short.items())


def _delays(analysis: TrafficAnalysis, found: JunctionMovements) -> Iterator[Answer]:
    """The delay of each approach of a junction where ways meet; of the others what is missing, in one answer."""
    if not analysis.ways_meet(found.junction.number):
        return
    subject, seen_s = f"junction {found.junction.number}", float(np.diff(analysis.trajectories.observed_s).max())
    if seen_s < MIN_DELAY_S:
        text = f"too little data: {seen_s:.0f} s, {MIN_DELAY_S:.0f} s needed"
        yield Answer("delay", subject, "too little data", text)
        return
    delays = approach_delays(analysis, found)
    for delay in delays:
        yield Answer("delay", f"{subject} from {delay.arm}", "found", f"mean {delay.text}", delay.estimate_s, "s")
    unknown = arms_without_delay(found, delays)
    few = [arm for arm in unknown if found.timed(arm) < MIN_DELAYED]
    stop = [arm for arm in unknown if arm not in few]
    if few:
        seen = list_text([str(found.timed(arm)) for arm in few])
        text = f"too little data: {seen} vehicles were seen from 60 m before it to behind it, of {MIN_DELAYED} needed"
        yield Answer("delay", f"{subject} from {list_text(few)}", "too little data", text)
    if stop:
        text = "too little data: hardly one vehicle passes or comes without a stop, to compare with"
        yield Answer("delay", f"{subject} from {list_text(stop)}", "too little data", text)


def _queues(analysis: TrafficAnalysis, found: JunctionMovements) -> Iterator[Answer]:
    """The longest queue of each arm; the lanes whose queue is not known."""
    number, subject = found.junction.number, f"junction {found.junction.number}"
    if analysis.ways_meet(number) and number not in analysis.lane_queues:
        text = "too little data: queues are measured before a signal whose cycle is known"
        yield Answer("queue", subject, "too little data", text)
    for arm, longest in longest_queues(analysis, found).items():
        text = f"longest, {lane_text(found, longest.lane)}: {longest.text}"
        yield Answer("queue", f"{subject} from {arm}", "found", text, longest.vehicles, "vehicles")
    for arm, lanes in lanes_without_queue(analysis, found).items():
        text = (
            f"too little data: vehicles stand on {lanes_text(lanes)}, but hardly one is seen to stand at the stop line"
        )
        yield Answer("queue", f"{subject} from {arm}", "too little data", text)


def _from_arms(analysis: TrafficAnalysis, junction: int, lanes: Sequence[int]) -> str:
    """Where the lanes of a phase come from, and which turns their vehicles take."""
    found = next(found for found in analysis.movements if found.junction.number == junction)
    mine = {lane: arm for lane, arm in found.gates.arms_in.items() if lane in lanes}
    turns = dict.fromkeys(TURNS[m.turn] for lane in mine for m in found.movements_of(lane))
    if not mine:
        return f"{lanes_text(lanes)}: "
    ways = f", {list_text([*turns])}" if turns else ""
    return f"from {list_text(sorted(set(mine.values())))}{ways} ({lanes_text(lanes)}): "


def _conflicts(analysis: TrafficAnalysis) -> Answer:
    likely = [c for c in analysis.conflicts if c.likely]
    kinds = _places([f"{c.kind} {_near(analysis, c.xy_m)}" for c in likely])
    unclear = sum(c.on_unclear_levels for c in analysis.conflicts)
    if unclear and not likely:
        text = f"{count_text(unclear, 'pair')} below 1.5 s where it is not clear that the roads are on one level"
        return Answer("conflicts", "", "too little data", f"too little data: {text}")
    if not likely and np.prod([1.0 - c.probability for c in analysis.conflicts]) < 0.5:
        text = "pairs may have been less than 1.5 s apart, which positions with such errors do not settle"
        return Answer("conflicts", "", "too little data", f"too little data: {text}")
    return _events("conflicts", analysis, len(likely), f"{kinds}, probably less than 1.5 s apart")


def _places(found: Sequence[str]) -> str:
    """How many are where.

    Examples
    --------
    >>> _places(["at junction 2", "away from junctions", "at junction 2"])
    '2 at junction 2, 1 away from junctions'
    """
    return ", ".join(f"{found.count(place)} {place}" for place in sorted(set(found)))


def _near(analysis: TrafficAnalysis, xy_m: FloatArray) -> str:
    """The place of an event: the junction near it, if one is; else the lane."""
    away = [
        (0.0 if inside_hull(xy_m[None], j.hull_m)[0] else float(np.hypot(*(j.hull_m - xy_m).T).min()), j.number)
        for j in analysis.lanes.junctions
    ]
    distance_m, number = min(away, default=(np.inf, 0))
    if distance_m < _AT_JUNCTION_M:
        return f"at {_place(analysis, number)}"
    aside = [(float(np.hypot(*(lane.xy_m - xy_m).T).min()), lane.number) for lane in analysis.lanes]
    distance_m, lane = min(aside, default=(np.inf, 0))
    if distance_m >= _ON_LANE_M:
        return "away from junctions"
    arms = ((found, gate) for found in analysis.movements for gate in found.gates.gates if gate.lane == lane)
    of = [f"{found.gates.arms[gate.arm].name} of junction {found.junction.number}" for found, gate in arms]
    return f"on lane {lane}, on the road {of[0]}" if of else f"on lane {lane}, away from junctions"


def _unusual(analysis: TrafficAnalysis) -> Iterator[Answer]:
    """Vehicles against the traffic, which are a danger; and turns that hardly anyone takes, which need be none."""
    wrong = [u for u in analysis.unusual if u.kind == "wrong way"]
    seen = "; ".join(f"{u.detail} {_when(analysis, u)}" for u in wrong[:_NAMED])
    yield _events("wrong way", analysis, len(wrong), seen)
    turns: dict[str, list[str]] = {}
    for u in analysis.unusual:
        if u.kind == "rare turn":
            turns.setdefault(u.detail, []).append(_when(analysis, u))
    for detail, when in turns.items():
        yield Answer("rare turn", "", "found", f"{detail} vehicles, {list_text(when)}")


def _when(analysis: TrafficAnalysis, found: Unusual) -> str:
    """When an unusual track is to be seen, and its id."""
    track = analysis.trajectories.id_of(found.track)
    return f"at {found.time_s:.1f} s (frame {found.frame}, track {track})"


def _events(topic: str, analysis: TrafficAnalysis, n: int, detail: str = "") -> Answer:
    """A number of events, and how many an hour that is; of none how rare they are at least."""
    seconds = analysis.trajectories.duration_s
    hours = (analysis.reversals_seen_s if topic == "u-turns" else seconds) / 3600
    if n:
        rate = estimate_event_rate(n, hours) if seconds >= _SHORT_S else None
        often = ", too short to say how often"
        if rate and n < _FEW_EVENTS:  # so wide an interval would be quoted by one of its ends
            often = ", too few to say how often"
        elif rate:
            often = f", {rate.value:.0f} an hour ({rate.low:.0f} to {rate.high:.0f})"
        text = f"{n} seen{often}: {detail}" if detail else f"{n} seen{often}"
        return Answer(topic, "", "found", text, rate, "/h" if rate else "")
    if seconds < _SHORT_S:
        text = f"none was seen in {duration_text(seconds)}, too short a time to say how rare they are"
        return Answer(topic, "", "too little data", text)
    hourly = estimate_event_rate(0, hours).high
    where = f" {COVERED}" if topic == "conflicts" else ""
    text = f"none in {duration_text(seconds)}{where}, so fewer than {rate_text(hourly)} an hour with 90 % probability"
    return Answer(topic, "", "none", text, at_most_per_h=hourly)


def duration_text(seconds: float) -> str:
    """A duration in seconds or minutes, for people."""
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.1f} min"


def rate_text(hourly: float) -> str:
    """A rate an hour, for people."""
    return f"{hourly:.2g}" if hourly < 10 else f"{hourly:.0f}"


def estimate_text(estimate: Estimate | None, unit: str, factor: float = 1.0) -> str:
    """An estimate in another unit with its interval and count; or that there is too little data.

    Seconds have one decimal; km/h and mph have none where the value is 10 or more; others have three digits.

    Examples
    --------
    >>> estimate_text(Estimate(0.991, 0.819, 1.16, 57), "s"), estimate_text(Estimate(13.62, 2.5, 15, 9), "km/h", 3.6)
    ('1.0 s (0.8 to 1.2, n 57)', '49 km/h (9 to 54, n 9)')
    """
    if estimate is None:
        return "too little data"
    scaled = estimate.in_units(factor)
    speed = int(abs(scaled.value) < 10)
    decimals = {"s": 1, "km/h": speed, "mph": speed}.get(unit)

    def rounded(x: float) -> str:
        if decimals is not None:
            return f"{x:.{decimals}f}"
        return f"{x:.0f}" if abs(x) >= 1000 else f"{x:.3g}"

    value, low, high = map(rounded, (scaled.value, scaled.low, scaled.high))
    return f"{value} {unit} ({low} to {high}, n {scaled.n})"
