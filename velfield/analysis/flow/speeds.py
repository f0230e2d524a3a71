"""Speeds along lanes: profiles, free flow and the limit that it shows, and what a feature takes from it."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import special

from schemas.arrays import FloatArray, IntArray, Mask
from schemas.export import PER_M_PER_S, SpeedUnit
from velfield.analysis.flow.passings import LaneTraffic, find_passings
from velfield.analysis.intervals import (
    LEVEL,
    Estimate,
    estimate_censored_quantile,
    estimate_median,
    estimate_quantile,
)
from velfield.analysis.lanes.model import Junction, LaneGraph, LaneSamples
from velfield.compiled import kernel

STATION_M = 10.0
"""Length of a profile's stations."""
_FREE_HEADWAY_S = 4.0
"""A vehicle whose leader is further ahead follows nobody."""
_UNSEEN_HEADWAY_S, _ALIKE = 8.0, 0.03
"""One whose leader is nearer than this, and as fast but for this fraction, may follow another that was not seen: it
does not count as free."""
_FOLLOWS_HEADWAY_S = (2.0, 3.0)
"""One whose leader is nearer goes no faster than it would like: from which headway on is not known better than this."""
_STEADY_M, _STEADY = 30.0, 0.03
"""A vehicle that goes freely changes its speed by no more than this fraction over so long a distance."""
_STEADY_SD = 0.002
"""By which the median of such speeds may differ from what drivers would like: standard deviation, as a fraction."""
_RISES = 0.01
"""One that is faster by more than this fraction at its end still speeds up: it would like to go faster than it does."""
_MIN_FREE = 8
SIGNS: dict[SpeedUnit, float] = {"km/h": 10.0, "mph": 5.0}
"""Speed limits are multiples of these."""
_AWAY_M, _WAY_M, _MIN_WAY_M = 50, 45, 15
"""A speed before a junction is that so far from its area; the lowest is sought so far into it, of tracks seen at least
so far."""
_WAITS_S, _STANDS_M_PER_S = 1.5, 1.0
"""A vehicle that needs longer for a metre, or is slower, has stopped."""
_RECOVERED = 0.95
_FREELY = 0.25
"""At least this fraction of the vehicles that do not stop has nobody to give way to."""


@dataclass(frozen=True)
class Station:
    """Speeds at a station of a lane, m/s: quantiles over vehicles."""

    lane: int
    along_m: float
    xy_m: FloatArray
    vehicles: int
    p15: Estimate | None
    p50: Estimate | None
    p85: Estimate | None


def speed_profile(traffic: LaneTraffic, lane: int) -> list[Station]:
    """Speeds of the vehicles at each station of a lane, every vehicle once."""
    samples = traffic.samples(lane)
    length = traffic.graph.lanes[lane].length_m
    count = max(round(length / STATION_M), 1)
    station = np.clip((samples.along_m / length * count).astype(np.int64), 0, count - 1)
    out = []
    for k, (speeds, time_s) in enumerate(_speeds_by_station(samples, station, count)):
        at = (k + 0.5) * length / count
        quantiles = [estimate_quantile(speeds, q, time_s) for q in (0.15, 0.5, 0.85)]
        out.append(Station(lane, at, traffic.graph.lanes[lane].at(at), len(speeds), *quantiles))
    return out


def _speeds_by_station(samples: LaneSamples, station: IntArray, count: int) -> list[tuple[FloatArray, FloatArray]]:
    """Mean speed and time of each track at each station."""
    key = station * (int(samples.track.max(initial=0)) + 1) + samples.track
    keys, inverse = np.unique(key, return_inverse=True)
    n = np.bincount(inverse, minlength=len(keys))
    speed, time = (np.bincount(inverse, of, len(keys)) / n for of in (samples.speed_m_per_s, samples.time_s))
    owner = keys // (int(samples.track.max(initial=0)) + 1)
    first = np.searchsorted(owner, np.arange(count + 1))
    return [(speed[a:b], time[a:b]) for a, b in pairwise(first)]


