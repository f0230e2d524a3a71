"""Movements through a junction: counted where both ends are seen, inferred where a track is cut.

A track that enters and leaves within sight is a movement that is seen. Tracks of one vehicle that is lost and found
again where it must have gone (`cut_tracks`) are a movement that is inferred. What remains is half of one: it enters and
is lost, or is found within and leaves. Such halves are joined as the entries and exits require: the known movements are
scaled until their rows add up to the entries that were lost, and their columns to the exits of unknown origin (Furness'
method).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from schemas.analysis import Turn
from schemas.arrays import FloatArray, IntArray, Mask
from velfield.analysis.intervals import Estimate, estimate_mean, estimate_rate, estimate_share
from velfield.analysis.lanes.junctions import inside_hull
from velfield.analysis.lanes.model import Junction, LaneGraph
from velfield.analysis.movements.cut_tracks import CutTracks, join_cut_tracks
from velfield.analysis.movements.gates import ROAD_M, Arm, ArmNames, Gates, find_gates
from velfield.analysis.observed import ObservedSlices
from velfield.analysis.trajectories import PathSamples, Trajectories, within

_UPSTREAM_M, _FARTHER_M = 60, 90
"""A travel time begins so far before the junction where the track does; a delay so much farther where it is seen."""
_PACED_M = 20.0
"""How fast vehicles come freely is measured over so many of these metres at least."""
_FURNESS_STEPS = 60
_SLICE_S = 120.0
"""Counts of slices so long show how much the flow varies."""
MIN_PASSES, MIN_DELAYED, _MIN_FREE = 3, 10, 3
"""Fewest vehicles of a movement; of which the delay is known; and of these that do not stop."""
MIN_DELAY_S = 120.0
"""A delay is that of traffic that is seen for so long: in less there are a queue or two, and who waits long in them is
not seen to leave."""
_TURN_RAD = np.radians(40)
"""Who changes his direction by less goes straight on."""
_WAITS_S = 1.5
"""A vehicle that needs longer for a metre has stopped."""
_LEAST_SEEN = 0.5
"""A vehicle that could be seen in whole in less than this fraction of the time weighs as one of this fraction: else one
that stands for most of a clip outweighs all others."""
_SPREAD_N = 8
"""The standard deviation of all travel times through a junction counts for so many of a movement's vehicles: five may
all have come at green."""

_NOWHERE = np.empty(0, np.int64)


@dataclass(frozen=True)
class Passes:
    """Tracks in a junction, one row a pass: gates by number, -1 where the track was not seen to enter (or leave).

    ``entry_s``, ``exit_s`` and ``upstream_s`` (``_UPSTREAM_M`` before the entry) are times, NaN where unknown;
    ``farther_m`` and ``farther_s``: how far before that the track is seen, up to ``_FARTHER_M`` and from the junction
    before on, and for how long; ``farther_stood``: at some time there; ``inside_m``: length of its way inside;
    ``joined``: of two tracks or more of one vehicle, of which ``track`` is the one that enters (or leaves);
    ``stood``: at some time between upstream and exit.
    """

    track: IntArray
    gate_in: IntArray
    gate_out: IntArray
    entry_s: FloatArray
    exit_s: FloatArray
    upstream_s: FloatArray
    joined: Mask
    stood: Mask
    farther_m: FloatArray
    farther_s: FloatArray
    farther_stood: Mask
    inside_m: FloatArray

    @property
    def travel_s(self) -> FloatArray:
        """(n,) times from upstream of the junction to its exit, NaN where unknown."""
        return self.exit_s - self.upstream_s

    def select(self, rows: Mask) -> "Passes":
        """Some of the passes (n,)."""
        return Passes(*(getattr(self, name)[rows] for name in Passes.__dataclass_fields__))


@dataclass(frozen=True)
class Movement:
    """From one arm of a junction to another."""

    junction: int
    arm_in: str
    arm_out: str
    turn: Turn
    seen: int
    inferred: float
    """Vehicles seen from entry to exit by one track, and those inferred from tracks that are cut."""
    share: Estimate | None
    """Fraction of the vehicles that enter by the arm."""
    flow_veh_per_h: Estimate | None
    """Vehicles an hour."""
    travel_time_s: Estimate | None
    """From 60 m before the junction to its exit."""
    delay_s: Estimate | None
    """What that is longer than for vehicles that pass freely, and what they need longer for up to 90 m before, as far
    as they are seen."""
    line_m: FloatArray


@dataclass(frozen=True)
class JunctionMovements:
    """All movements of a junction; ``delays_s``: mean delay of those that enter by an arm, by its name."""

    junction: Junction
    gates: Gates
    passes: Passes
    movements: tuple[Movement, ...]
    delays_s: Mapping[str, Estimate]

    @property
    def volume(self) -> float:
        """Vehicles that passed."""
        return float(sum(m.seen + m.inferred for m in self.movements))

    def entered(self, arm_in: str) -> float:
        """Vehicles that entered by an arm, those that went ways too rare for a movement of their own among them."""
        mine = self._from(arm_in)
        counted = sum(m.seen + m.inferred for m in mine)
        return max([counted, *((m.seen + m.inferred) / m.share.value for m in mine if m.share)])

    def tracks(self, movement: Movement) -> IntArray:
        """Numbers of the tracks of a movement's vehicles whose both ends are known: those that enter."""
        return np.asarray(self.passes.track[self._took(movement)])

    def timed(self, arm_in: str) -> int:
        """Vehicles of an arm's movements that are seen from 60 m before the junction to its exit."""
        timed = np.isfinite(self.passes.travel_s)
        return sum(int(np.count_nonzero(self._took(m) & timed)) for m in self._from(arm_in))

    def movements_of(self, lane: int) -> list[Movement]:
        """Movements that vehicles of a lane into the junction take, that of most first."""
        mine = np.array([gate.lane == lane for gate in self.gates.gates] + [False])[self.passes.gate_in]
        count = {m.arm_out: int(np.count_nonzero(self._took(m) & mine)) for m in self._from(self.gates.arms_in[lane])}
        taken = [m for m in self._from(self.gates.arms_in[lane]) if count[m.arm_out]]
        return sorted(taken, key=lambda m: -count[m.arm_out])

    def _from(self, arm_in: str) -> list[Movement]:
        return [m for m in self.movements if m.arm_in == arm_in]

    def _took(self, movement: Movement) -> Mask:
        """(n,) passes of a movement whose both ends are known."""
        name = np.array([self.gates.arms[gate.arm].name for gate in self.gates.gates] + [""])
        ends = name[self.passes.gate_in], name[self.passes.gate_out]
        return np.asarray((ends[0] == movement.arm_in) & (ends[1] == movement.arm_out))


