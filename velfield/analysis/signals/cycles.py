"""Cycles: whether the starts of queues recur, and when each stream has green."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import special

from schemas.arrays import FloatArray, IntArray
from velfield.analysis.intervals import LEVEL, Estimate, estimate_mean, estimate_share
from velfield.analysis.signals.phases import START_DELAY_S, Phase, fit_phases, start_together
from velfield.analysis.signals.queues import REACH_M, Stream
from velfield.analysis.signals.shared_greens import lanes_by_phase
from velfield.analysis.trajectories import VEHICLE_LENGTH_M

MIN_CYCLE_S, MAX_CYCLE_S = 24.0, 200.0
MIN_STARTS = 2
"""A stream with fewer starts of queues says nothing of a cycle."""
_JUNCTION_STARTS = 4
"""Fewest starts of queues of a junction, of at least two streams or of one that alone has so many."""
_NO_CYCLE_STARTS, _NO_CYCLE_S = 16, 300.0
"""With so many starts in so long a fixed cycle would show. At a roundabout, where vehicles give way and signals are
rare, a cycle needs as many: fewer may recur by chance."""
_FEW_STOP, _FEW_STOP_N, _FEW_STOP_S = 0.08, 60, 150.0
"""At a junction without a signal fewer stop than this share, with 95 % probability; all of a shorter clip may have come
at green."""
_DRAWN_STARTS, _DRAWS = 40, 2000
"""Maximum number of starts for which the probability of recurring by chance is simulated, and number of simulations."""
_QUEUE_GAP_S = 8.0
_CLEARS_S, _CLEARS_SHARE = 5.0, 0.9
"""Where so large a share of the starts follows so soon on vehicles that waited within the junction, none is known to be
prompt."""
_MAX_P_VALUE = 0.005
"""Probability by chance above which starts do not recur."""
_MIN_CONCENTRATION = 0.85
"""Mean resultant length of the starts' phases under a signal; one that traffic actuates has less."""
_SPACING_M = 6.4
"""From front to front in a queue."""
_MAX_HIDDEN = 2.4
"""Room for more vehicles than this ends a queue."""
_EDGE_M = 25.0
"""The last of a queue stands so near to where its approach comes into view: who stops in its first 15 m or so is hardly
tracked, and others may stand out of view."""
_BEYOND_M, _SAME_M = 3.2, 2.0
"""The first of a queue stands so far beyond its stop line at most; fronts that lie nearer to each other are one's."""
_START_UP_VEHICLES = 4
"""The first vehicles of a queue lose time at the start (HCM)."""
_MIN_CROSSINGS = 20
"""An onset of red rests on so many crossings of the line at least."""
_SETS_OFF_S, _PAUSE_S = 6.0, 4.0
"""Longest time from green to the first crossing, and between two, of a queue that drives off."""
_RATE_S, _MIN_RATE_CROSSINGS = 8.0, 3
"""The rate of crossings, of all cycles together, is that of so long before their end; of fewer crossings it is unknown,
and taken for theirs."""
_THINNING_S = 1.2
"""Crossings thin out over the last so long: drivers' speeds differ, and so does how late they can still not stop."""
_RED_SD_S = 0.45
"""By which the end of crossings differs from the onset of red from junction to junction: standard deviation."""


@dataclass(frozen=True)
class StreamSignal:
    """The signal of one stream."""

    stream: Stream
    green_phase_s: Estimate
    red_phase_s: Estimate | None
    """Onsets of green and of red after the start of a cycle, s."""
    green_s: FloatArray
    """Onsets of green in the flight, one a cycle."""
    start_up_lost_s: Estimate | None
    saturation_veh_per_h: Estimate | None
    """Time that a queue's first four vehicles lose, and flow of those behind them."""

    @cached_property
    def queues(self) -> list["Queue"]:
        """The queue at each onset of green."""
        return queues(self.stream, self.green_s)


@dataclass(frozen=True)
class JunctionSignal:
    """Whether a junction has a signal, and its cycle."""

    junction: int
    signalised: bool | None
    """None: too little data."""
    reason: str
    """Why there is none, or why it is not known."""
    cycle_s: Estimate | None
    streams: tuple[StreamSignal, ...]
    phases: tuple[tuple[int, ...], ...]
    """Lanes whose green begins together, in the order of the cycle."""


