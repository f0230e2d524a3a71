"""What the analysis of a simulated clip says, held against the truth: statements, each true or false, and intervals."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import brentq
from scipy.spatial import cKDTree
from scipy.special import ndtr

from schemas.arrays import FloatArray, IntArray
from tests.analysis.noisy_tracks import GSD_M, Noise, TrueTracks, analyse, flight, true_numbers
from tests.benchmarks.analysis import crossings_m, signal_onsets_s
from velfield.analysis.answers import find_answers
from velfield.analysis.flow.conflicts import HARD_BRAKING_M_PER_S2
from velfield.analysis.intervals import Estimate
from velfield.analysis.movements.movements import JunctionMovements, find_movements, find_passes
from velfield.analysis.signals.cycles import JunctionSignal, least_green_s, queues
from velfield.analysis.signals.queues import observe_stream
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.analysis.vehicle_classes import COUNTED_CLASSES
from velfield.synthetic.flight import Flight

CROSSING_M = 35.0
"""A junction nearer to a crossing of avenues is that crossing."""
SLACK = 2.0
"""A value so many half widths of its 90 % interval off is false; the intervals' coverage is measured apart."""
PET_SLACK_S, BRAKING_SLACK = 0.3, 1.3
LORRY_SHAPE = 2
"""From this shape on a simulated vehicle is a lorry or a bus."""


@dataclass(frozen=True)
class Statement:
    """One thing that was said: its kind, whether it is true, and the words; ``withheld``: nothing was said."""

    kind: str
    true: bool
    text: str
    withheld: bool = False


@dataclass(frozen=True)
class Interval:
    """An interval, and the value that it should hold."""

    kind: str
    truth: float
    estimate: Estimate


@dataclass(frozen=True)
class Truth:
    """The simulated flight of a clip, its true tracks, and the analysis of the whole flight without the vehicles that
    are left out of the clip: ``scene``."""

    flight: Flight
    signals: bool
    tracks: TrueTracks
    scene: TrafficAnalysis

    @property
    def cycle_s(self) -> float:
        """Cycle of the signals."""
        return self.flight.config.traffic.cycle_s

    @cached_property
    def analysis(self) -> TrafficAnalysis:
        """The analysis of the true tracks."""
        return analyse(self.tracks, Noise(), lengths_m=self.lengths_m)

    @property
    def lengths_m(self) -> FloatArray:
        """(vehicles,) true lengths."""
        return self.flight.city.traffic.dimensions.length_m

    @cached_property
    def crossings_m(self) -> FloatArray:
        """(n, 2) crossings of avenues."""
        return crossings_m(self.flight)

    @cached_property
    def _edges(self) -> tuple[cKDTree, IntArray]:
        edges = self.flight.city.plan.road_network.edges
        points = self.flight.city.to_px(np.concatenate([edge.path for edge in edges])) * GSD_M
        return cKDTree(points), np.repeat(np.arange(len(edges)), [len(edge.path) for edge in edges])

    def free_speed_m_per_s(self, xy_m: FloatArray) -> float:
        """Median of the speeds that drivers want on the fastest of the edges at the points (n, 2)."""
        tree, of = self._edges
        edges = self.flight.city.plan.road_network.edges
        return min(self._wanted_m_per_s, max(edges[k].speed_m_per_s for k in np.unique(of[tree.query(xy_m)[1]])))

    @cached_property
    def _wanted_m_per_s(self) -> float:
        """Median of the speeds that drivers want; those of long vehicles want a tenth less (`simulate_traffic`)."""
        traffic, long = self.flight.config.traffic, float((self.lengths_m > 7).mean())
        mean, sd = traffic.speed_mean_km_per_h, traffic.speed_sd_km_per_h

        def share_of_slower(speed: float) -> float:
            z = (speed - mean) / sd, (speed / 0.9 - mean) / sd
            return float((1 - long) * ndtr(z[0]) + long * ndtr(z[1]))

        return float(brentq(lambda speed: share_of_slower(speed) - 0.5, 0.9 * mean, mean)) / 3.6

    @property
    def may_be_heavy(self) -> float:
        """Share of the vehicles on routes that lorries take."""
        config = self.flight.config
        every = flight(config.seed, 140.0, config.traffic.model_copy(update={"large_share": 1.0}), self.signals)
        return float((every.city.traffic.dimensions.shape >= LORRY_SHAPE).mean())

    def is_heavy(self, vehicles: IntArray) -> FloatArray:
        """Whether each vehicle (n,) is a lorry or a bus."""
        return self.flight.city.traffic.dimensions.shape[vehicles] >= LORRY_SHAPE