@dataclass(frozen=True)
class FreeFlow:
    """Free flow on a road: lanes beside each other and one after the other."""

    lanes: tuple[int, ...]
    """Lanes of the road."""
    speed_m_per_s: Estimate | None
    """Median speed at which drivers go where nobody is ahead; None: too few of them are seen to. Those who follow count
    as faster than they go (Botma's estimator of free speeds)."""
    p85_m_per_s: Estimate | None
    """Which 85 of 100 drivers do not exceed."""

    def limits(self, unit: SpeedUnit = "km/h") -> list[float]:
        """Speeds on signs (`SIGNS`), in km/h or mph, of which one is nearest to the free speed."""
        if self.speed_m_per_s is None or unit not in SIGNS:
            return []
        low, high = (
            round(v * PER_M_PER_S[unit] / SIGNS[unit]) for v in (self.speed_m_per_s.low, self.speed_m_per_s.high)
        )
        return [sign * SIGNS[unit] for sign in range(low, high + 1)]

    def limit(self, unit: SpeedUnit = "km/h") -> float | None:
        """The one of `limits`; None where there are several."""
        found = self.limits(unit)
        return found[0] if len(found) == 1 else None


def free_flow(traffic: LaneTraffic, *, position_sd_m: float = 0.0) -> list[FreeFlow]:
    """Free flow of every road of a lane graph, of tracks whose positions have a standard deviation."""
    lanes = [_steady_speeds(traffic, lane.number) for lane in traffic.graph]
    found = [(road, [np.concatenate([lanes[k][c] for k in road]) for c in range(4)]) for road in roads(traffic.graph)]
    by_vehicle = [
        [_by_vehicle(*speeds, follows_s=follows_s) for follows_s in _FOLLOWS_HEADWAY_S] for _, speeds in found
    ]
    spread = _spread([one[0] for one in by_vehicle])
    out = []
    for (road, _), speeds in zip(found, by_vehicle, strict=True):
        median, p85 = (_free_quantile(speeds, q, spread, position_sd_m) for q in (0.5, 0.85))
        out.append(FreeFlow(tuple(road), median, p85))
    return out


def _by_vehicle(
    tracks: IntArray, speeds: FloatArray, headway_s: FloatArray, rises: Mask, *, follows_s: float
) -> tuple[FloatArray, Mask]:
    """The fastest steady stretch of each vehicle, as it goes slowly for other reasons too, and whether it goes freely
    there; else it would like to go faster. ``follows_s``: headway below which a vehicle follows."""
    free = headway_s > _FREE_HEADWAY_S
    doubtful = np.isin(tracks, tracks[np.isnan(headway_s)])
    used = np.flatnonzero((free & ~doubtful) | (headway_s < follows_s))
    order = used[np.lexsort((-speeds[used], tracks[used]))]
    best = order[np.unique(tracks[order], return_index=True)[1]]
    return speeds[best], (free & ~rises)[best]


def _spread(by_road: Sequence[tuple[FloatArray, Mask]]) -> tuple[float, int]:
    """Standard deviation of the logarithms of drivers' free speeds about their road's mean, and its degrees of
    freedom."""
    logs = [np.log(speeds[free]) for speeds, free in by_road if free.sum() > 1]
    squares, degrees = sum(float(((x - x.mean()) ** 2).sum()) for x in logs), sum(len(x) - 1 for x in logs)
    return float(np.sqrt(squares / degrees)) if degrees else 0.0, degrees


