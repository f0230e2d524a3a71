"""U-turns: tracks that reverse their direction within a short path, on a road where others go on."""

from dataclasses import dataclass

import numpy as np

from schemas.arrays import FloatArray, IntArray
from velfield.analysis.lanes.junctions import inside_hull
from velfield.analysis.lanes.model import LaneGraph
from velfield.analysis.trajectories import PathSamples

_PATH_M = 36
"""A U-turn is no longer; half round a circle of 13 m radius is."""
_MIN_TURN_RAD = np.radians(150)
_ROAD_M_PER_S = 5.5
"""Who is slower all the way from 40 m before a turn to 40 m after it turns in a car park."""
_APPROACH_M = 40
_LEG_M, _LEG_SIGMAS = 8, 6.0
"""Before the turn and after it the vehicle goes on so far, and farther than its errors by so many standard deviations,
the opposite way."""
_OPPOSITE_RAD = np.radians(140)


@dataclass(frozen=True)
class Reversal:
    """A U-turn: number of the track, middle of the turn and its time; ``left`` or to the right."""

    track: int
    time_s: float
    xy_m: FloatArray
    left: bool


def find_reversals(samples: PathSamples, graph: LaneGraph, *, position_sd_m: float = 0.0) -> list[Reversal]:
    """U-turns, by time; those within roundabouts are none, nor what errors of positions may be."""
    n = len(samples)
    if n <= _PATH_M:
        return []
    step = np.angle(np.exp(1j * np.diff(samples.direction_rad)))
    step[np.diff(samples.track) != 0] = 0.0
    course = np.concatenate([[0.0], np.cumsum(step)])
    turn = course[_PATH_M:] - course[:-_PATH_M]
    turn[samples.track[_PATH_M:] != samples.track[:-_PATH_M]] = 0.0
    rows = np.flatnonzero(np.abs(turn) >= _MIN_TURN_RAD)
    rings = [junction.hull_m for junction in graph.junctions if junction.kind == "roundabout"]
    out = []
    for group in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
        if not len(group):
            continue
        best = int(group[np.argmax(np.abs(turn[group]))])
        middle = best + _PATH_M // 2
        inside_ring = any(inside_hull(samples.xy_m[[middle]], hull)[0] for hull in rings)
        if not inside_ring and _comes_by_road(samples, best) and _goes_back(samples, group, position_sd_m):
            track = int(samples.track[middle])
            out.append(Reversal(track, float(samples.time_s[middle]), samples.xy_m[middle], bool(turn[best] < 0)))
    return sorted(out, key=lambda row: row.time_s)


def _goes_back(samples: PathSamples, group: IntArray, position_sd_m: float) -> bool:
    """Whether the track goes one way before the turn, and the other after it, farther than errors explain."""
    leg = max(_LEG_M, int(np.ceil(_LEG_SIGMAS * position_sd_m)))
    for row in group:
        before, after = row - np.array([leg // 2, -leg // 2]), row + _PATH_M + np.array([-leg // 2, leg // 2])
        rows = np.r_[before[0], before[1], after[0], after[1]]
        if rows.min() < 0 or rows.max() >= len(samples) or np.ptp(samples.track[rows]):
            continue
        ways = samples.xy_m[rows[[1, 3]]] - samples.xy_m[rows[[0, 2]]]
        length = np.hypot(*ways.T)
        turn = np.abs(np.angle(np.exp(1j * float(np.subtract(*np.arctan2(ways[:, 1], ways[:, 0]))))))
        if length.min() > 0.7 * leg and turn >= _OPPOSITE_RAD:
            return True
    return False


def _comes_by_road(samples: PathSamples, row: int) -> bool:
    """Whether the track was as fast as on a road before, or after, the turn."""
    low, high = max(row - _APPROACH_M, 0), min(row + _PATH_M + _APPROACH_M, len(samples))
    own = samples.track[low:high] == samples.track[row]
    return bool(np.quantile(samples.speed_m_per_s[low:high][own], 0.9) > _ROAD_M_PER_S)