def find_signal(
    junction: int, streams: Sequence[Stream], observed_s: FloatArray, *, roundabout: bool = False
) -> JunctionSignal:
    """The signal of a junction from its streams, seen in times (k, 2) from begins to ends.

    The cycle is that of the time with most starts of queues: over a gap, as between clips, its error would grow to a
    cycle. In the other times the signal is late by what their own starts show.
    """
    foremost, streams = streams, _at_stop_lines(streams, observed_s)
    by_time = _starts_by_time(streams, observed_s)
    counts = [sum(len(times) for _, times in found) for found in by_time]
    main = int(np.argmax(counts)) if counts else 0
    used = [stream for stream, _ in by_time[main]] if counts else []
    events = [times for _, times in by_time[main]] if counts else []
    n, duration = max(counts, default=0), float(np.diff(observed_s[main])[0]) if counts else 0.0
    stopped, share = _stopping(streams)
    needed = _NO_CYCLE_STARTS if roundabout else _JUNCTION_STARTS
    if n < needed:
        few = share is not None and share.n >= _FEW_STOP_N and share.high < _FEW_STOP
        if share is not None and few and sum(counts) < needed and np.diff(observed_s).sum() >= _FEW_STOP_S:
            most = f"at most {100 * share.high:.1f} % stop"
            reason = f"no signal: {stopped} of {share.n} vehicles stopped, {most} with 95 % probability"
            return JunctionSignal(junction, False, reason, None, (), ())
        reason = (
            f"too little data: {n} starts of queues that recur in a lane in {duration:.0f} s, {needed} "
            f"needed; {stopped} of {share.n if share else 0} vehicles stopped"
        )
        return JunctionSignal(junction, None, reason, None, (), ())
    # Two streams whose greens alternate recur at half the cycle, too: cycles of which two are not seen compete with it.
    found = _find_cycle(events, min(MAX_CYCLE_S, duration)) if duration > 2 * MIN_CYCLE_S else None
    if found is None:
        reason = f"too little data: {duration:.0f} s, two cycles of {MIN_CYCLE_S:.0f} s or more needed"
        return JunctionSignal(junction, None, reason, None, (), ())
    cycle, p_value = found
    if cycle > duration / 2:
        reason = (
            f"too little data: starts of queues may recur every {cycle:.0f} s, of which {duration:.0f} s hold no two"
        )
        return JunctionSignal(junction, None, reason, None, (), ())
    events, concentration = _recurring(events, cycle)
    if p_value > _MAX_P_VALUE or concentration < _MIN_CONCENTRATION:
        if n >= _NO_CYCLE_STARTS and duration >= _NO_CYCLE_S:
            reason = (
                f"no signal was found: vehicles start at any time, {n} queues in no fixed cycle (an actuated signal "
                "has none either)"
            )
            return JunctionSignal(junction, False, reason, None, (), ())
        reason = (
            f"too little data: {n} starts of queues in {duration:.0f} s do not tell a cycle from chance "
            f"({stopped} of {share.n if share else 0} vehicles stopped)"
        )
        return JunctionSignal(junction, None, reason, None, (), ())
    estimate, by_start = fit_phases(events, cycle, time_sd_s=max(stream.stop_time_sd_s for stream in used))
    waits = [one for one, line in zip(foremost, streams, strict=True) if one is not line]
    by_start = tuple(_not_before_clear(phase, used, events, waits) for phase in by_start)
    phases = lanes_by_phase(used, events, by_start, estimate.value)
    greens = {used[k].approach.lane: phase.green_s for phase in phases for k in phase.streams}
    late = _late_s([_after_green(found, greens) for found in by_time], main, estimate.value)
    seen_late = [(seen, by) for seen, by in zip(observed_s, late, strict=True) if by is not None]
    signals = [_stream_signal(used[k], phase.green_s, estimate, seen_late) for phase in phases for k in phase.streams]
    lanes = tuple(tuple(sorted(used[k].approach.lane for k in phase.streams)) for phase in phases)
    return JunctionSignal(junction, True, "", estimate, _with_hidden_share(signals), lanes)