def _free_quantile(
    by_headway: Sequence[tuple[FloatArray, Mask]], q: float, spread: tuple[float, int], position_sd_m: float
) -> Estimate | None:
    """A quantile of free speeds: the mean for both headways from which on a vehicle may follow, and the interval that
    holds both of theirs.

    Order statistics of few drivers may lie near to each other by chance: the interval is no narrower than the
    ``spread`` of the drivers of all roads gives (`_spread`).
    """
    found = [estimate_censored_quantile(speeds, free, q, min_n=_MIN_FREE) for speeds, free in by_headway]
    known = [estimate for estimate in found if estimate is not None]
    if not known:
        return None
    value, n = float(np.mean([estimate.value for estimate in known])), min(estimate.n for estimate in known)
    sd, degrees = spread
    density = float(np.exp(-(special.ndtri(q) ** 2) / 2) / np.sqrt(2 * np.pi))
    least = value * sd * float(special.stdtrit(degrees, (1 + LEVEL) / 2)) * np.sqrt(q * (1 - q) / n) / density
    # errors that last make one stretch of a vehicle seem faster than the others: the fastest of some ten is used
    error = float(np.hypot(_STEADY_SD, 3 * np.sqrt(2) * position_sd_m / _STEADY_M)) * value
    systematic = float(special.ndtri((1 + LEVEL) / 2)) * error
    below, above = value - min(e.low for e in known), max(e.high for e in known) - value
    low, high = (float(np.hypot(max(side, least), systematic)) for side in (below, above))
    return Estimate(value, value - low, value + high, n)


def _steady_speeds(traffic: LaneTraffic, lane: int) -> tuple[IntArray, FloatArray, FloatArray, Mask]:
    """Tracks, their speeds where they go steadily, their headways there, s, and whether they still speed up."""
    samples = traffic.samples(lane)
    length = traffic.graph.lanes[lane].length_m
    window = min(_STEADY_M, 0.6 * length)
    tracks, speeds, headways, rises = [np.empty(0, np.int64)], [np.empty(0)], [np.empty(0)], [np.empty(0, bool)]
    steps = int(window)
    if steps < 5 or len(samples) <= steps:
        return tracks[0], speeds[0], headways[0], rises[0]
    low, high = (_of_windows(samples.speed_m_per_s, steps, of) for of in (np.minimum, np.maximum))
    mean = (low + high) / 2
    rise = samples.speed_m_per_s[steps - 1 :] - samples.speed_m_per_s[: len(low)]
    one = samples.track[: len(low)] == samples.track[steps - 1 :]
    steady = one & (high - low < 2 * _STEADY * mean) & (low > 2.0)
    for at in np.arange(0.5 * window, length, 10.0):
        passed, headway = traffic_passings(samples, at)
        begin = np.flatnonzero(steady & (samples.along_m[: len(low)] <= at - window / 2 + 1.0))
        begin = begin[samples.along_m[begin] > at - window / 2 - 1.5]
        order = np.argsort(passed, kind="stable")
        k = np.clip(np.searchsorted(passed[order], samples.track[begin]), 0, max(len(passed) - 1, 0))
        known = passed[order][k] == samples.track[begin] if len(passed) else np.zeros(len(begin), bool)
        begin = begin[known]
        tracks.append(samples.track[begin])
        speeds.append(mean[begin])
        headways.append(headway[order][k[known]] if len(passed) else np.empty(0))
        rises.append(rise[begin] > _RISES * mean[begin])
    return np.concatenate(tracks), np.concatenate(speeds), np.concatenate(headways), np.concatenate(rises)


def _of_windows(values: FloatArray, steps: int, of: np.ufunc) -> FloatArray:
    """The least (or greatest: ``of``) of each ``steps`` consecutive values (n,): of windows twice as long each time."""
    out, width = values, 1
    while width < steps:
        further = min(width, steps - width)
        out = of(out[: len(out) - further], out[further:])
        width += further
    return out


def traffic_passings(samples: LaneSamples, at_m: float) -> tuple[IntArray, FloatArray]:
    """Tracks at a place and their headways, s: infinite for the first, which counts as free; NaN for one that may
    follow an unseen vehicle."""
    found = find_passings(samples, at_m)
    headway_s = np.nan_to_num(found.headway_s, nan=np.inf)
    leads = np.roll(found.speed_m_per_s, 1)
    alike = np.abs(found.speed_m_per_s - leads) < _ALIKE * leads
    unseen = alike & (headway_s > _FREE_HEADWAY_S) & (headway_s < _UNSEEN_HEADWAY_S)
    return found.track, np.where(unseen, np.nan, headway_s)