def find_movements(
    trajectories: Trajectories,
    graph: LaneGraph,
    *,
    cut_tracks: CutTracks | None = None,
    names: ArmNames | None = None,
) -> tuple[JunctionMovements, ...]:
    """Movements through every junction of a lane graph.

    Parameters
    ----------
    cut_tracks
        Cut tracks of the trajectories, if already known.
    names
        How arms are named; None: by sides of the image.
    """
    cut = join_cut_tracks(trajectories) if cut_tracks is None else cut_tracks
    samples = cut.samples
    slices = ObservedSlices.of(trajectories.observed_s, _SLICE_S)
    inside = [_inside(samples, junction) for junction in graph.junctions]
    meet = [
        rows
        for junction, rows in zip(graph.junctions, inside, strict=True)
        if junction.kind in ("intersection", "roundabout")
    ]
    elsewhere = np.zeros(len(samples), bool)
    elsewhere[np.concatenate([_NOWHERE, *meet])] = True
    waits_elsewhere, waits = np.flatnonzero(elsewhere), _waits(samples)
    out = []
    for junction, rows in zip(graph.junctions, inside, strict=True):
        gates = find_gates(graph, junction, names)
        passes = _passes(samples, rows, gates, waits, waits_elsewhere)
        passes = _within(_by_track(passes, cut), *trajectories.window_s)
        movements, delays_s = _count(junction, gates, passes, slices, trajectories.observed_s)
        out.append(JunctionMovements(junction, gates, passes, movements, delays_s))
    return tuple(out)


def _inside(samples: PathSamples, junction: Junction) -> IntArray:
    """Rows of the samples in the area of a junction."""
    near = within(samples.xy_m, junction.hull_m.min(axis=0), junction.hull_m.max(axis=0))
    return near[inside_hull(samples.xy_m[near], junction.hull_m)]


def find_passes(samples: PathSamples, junction: Junction, gates: Gates) -> Passes:
    """Tracks in the area of a junction."""
    return _passes(samples, _inside(samples, junction), gates, _waits(samples), _NOWHERE)