def _not_before_clear(
    phase: Phase, streams: Sequence[Stream], starts_s: Sequence[FloatArray], waits: Sequence[Stream]
) -> Phase:
    """A phase whose green may have begun earlier, if vehicles of other lanes leave the junction before all its starts:
    it begins behind the last of the others that crosses a stop line.

    Parameters
    ----------
    waits
        Lanes whose vehicles wait within the junction, by the place where they do.
    """
    lanes = {streams[k].approach.lane for k in phase.streams}
    starts = np.sort(np.concatenate([starts_s[k] for k in phase.streams]))
    leave, cross = (
        np.sort(np.concatenate([np.empty(0), *(s.cross_time_s for s in of if s.approach.lane not in lanes)]))
        for of in (waits, streams)
    )
    clears = _since(starts, leave) < _CLEARS_S
    if np.mean(clears) < _CLEARS_SHARE:
        return phase
    green = phase.green_s
    low = green.value + START_DELAY_S - float(np.median(_since(starts, cross)[clears]))
    return replace(phase, green_s=replace(green, low=min(green.low, low)))


def _since(times_s: FloatArray, before_s: FloatArray) -> FloatArray:
    """How long before each time (n,) the last of others (m,), both sorted, was; infinite where none was."""
    return np.asarray(times_s - np.r_[-np.inf, before_s][np.searchsorted(before_s, times_s)])


def _starts_by_time(streams: Sequence[Stream], observed_s: FloatArray) -> list[list[tuple[Stream, FloatArray]]]:
    """The streams whose queues start often enough in each of the times (k, 2), and the times of these starts."""
    return [
        [(stream, times) for stream in streams if len(times := _within(_queue_heads(stream), *seen)) >= MIN_STARTS]
        for seen in observed_s
    ]


def _at_stop_lines(streams: Sequence[Stream], observed_s: FloatArray) -> list[Stream]:
    """Each stream by the line at which its queues stand at red.

    The first of a queue may stop at two places. Where the starts at both are in one part of the cycle, the foremost is
    the line: a vehicle that was not seen stood ahead of the others. Where they are not, vehicles that have passed the
    line wait for a gap at the foremost. Without a cycle it is the foremost.
    """
    every = [(stream, stream.upstream or stream) for stream in streams]
    if all(stream is upstream for stream, upstream in every):
        return list(streams)
    best, cycle_s = 0.0, 0.0
    for lines in zip(*every, strict=True):
        found = max(_starts_by_time(lines, observed_s), key=lambda one: sum(len(times) for _, times in one))
        events, duration = [times for _, times in found], float(np.diff(observed_s).max())
        fit = _fit_period(events, min(MAX_CYCLE_S, duration)) if events and duration > 2 * MIN_CYCLE_S else None
        if fit is None:
            continue
        events, concentration = _recurring(events, fit[0])
        recur = concentration * sum(map(len, events))  # so many starts do
        if concentration >= _MIN_CONCENTRATION and recur > best:
            cycle_s, best = fit[0], recur
    if not best:
        return list(streams)
    return [upstream if _waits_beyond(stream, upstream, cycle_s) else stream for stream, upstream in every]


def _recurring(events: Sequence[FloatArray], cycle_s: float) -> tuple[list[FloatArray], float]:
    """The first start of each stream in each cycle, and their concentration."""
    first = [_first_after_red(times, cycle_s) for times in events]
    return first, float(_concentration(np.array([1 / cycle_s]), first)[0])


def _first_after_red(times_s: FloatArray, cycle_s: float) -> FloatArray:
    """The first start of a stream in each cycle: others wait for a gap. Red ends the longest part without starts."""
    phase = np.sort(times_s % cycle_s)
    red_ends = phase[np.argmax(np.diff(phase, prepend=phase[-1] - cycle_s))] if len(phase) else 0.0
    _, first = np.unique(np.floor((times_s - red_ends) / cycle_s + 1e-9), return_index=True)
    return times_s[first]


