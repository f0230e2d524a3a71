"""Tracks that are one vehicle's: cut by a tree or a miss of the detector, and found again where it must have gone."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from schemas.arrays import FloatArray, IntArray, Mask
from velfield.analysis.trajectories import PathSamples, Trajectories, sample_paths

_MAX_GAP_S = 5.0
_ENDS_S = 0.6
"""A velocity at a track's end is the mean over so long."""
_ALONG_M, _ALONG_M_PER_S2, _MAX_ALONG_M = 1.5, 0.5, 6.0
"""A vehicle is found within this of where a constant acceleration takes it, more with the time squared, at most half
the spacing of vehicles that drive."""
_ACROSS_M = 1.5
"""Less than half a lane to the side of it."""


@dataclass(frozen=True)
class CutTracks:
    """Tracks joined into vehicles."""

    vehicle: IntArray
    """(tracks,) number of each track's vehicle."""
    trajectories: Trajectories
    """Trajectories of the vehicles, with gaps filled."""
    first: IntArray
    """(vehicles + 1,) rows of ``track`` and ``start_s``."""
    track: IntArray
    start_s: FloatArray
    """(tracks,) tracks of the vehicles in the order of time, and when each begins."""
    gap_start_s: FloatArray
    """(tracks,) when the gap before each begins, NaN for a vehicle's first track."""

    @cached_property
    def samples(self) -> PathSamples:
        """Points along the vehicles' paths, 1 m apart."""
        return sample_paths(self.trajectories)

    def track_at(self, vehicle: IntArray, time_s: FloatArray) -> IntArray:
        """Number of the track (n,) of vehicles at times, in a gap of the one before it."""
        span = float(np.ptp(self.start_s)) + 1.0 if len(self.start_s) else 1.0
        begin = float(self.start_s.min(initial=0.0))
        owner = np.repeat(np.arange(len(self.first) - 1), np.diff(self.first))
        key = owner * span + (self.start_s - begin)
        row = np.searchsorted(key, vehicle * span + np.clip(time_s - begin, 0.0, span - 1e-6), side="right") - 1
        return np.asarray(self.track[np.maximum(row, self.first[vehicle])])

    def has_gap(self, vehicle: IntArray, begin_s: FloatArray, end_s: FloatArray) -> Mask:
        """Whether (n,) a vehicle has a gap between two times."""
        joins = np.flatnonzero(np.isfinite(self.gap_start_s))
        owner = self.vehicle[self.track[joins]]
        gap_begin, gap_end = self.gap_start_s[joins], self.start_s[joins]
        low, high = np.searchsorted(owner, vehicle), np.searchsorted(owner, vehicle, side="right")
        out = np.zeros(len(vehicle), bool)
        for k in range(int((high - low).max(initial=0))):
            row = np.minimum(low + k, max(len(joins) - 1, 0))
            out |= (low + k < high) & (gap_begin[row] <= end_s) & (gap_end[row] >= begin_s)
        return out


def join_cut_tracks(trajectories: Trajectories) -> CutTracks:
    """Join each track's end to the start that fits best, one to one: where it leads at a constant acceleration."""
    n = len(trajectories)
    after = np.full(n, -1, np.int64)
    ends, starts, miss_m = _candidates(trajectories)
    before = np.full(n, -1, np.int64)
    for k in np.argsort(miss_m, kind="stable").tolist():
        end, start = int(ends[k]), int(starts[k])
        if after[end] < 0 and before[start] < 0:
            after[end], before[start] = start, end
    return _chain(trajectories, before)


def _candidates(trajectories: Trajectories) -> tuple[IntArray, IntArray, FloatArray]:
    """Pairs of tracks of which the second may go on where the first ends, and by how far it misses, m."""
    if not len(trajectories):
        return np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0)
    last, first = trajectories.first[1:] - 1, trajectories.first[:-1]
    time, xy = trajectories.time_s, trajectories.xy_m
    v_end, v_start = _end_velocity(trajectories, at_end=True), _end_velocity(trajectories, at_end=False)
    order = np.argsort(time[first], kind="stable")
    low = np.searchsorted(time[first][order], time[last], side="right")
    high = np.searchsorted(time[first][order], time[last] + _MAX_GAP_S, side="right")
    end = np.repeat(np.arange(len(last)), high - low)
    count = high - low
    start = order[np.arange(len(end)) + np.repeat(low - np.cumsum(count) + count, count)]
    gap = time[first[start]] - time[last[end]]
    mean = (v_end[end] + v_start[start]) / 2
    miss = xy[first[start]] - xy[last[end]] - gap[:, None] * mean
    speed = np.hypot(*mean.T)
    unit = mean / np.maximum(speed, 0.1)[:, None]
    along = (miss * unit).sum(axis=1)
    across = np.abs(miss[:, 0] * unit[:, 1] - miss[:, 1] * unit[:, 0])
    ok = (np.abs(along) < np.minimum(_ALONG_M + _ALONG_M_PER_S2 * gap**2, _MAX_ALONG_M)) & (across < _ACROSS_M)
    ok &= (end != start) & ((v_end[end] * v_start[start]).sum(axis=1) >= 0)
    return end[ok], start[ok], np.hypot(along, across)[ok]


def _end_velocity(trajectories: Trajectories, *, at_end: bool) -> FloatArray:
    """Mean velocity (tracks, 2) over the last, or first, `_ENDS_S` of each track."""
    first, time = trajectories.first, trajectories.time_s
    edge = time[first[1:] - 1] if at_end else time[first[:-1]]
    near = np.abs(time - np.repeat(edge, np.diff(first))) <= _ENDS_S
    owner = trajectories.owner[near]
    count = np.maximum(np.bincount(owner, minlength=len(trajectories)), 1)
    velocity = trajectories.velocity_m_per_s[near]
    return np.column_stack([np.bincount(owner, velocity[:, k], len(trajectories)) / count for k in (0, 1)])


def _chain(trajectories: Trajectories, before: IntArray) -> CutTracks:
    """Vehicles of tracks whose predecessors are given, -1: none; they are in the order of their first tracks."""
    n = len(trajectories)
    root, rank = np.arange(n), np.zeros(n, np.int64)
    at = before.copy()
    while (at >= 0).any():
        known = at >= 0
        root[known], rank[known] = at[known], rank[known] + 1
        at[known] = before[at[known]]
    roots, vehicle = np.unique(root, return_inverse=True)
    track = np.lexsort((rank, vehicle))
    first = np.searchsorted(vehicle[track], np.arange(len(roots) + 1))
    begin, end = trajectories.first[:-1][track], trajectories.first[1:][track]
    length = end - begin
    offset = np.cumsum(length) - length
    rows = np.arange(int(length.sum())) - np.repeat(offset - begin, length)
    joined = Trajectories(
        trajectories.track_id[roots],
        np.r_[offset, len(rows)][first].astype(np.int64),
        trajectories.frame[rows],
        trajectories.time_s[rows],
        trajectories.xy_m[rows],
        trajectories.velocity_m_per_s[rows],
        trajectories.gsd_m,
        position_sd_m=trajectories.position_sd_m,
        gaps_s=trajectories.gaps_s,
        seen_s=trajectories.seen_s,
    )
    gap = np.full(n, np.nan)
    later = before[track] >= 0
    gap[later] = trajectories.time_s[trajectories.first[before[track[later]] + 1] - 1]
    return CutTracks(vehicle, joined, first, track, trajectories.time_s[begin], gap)
