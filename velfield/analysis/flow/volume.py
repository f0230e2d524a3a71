"""Volume, density and space-mean speed of lanes by Edie's definitions; headways; levels of service."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from schemas.arrays import FloatArray, IntArray
from velfield.analysis.flow.passings import LaneTraffic
from velfield.analysis.intervals import (
    MIN_VEHICLES,
    Estimate,
    estimate_mean,
    estimate_median,
    estimate_rate,
    independent_vehicles,
)
from velfield.analysis.lanes.model import LaneSamples
from velfield.analysis.observed import ObservedSlices
from velfield.analysis.trajectories import SAMPLES_M, VEHICLE_LENGTH_M

_FOLLOW_S = 3.0
"""A vehicle with a shorter headway follows the one before."""
_SPREAD, _SPREAD_N = 0.25, 8
"""Speeds on a lane have this coefficient of variation before any is seen; it counts for so many vehicles."""
_AT_END_M = 1e-6
_MIN_SLICE_S = 40.0
"""A shorter slice of time is no point of a fundamental diagram."""
LOS_SIGNAL_S = (10.0, 20.0, 35.0, 55.0, 80.0)
"""Control delay, s, up to which levels A to E reach at signals: Highway Capacity Manual, 7th edition, Exhibit 19-8."""
LOS_YIELD_S = (10.0, 15.0, 25.0, 35.0, 50.0)
"""The same without signals: Exhibits 20-2 (stop control) and 22-8 (roundabouts)."""


@dataclass(frozen=True)
class LaneFlow:
    """Traffic of a lane."""

    lane: int
    flow_veh_per_h: Estimate | None
    """At the middle of the lane."""
    density_veh_per_km: Estimate | None
    space_mean_speed_m_per_s: Estimate | None
    """Time spent on the lane over its length and the time; distance driven over time spent (Edie)."""
    headway_s: Estimate | None
    gap_s: Estimate | None
    """Mean headway; median time gap of those that follow, rear bumper to front bumper."""


@dataclass(frozen=True)
class FlowSlices:
    """Edie's flow (veh/h), density (veh/km) and speed (m/s; NaN without traffic) of a lane by slice of time."""

    slices: ObservedSlices
    flow_veh_per_h: FloatArray
    density_veh_per_km: FloatArray
    speed_m_per_s: FloatArray
    samples: LaneSamples

    @cached_property
    def vehicles(self) -> IntArray:
        """Number of vehicles on the lane by slice."""
        number = self.slices.number(self.samples.time_s)
        pairs = np.unique(np.column_stack([number, self.samples.track])[number >= 0], axis=0)
        return np.bincount(pairs[:, 0], minlength=len(self.slices))

    @cached_property
    def points(self) -> IntArray:
        """The slices that are points of the lane's fundamental diagram: with vehicles enough, and long enough."""
        lasts = self.slices.end_s - self.slices.begin_s >= _MIN_SLICE_S
        # on a lane of a metre or two vehicles have one sample each, and no speed
        return np.flatnonzero(lasts & (self.vehicles >= MIN_VEHICLES) & np.isfinite(self.speed_m_per_s))


def lane_flow(
    traffic: LaneTraffic,
    lane: int,
    observed_s: FloatArray,
    *,
    lengths_m: FloatArray | None = None,
) -> LaneFlow:
    """Traffic of one lane.

    Parameters
    ----------
    observed_s
        (k, 2) begins and ends of the times that are seen, in time order.
    lengths_m
        (tracks,) lengths of the vehicles; None: a car's.
    """
    by_slice = flow_slices(traffic, lane, observed_s)
    passing = traffic.passings(lane, traffic.graph.lanes[lane].length_m / 2)
    # the first vehicle after a gap follows nobody that is known
    period = np.searchsorted(observed_s[:, 0], passing.time_s, side="right")
    headway = np.where(np.diff(period, prepend=period[:1]) == 0, passing.headway_s, np.nan)
    follows = headway < _FOLLOW_S
    length = np.full(len(passing), VEHICLE_LENGTH_M) if lengths_m is None else lengths_m[passing.track]
    between = (length + np.r_[length[:1], length[:-1]]) / 2  # the leader's rear half, the follower's front half
    gap = headway[follows] - between[follows] / np.maximum(passing.speed_m_per_s[follows], 1.0)
    enough = len(passing) >= 5
    driven, spent, at = _by_track(traffic.samples(lane), traffic.graph.lanes[lane].length_m)
    return LaneFlow(
        lane,
        estimate_rate(by_slice.slices.sums(passing.time_s), by_slice.slices.hours),
        _density(by_slice.density_veh_per_km, spent, at) if enough else None,
        _space_mean_speed(driven, spent, at),
        estimate_mean(headway),
        estimate_median(gap[gap > 0], passing.time_s[follows][gap > 0]),
    )


