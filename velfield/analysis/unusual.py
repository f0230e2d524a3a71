"""Unusual tracks: against the direction of every lane, or by a turn that hardly anyone takes; and places where tracks
are unlikely to be vehicles."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from schemas.arrays import FloatArray
from velfield.analysis.lanes.model import LaneGraph
from velfield.analysis.lanes.ridges import bin_keys, bin_samples
from velfield.analysis.movements.movements import JunctionMovements
from velfield.analysis.trajectories import PathSamples, Trajectories, sample_paths

UnusualKind = Literal["wrong way", "rare turn"]
_BESIDE_M = 1.6
"""A lane is a track's if it is nearer than this."""
_MIN_WRONG_M = 15
"""A track against the direction of traffic for a shorter distance may be an error of tracking."""
_RARE_TRACKS, _RARE_OF = 2, 40
"""A turn that so few of so many took is rare."""
_CELL_M, _SHORT_M, _MIN_SHORT = 12.0, 15.0, 5


@dataclass(frozen=True)
class Unusual:
    """An unusual track, by its number in the trajectories: what it did, where and when; ``detail`` in words."""

    kind: UnusualKind
    track: int
    time_s: float
    frame: int
    xy_m: FloatArray
    detail: str


@dataclass(frozen=True)
class DoubtfulPlace:
    """A square of 12 m where most tracks begin and end within 15 m: dense car parks make false motion."""

    xy_m: FloatArray
    short_tracks: int
    tracks: int


def find_unusual(
    trajectories: Trajectories,
    graph: LaneGraph,
    movements: Sequence[JunctionMovements],
    *,
    samples: PathSamples | None = None,
) -> list[Unusual]:
    """Unusual tracks, by time; ``samples``: `sample_paths` of the tracks, where they are known already."""
    samples = sample_paths(trajectories) if samples is None else samples
    found = [*_wrong_way(trajectories, samples, graph), *_rare_turns(trajectories, movements)]
    return sorted(found, key=lambda row: row.time_s)


def _wrong_way(trajectories: Trajectories, samples: PathSamples, graph: LaneGraph) -> list[Unusual]:
    """Tracks that drive along a lane against its direction, where no lane of theirs is."""
    if not len(graph):
        return []
    keys = bin_keys(samples.xy_m, samples.direction_rad)
    bins, bin_of = bin_samples(samples, keys)
    points = np.concatenate([lane.xy_m for lane in graph])
    heading = np.concatenate([lane.direction_rad for lane in graph])
    tracks = np.concatenate([np.full(len(lane.xy_m), lane.tracks) for lane in graph])
    near = cKDTree(points).query_ball_point(bins.xy_m, _BESIDE_M + 1.5)
    wrong = np.zeros(len(bins.key), bool)
    for k, found in enumerate(near):
        if found:
            turn = np.abs(np.angle(np.exp(1j * (heading[found] - bins.direction_rad[k]))))
            d = points[found] - bins.xy_m[k]
            across = np.abs(d[:, 1] * np.cos(heading[found]) - d[:, 0] * np.sin(heading[found]))
            against = (turn > np.radians(145)) & (across < _BESIDE_M) & (tracks[found] >= 8)
            wrong[k] = against.any() and not (turn < np.radians(70)).any()
    rows = np.flatnonzero(wrong[bin_of])
    out = []
    for track in np.unique(samples.track[rows]):
        own = rows[samples.track[rows] == track]
        if len(own) >= _MIN_WRONG_M:
            middle = own[len(own) // 2]
            detail = f"{len(own)} m against the direction of traffic"
            out.append(
                _unusual(
                    trajectories, "wrong way", int(track), float(samples.time_s[middle]), samples.xy_m[middle], detail
                )
            )
    return out


def _rare_turns(trajectories: Trajectories, movements: Sequence[JunctionMovements]) -> list[Unusual]:
    """Tracks that go from an arm to another as hardly any other does."""
    out = []
    for junction in movements:
        passes, gates = junction.passes, junction.gates
        arm = np.array([gate.arm for gate in gates.gates] + [-1], np.int64)
        arm_in, arm_out = arm[passes.gate_in], arm[passes.gate_out]
        for i in np.unique(arm_in[arm_in >= 0]):
            whole = (arm_in == i) & (arm_out >= 0)
            for j in np.unique(arm_out[whole]):
                rows = np.flatnonzero(whole & (arm_out == j))
                if len(rows) <= _RARE_TRACKS and whole.sum() >= _RARE_OF:
                    detail = f"from {gates.arms[i].name} to {gates.arms[j].name}: {len(rows)} of {whole.sum()}"
                    out += [
                        _unusual(
                            trajectories,
                            "rare turn",
                            int(passes.track[k]),
                            float(passes.exit_s[k]),
                            junction.junction.centre_m,
                            detail,
                        )
                        for k in rows
                    ]
    return out


def _unusual(
    trajectories: Trajectories, kind: UnusualKind, track: int, time_s: float, xy_m: FloatArray, detail: str
) -> Unusual:
    rows = slice(int(trajectories.first[track]), int(trajectories.first[track + 1]))
    k = int(np.argmin(np.abs(trajectories.time_s[rows] - time_s)))
    return Unusual(kind, track, time_s, int(trajectories.frame[rows][k]), xy_m, detail)


def find_doubtful_places(trajectories: Trajectories) -> list[DoubtfulPlace]:
    """Squares where most tracks are short."""
    if not len(trajectories):
        return []
    first = trajectories.first[:-1]
    low, high = (reduce.reduceat(trajectories.xy_m, first, axis=0) for reduce in (np.minimum, np.maximum))
    short = np.hypot(*(high - low).T) < _SHORT_M
    cell = np.floor(trajectories.xy_m / _CELL_M).astype(np.int64)
    corner = cell.min(axis=0)
    columns = int(np.ptp(cell[:, 0])) + 1
    number = (cell[:, 1] - corner[1]) * columns + cell[:, 0] - corner[0]
    # one integer a visit sorts several times as fast as rows of three
    visits = np.unique(number * len(trajectories) + trajectories.owner)
    numbers, inverse = np.unique(visits // len(trajectories), return_inverse=True)
    total = np.bincount(inverse, minlength=len(numbers))
    brief = np.bincount(inverse, short[visits % len(trajectories)], len(numbers))
    rows = np.flatnonzero((brief >= _MIN_SHORT) & (brief > 0.7 * total))
    cells = np.column_stack([numbers % columns, numbers // columns]) + corner
    return [DoubtfulPlace((cells[k] + 0.5) * _CELL_M, int(brief[k]), int(total[k])) for k in rows]
