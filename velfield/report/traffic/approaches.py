"""Approaches of a junction for people: names of their lanes, delay, level of service."""

from dataclasses import dataclass

from velfield.analysis.flow.volume import LOS_SIGNAL_S, LOS_YIELD_S, level_of_service
from velfield.analysis.movements.movements import JunctionMovements
from velfield.analysis.traffic_analysis import TrafficAnalysis


@dataclass(frozen=True)
class ApproachDelay:
    """Mean delay of the vehicles that enter by an arm, its level of service, and where the next levels begin.

    The level is empty, and its limits none, where it is not known whether there is a signal.
    """

    arm: str
    delay_s: float
    vehicles: float
    level: str
    limits_s: tuple[float, ...]


def approach_delays(analysis: TrafficAnalysis, found: JunctionMovements) -> list[ApproachDelay]:
    """Delay by arm, the mean over its movements weighted by their vehicles; the longest first."""
    signalised = analysis.is_signalised(found.junction.number)
    out = []
    for arm in dict.fromkeys(m.arm_in for m in found.movements):
        known = [(m.delay_s.value, m.seen + m.inferred) for m in found.movements if m.arm_in == arm and m.delay_s]
        vehicles = sum(n for _, n in known)
        if vehicles:
            delay = sum(value * n for value, n in known) / vehicles
            level = level_of_service(delay, signalised=signalised)
            limits = {None: (), True: LOS_SIGNAL_S, False: LOS_YIELD_S}[signalised]
            out.append(ApproachDelay(arm, delay, vehicles, level, limits))
    return sorted(out, key=lambda one: -one.delay_s)


def lane_names(found: JunctionMovements) -> dict[int, str]:
    """``from W, lane 3`` of each lane that leads into a junction."""
    gates = found.gates
    return {g.lane: f"from {gates.arms[g.arm].name}, lane {g.lane}" for g in gates.gates if g.inwards}