def _waits(samples: PathSamples) -> IntArray:
    """(rows,) number of stops up to each of the samples, over all tracks."""
    return np.cumsum(np.diff(samples.time_s, prepend=samples.time_s[:1]) > _WAITS_S)


def _passes(samples: PathSamples, inside: IntArray, gates: Gates, waits: IntArray, waits_elsewhere: IntArray) -> Passes:
    """Tracks in the area of a junction, which rows ``inside`` of the samples are in; ``waits_elsewhere``: rows, in
    order, in areas where vehicles wait for each other: delays begin behind the last one."""
    if not len(inside):
        none, number = np.empty(0), np.empty(0, np.int64)
        no = np.empty(0, bool)
        return Passes(number, number, number, none, none, none, no, no, none, none, no, none)
    breaks = np.flatnonzero((np.diff(inside) > 1) | (np.diff(samples.track[inside]) != 0)) + 1
    first, last = inside[np.r_[0, breaks]], inside[np.r_[breaks - 1, len(inside) - 1]]
    enters = (first > 0) & (samples.track[np.maximum(first - 1, 0)] == samples.track[first])
    after = np.minimum(last + 1, len(samples) - 1)
    leaves = (last + 1 < len(samples)) & (samples.track[after] == samples.track[last])
    before = np.maximum(first - ROAD_M, np.searchsorted(samples.track, samples.track[first]))
    behind = np.minimum(last + ROAD_M, np.searchsorted(samples.track, samples.track[last], side="right") - 1)
    gate_in, gate_out = (
        np.where(
            crosses,
            gates.nearest(samples.xy_m[at], samples.direction_rad[at], samples.xy_m[outside], inwards=inwards),
            -1,
        )
        for crosses, at, outside, inwards in ((enters, first, before, True), (leaves, last, behind, False))
    )
    turned = np.angle(np.exp(1j * (samples.direction_rad[behind] - samples.direction_rad[before])))
    # who passes beside all gates, straight on, may be on a lane that is none of the junction's
    of_junction = (gate_in >= 0) | (gate_out >= 0) | (np.abs(turned) > _TURN_RAD)
    came = gates.of_road(samples.xy_m[before], samples.direction_rad[before], inwards=True)
    went = gates.of_road(samples.xy_m[behind], samples.direction_rad[behind], inwards=False)
    gate_in = np.where(enters & of_junction & (gate_in < 0), came, gate_in)
    gate_out = np.where(leaves & of_junction & (gate_out < 0), went, gate_out)
    up = np.maximum(first - _UPSTREAM_M, 0)
    reaches = enters & (samples.track[up] == samples.track[first])
    far = np.maximum(up - _FARTHER_M, np.searchsorted(samples.track, samples.track[first]))
    if len(waits_elsewhere):
        before = np.searchsorted(waits_elsewhere, up, side="right") - 1
        far = np.maximum(far, np.where(before >= 0, waits_elsewhere[before], -1) + 1)
    far = np.where(reaches, np.minimum(far, up), up)
    return Passes(
        samples.track[first],
        gate_in,
        gate_out,
        np.where(enters, samples.time_s[first], np.nan),
        np.where(leaves, samples.time_s[last], np.nan),
        np.where(reaches, samples.time_s[up], np.nan),
        np.zeros(len(first), bool),
        reaches & (waits[last] > waits[up]),
        np.where(reaches, up - far, 0.0),
        np.where(reaches, samples.time_s[up] - samples.time_s[far], 0.0),
        waits[up] > waits[far],
        (last - first).astype(np.float64),
    )


def _by_track(passes: Passes, cut: CutTracks) -> Passes:
    """Passes of vehicles as those of their tracks; joined where a gap lies on the way."""
    if not len(passes.track):
        return passes
    known = np.where(np.isfinite(passes.entry_s), passes.entry_s, passes.exit_s)
    used = np.isfinite(known)
    entry = np.where(np.isfinite(passes.entry_s), passes.entry_s, passes.exit_s)
    leave = np.where(np.isfinite(passes.exit_s), passes.exit_s, passes.entry_s)
    track, joined = np.full(len(used), -1), np.zeros(len(used), bool)
    track[used] = cut.track_at(passes.track[used], known[used])
    joined[used] = cut.has_gap(passes.track[used], entry[used], leave[used])
    made = replace(passes, track=track, joined=joined)
    return made.select(used)