def roads(graph: LaneGraph) -> list[list[int]]:
    """Lanes by road: beside each other in one direction, or straight on from each other, outside roundabouts."""
    label = np.arange(len(graph))
    ring = {k for junction in graph.junctions if junction.kind == "roundabout" for k in junction.lanes_inside}
    pairs = [(c.start, c.end) for c in graph.connections if c.turn == "straight" and c.share > 0.5]
    pairs = [(a, b) for a, b in pairs if graph.predecessors[b][0] == a]
    pairs += [(lane.number, other) for lane in graph for other in (lane.left, lane.right) if other is not None]
    for a, b in pairs:
        if (a in ring) == (b in ring):
            label[label == label[a]] = label[b]
    return [np.flatnonzero(label == k).tolist() for k in np.unique(label)]


@dataclass(frozen=True)
class Reduction:
    """Speed reduction at a junction of the vehicles that reach it by a lane and pass it without stopping.

    Attributes
    ----------
    before_m_per_s, after_m_per_s
        Medians: 50 m before its area, 50 m after its area.
    lowest_m_per_s, reduction_m_per_s
        The lowest on the way, and the speed before less it, of the vehicles that nothing but the junction slows: the
        upper quartile of the lowest speeds, the lower one of the reductions, as those who give way go slower.
    recovery_m
        Distance from the lowest speed to where 95 % of the speed before, or of that after if it is lower, is reached.
    """

    junction: int
    lane: int
    before_m_per_s: Estimate | None
    lowest_m_per_s: Estimate | None
    after_m_per_s: Estimate | None
    reduction_m_per_s: Estimate | None
    recovery_m: Estimate | None


def speed_reduction(
    samples: "PathArrays", junction: Junction, lane: int, tracks: IntArray, entry_s: FloatArray
) -> Reduction:
    """Speeds of tracks that enter a junction at given times, from 50 m before it to 100 m after it."""
    b, w, a, r, t = slowing(samples.first, samples.time_s, samples.speed_m_per_s, tracks, entry_s).T
    return Reduction(
        junction.number,
        lane,
        estimate_median(b, t),
        estimate_quantile(w, 1 - _FREELY, t),
        estimate_median(a, t),
        estimate_quantile(b - w, _FREELY, t),
        estimate_median(r, t),
    )


@kernel
def slowing(
    first: IntArray, time_s: FloatArray, speed: FloatArray, tracks: IntArray, entry_s: FloatArray
) -> FloatArray:
    """Rows (before, lowest, after, recovery, entry): speeds of the tracks that enter a junction and do not stop, m/s,
    the distance over which they recover, m, and when they enter, s."""
    out = np.empty((len(tracks), 5))
    n = 0
    for i in range(len(tracks)):
        a, end = first[tracks[i]], first[tracks[i] + 1]
        k = a + np.searchsorted(time_s[a:end], entry_s[i])
        begin = k - _AWAY_M
        if begin < a or min(k + _WAY_M, end) - k < _MIN_WAY_M:
            continue
        waits = False
        for q in range(begin + 1, k):
            waits |= time_s[q] - time_s[q - 1] > _WAITS_S
        if waits:
            continue
        low = k + np.argmin(speed[k : min(k + _WAY_M, end)])
        if speed[low] < _STANDS_M_PER_S:
            continue
        start = np.median(speed[begin : begin + 10])
        after = np.median(speed[low + 70 : min(low + 90, end)]) if end - low > 80 else np.nan
        recovery = np.nan
        if not np.isnan(after):
            aim = _RECOVERED * min(start, after)
            for q in range(low, min(low + 120, end)):
                if speed[q] >= aim:
                    recovery = q - low
                    break
        out[n, 0], out[n, 1], out[n, 2], out[n, 3], out[n, 4] = start, speed[low], after, recovery, entry_s[i]
        n += 1
    return out[:n]


@dataclass(frozen=True)
class PathArrays:
    """Path samples by track: ``first`` (tracks + 1,) rows."""

    first: IntArray
    time_s: FloatArray
    speed_m_per_s: FloatArray
