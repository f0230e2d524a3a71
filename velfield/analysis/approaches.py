"""Approaches of a junction for people: names of their lanes, delay, level of service, queues."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import hypot, sqrt

import numpy as np
from scipy import stats

from schemas.analysis import Turn
from velfield.analysis.flow.volume import LOS_SIGNAL_S, LOS_YIELD_S, delay_level
from velfield.analysis.intervals import Estimate
from velfield.analysis.movements.movements import JunctionMovements
from velfield.analysis.signals.cycles import Queue
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.errors import count_text, list_text

TURNS: dict[Turn, str] = {"straight": "straight on", "left": "left", "right": "right", "u-turn": "back"}
"""Turns for people."""


@dataclass(frozen=True)
class ApproachDelay:
    """Mean delay of the vehicles that enter by an arm, its level of service, and where the next levels begin.

    The level is one, or those that the interval reaches, as ``C to D``; it is empty, and its limits none, where it is
    not known whether there is a signal. ``partly``: queues end out of view.
    """

    arm: str
    delay_s: Estimate
    level: str
    limits_s: tuple[float, ...]
    partly: bool

    @property
    def estimate_s(self) -> Estimate | None:
        """The delay with its interval; None where a part of the wait is out of view."""
        return None if self.partly else self.delay_s

    @property
    def value_text(self) -> str:
        """The delay alone, its lower bound where a part of the wait is out of view: ``25 s``, ``at least 20 s``."""
        return f"at least {self.delay_s.low:.0f} s" if self.partly else f"{self.delay_s.value:.0f} s"

    @property
    def text(self) -> str:
        """The delay, its interval and its level, for people."""
        delay, level = self.delay_s, f", level of service {self.level}" if self.level else ""
        ends = "" if self.partly else f"{delay.low:.0f} to {delay.high:.0f}, "
        return f"{self.value_text} ({ends}n {delay.n}){level}"


def approach_delays(analysis: TrafficAnalysis, found: JunctionMovements) -> list[ApproachDelay]:
    """Delay by arm, the longest first."""
    number = found.junction.number
    signalised = analysis.is_signalised(number)
    limits = {None: (), True: LOS_SIGNAL_S, False: LOS_YIELD_S}[signalised]
    out = []
    for arm, delay in found.delays_s.items():
        partly = analysis.delay_is_partial(number, arm)
        out.append(ApproachDelay(arm, delay, delay_level(delay, signalised=signalised, partly=partly), limits, partly))
    return sorted(out, key=lambda one: -one.delay_s.value)


def arms_without_delay(found: JunctionMovements, delays: Sequence[ApproachDelay]) -> list[str]:
    """Arms by which vehicles enter a junction, and whose delay is not known."""
    return sorted({m.arm_in for m in found.movements} - {d.arm for d in delays})


def compare_delays(delays: Sequence[ApproachDelay], unknown: Sequence[str] = ()) -> str:
    """By how much the first approach, with the longest delay, waits longer than the last; or that none is shown to.

    The two are chosen by their delays, so the interval is that of the range of all of them. A delay that is a lower
    bound has no upper one, nor has its difference from another; and no other is shown to be longer than it.

    Parameters
    ----------
    unknown
        Arms whose delay is not known: vehicles may wait longest there.

    Examples
    --------
    >>> east = ApproachDelay("E", Estimate(46, 39, 53, 60), "", (), False)
    >>> west = ApproachDelay("W", Estimate(22, 15, 29, 60), "", (), False)
    >>> compare_delays([east, west])
    'it is not fair by waiting time: vehicles from E wait 24 s (14 to 34) longer than those from W'
    >>> compare_delays([west, west])
    'it is not shown to be unfair: mean delays differ by 0 s, at most by 10 s with 90 % probability'
    >>> compare_delays([west], ["E", "N"])
    'whether it is fair is not known: the delay from E and N is not'
    >>> compare_delays([west, west], ["N"])
    'whether it is fair is not known: the delay from N is not; those from W and W are within 0 s'
    >>> compare_delays([west, ApproachDelay("S", Estimate(21, 14, 28, 60), "", (), True)])
    'whether it is fair is not known: vehicles from S wait at least 14 s, and longer out of view'
    """
    known, beyond = ([d for d in delays if d.partly is partly] for partly in (False, True))
    missing = [f"the delay from {list_text(unknown)} is not"] if unknown else []
    if len(delays) > 1:
        missing += [f"vehicles from {d.arm} wait {d.value_text}, and longer out of view" for d in beyond]
    lacks = f"whether it is fair is not known: {'; '.join(missing)}" if missing else ""
    if len(delays) < 2 or not known:
        return lacks
    shortest = known[-1]
    for longest in delays[0], known[0]:
        by_s = longest.delay_s.value - shortest.delay_s.value
        sd_s = [(d.delay_s.high - d.delay_s.low) / (2 * stats.norm.ppf(0.95)) for d in (longest, shortest)]
        reach_s = float(stats.studentized_range.ppf(0.9, len(delays), np.inf)) * hypot(*sd_s) / sqrt(2)
        if by_s >= reach_s and longest is not shortest:
            by = f"{by_s:.0f} s ({by_s - reach_s:.0f} to {by_s + reach_s:.0f})"
            longer = f"at least {by_s - reach_s:.0f} s" if longest.partly else by
            more = [f"; those from {d.arm} wait {d.value_text}, and longer out of view" for d in beyond if d != longest]
            more += [f"; the delay from {list_text(unknown)} is not known"] if unknown else []
            who = f"vehicles from {longest.arm} wait {longer} longer than those from {shortest.arm}"
            return f"it is not fair by waiting time: {who}{''.join(more)}"
    if lacks and len(known) > 1:
        return f"{lacks}; those from {list_text([d.arm for d in known])} are within {by_s:.0f} s"
    most = f"{by_s + reach_s:.0f} s with 90 % probability"
    return lacks or f"it is not shown to be unfair: mean delays differ by {by_s:.0f} s, at most by {most}"


def wait_longest(delays: Sequence[ApproachDelay]) -> list[str]:
    """Arms from which vehicles may wait longest, as far as delays are known.

    Examples
    --------
    >>> at = lambda arm, s, partly: ApproachDelay(arm, Estimate(s, s - 5, s + 5, 40), "", (), partly)
    >>> wait_longest([at("E", 46, False), at("S", 25, True), at("N", 22, False)])
    ['E', 'S']
    """
    least_s = max(d.delay_s.low for d in delays)
    return [d.arm for d in delays if d.partly or d.delay_s.high >= least_s]


def lane_names(found: JunctionMovements) -> dict[int, str]:
    """``from W, lane 3`` of each lane that leads into a junction."""
    return {lane: f"from {arm}, lane {lane}" for lane, arm in found.gates.arms_in.items()}


@dataclass(frozen=True)
class ArmQueue:
    """The longest queue of an arm: ``queue``, of a ``lane``, if it was not on one of the lanes ``alike``.

    ``vehicles`` with their interval; None: there is no upper bound, as a queue ends out of view or is not known.
    """

    lane: int
    queue: Queue
    alike: tuple[int, ...]
    vehicles: Estimate | None

    @property
    def text(self) -> str:
        """The queue for people: ``at least 8 vehicles, 52 m; on lane 0 it may have been as long``."""
        queue = self.queue
        if self.vehicles or queue.reaches_edge:
            said = queue_text(queue)
        else:
            said = f"at least {count_text(queue.vehicles.low, 'vehicle')}, {queue.length_m:.0f} m"
        return said + (f"; on {lanes_text(self.alike)} it may have been as long" if self.alike else "")


def longest_queues(analysis: TrafficAnalysis, found: JunctionMovements) -> dict[str, ArmQueue]:
    """The longest queue of each arm of a junction whose signal is known, where vehicles queue, the longest first."""
    by_arm: dict[str, dict[int, Queue | None]] = {}
    for lane, queue in analysis.lane_queues.get(found.junction.number, {}).items():
        by_arm.setdefault(found.gates.arms_in.get(lane, ""), {})[lane] = queue
    out = {}
    for arm, queues in by_arm.items():
        known = {lane: queue for lane, queue in queues.items() if queue}
        if known:
            lane, longest = max(known.items(), key=lambda item: (item[1].length_m, -item[0]))
            least = longest.vehicles.low
            alike = {k: q for k, q in queues.items() if k != lane and _reach(q) >= least}
            most = max(_reach(longest), *map(_reach, alike.values()), 0.0)
            vehicles = replace(longest.vehicles, high=most) if most < np.inf else None
            out[arm] = ArmQueue(lane, longest, tuple(sorted(alike)), vehicles)
    return dict(sorted(out.items(), key=lambda item: -item[1].queue.length_m))


def _reach(queue: Queue | None) -> float:
    """Upper bound of the vehicles of a queue, which may not be known."""
    return np.inf if queue is None or queue.reaches_edge else queue.vehicles.high


def lanes_without_queue(analysis: TrafficAnalysis, found: JunctionMovements) -> dict[str, list[int]]:
    """Lanes by arm on which vehicles stand before a junction whose signal is known, in a queue that is not."""
    out: dict[str, list[int]] = {}
    for lane, queue in analysis.lane_queues.get(found.junction.number, {}).items():
        if queue is None:
            out.setdefault(found.gates.arms_in.get(lane, ""), []).append(lane)
    return out


def lanes_text(lanes: Sequence[int]) -> str:
    """Lanes by their numbers.

    Examples
    --------
    >>> lanes_text([2]), lanes_text([0, 1])
    ('lane 2', 'lanes 0, 1')
    """
    return f"lane{'s' if len(lanes) != 1 else ''} {', '.join(map(str, lanes))}"


def lane_text(found: JunctionMovements, lane: int) -> str:
    """A lane into a junction by the ways that its vehicles go: ``straight on to E and right to S (lane 0)``."""
    ways = [f"{TURNS[m.turn]} to {m.arm_out}" for m in found.movements_of(lane)]
    return f"{list_text(ways)} (lane {lane})" if ways else f"on lane {lane}"


def queue_text(queue: Queue) -> str:
    """Vehicles of a queue, with their interval, and its length; of one whose end is not seen lower bounds.

    Examples
    --------
    >>> queue_text(Queue(12.0, Estimate(4, 3, 6, 3), 23.4))
    '4 vehicles (3 to 6), 23 m'
    >>> queue_text(Queue(12.0, Estimate(14, 14, 14, 14), 92.0, reaches_edge=True))
    'at least 14 vehicles, 92 m and more: it ends out of view'
    """
    n = queue.vehicles
    if queue.reaches_edge:
        return f"at least {count_text(n.low, 'vehicle')}, {queue.length_m:.0f} m and more: it ends out of view"
    ends = f" ({n.low:.0f} to {n.high:.0f})" if n.low < n.high else ""
    return f"{count_text(n.value, 'vehicle')}{ends}, {queue.length_m:.0f} m"
