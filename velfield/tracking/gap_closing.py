"""Passages over gaps: a vehicle that was lost from sight for a moment goes on as the one it was.

A detector misses a car now and then, and a chain of tracklets ends there; without this, a flight counted four passages
of each vehicle, and a queue many more. Both ends of a gap say where and how fast: at a constant acceleration between
them the way is the mean of both velocities times the gap, whatever the acceleration, so the place where the later chain
starts is foretold below a metre for gaps of a second or two. One that stands stays where it is, however long.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from schemas.arrays import FloatArray, IntArray
from schemas.flight import PAPER_GSD_M
from velfield.tracking.chains import smallest_joined

_SLACK_M = 1.5
"""How far a vehicle may be from where it is foretold, besides: places of detections wander along a car."""
_CHANGE_M_PER_S2 = 4.0
"""How far an acceleration changes within a gap: from hard braking to none. Over dt that moves a vehicle by dt^2 / 8."""
_WITHIN_M = 2.2
"""Never farther than this: half a car, so that the neighbour in a queue is not meant."""

_SOONER_PER_S = 0.5
"""A second later counts as much as half of what the place may be off."""
_STANDING_WITHIN_M = 1.0
"""A vehicle that stood is found where it stood; the next in its place would come rolling."""


@dataclass(frozen=True)
class _Ends:
    """One end of each chain: time (n,) s, place (n, 2) m, velocity (n, 2) m/s."""

    time_s: FloatArray
    place_m: FloatArray
    velocity_m_per_s: FloatArray

    @property
    def speed_m_per_s(self) -> FloatArray:
        return np.asarray(np.hypot(self.velocity_m_per_s[:, 0], self.velocity_m_per_s[:, 1]))


@dataclass(frozen=True)
class Gaps:
    """How long a vehicle may be lost from sight, s; one slower than ``slow_m_per_s`` at both ends stands."""

    moving_s: float
    standing_s: float = 0.0
    slow_m_per_s: float = 1.15


END_COLUMNS = [
    *("time_0_s", "x_0_px", "y_0_px", "vx_01_px_per_s", "vy_01_px_per_s"),
    *("time_2_s", "x_2_px", "y_2_px", "vx_12_px_per_s", "vy_12_px_per_s"),
]
"""Columns of tracklets that `join_chains` reads."""


def join_chains(tracklets: pd.DataFrame, chains: IntArray, gaps: Gaps, *, gsd_m: float | None) -> IntArray:
    """The passage of each tracklet: chains of one vehicle, with gaps between them, are one.

    Every end goes on in one start at most, the likeliest pairs first.

    Parameters
    ----------
    tracklets
        `END_COLUMNS`.
    chains
        (n,) chain of each tracklet, by `velfield.tracking.chains.assign_passages`.
    gaps
        The longest ones; 0 leaves the chains as they are.
    gsd_m
        Metres a base pixel; None: the paper's.

    Returns
    -------
    (n,) int64: the smallest chain of each passage.
    """
    names, chain = np.unique(chains, return_inverse=True)
    metres = PAPER_GSD_M if gsd_m is None else gsd_m
    order = np.lexsort((tracklets["time_0_s"].to_numpy(), chain))
    first = order[np.searchsorted(chain[order], np.arange(len(names)))]
    order = np.lexsort((tracklets["time_2_s"].to_numpy(), chain))
    last = order[np.searchsorted(chain[order], np.arange(len(names)), side="right") - 1]
    starts = _ends(tracklets.iloc[first], "0", "01", metres)
    ends = _ends(tracklets.iloc[last], "2", "12", metres)
    goes_on, is_gone_on = np.zeros(len(names), bool), np.zeros(len(names), bool)
    joined: list[IntArray] = []
    for pair in _pairs(ends, starts, gaps):
        end, start = pair
        if not goes_on[end] and not is_gone_on[start]:
            goes_on[end] = is_gone_on[start] = True
            joined.append(pair)
    return smallest_joined(names, np.array(joined, np.int64).reshape(-1, 2))[chain]


def _ends(rows: pd.DataFrame, place: str, link: str, metres: float) -> _Ends:
    return _Ends(
        rows[f"time_{place}_s"].to_numpy(np.float64),
        rows[[f"x_{place}_px", f"y_{place}_px"]].to_numpy(np.float64) * metres,
        rows[[f"vx_{link}_px_per_s", f"vy_{link}_px_per_s"]].to_numpy(np.float64) * metres,
    )


def _pairs(ends: _Ends, starts: _Ends, gaps: Gaps) -> IntArray:
    """(m, 2) ends and starts that may be one vehicle, the likeliest first."""
    order = np.argsort(starts.time_s, kind="stable")
    times = starts.time_s[order]
    stands = starts.speed_m_per_s < gaps.slow_m_per_s
    stood = ends.speed_m_per_s < gaps.slow_m_per_s
    longest = np.where(stood, max(gaps.moving_s, gaps.standing_s), gaps.moving_s)
    low = np.searchsorted(times, ends.time_s, side="right")
    high = np.searchsorted(times, ends.time_s + longest, side="right")
    found = []
    for end in np.flatnonzero(high > low):
        start = order[low[end] : high[end]]
        gap = starts.time_s[start] - ends.time_s[end]
        way = starts.place_m[start] - ends.place_m[end]
        mean = (ends.velocity_m_per_s[end] + starts.velocity_m_per_s[start]) / 2
        off = np.hypot(*(way - mean * gap[:, None]).T)
        share = off / np.minimum(_SLACK_M + _CHANGE_M_PER_S2 * gap**2 / 8, _WITHIN_M)
        share[gap > gaps.moving_s] = np.inf
        if stood[end]:
            stays = stands[start] & (gap <= gaps.standing_s)
            share = np.where(stays, np.minimum(share, np.hypot(*way.T) / _STANDING_WITHIN_M), share)
        may = share <= 1
        # Of two that fit alike, the one that comes sooner.
        rank = share[may] + _SOONER_PER_S * gap[may]
        found.append(np.stack([rank, np.full(may.sum(), end), start[may]], axis=1))
    table = np.concatenate(found) if found else np.empty((0, 3))
    pairs = table[:, 1:].astype(np.int64)
    return np.asarray(pairs[np.lexsort((pairs[:, 1], pairs[:, 0], table[:, 0]))], np.int64)
