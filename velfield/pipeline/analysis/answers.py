"""The answers in a few lines, as the command line prints them; and what an empty table means."""

import math
from collections.abc import Iterator

from schemas.analysis import AnalysisTable
from velfield.analysis.intervals import Estimate
from velfield.analysis.signals.cycles import JunctionSignal, queues
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.analysis.vehicle_classes import COUNTED_CLASSES

MAX_LINES = 12
"""Lines on movements, on origins and destinations, and on lanes, that are printed: those with the most vehicles."""
_SHORT_S, _FEW_TRACKS = 60.0, 30
"""In a shorter clip with fewer vehicles nothing is expected to be found; what it did not show may still be frequent."""
_NONE_PROBABILITY = 0.1
_EVENTS = ("u_turns", "conflicts", "unusual")


def answers(analysis: TrafficAnalysis) -> Iterator[str]:
    """Lines for people: what was asked, and the answer with its 90 % interval and n in brackets."""
    tracks, seconds = len(analysis.trajectories), analysis.trajectories.duration_s
    length = sum(lane.length_m for lane in analysis.lanes) / 1000
    yield _line(
        "lanes",
        f"{_count(len(analysis.lanes), 'lane')} of {length:.2f} km, "
        f"{_count(len(analysis.lanes.junctions), 'junction')}, from "
        f"{_count(tracks, 'moving vehicle')} in {duration_text(seconds)}",
    )
    if seconds < _SHORT_S or tracks < _FEW_TRACKS:
        yield _line("", too_short(analysis))
    yield from _class_lines(analysis)
    yield from _movement_lines(analysis)
    yield from _scene_lines(analysis)
    yield from _speed_lines(analysis)
    for number, signal in analysis.signals.items():
        yield from _signal_lines(number, signal)
    yield _line("u-turns", _events(len(analysis.reversals), seconds))
    likely = [c for c in analysis.conflicts if c.probability >= 0.5]
    kinds = ", ".join(f"{sum(c.kind == k for c in likely)} {k}" for k in sorted({c.kind for c in likely}))
    found = f"{len(likely)}: {kinds}" if likely else _events(0, seconds)
    yield _line("conflicts", f"below 1.5 s, more likely than not: {found}")
    yield _line("unusual", _events(len(analysis.unusual), seconds))
    for event in analysis.unusual[:3]:
        track = int(analysis.trajectories.track_id[event.track])
        yield _line("", f"{event.kind} at {event.time_s:.1f} s (frame {event.frame}, track {track}): {event.detail}")


def too_short(analysis: TrafficAnalysis) -> str:
    """What a short clip with few vehicles allows to say."""
    tracks, seconds = len(analysis.trajectories), analysis.trajectories.duration_s
    verb = "is" if tracks == 1 else "are"
    return (
        f"{_count(tracks, 'moving vehicle')} in {duration_text(seconds)} {verb} too few for most "
        "questions: a movement needs 5, free flow 8 that go freely, a signal three cycles"
    )


def explain_empty(table: AnalysisTable, analysis: TrafficAnalysis) -> AnalysisTable:
    """An empty table with the reason in its note; others as they are."""
    if table.rows:
        return table
    seconds, tracks = analysis.trajectories.duration_s, len(analysis.trajectories)
    if table.name in _EVENTS:
        reason = f"{_events(0, seconds).capitalize()}."
    elif seconds < _SHORT_S or tracks < _FEW_TRACKS:
        reason = f"Too little data: {_count(tracks, 'moving vehicle')} in {duration_text(seconds)}."
    else:
        reason = "None found."
    return table.model_copy(update={"note": f"{reason} {table.note}".strip()})


def _class_lines(analysis: TrafficAnalysis) -> Iterator[str]:
    if analysis.classes is None or not len(analysis.classes.measured):
        return
    shares = analysis.classes.estimate_shares(analysis.classes.measured)
    known = [(name, share) for name, share in zip(COUNTED_CLASSES, shares, strict=True) if share is not None]
    rest = ", ".join(f"{name} {100 * s.value:.1f} % ({100 * s.low:.1f} to {100 * s.high:.1f})" for name, s in known)
    yield _line(
        "classes", f"of {_count(len(analysis.classes.measured), 'measured vehicle')}: {rest or 'too little data'}"
    )


