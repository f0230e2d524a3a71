"""Approaches of a junction for people: names of their lanes, delay, level of service."""

from dataclasses import dataclass

from velfield.analysis.flow.volume import LOS_SIGNAL_S, LOS_YIELD_S, level_of_service
from velfield.analysis.movements.movements import JunctionMovements
from velfield.analysis.traffic_analysis import TrafficAnalysis


@dataclass(frozen=True)
class ApproachDelay:
    """Mean delay of the vehicles that enter by an arm, its level of service, and where the next levels begin.

    The level is empty, and its limits none, where it is not known whether there is a signal. ``partly``: queues
    end out of view. ``low_s`` and ``high_s``: the 90 % interval, of ``n`` vehicles whose delay
    is known.
    """

    arm: str
    delay_s: float
    vehicles: float
    level: str
    limits_s: tuple[float, ...]
    partly: bool
    low_s: float
    high_s: float
    n: int

    @property
    def level_text(self) -> str:
        """The level, for people: the best that it can be."""
        return f"{self.level} or worse" if self.level and self.partly else self.level

    @property
    def text(self) -> str:
        """The delay and its level, for people."""
        level = f" (level of service {self.level_text})" if self.level else ""
        return f"{self.delay_s:.0f} s{level}"


def approach_delays(analysis: TrafficAnalysis, found: JunctionMovements) -> list[ApproachDelay]:
    """Delay by arm, the mean over its movements weighted by their vehicles; the longest first."""
    signalised = analysis.is_signalised(found.junction.number)
    out = []
    for arm in dict.fromkeys(m.arm_in for m in found.movements):
        known = [(m.delay_s, m.seen + m.inferred) for m in found.movements if m.arm_in == arm and m.delay_s]
        vehicles = sum(n for _, n in known)
        if vehicles:
            delay = sum(one.value * n for one, n in known) / vehicles
            half = [
                sum(((getattr(one, end) - one.value) * n / vehicles) ** 2 for one, n in known) ** 0.5
                for end in ("low", "high")
            ]
            level = level_of_service(delay, signalised=signalised)
            limits = {None: (), True: LOS_SIGNAL_S, False: LOS_YIELD_S}[signalised]
            partly = analysis.delay_is_partial(found.junction.number, arm)
            n = sum(one.n for one, _ in known)
            out.append(ApproachDelay(arm, delay, vehicles, level, limits, partly, delay - half[0], delay + half[1], n))
    return sorted(out, key=lambda one: -one.delay_s)


def lane_names(found: JunctionMovements) -> dict[int, str]:
    """``from W, lane 3`` of each lane that leads into a junction."""
    gates = found.gates
    return {g.lane: f"from {gates.arms[g.arm].name}, lane {g.lane}" for g in gates.gates if g.inwards}