def statements(analysis: TrafficAnalysis, truth: Truth, u_turns: tuple[set[int], set[int]]) -> Iterator[Statement]:
    """All statements of a clip; ``u_turns``: true tracks that reverse, seen whole, and in part."""
    numbers = true_numbers(analysis, truth.tracks)
    yield from _signals(analysis, truth)
    circles = [turn.track for turn in truth.analysis.reversals if turn.round_circle]
    round_circles = set(true_numbers(truth.analysis, truth.tracks)[circles].tolist())
    yield from _u_turns(analysis, numbers, *(found | round_circles for found in u_turns))
    yield from _limits(analysis, truth)
    yield from _counts(analysis, truth)
    yield from _delays(analysis, truth)
    yield from _conflicts(analysis, truth, numbers)
    yield from _unusual(analysis, truth, numbers)
    yield from _car_parks(analysis, truth)
    yield from _classes(analysis, truth)
    for answer in find_answers(analysis):
        explains = answer.state != "too little data" or "too" in answer.text
        bounded = answer.state != "none" or answer.at_most_per_h is not None or answer.topic == "signal"
        yield Statement("words", explains and bounded, f"{answer.topic} {answer.text}")


def _near(estimate: Estimate, truth: float, least: float) -> bool:
    below, above = max(estimate.value - estimate.low, least), max(estimate.high - estimate.value, least)
    return estimate.value - SLACK * below <= truth <= estimate.value + SLACK * above


def _signals(analysis: TrafficAnalysis, truth: Truth) -> Iterator[Statement]:
    for number, signal in analysis.signals.items():
        centre = analysis.lanes.junctions[number].centre_m
        crossing = np.hypot(*(truth.crossings_m - centre).T).min(initial=np.inf) < CROSSING_M
        has = bool(crossing and truth.signals)
        name = f"junction {number}, in truth {f'{truth.cycle_s:.1f} s' if has else 'none'}:"
        if signal.signalised is None:
            yield Statement("signal", True, f"{name} {signal.reason}", withheld=True)
        elif signal.signalised is False or signal.cycle_s is None:
            yield Statement("signal", not has, f"{name} {signal.reason}")
        else:
            yield Statement("signal", has and _near(signal.cycle_s, truth.cycle_s, 0.3), f"{name} {signal.cycle_s}")
            yield Statement("phases", len(signal.phases) <= 2, f"{name} {len(signal.phases)} phases")
            if has:
                yield from _queues(signal, truth)
                yield from _greens(signal, signal.cycle_s.value, truth)


def _queues(signal: JunctionSignal, truth: Truth) -> Iterator[Statement]:
    for estimate, n in queue_pairs(signal, truth):
        yield Statement("queue", estimate.low - 1 <= n <= estimate.high + 1, f"queue {estimate}, in truth {n}")


def _greens(signal: JunctionSignal, cycle_s: float, truth: Truth) -> Iterator[Statement]:
    for stream in signal.streams:
        green, red = signal_onsets_s(truth.flight, stream.stream)
        seen = least_green_s([stream], cycle_s)
        yield Statement("least green", seen <= red - green + 1.5, f"{seen:.1f} s, in truth {red - green:.1f}")


def _delays(analysis: TrafficAnalysis, truth: Truth) -> Iterator[Statement]:
    real = find_movements(truth.scene.trajectories, analysis.lanes, names=analysis.arm_names)
    for found, true in zip(analysis.movements, real, strict=True):
        for arm, delay in found.delays_s.items():
            if arm in true.delays_s:
                value = true.delays_s[arm].value
                yield Statement("delay", _near(delay, value, 2.0), f"from {arm} {delay}, in truth {value:.1f}")