def _within(passes: Passes, begin_s: float, end_s: float) -> Passes:
    time = np.where(np.isfinite(passes.entry_s), passes.entry_s, passes.exit_s)
    keep = (time >= begin_s) & (time <= end_s)
    return passes.select(keep)


def _count(
    junction: Junction, gates: Gates, passes: Passes, slices: ObservedSlices, observed_s: FloatArray
) -> tuple[tuple[Movement, ...], dict[str, Estimate]]:
    """The movements of a junction, and the delay of each arm, by its name, where it is known."""
    arm = np.array([gate.arm for gate in gates.gates] + [-1], np.int64)
    arm_in, arm_out = arm[passes.gate_in], arm[passes.gate_out]
    n = len(gates.arms)
    seen, joined = np.zeros((n, n)), np.zeros((n, n))
    both = (arm_in >= 0) & (arm_out >= 0)
    for counts, rows in ((seen, both & ~passes.joined), (joined, both & passes.joined)):
        np.add.at(counts, (arm_in[rows], arm_out[rows]), 1)
    lost = np.bincount(arm_in[(arm_in >= 0) & (arm_out < 0)], minlength=n).astype(np.float64)
    found = np.bincount(arm_out[(arm_out >= 0) & (arm_in < 0)], minlength=n).astype(np.float64)
    known = seen + joined
    inferred = joined + furness(known, lost, found)
    pairs = [(int(i), int(j)) for i, j in zip(*np.nonzero(known >= MIN_PASSES), strict=True)]
    spread = _spread([passes.travel_s[both & (arm_in == i) & (arm_out == j)] for i, j in pairs])
    timed = both & np.isfinite(passes.travel_s)
    pace = {i: _free_pace(passes.select(timed & (arm_in == i))) for i, _ in pairs}
    of_arm: dict[str, list[_Times]] = {}
    movements = []
    for i, j in pairs:
        rows = both & (arm_in == i) & (arm_out == j)
        total = seen[i, j] + inferred[i, j]
        entering = seen[i].sum() + inferred[i].sum()
        counts = slices.sums(passes.entry_s[rows]) * total / max(known[i, j], 1)
        name_in, name_out = gates.arms[i].name, gates.arms[j].name
        turn = _turn(gates.arms[i], gates.arms[j])
        times = _times(passes.select(rows & timed), pace[i], turn, total / max(known[i, j], 1))
        if times.lost_s is not None:
            of_arm.setdefault(name_in, []).append(times)
        effective = round(float(known[i].sum()))
        share = estimate_share(total / entering * effective, effective)
        movements.append(
            Movement(
                junction.number,
                name_in,
                name_out,
                turn,
                int(seen[i, j]),
                float(inferred[i, j]),
                share,
                estimate_rate(counts, slices.hours),
                _mean_time(times.travel_s, times.travel_s, times.begin_s, observed_s, spread, times.weight),
                _delay([times], observed_s, spread),
                np.array([gates.arms[i].xy_m, junction.centre_m, gates.arms[j].xy_m]),
            )
        )
    delays = {name: _delay(times, observed_s, spread) for name, times in of_arm.items()}
    return tuple(movements), {name: delay for name, delay in delays.items() if delay}


def furness(seen: FloatArray, rows: FloatArray, columns: FloatArray) -> FloatArray:
    """The matrix (n, n) with these sums of rows and columns that is nearest to the seen movements in its ratios.

    Movements that were never seen stay zero. Where rows and columns add up to different totals, the rows count.
    """
    out = seen.copy()
    if rows.sum() == 0 or seen.sum() == 0:
        return np.zeros_like(seen)
    known = rows * (seen.sum(axis=1) > 0)
    target = columns * (seen.sum(axis=0) > 0)
    target = target * (known.sum() / target.sum()) if target.sum() > 0 else seen.sum(axis=0) * known.sum() / seen.sum()
    # Where few exits are of unknown origin their shares are noise: the seen ones' are mixed in.
    prior = seen.sum(axis=0) * known.sum() / seen.sum()
    weight = columns.sum() / (columns.sum() + 10.0)
    target = weight * target + (1 - weight) * prior
    for _ in range(_FURNESS_STEPS):
        out *= (target / np.maximum(out.sum(axis=0), 1e-12))[None, :]
        out *= (known / np.maximum(out.sum(axis=1), 1e-12))[:, None]
    return np.asarray(out)