def _waits_beyond(stream: Stream, upstream: Stream, cycle_s: float) -> bool:
    """Whether vehicles wait for a gap at the foremost line, and for green at the one before."""
    at_gap, at_green = (_first_after_red(_queue_heads(one), cycle_s) for one in (stream, upstream))
    if len(at_green) < MIN_STARTS or abs(np.exp(2j * np.pi * at_green / cycle_s).mean()) < _MIN_CONCENTRATION:
        return False
    return len(at_gap) < MIN_STARTS or not start_together(at_gap, at_green, cycle_s)


def _with_hidden_share(signals: Sequence[StreamSignal]) -> tuple[StreamSignal, ...]:
    """The streams with the share of the vehicles of the junction's queues that are not seen: its lower bound."""
    used = [s for s in signals if s.stream.stop_line_m is not None]
    found = [_stand_at(s.stream, float(t), 0.0, through_gaps=True) for s in used for t in s.green_s]
    hidden = sum(f.hidden for f in found)
    share = estimate_share(hidden, hidden + sum(f.seen for f in found))
    sure = share.low if share else 0.0
    return tuple(replace(s, stream=replace(s.stream, hidden_share=sure)) for s in signals)


def _within(times_s: FloatArray, begin_s: float, end_s: float) -> FloatArray:
    return times_s[(times_s >= begin_s) & (times_s <= end_s)]


def _after_green(found: Sequence[tuple[Stream, FloatArray]], greens: Mapping[int, Estimate]) -> FloatArray:
    """Times (n,) of starts of queues after the first green of their stream."""
    after = [times - greens[s.approach.lane].value for s, times in found if s.approach.lane in greens]
    return np.concatenate(after) if after else np.empty(0)


def _late_s(after_s: Sequence[FloatArray], main: int, cycle_s: float) -> list[float | None]:
    """By how much the signal is later in each of the times than by its cycle in the main one, 0 there; None: the starts
    of queues in it do not show it. Mean starts are compared with mean starts: some wait for the junction to clear."""
    means = [np.exp(2j * np.pi * after / cycle_s).mean() if len(after) else 0j for after in after_s]
    return [
        float(np.angle(mean * np.conj(means[main])) / (2 * np.pi) * cycle_s)
        if k == main or (len(after) >= _JUNCTION_STARTS and abs(mean) >= _MIN_CONCENTRATION)
        else None
        for k, (mean, after) in enumerate(zip(means, after_s, strict=True))
    ]


def _queue_heads(stream: Stream) -> FloatArray:
    """Starts at the stop line, the first of each queue: a second start within 8 s is of the same green."""
    time = np.sort(stream.head_time_s)
    return time[np.r_[True, np.diff(time) > _QUEUE_GAP_S]] if len(time) else time


def _stopping(streams: Sequence[Stream]) -> tuple[int, Estimate | None]:
    """Vehicles that stop on the approaches, and their share of all that stop or cross."""
    stopped = np.unique(np.concatenate([s.stop_track for s in streams] or [np.empty(0, np.int64)]))
    every = np.unique(np.concatenate([stopped, *(s.cross_track for s in streams)]))
    return len(stopped), estimate_share(float(len(stopped)), len(every))


def _find_cycle(events: Sequence[FloatArray], longest_s: float) -> tuple[float, float] | None:
    """The period at which the starts of each stream recur, s, and the probability that they do by chance."""
    found = _fit_period(events, longest_s)
    if found is None:
        return None
    cycle_s, concentration, frequency = found
    n = sum(len(times) for times in events)
    if n <= _DRAWN_STARTS:
        return cycle_s, _chance(events, frequency, concentration)
    excess = max(n * concentration - 1.0 * len(events), 0.0) ** 2 / n
    return cycle_s, float(min(len(frequency) / 5 * np.exp(-excess), 1.0))


