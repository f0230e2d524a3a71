"""When tracks pass a place on a lane."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from schemas.arrays import FloatArray, IntArray
from velfield.analysis.lanes.model import LaneGraph, LaneSamples
from velfield.analysis.trajectories import group_rows

_GOES_S = 1.5
"""A vehicle that needs longer from one sample to the next, 1 m on, has waited."""


@dataclass(frozen=True)
class Passings:
    """Tracks at a place: ``track``, ``time_s``, ``speed_m_per_s`` and ``offset_m``, to the right of the lane's centre
    line, (n,) each, in time order."""

    track: IntArray
    time_s: FloatArray
    speed_m_per_s: FloatArray
    offset_m: FloatArray

    def __len__(self) -> int:
        return len(self.track)

    @property
    def headway_s(self) -> FloatArray:
        """(n,) time since the one before; NaN for the first."""
        return np.r_[np.nan, np.diff(self.time_s)] if len(self) else np.empty(0)


@dataclass(frozen=True)
class LaneTraffic:
    """The samples of a lane graph by lane."""

    graph: LaneGraph

    @cached_property
    def _by_lane(self) -> tuple[LaneSamples, IntArray]:
        """The samples in the order of their lanes, and the lanes' borders among them."""
        order, first = group_rows(self.graph.samples.lane, len(self.graph))
        columns = (getattr(self.graph.samples, name)[order] for name in LaneSamples.__dataclass_fields__)
        return LaneSamples(*columns), first

    def samples(self, lane: int) -> LaneSamples:
        """Samples on one lane, by track and along it."""
        samples, first = self._by_lane
        rows = slice(int(first[lane]), int(first[lane + 1]))
        return LaneSamples(*(getattr(samples, name)[rows] for name in LaneSamples.__dataclass_fields__))

    def passings(self, lane: int, along_m: float) -> Passings:
        """Tracks that pass a distance along a lane."""
        return find_passings(self.samples(lane), along_m)


def find_passings(samples: LaneSamples, along_m: float) -> Passings:
    """Tracks that pass a distance along a lane whose samples are given."""
    s = samples.along_m
    step = np.flatnonzero(
        (samples.track[1:] == samples.track[:-1]) & (s[:-1] <= along_m) & (s[1:] > along_m) & (s[1:] - s[:-1] < 6.0)
    )
    f = (along_m - s[step]) / np.maximum(s[step + 1] - s[step], 1e-9)
    # a vehicle that waits between two samples goes on at the end of that time
    lasts = np.minimum(samples.time_s[step + 1] - samples.time_s[step], _GOES_S)
    time = samples.time_s[step + 1] - (1 - f) * lasts
    speed = samples.speed_m_per_s[step] + f * (samples.speed_m_per_s[step + 1] - samples.speed_m_per_s[step])
    order = np.argsort(time, kind="stable")
    return Passings(samples.track[step][order], time[order], speed[order], samples.offset_m[step][order])
