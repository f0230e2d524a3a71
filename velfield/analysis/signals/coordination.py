"""Growth of queues during red, and offsets between the signals of successive junctions."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from schemas.arrays import FloatArray
from velfield.analysis.intervals import Estimate, estimate_mean
from velfield.analysis.lanes.model import LaneGraph
from velfield.analysis.signals.cycles import JunctionSignal, StreamSignal, queues
from velfield.errors import count_text

_STEP_S = 10.0
_MIN_CYCLES = 3
_REACH_M, _ASIDE_M = 800.0, 25.0
"""A junction follows another if it lies so far ahead of it at most, and so far beside the road's direction."""
_SAME_RAD = np.radians(30)


@dataclass(frozen=True)
class QueueGrowth:
    """The queue of a lane at a time after the onset of red, mean over the cycles: vehicles, and metres."""

    junction: int
    lane: int
    after_red_s: float
    vehicles: Estimate | None
    length_m: Estimate | None


@dataclass(frozen=True)
class Offset:
    """Offset: time from the start of green of ``lane_a`` at one junction to that of ``lane_b`` at the next."""

    junction_a: int
    junction_b: int
    lane_a: int
    lane_b: int
    distance_m: float
    cycle_s: Estimate
    offset_s: Estimate


def queue_growth(signal: JunctionSignal) -> list[QueueGrowth]:
    """Queues every 10 s from the onset of red on, and at that of green, of the streams whose red is known."""
    out = []
    for stream in signal.streams:
        if stream.red_phase_s is None or signal.cycle_s is None:
            continue
        cycle = signal.cycle_s.value
        red_s = (stream.green_phase_s.value - stream.red_phase_s.value) % cycle
        # whole reds alone: what is seen may begin within one
        greens = stream.green_s[1:][np.diff(stream.green_s) < 1.5 * cycle]
        for after in [*np.arange(0.0, red_s - _STEP_S / 2, _STEP_S).tolist(), red_s]:
            found = queues(stream.stream, greens - red_s + after)
            counts, lengths = np.array([(q.vehicles.value, q.length_m) for q in found]).reshape(-1, 2).T
            out.append(
                QueueGrowth(
                    signal.junction,
                    stream.stream.approach.lane,
                    after,
                    estimate_mean(counts, min_n=_MIN_CYCLES),
                    estimate_mean(lengths, min_n=_MIN_CYCLES),
                )
            )
    return out


def find_offsets(
    signals: Mapping[int, JunctionSignal], graph: LaneGraph, observed_s: FloatArray
) -> tuple[list[Offset], str]:
    """Offsets between signals of one cycle, and why there are none.

    Parameters
    ----------
    observed_s
        (k, 2) begins and ends of the clips: greens are compared within one, as signals may be late in others.
    """
    known = [(signal, signal.cycle_s) for signal in signals.values() if signal.signalised and signal.cycle_s]
    if len(known) < 2:
        return [], f"No offsets: {count_text(len(known), 'junction')} with a signal of a fixed cycle."
    follow = False
    out, cycles = [], sorted({round(cycle.value, 1) for _, cycle in known})
    for (a, cycle_a), (b, cycle_b) in permutations(known, 2):
        if cycle_a.low > cycle_b.high or cycle_b.low > cycle_a.high:
            continue
        for first in a.streams:
            for second in b.streams:
                distance = _leads_to(first, second, graph, a.junction, b.junction)
                if distance is None:
                    continue
                follow = True
                cycle = cycle_a if cycle_a.n >= cycle_b.n else cycle_b
                offset = _offset_s(first, second, cycle.value, observed_s)
                if offset is not None:
                    lanes = first.stream.approach.lane, second.stream.approach.lane
                    out.append(Offset(a.junction, b.junction, *lanes, distance, cycle, offset))
    if out:
        return out, ""
    if follow:
        return [], "None: no clip shows the greens of both of two successive junctions."
    if len(cycles) > 1:
        return [], f"None: the signals have cycles of their own, {', '.join(f'{c:g}' for c in cycles)} s."
    return [], "None: no signal follows another on one road."


def _leads_to(first: StreamSignal, second: StreamSignal, graph: LaneGraph, a: int, b: int) -> float | None:
    """Distance of the second junction ahead on the first stream's road; None: it is not there."""
    step = graph.junctions[b].centre_m - graph.junctions[a].centre_m
    headings = []
    for stream in (first, second):
        line = stream.stream.approach.path_m
        at = int(np.clip(stream.stream.approach.border_m, 1, len(line) - 1))
        d = line[at] - line[max(at - 20, 0)]
        headings.append(float(np.arctan2(d[1], d[0])))
    turn = abs(float(np.angle(np.exp(1j * (headings[1] - headings[0])))))
    c, s = np.cos(headings[0]), np.sin(headings[0])
    ahead, aside = float(step[0] * c + step[1] * s), abs(float(step[1] * c - step[0] * s))
    return ahead if turn < _SAME_RAD and 0 < ahead < _REACH_M and aside < _ASIDE_M else None


def _offset_s(first: StreamSignal, second: StreamSignal, cycle_s: float, observed_s: FloatArray) -> Estimate | None:
    """Time from a green of the first stream to one of the second, in the clip with most of both; None: in none."""
    by_clip = [
        [s.green_s[(s.green_s >= begin) & (s.green_s <= end)] for s in (first, second)] for begin, end in observed_s
    ]
    before, after = max(by_clip, key=lambda greens: min(map(len, greens)))
    if not (len(before) and len(after)):
        return None
    apart = after[:, None] - before
    nearest = apart[np.arange(len(after)), np.abs(apart).argmin(axis=1)]
    value = float(np.angle(np.exp(2j * np.pi * nearest / cycle_s).mean()) / (2 * np.pi) * cycle_s) % cycle_s
    x, y = first.green_phase_s, second.green_phase_s
    half = float(np.hypot((x.high - x.low) / 2, (y.high - y.low) / 2))
    return Estimate(value, value - half, value + half, min(x.n, y.n))