def _spread(times_s: Sequence[FloatArray]) -> tuple[float, int]:
    """Standard deviation of travel times about their movement's mean, and the number of vehicles that it counts for."""
    known = [times[np.isfinite(times)] for times in times_s]
    used = [times for times in known if len(times) > 1]
    degrees = sum(len(times) - 1 for times in used)
    squares = sum(float(((times - times.mean()) ** 2).sum()) for times in used)
    return (float(np.sqrt(squares / degrees)), _SPREAD_N) if degrees else (0.0, 0)


@dataclass(frozen=True)
class _Times:
    """Times (n,) of the passes of a movement that are seen from upstream to their exit, s.

    ``travel_s`` from ``begin_s`` on; ``whole_s``: what they need longer farther back than a free vehicle added;
    ``lost_s``: what of that a free one does not need, None where that is not known. ``weight`` (n,): vehicles that each
    stands for.
    """

    begin_s: FloatArray
    travel_s: FloatArray
    whole_s: FloatArray
    lost_s: FloatArray | None
    weight: FloatArray


def _free_pace(passes: Passes) -> float | None:
    """Time a metre of the fastest tenth of vehicles that come to a junction and do not stop on the way, farther away
    than its delays begin."""
    goes = (passes.farther_m >= _PACED_M) & ~passes.farther_stood
    if goes.sum() < _MIN_FREE:
        return None
    return float(np.quantile(passes.farther_s[goes] / passes.farther_m[goes], 0.1))


def _times(passes: Passes, pace: float | None, turn: Turn, weight: float) -> _Times:
    """Times of a movement's passes: a free vehicle's is that of the fastest tenth of those that do not stop; where
    hardly any passes without a stop, as where a queue never clears, that at the pace of those that come."""
    whole = passes.travel_s
    if pace is not None:
        whole = whole + np.maximum(passes.farther_s - pace * passes.farther_m, 0.0)
    free = ~passes.stood
    least = None
    if free.sum() >= _MIN_FREE:
        least = float(np.quantile(passes.travel_s[free], 0.1))
    elif pace is not None and len(whole):
        inside = pace * float(np.median(passes.inside_m))
        if turn != "straight":  # nobody turns at the pace of the road
            inside = max(inside, float(np.quantile(passes.exit_s - passes.entry_s, 0.1)))
        least = pace * _UPSTREAM_M + inside
    lost = None if least is None else whole - least
    return _Times(passes.upstream_s, passes.travel_s, whole, lost, np.full(len(whole), weight))


def _delay(of: Sequence[_Times], observed_s: FloatArray, spread: tuple[float, int]) -> Estimate | None:
    """Mean delay of the vehicles of some movements; None of fewer than ten whose delay is known, or seen too short."""
    known = [(t.lost_s, t.whole_s, t.begin_s, t.weight) for t in of if t.lost_s is not None]
    if sum(len(row[0]) for row in known) < MIN_DELAYED or np.diff(observed_s).max() < MIN_DELAY_S:
        return None
    lost, whole, begin, weight = map(np.concatenate, zip(*known, strict=True))
    delay = _mean_time(lost, whole, begin, observed_s, spread, weight)
    return replace(delay, low=max(delay.low, 0.0)) if delay else None


def _mean_time(
    value_s: FloatArray,
    whole_s: FloatArray,
    begin_s: FloatArray,
    observed_s: FloatArray,
    spread: tuple[float, int],
    weight: FloatArray,
) -> Estimate | None:
    """Mean of values (n,) of passes that begin at times and take so long: those that take long are more often cut by
    the begin and the end of what is seen, and weigh more."""
    clip_s = np.diff(observed_s, axis=1)
    weight = weight / np.maximum(np.maximum(clip_s - whole_s, 0.0).sum(axis=0) / clip_s.sum(), _LEAST_SEEN)
    weight = weight / weight.mean() if len(weight) else weight
    mean = float((weight * value_s).mean()) if len(value_s) else 0.0
    return estimate_mean(mean + weight * (value_s - mean), begin_s, spread=spread)


def _turn(arm_in: Arm, arm_out: Arm) -> Turn:
    """The turn from one arm to another."""
    if arm_in.number == arm_out.number:
        return "u-turn"
    angle = float(np.angle(-np.exp(1j * (arm_out.outward_rad - arm_in.outward_rad))))
    if abs(angle) < _TURN_RAD:
        return "straight"
    return "right" if angle > 0 else "left"