def queue_pairs(signal: JunctionSignal, truth: Truth) -> Iterator[tuple[Estimate, int]]:
    """Queues that were found at the onsets of green, and the vehicles that stood there: of the scene."""
    scene = truth.scene
    for stream in signal.streams:
        true = observe_stream(stream.stream.approach, scene.samples, scene.stops, scene.trajectories.length_m)
        found, real = (queues(s, stream.green_s) for s in (stream.stream, true))
        yield from ((a.vehicles, b.vehicles.n) for a, b in zip(found, real, strict=False))


def _u_turns(analysis: TrafficAnalysis, numbers: IntArray, whole: set[int], begun: set[int]) -> Iterator[Statement]:
    for reversal in analysis.reversals:
        yield Statement("u-turn", int(numbers[reversal.track]) in begun, f"at {reversal.xy_m.round()}")
    # one seen over less than 20 m before or after may count, and need not
    least, most = (len(found) / analysis.trajectories.duration_s * 3600 for found in (whole, begun))
    for answer in find_answers(analysis):
        if answer.topic == "u-turns":
            # each is a statement above; the answer says how many an hour there are, or that this is not known
            low, high = (answer.estimate.low, answer.estimate.high) if answer.estimate else (0.0, answer.at_most_per_h)
            text = f"{answer.text}; {len(whole)} to {len(begun)} in truth"
            yield Statement("u-turns", high is None or (low <= most and least <= high), text, high is None)


def u_turns_found(analysis: TrafficAnalysis, truth: Truth, whole: set[int]) -> tuple[int, int]:
    """U-turns that were seen whole, and how many of them are found."""
    numbers = true_numbers(analysis, truth.tracks)
    return len(whole), len(whole & {int(numbers[r.track]) for r in analysis.reversals})


def _limits(analysis: TrafficAnalysis, truth: Truth) -> Iterator[Statement]:
    for road in analysis.free_flow:
        if road.speed_m_per_s is None:
            yield Statement("speed", True, "", withheld=True)
            continue
        at = np.concatenate([analysis.lanes.lanes[k].xy_m for k in road.lanes])
        free = truth.free_speed_m_per_s(at)
        yield Statement("speed", _near(road.speed_m_per_s, free, 0.2), f"{road.speed_m_per_s}, in truth {free:.2f}")
        if road.limit() is None:
            yield Statement("limit", True, "", withheld=True)
        else:
            right = round(free * 3.6 / 10) * 10
            yield Statement("limit", road.limit() == right, f"{road.limit()}, in truth {free * 3.6:.0f}")


def true_counts(found: JunctionMovements, truth: Truth) -> tuple[IntArray, IntArray]:
    """Vehicles (arms, arms) from arm to arm by the true tracks: at least, and at most.

    Gates lie on lanes as they were found under errors; a vehicle that passes beside all of one side may have used any.
    """
    passes = find_passes(truth.analysis.samples, found.junction, found.gates)
    arm = np.array([gate.arm for gate in found.gates.gates] + [-1], np.int64)
    i, j = arm[passes.gate_in], arm[passes.gate_out]
    n = len(found.gates.arms)
    counts = np.bincount((i + 1) * (n + 1) + j + 1, minlength=(n + 1) ** 2).reshape(n + 1, n + 1)
    least = counts[1:, 1:]
    return least, least + counts[1:, :1] + counts[:1, 1:]


def _counts(analysis: TrafficAnalysis, truth: Truth) -> Iterator[Statement]:
    hours = analysis.trajectories.duration_s / 3600
    for found in analysis.movements:
        names, counts = [arm.name for arm in found.gates.arms], true_counts(found, truth)
        for m in found.movements:
            least, most = (int(n[names.index(m.arm_in), names.index(m.arm_out)]) for n in counts)
            right = m.seen <= most + max(1, 0.1 * most) and m.seen + m.inferred >= least - max(1, 0.1 * least)
            yield Statement("count", right, f"{m.seen} + {m.inferred:.1f}, in truth {least} to {most}")
            if m.flow_veh_per_h:
                flow, text = m.flow_veh_per_h, f"{least / hours:.0f} to {most / hours:.0f}"
                right = flow.low <= most / hours and least / hours <= flow.high
                yield Statement("flow", right, f"{flow}, in truth {text}")