def flow_slices(traffic: LaneTraffic, lane: int, observed_s: FloatArray, *, slice_s: float = 60.0) -> FlowSlices:
    """Edie's quantities of one lane by slice of the times (k, 2) that are seen."""
    samples, length = traffic.samples(lane), traffic.graph.lanes[lane].length_m
    slices = ObservedSlices.of(observed_s, slice_s)
    rows, step, wait = _steps(samples, length)
    begin = samples.time_s[rows]
    whole = slices.number(begin) == slices.number(begin + wait)
    driven, spent = (slices.sums(begin[whole], weights[whole]) for weights in (step, wait))
    begin, step, wait = begin[~whole], step[~whole], wait[~whole]  # these spread over slices
    for part in range(8):
        at = begin + wait * (part + 0.5) / 8
        driven += slices.sums(at, step / 8)
        spent += slices.sums(at, wait / 8)
    area = length * np.maximum(slices.end_s - slices.begin_s, 1e-9)
    speed = np.divide(driven, spent, out=np.full(len(slices), np.nan), where=spent > 0)
    return FlowSlices(slices, driven / area * 3600, spent / area * 1000, speed, samples)


def _density(density: FloatArray, spent: FloatArray, at: FloatArray) -> Estimate | None:
    """Mean density of slices. A few slices may be alike by chance, so one more is added to them, as far from their mean
    as vehicles would bring it that come at random and each spend their time (n,) on the lane."""
    if len(spent) < 2:
        return None
    clusters = len(spent) / max(independent_vehicles(spent, at), 2.0)
    share = np.sqrt((spent**2).sum() / spent.sum() ** 2 * clusters)
    return estimate_mean(density, spread=(float(density.mean() * share * np.sqrt(len(density))), 1))


def _steps(samples: LaneSamples, length_m: float) -> tuple[IntArray, FloatArray, FloatArray]:
    """Rows of the samples from which a track goes on along the lane, how far, m, and how long it takes, s."""
    one = samples.track[1:] == samples.track[:-1]
    step = np.where(one, samples.along_m[1:] - samples.along_m[:-1], 0.0)
    wait = np.where(one, samples.time_s[1:] - samples.time_s[:-1], 0.0)
    # what lies beyond the lane's ends stands at them: of a step over an end the time on the lane alone counts
    beyond = (samples.along_m < _AT_END_M) | (samples.along_m > length_m - _AT_END_M)
    wait = np.where(beyond[1:] | beyond[:-1], wait * np.minimum(step / SAMPLES_M, 1.0), wait)
    rows = np.flatnonzero(one & (step >= 0) & (step < 20.0) & (wait > 0))
    return rows, step[rows], wait[rows]


def _by_track(samples: LaneSamples, length_m: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(tracks,) distance driven, time spent, and when, of the tracks on a lane, whose samples are by track."""
    rows, step, wait = _steps(samples, length_m)
    of = np.cumsum(np.diff(samples.track[rows], prepend=samples.track[rows[:1]]) != 0)
    driven, spent, at = (np.bincount(of, w).astype(np.float64) for w in (step, wait, samples.time_s[rows] * wait))
    return driven, spent, at / spent


def _space_mean_speed(driven: FloatArray, spent: FloatArray, at: FloatArray) -> Estimate | None:
    """Distance driven over time spent of all vehicles on a lane, by the ratio estimator."""
    if not len(spent):
        return None
    ratio = float(driven.sum() / spent.sum())
    off = estimate_mean((driven - ratio * spent) / spent.mean(), at, spread=(_SPREAD * ratio, _SPREAD_N))
    return Estimate(ratio, max(ratio + off.low, 0.0), ratio + off.high, off.n) if off else None


def delay_level(delay_s: Estimate, *, signalised: bool | None, partly: bool) -> str:
    """Level of service of a mean delay: one, or those that its interval reaches; of a part of one at least the best.

    Examples
    --------
    >>> delay_level(Estimate(23.0, 17.0, 28.0, 53), signalised=True, partly=False)
    'B to C'
    >>> delay_level(Estimate(23.0, 17.0, 28.0, 53), signalised=True, partly=True)
    'B or worse'
    """
    best, worst = (level_of_service(max(end, 0.0), signalised=signalised) for end in (delay_s.low, delay_s.high))
    if partly:
        return f"{best} or worse" if best not in ("", "F") else best
    return best if best == worst else f"{best} to {worst}"


def level_of_service(delay_s: float, *, signalised: bool | None) -> str:
    """Level of service A to F by the control delay; empty where it is not known whether there is a signal.

    Examples
    --------
    >>> level_of_service(12.0, signalised=True), level_of_service(51.0, signalised=False)
    ('B', 'F')
    """
    if signalised is None:
        return ""
    limits = LOS_SIGNAL_S if signalised else LOS_YIELD_S
    return "ABCDEF"[int(np.searchsorted(limits, delay_s))]
