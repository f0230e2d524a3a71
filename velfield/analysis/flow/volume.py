"""Volume, density and space-mean speed of lanes by Edie's definitions; headways; levels of service."""

from dataclasses import dataclass

import numpy as np

from schemas.arrays import FloatArray
from velfield.analysis.flow.passings import LaneTraffic
from velfield.analysis.intervals import Estimate, estimate_mean, estimate_median, estimate_rate
from velfield.analysis.observed import ObservedSlices
from velfield.analysis.trajectories import VEHICLE_LENGTH_M

_FOLLOW_S = 3.0
"""A vehicle with a shorter headway follows the one before."""
LOS_SIGNAL_S = (10.0, 20.0, 35.0, 55.0, 80.0)
"""Control delay, s, up to which levels A to E reach at signals: Highway Capacity Manual, 7th edition, Exhibit 19-8."""
LOS_YIELD_S = (10.0, 15.0, 25.0, 35.0, 50.0)
"""The same without signals: Exhibits 20-2 (stop control) and 22-8 (roundabouts)."""


@dataclass(frozen=True)
class LaneFlow:
    """Traffic of a lane.

    Attributes
    ----------
    flow_veh_per_h
        At the middle of the lane.
    density_veh_per_km, space_mean_speed_m_per_s
        Time spent on the lane over its length and the time; distance driven over time spent (Edie).
    headway_s, gap_s
        Mean headway; median time gap of those that follow, rear bumper to front bumper.
    """

    lane: int
    flow_veh_per_h: Estimate | None
    density_veh_per_km: Estimate | None
    space_mean_speed_m_per_s: Estimate | None
    headway_s: Estimate | None
    gap_s: Estimate | None


@dataclass(frozen=True)
class FlowSlices:
    """Edie's flow (veh/h), density (veh/km) and speed (m/s; NaN without traffic) of a lane by slice of time: points of
    its fundamental diagram."""

    slices: ObservedSlices
    flow_veh_per_h: FloatArray
    density_veh_per_km: FloatArray
    speed_m_per_s: FloatArray


def lane_flow(
    traffic: LaneTraffic,
    lane: int,
    observed_s: FloatArray,
    *,
    slice_s: float = 60.0,
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
    by_slice = flow_slices(traffic, lane, observed_s, slice_s=slice_s)
    passing = traffic.passings(lane, traffic.graph.lanes[lane].length_m / 2)
    # the first vehicle after a gap follows nobody that is known
    period = np.searchsorted(observed_s[:, 0], passing.time_s, side="right")
    headway = np.where(np.diff(period, prepend=period[:1]) == 0, passing.headway_s, np.nan)
    follows = headway < _FOLLOW_S
    length = np.full(len(passing), VEHICLE_LENGTH_M) if lengths_m is None else lengths_m[passing.track]
    between = (length + np.r_[length[:1], length[:-1]]) / 2  # the leader's rear half, the follower's front half
    gap = headway[follows] - between[follows] / np.maximum(passing.speed_m_per_s[follows], 1.0)
    enough = len(passing) >= 5
    return LaneFlow(
        lane,
        estimate_rate(by_slice.slices.sums(passing.time_s), by_slice.slices.hours),
        estimate_mean(by_slice.density_veh_per_km) if enough else None,
        _ratio(by_slice) if enough else None,
        estimate_mean(headway),
        estimate_median(gap[gap > 0]),
    )


def flow_slices(traffic: LaneTraffic, lane: int, observed_s: FloatArray, *, slice_s: float = 60.0) -> FlowSlices:
    """Edie's quantities of one lane by slice of the times (k, 2) that are seen."""
    samples, length = traffic.samples(lane), traffic.graph.lanes[lane].length_m
    slices = ObservedSlices.of(observed_s, slice_s)
    one = samples.track[1:] == samples.track[:-1]
    step = np.where(one, samples.along_m[1:] - samples.along_m[:-1], 0.0)
    wait = np.where(one, samples.time_s[1:] - samples.time_s[:-1], 0.0)
    ok = one & (step >= 0) & (step < 20.0) & (wait > 0)
    driven, spent = np.zeros(len(slices)), np.zeros(len(slices))
    # a long wait between two samples spreads over slices
    for part in range(8):
        at = samples.time_s[:-1][ok] + wait[ok] * (part + 0.5) / 8
        driven += slices.sums(at, step[ok] / 8)
        spent += slices.sums(at, wait[ok] / 8)
    area = length * np.maximum(slices.end_s - slices.begin_s, 1e-9)
    speed = np.divide(driven, spent, out=np.full(len(slices), np.nan), where=spent > 0)
    return FlowSlices(slices, driven / area * 3600, spent / area * 1000, speed)


def _ratio(slices: FlowSlices) -> Estimate | None:
    """Space-mean speed of all slices together, by the ratio estimator."""
    flow, density = slices.flow_veh_per_h / 3.6, slices.density_veh_per_km  # veh/s * 1000, veh/km
    used = density > 0
    n = int(used.sum())
    if n < 5:
        return None
    ratio = float(flow.sum() / density.sum())
    residual = (flow - ratio * density)[used]
    half = 1.645 * float(residual.std(ddof=1)) / np.sqrt(n) / float(density[used].mean())
    return Estimate(ratio, max(ratio - half, 0.0), ratio + half, n)


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