def conflicts_found(analysis: TrafficAnalysis, truth: Truth) -> tuple[int, int]:
    """Conflicts beyond doubt in truth, and how many of them are found; none of roads on two levels."""
    if not truth.signals:
        return 0, 0
    numbers = true_numbers(analysis, truth.tracks)
    near = near_in_time(truth, longest_s=1.5 - PET_SLACK_S, doubtless=True)
    said = {frozenset((int(numbers[c.first]), int(numbers[c.second]))) for c in analysis.conflicts if c.likely}
    return len(near), len(said & near.keys())


def _conflicts(analysis: TrafficAnalysis, truth: Truth, numbers: IntArray) -> Iterator[Statement]:
    near = near_in_time(truth)
    levels = np.empty((0, 2)) if truth.signals else truth.crossings_m
    for c in analysis.conflicts:
        if c.likely:
            pair = frozenset((int(numbers[c.first]), int(numbers[c.second])))
            bridge = c.kind == "crossing" and np.hypot(*(levels - c.xy_m).T).min(initial=np.inf) < CROSSING_M
            value = np.inf if bridge else near.get(pair, np.inf)
            text = f"{c.kind} {c.value_s:.2f} s, p {c.probability:.2f}, in truth {value:.2f} s"
            yield Statement(f"conflict, {c.kind}", value < c.threshold_s + PET_SLACK_S, text)


def near_in_time(truth: Truth, *, longest_s: float = 3.0, doubtless: bool = False) -> dict[frozenset[int], float]:
    """Least time to collision, or post-encroachment time, of each pair of true tracks for which it is below
    ``longest_s``; ``doubtless``: those that need harder braking than a conflict, not those that need nearly as hard."""
    slack = 1 / BRAKING_SLACK if doubtless else BRAKING_SLACK
    out = _times_to_collision(truth, longest_s, HARD_BRAKING_M_PER_S2 / slack, doubtless=doubtless)
    for pair, value in _encroachments(truth, longest_s, doubtless=doubtless).items():
        out[pair] = min(value, out.get(pair, np.inf))
    return out


def _times_to_collision(
    truth: Truth, longest_s: float, braking_m_per_s2: float, *, doubtless: bool
) -> dict[frozenset[int], float]:
    """By true positions: a follower faster than 3 m/s that closes in by .5 m/s, in one lane, in one frame, and must
    brake harder than ``braking_m_per_s2``; ``doubtless``: neither turns."""
    t = truth.analysis.trajectories
    owner, speed = t.track_id[t.owner], t.speed_m_per_s
    length, way = truth.lengths_m[truth.tracks.vehicle][owner], t.velocity_m_per_s / np.maximum(speed, 0.1)[:, None]
    # frames lie far apart in the third dimension
    near = cKDTree(np.column_stack([t.xy_m, 1e3 * t.frame])).query_pairs(45.0, output_type="ndarray")
    follower, leader = np.concatenate([near, near[:, ::-1]]).T
    ahead = t.xy_m[leader] - t.xy_m[follower]
    along = (ahead * way[follower]).sum(axis=1)
    across = np.abs(ahead[:, 0] * way[follower, 1] - ahead[:, 1] * way[follower, 0])
    closing = speed[follower] - (t.velocity_m_per_s[leader] * way[follower]).sum(axis=1)
    value = (along - (length[follower] + length[leader]) / 2) / np.maximum(closing, 0.1)
    hard = closing / (2 * np.maximum(value, 1e-3)) > braking_m_per_s2
    same_way = (way[follower] * way[leader]).sum(axis=1) > np.cos(np.radians(30))
    counts = (along > 0) & (across < 1.5) & (closing > 0.5) & (speed[follower] > 3.0) & hard & (value < longest_s)
    counts &= (same_way | (not doubtless)) & (owner[follower] != owner[leader])
    out: dict[frozenset[int], float] = {}
    for k in np.flatnonzero(counts):
        pair = frozenset((int(owner[follower[k]]), int(owner[leader[k]])))
        out[pair] = min(max(float(value[k]), 0.0), out.get(pair, np.inf))
    return out