def _movement_lines(analysis: TrafficAnalysis) -> Iterator[str]:
    found = [(j.junction.kind, m) for j in analysis.movements for m in j.movements]
    found.sort(key=lambda pair: -(pair[1].seen + pair[1].inferred))
    for kind, m in found[:MAX_LINES]:
        share = f", {_text(m.share, '%', 100)} of the entry" if m.share else ""
        delay = f", delay {_text(m.delay_s, 's')}" if m.delay_s else ""
        yield _line(
            "movement", f"{kind} {m.junction}, {m.arm_in} to {m.arm_out}: {m.seen + m.inferred:.0f}{share}{delay}"
        )
    if len(found) > MAX_LINES:
        yield _line("", f"and {len(found) - MAX_LINES} movements more")


def _scene_lines(analysis: TrafficAnalysis) -> Iterator[str]:
    relations = analysis.scene.relations if analysis.scene else ()
    for r in relations[:MAX_LINES]:
        share = f", {_text(r.share, '%', 100)} of the entry" if r.share else ""
        yield _line("scene", f"{r.origin.name} to {r.destination.name}: {r.vehicles:.0f}, seen whole {r.seen}{share}")
    if len(relations) > MAX_LINES:
        yield _line("", f"and {len(relations) - MAX_LINES} pairs more")


def _speed_lines(analysis: TrafficAnalysis) -> Iterator[str]:
    known = [road for road in analysis.free_flow if road.speed_m_per_s]
    known.sort(key=lambda road: -(road.speed_m_per_s.n if road.speed_m_per_s else 0))
    for road in known[:MAX_LINES]:
        lanes = " ".join(map(str, road.lanes))
        yield _line(
            "speed",
            f"lanes {lanes}: free flow {_text(road.speed_m_per_s, 'km/h', 3.6)}, limit about {road.limit_km_per_h:.0f}",
        )


def _signal_lines(number: int, signal: JunctionSignal) -> Iterator[str]:
    if not signal.signalised or signal.cycle_s is None:
        yield _line("signal", f"junction {number}: {signal.reason}")
        return
    yield _line(
        "signal", f"junction {number}: cycle {_text(signal.cycle_s, 's')}, {_count(len(signal.phases), 'phase')}"
    )
    for lanes in signal.phases:
        streams = [s for s in signal.streams if s.stream.approach.lane in lanes]
        longest = max((q for s in streams for q in queues(s.stream, s.green_s)), key=lambda q: q.length_m, default=None)
        queue = f", longest queue {_count(longest.vehicles, 'vehicle')}, {longest.length_m:.0f} m" if longest else ""
        green = _text(streams[0].green_phase_s, "s of the cycle")
        yield _line("", f"lanes {' '.join(map(str, lanes))}: green at {green}{queue}")


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def _events(n: int, seconds: float) -> str:
    """A number of events, and of none how rare they are at least."""
    if n or seconds <= 0:
        return str(n)
    if seconds < _SHORT_S:
        return f"none in {duration_text(seconds)}, too short to say how rare they are"
    hourly = -math.log(_NONE_PROBABILITY) / seconds * 3600
    rate = f"{hourly:.2g}" if hourly < 10 else f"{hourly:.0f}"
    return f"none in {duration_text(seconds)}, so fewer than {rate} an hour with 90 % probability"


def duration_text(seconds: float) -> str:
    """A duration in seconds or minutes, for people."""
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.1f} min"


def _text(estimate: Estimate | None, unit: str, factor: float = 1.0) -> str:
    if estimate is None:
        return "too little data"
    scaled = estimate.in_units(factor)
    value, low, high = (f"{x:.0f}" if abs(x) >= 1000 else f"{x:.3g}" for x in (scaled.value, scaled.low, scaled.high))
    return f"{value} {unit} ({low} to {high}, n {scaled.n})"


def _line(topic: str, text: str) -> str:
    return f"{topic:11} {text}"
