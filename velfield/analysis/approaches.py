"""Approaches of a junction for people: names of their lanes, delay, level of service, queues."""

from collections.abc import Sequence
from dataclasses import dataclass
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

    The two are chosen by their delays, so the interval is that of the range of all of them.

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
    """
    lacks = f"whether it is fair is not known: the delay from {list_text(unknown)} is not" if unknown else ""
    if len(delays) < 2:
        return lacks
    longest, shortest = delays[0], delays[-1]
    sd_s = [(d.delay_s.high - d.delay_s.low) / (2 * stats.norm.ppf(0.95)) for d in (longest, shortest)]
    reach_s = float(stats.studentized_range.ppf(0.9, len(delays), np.inf)) * hypot(*sd_s) / sqrt(2)
    by_s = longest.delay_s.value - shortest.delay_s.value
    if by_s < reach_s and lacks:
        return f"{lacks}; those from {list_text([d.arm for d in delays])} are within {by_s:.0f} s"
    least, most = f"{by_s - reach_s:.0f}", f"{by_s + reach_s:.0f}"
    if by_s < reach_s:
        part = ", in view," if longest.partly or shortest.partly else ""
        by = f"by {by_s:.0f} s, at most by {most} s with 90 % probability"
        return f"it is not shown to be unfair: mean delays{part} differ {by}"
    longer = f"at least {least} s" if longest.partly else f"{by_s:.0f} s ({least} to {most})"
    return (
        f"it is not fair by waiting time: vehicles from {longest.arm} wait {longer} longer than those from "
        f"{shortest.arm}"
        + (", as far as is seen" if shortest.partly else "")
        + (f"; the delay from {list_text(unknown)} is not known" if unknown else "")
    )


def lane_names(found: JunctionMovements) -> dict[int, str]:
    """``from W, lane 3`` of each lane that leads into a junction."""
    return {lane: f"from {arm}, lane {lane}" for lane, arm in found.gates.arms_in.items()}


def longest_queues(analysis: TrafficAnalysis, found: JunctionMovements) -> dict[str, tuple[int, Queue]]:
    """The longest queue at a green of each arm of a junction whose signal is known, where vehicles queue, and its
    lane."""
    signal, arm = analysis.signals.get(found.junction.number), found.gates.arms_in
    out: dict[str, tuple[int, Queue]] = {}
    for stream in signal.streams if signal else ():
        lane = stream.stream.approach.lane
        name = arm.get(lane)
        for queue in stream.queues:
            if name and queue.vehicles.value and (name not in out or queue.length_m > out[name][1].length_m):
                out[name] = lane, queue
    return out


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