def _fit_period(events: Sequence[FloatArray], longest_s: float) -> tuple[float, float, FloatArray] | None:
    """The period at which the starts of each stream recur best: s, concentration, and the frequencies tried, Hz."""
    n = sum(len(times) for times in events)
    span = max(float(np.ptp(times)) for times in events)
    if span < MIN_CYCLE_S:
        return None
    frequency = np.arange(1 / longest_s, 1 / MIN_CYCLE_S, 0.1 / span)
    power = _concentration(frequency, events)
    # Starts that recur every P recur every P / 2 too: the longest period nearly as good as the best is the cycle.
    peak = np.flatnonzero((power >= np.r_[0, power[:-1]]) & (power >= np.r_[power[1:], 0]))
    good = peak[power[peak] > power.max() - 0.06]
    best = good[0]
    fine = np.linspace(frequency[max(best - 1, 0)], frequency[min(best + 1, len(frequency) - 1)], 201)
    sharp = sum(np.abs(np.exp(2j * np.pi * fine[:, None] * times).sum(axis=1)) for times in events) / n
    k = int(np.argmax(sharp))
    return float(1 / fine[k]), float(sharp[k]), frequency


def _concentration(frequency: FloatArray, events: Sequence[FloatArray]) -> FloatArray:
    """Mean resultant length (frequencies,) of the phases of all starts, each stream about its own mean."""
    power = np.zeros(len(frequency))
    for times in events:
        power += np.abs(np.exp(2j * np.pi * frequency[:, None] * times).sum(axis=1))
    return np.asarray(power / sum(len(times) for times in events))


def _chance(events: Sequence[FloatArray], frequency: FloatArray, concentration: float) -> float:
    """Probability that starts at random times, as many and as far apart at least, are as concentrated."""
    rng = np.random.default_rng(0)
    begin, end = min(float(t.min()) for t in events), max(float(t.max()) for t in events)
    total = np.zeros((_DRAWS, len(frequency)))
    for times in events:
        free = max(end - begin - _QUEUE_GAP_S * (len(times) - 1), 0.0)
        drawn = np.sort(rng.uniform(0, free, (_DRAWS, len(times))), axis=1) + _QUEUE_GAP_S * np.arange(len(times))
        total += np.abs(np.exp(2j * np.pi * drawn[:, None, :] * frequency[:, None]).sum(axis=2))
    best = total.max(axis=1) / sum(len(times) for times in events)
    return float((1 + np.sum(best >= concentration - 1e-9)) / (1 + _DRAWS))


def _stream_signal(
    stream: Stream, green: Estimate, cycle: Estimate, seen_late: Sequence[tuple[FloatArray, float]]
) -> StreamSignal:
    """The signal of a stream in times that are seen, in each of which it is later than by its cycle."""
    onsets, crossed = [], []
    for (begin, end), late in seen_late:
        value = green.value + late
        k = np.arange(np.ceil((begin - value) / cycle.value), np.floor((end - value) / cycle.value) + 1)
        onsets.append(value + k * cycle.value)
        crossed.append(_within(stream.cross_time_s, begin, end) - late)
    green_s = np.concatenate(onsets)
    lost, saturation = _discharge(stream, green_s)
    red = _red_onset(np.concatenate(crossed), green.value, cycle)
    return StreamSignal(stream, green, red, green_s, lost, saturation)


def _red_onset(cross_time_s: FloatArray, green_s: float, cycle: Estimate) -> Estimate | None:
    """Onset of red: when the crossings of the stop line end, those of vehicles too near to stop at yellow included."""
    cycle_s = cycle.value
    crossed = np.sort((cross_time_s - green_s) % cycle_s)
    n = len(crossed)
    if n < _MIN_CROSSINGS:
        return None
    bins = max(round(cycle_s / 1.0), 8)
    counts = np.bincount(np.minimum((crossed / cycle_s * bins).astype(np.int64), bins - 1), minlength=bins)
    # the longest time of the cycle that hardly anyone crosses is the red
    quiet = np.tile(counts <= 0.15 * counts.mean(), 2)
    edge = np.diff(np.r_[False, quiet, False].astype(np.int8))
    start, end = np.flatnonzero(edge == 1), np.flatnonzero(edge == -1)
    if not len(start) or (end - start).max() < 6:
        return None
    quiet_s = float(start[np.argmax(end - start)] % bins) * cycle_s / bins
    # How far it lies behind the last crossing: the rate of crossings falls to nothing over the last of the time.
    before = np.sort((crossed - quiet_s) % cycle_s) - cycle_s
    last = float(before[-1])
    crossings = int(np.sum((before > last - _RATE_S) & (before <= last - 1)))
    rate = max(crossings, _MIN_RATE_CROSSINGS) / (_RATE_S - 1)
    early, middle, late = (_last_crossing_gap(p, rate) for p in ((1 - LEVEL) / 2, 0.5, (1 + LEVEL) / 2))
    value = quiet_s + last + middle
    # the onset is that of second 0, the crossings are of some cycles later
    cycles = float(cross_time_s.mean()) / cycle_s
    drift = sorted(cycles * (cycle.value - end) for end in (cycle.low, cycle.high))
    systematic = float(special.ndtri((1 + LEVEL) / 2)) * _RED_SD_S
    low = value - float(np.linalg.norm([middle - early, systematic, drift[0]]))
    high = value + float(np.linalg.norm([late - middle, systematic, drift[1]]))
    shift = green_s - cycle_s * np.floor((value + green_s) / cycle_s)
    return Estimate(value + shift, low + shift, high + shift, n)


