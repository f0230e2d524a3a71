"""Before and after: what two flights over one place differ in, and whether that is more than chance.

Junctions are matched by their place, movements by their arms, roads by theirs. The false discovery rate over all
comparisons is held (Benjamini and Hochberg, 1995).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import special

from schemas.arrays import FloatArray
from velfield.analysis.intervals import LEVEL, Estimate
from velfield.analysis.movements.movements import JunctionMovements
from velfield.analysis.traffic_analysis import TrafficAnalysis

FDR_LEVEL = 0.05
_NEAR_M = 15.0
"""Junctions, and middles of lanes, nearer than this are the same."""


@dataclass(frozen=True)
class Change:
    """A quantity before and after: ``what`` it is, in ``unit``, at ``xy_m``; whether it differs by more than chance."""

    what: str
    unit: str
    xy_m: FloatArray
    before: Estimate
    after: Estimate
    p_value: float
    significant: bool

    @property
    def change(self) -> float:
        """After less before."""
        return self.after.value - self.before.value


Quantity = tuple[str, str, FloatArray, Estimate | None, Estimate | None]


def find_changes(before: TrafficAnalysis, after: TrafficAnalysis) -> list[Change]:
    """All quantities that both flights have an estimate of, the surest changes first."""
    pairs = [q for q in (*_junctions(before, after), *_roads(before, after)) if q[3] is not None and q[4] is not None]
    p = np.array([p_value(a, b) for _, _, _, a, b in pairs if a is not None and b is not None])
    real = _discoveries(p)
    made = [
        Change(what, unit, xy, a, b, float(p[k]), bool(real[k]))
        for k, (what, unit, xy, a, b) in enumerate(pairs)
        if a is not None and b is not None
    ]
    return sorted(made, key=lambda change: change.p_value)


def p_value(a: Estimate, b: Estimate) -> float:
    """Probability of so large a difference by chance, by the standard errors of the two intervals."""
    z = special.ndtri((1 + LEVEL) / 2)
    error = np.hypot((a.high - a.low) / (2 * z), (b.high - b.low) / (2 * z))
    return float(2 * special.ndtr(-abs(a.value - b.value) / max(float(error), 1e-12)))


def _discoveries(p: FloatArray) -> FloatArray:
    """Which p-values are significant at the false discovery rate."""
    n = len(p)
    order = np.argsort(p)
    passed = np.flatnonzero(p[order] <= FDR_LEVEL * np.arange(1, n + 1) / max(n, 1))
    out = np.zeros(n, bool)
    if len(passed):
        out[order[: passed[-1] + 1]] = True
    return out


def common_junctions(
    before: TrafficAnalysis, after: TrafficAnalysis
) -> Iterator[tuple[JunctionMovements, JunctionMovements]]:
    """Junctions that both flights have."""
    for old in before.movements:
        away = [float(np.hypot(*(new.junction.centre_m - old.junction.centre_m))) for new in after.movements]
        if min(away, default=np.inf) < _NEAR_M:
            yield old, after.movements[int(np.argmin(away))]


def _junctions(before: TrafficAnalysis, after: TrafficAnalysis) -> Iterator[Quantity]:
    """Cycles, shares, flows, travel times and delays at junctions that both flights have."""
    for old, new in common_junctions(before, after):
        centre = old.junction.centre_m
        name = f"{before.junction_kind(old.junction.number)} at {centre[0]:.0f}, {centre[1]:.0f} m"
        a, b = before.signals.get(old.junction.number), after.signals.get(new.junction.number)
        yield f"cycle, {name}", "s", centre, a.cycle_s if a else None, b.cycle_s if b else None
        known = {(m.arm_in, m.arm_out): m for m in new.movements}
        for m in old.movements:
            if other := known.get((m.arm_in, m.arm_out)):
                way = f"from {m.arm_in} to {m.arm_out}, {name}"
                yield f"share {way}", "", centre, m.share, other.share
                yield f"flow {way}", "veh/h", centre, m.flow_veh_per_h, other.flow_veh_per_h
                yield f"travel time {way}", "s", centre, m.travel_time_s, other.travel_time_s
                whole = not any(a.delay_is_partial(k.junction, m.arm_in) for a, k in ((before, m), (after, other)))
                if whole:  # of lower bounds no difference is known
                    yield f"delay {way}", "s", centre, m.delay_s, other.delay_s


def _roads(before: TrafficAnalysis, after: TrafficAnalysis) -> Iterator[Quantity]:
    """Free-flow speeds of roads that both flights have."""
    middles = {k: after.lanes.lanes[road.lanes[0]].at(20.0) for k, road in enumerate(after.free_flow)}
    for road in before.free_flow:
        lane = before.lanes.lanes[road.lanes[0]]
        heading = float(np.interp(20.0, lane.along_m, np.unwrap(lane.direction_rad)))
        for k, xy in middles.items():
            other = after.lanes.lanes[after.free_flow[k].lanes[0]]
            turn = np.cos(heading - float(np.interp(20.0, other.along_m, np.unwrap(other.direction_rad))))
            if np.hypot(*(xy - lane.at(20.0))) < 5.0 and turn > 0.9:
                what = f"free-flow speed at {xy[0]:.0f}, {xy[1]:.0f} m"
                yield what, "m/s", xy, road.speed_m_per_s, after.free_flow[k].speed_m_per_s