def _encroachments(truth: Truth, longest_s: float, *, doubtless: bool) -> dict[frozenset[int], float]:
    """Least time between one vehicle's rear and another's front at a place to which they came by different ways, or
    lanes; ``doubtless``: of both it is known by which way, as one turned: who changes the lane follows, no more."""
    samples, lengths = truth.analysis.samples, truth.lengths_m[truth.tracks.vehicle]
    ids = truth.analysis.trajectories.track_id[samples.track]
    half = lengths[ids] / 2 / np.maximum(samples.speed_m_per_s, 1.0)
    out: dict[frozenset[int], float] = {}
    pairs = cKDTree(samples.xy_m).query_pairs(1.2, output_type="ndarray")
    close = np.abs(samples.time_s[pairs[:, 0]] - samples.time_s[pairs[:, 1]]) < longest_s + 6.0
    pairs = pairs[close & (ids[pairs[:, 0]] != ids[pairs[:, 1]])]
    before = np.maximum(np.arange(len(ids)) - 12, 0)
    known = samples.track[before] == samples.track
    before = np.where(known, before, np.arange(len(ids)))
    if doubtless:
        pairs = pairs[known[pairs].all(axis=1)]
    a, b = pairs.T
    turned = np.abs(np.angle(np.exp(1j * (samples.direction_rad[before[a]] - samples.direction_rad[before[b]]))))
    apart = np.hypot(*(samples.xy_m[before[a]] - samples.xy_m[before[b]]).T)
    for i in np.flatnonzero((turned > np.radians(15)) | ((apart > 3.0) & (not doubtless))):
        first, second = (a[i], b[i]) if samples.time_s[a[i]] < samples.time_s[b[i]] else (b[i], a[i])
        value = float(samples.time_s[second] - half[second] - samples.time_s[first] - half[first])
        if value < longest_s:
            pair = frozenset((int(ids[first]), int(ids[second])))
            out[pair] = min(value, out.get(pair, np.inf))
    return out


def _unusual(analysis: TrafficAnalysis, truth: Truth, numbers: IntArray) -> Iterator[Statement]:
    for unusual in analysis.unusual:
        rare = unusual.kind == "rare turn" and numbers[unusual.track] >= 0
        yield Statement(f"unusual, {unusual.kind}", rare, unusual.detail)


def _car_parks(analysis: TrafficAnalysis, truth: Truth) -> Iterator[Statement]:
    if analysis.parked is None:
        return
    real = TrafficAnalysis(truth.analysis.trajectories, parked=analysis.parked).car_parks
    for found in analysis.car_parks:
        other = min(real, key=lambda park: float(np.hypot(*(park.hull_m.mean(axis=0) - found.hull_m.mean(axis=0)))))
        for kind in ("entered", "through"):
            a, b = getattr(found, kind), getattr(other, kind)
            yield Statement("car park", abs(a - b) <= max(1, 0.15 * b), f"{kind} {a}, in truth {b}")


def _classes(analysis: TrafficAnalysis, truth: Truth) -> Iterator[Statement]:
    if analysis.classes is None:
        return
    heavy = float(truth.is_heavy(truth.tracks.vehicle).mean())
    shares = analysis.classes.estimate_shares(analysis.classes.measured)
    for name, share in zip(COUNTED_CLASSES, shares, strict=True):
        real = {"motorcycle": 0.0, "car or van": 1 - heavy, "lorry or bus": heavy}[name]
        said = share is not None
        yield Statement(
            "class", share is None or _near(share, real, 0.01), f"{name} {share}, in truth {real:.3f}", not said
        )


def intervals(analysis: TrafficAnalysis, truth: Truth) -> Iterator[Interval]:
    """Intervals whose long-run values are known from the simulation."""
    for road in analysis.free_flow:
        if road.speed_m_per_s:
            at = np.concatenate([analysis.lanes.lanes[k].xy_m for k in road.lanes])
            yield Interval("free flow", truth.free_speed_m_per_s(at), road.speed_m_per_s)
    for number, signal in analysis.signals.items():
        centre = analysis.lanes.junctions[number].centre_m
        crossing = np.hypot(*(truth.crossings_m - centre).T).min(initial=np.inf) < CROSSING_M
        if signal.cycle_s and crossing and truth.signals:
            yield Interval("cycle", truth.cycle_s, signal.cycle_s)
            yield from (Interval("queue", n, estimate) for estimate, n in queue_pairs(signal, truth))
    if analysis.classes is not None:
        shares = analysis.classes.estimate_shares(analysis.classes.measured)
        if shares[-1]:
            yield Interval("heavy share", truth.flight.config.traffic.large_share * truth.may_be_heavy, shares[-1])