def _last_crossing_gap(probability: float, rate: float) -> float:
    """Time from the last crossing to the end of crossings that is exceeded with 1 - ``probability``, s: ``rate``
    crossings a second of the cycle, which falls linearly to none over the last `_THINNING_S`."""
    expected = -float(np.log1p(-probability))  # crossings in that time
    within = float(np.sqrt(2 * _THINNING_S * expected / rate))
    return within if within < _THINNING_S else expected / rate + _THINNING_S / 2


def _discharge(stream: Stream, green_s: FloatArray) -> tuple[Estimate | None, Estimate | None]:
    """Start-up lost time, s, and saturation flow, vehicles an hour, from the headways of queues that discharge."""
    headways: dict[int, list[float]] = {}
    for onset in green_s:
        queue = _queue_at(stream, float(onset) + 1.0)
        time = stream.cross_time_s[(stream.cross_time_s > onset) & (stream.cross_time_s < onset + 60)]
        track = stream.cross_track[(stream.cross_time_s > onset) & (stream.cross_time_s < onset + 60)]
        stood = np.isin(track, queue)
        before = onset
        for position, (t, queued) in enumerate(zip(time, stood, strict=True)):
            if not queued:
                break
            headways.setdefault(position, []).append(float(t - before))
            before = t
    later = [h for p, values in headways.items() if p >= _START_UP_VEHICLES for h in values]
    saturated = estimate_mean(np.array(later), min_n=8)
    if saturated is None:
        return None, None
    saturation = Estimate(3600 / saturated.value, 3600 / saturated.high, 3600 / max(saturated.low, 0.5), saturated.n)
    first = [np.array(headways.get(p, [])) for p in range(_START_UP_VEHICLES)]
    means = [estimate_mean(values, min_n=3) for values in first]
    if any(mean is None for mean in means):
        return None, saturation
    known = [mean for mean in means if mean is not None]
    value = sum(mean.value - saturated.value for mean in known)
    half = float(np.sqrt(sum(((m.high - m.low) / 2) ** 2 for m in known)))
    return Estimate(value, value - half, value + half, min(m.n for m in known)), saturation


def _queue_at(stream: Stream, time_s: float) -> IntArray:
    """Tracks that stand at a time, or have just left a stop at it."""
    end = np.where(np.isfinite(stream.stop_end_s), stream.stop_end_s, stream.stop_start_s)
    return np.unique(stream.stop_track[(stream.stop_start_s < time_s) & (end + 25 > time_s) & (end > time_s - 5)])


def stopping_share(stream: Stream) -> Estimate | None:
    """Share of the vehicles that cross which stopped before."""
    return estimate_share(float(np.isin(stream.cross_track, stream.stop_track).sum()), len(stream.cross_track))


@dataclass(frozen=True)
class Queue:
    """The queue of a stream at a time."""

    time_s: float
    vehicles: Estimate
    """Vehicles that stand, with those for which there is a place between others: a tree hides them, or they were
    missed. ``n`` is the number of those that are seen; the interval begins with those that are sure to stand at the
    time, and ends with those that may, with as many others between them as there is room for, and with those that are
    hidden behind the last one: vehicles are as often as between others."""
    length_m: float
    """From the stop line to the last one's rear."""
    reaches_edge: bool = False
    """It ends where the approach comes into view, or `REACH_M` before the line: number and length are lower bounds."""


def queues(stream: Stream, times_s: FloatArray) -> list[Queue]:
    """Queues that stand at the stop line at given times (as the onsets of green)."""
    if stream.stop_line_m is None:
        return []
    late = float(special.ndtri((1 + LEVEL) / 2)) * stream.stop_time_sd_s
    share = stream.hidden_share
    behind = int(np.log((1 - LEVEL) / 2) / np.log(share)) if share > 0 else 0
    cut = stream.approach.border_m >= REACH_M - 1.0  # at so far before the line, where vehicles are seen
    edge_m = _SPACING_M if cut else min(_EDGE_M, stream.stop_line_m / 2)
    out = []
    for time in times_s:
        least, found = (_stand_at(stream, float(time), margin) for margin in (-late, 0.0))
        most = _stand_at(stream, float(time), late, through_gaps=True)
        value = found.seen + found.hidden
        vehicles = Estimate(value, min(least.seen, value), max(most.seen + most.room, value) + behind, found.seen)
        reaches_edge = found.seen > 0 and stream.stop_line_m - found.length_m < edge_m
        out.append(Queue(float(time), vehicles, found.length_m, reaches_edge))
    return out


def green_duration_s(streams: Sequence[StreamSignal], cycle_s: float) -> float | None:
    """How long vehicles of the streams of a phase cross, yellow included, s; None where no onset of red is known."""
    lasts = [(s.red_phase_s.value - s.green_phase_s.value) % cycle_s for s in streams if s.red_phase_s]
    return max(lasts, default=None)


def least_green_s(streams: Sequence[StreamSignal], cycle_s: float) -> float:
    """How long queues of the streams of a phase were seen to drive off, s: it is green, or yellow, for longer."""
    return max((_drives_off_s(s.stream, float(onset), cycle_s) for s in streams for onset in s.green_s), default=0.0)


def _drives_off_s(stream: Stream, onset_s: float, cycle_s: float) -> float:
    """How long after an onset of green vehicles cross without a pause."""
    after = stream.cross_time_s - onset_s
    after = after[(after > 0) & (after < cycle_s)]
    pause = np.diff(after, prepend=0.0) > np.where(np.arange(len(after)), _PAUSE_S, _SETS_OFF_S)
    together = after[: int(np.argmax(pause)) if pause.any() else len(after)]
    return float(together.max(initial=0.0))


@dataclass(frozen=True)
class _Standing:
    """Vehicles that are seen to stand, those for which there is a place between them, and for which there is room."""

    seen: int
    hidden: int
    room: int
    length_m: float


def _stand_at(stream: Stream, time_s: float, margin_s: float, *, through_gaps: bool = False) -> _Standing:
    """Vehicles that stand from the stop line on, to the first long gap; their stops are longer by ``margin_s`` at
    either end."""
    line = stream.stop_line_m or 0.0
    stands = (stream.stop_start_s - margin_s <= time_s) & (stream.stop_seen_s + margin_s >= time_s)
    length = stream.stop_length_m[stands]
    front = stream.stop_along_m[stands] + length / 2
    order = np.argsort(-front, kind="stable")
    order = order[front[order] < line + _BEYOND_M]
    seen, hidden, room, at, rear = 0, 0, 0, np.inf, line + _SPACING_M - VEHICLE_LENGTH_M
    for position, own in zip(front[order].tolist(), length[order].tolist(), strict=True):
        free = rear - position - (_SPACING_M - VEHICLE_LENGTH_M)
        if free > _MAX_HIDDEN * _SPACING_M and not through_gaps:
            break
        if at - position > _SAME_M:  # else two tracks of one vehicle
            seen += 1
            hidden += max(round(free / _SPACING_M), 0)
            room += max(int(free / VEHICLE_LENGTH_M), 0)
        at, rear = position, position - own
    return _Standing(seen, hidden, room, line - rear if seen else 0.0)
