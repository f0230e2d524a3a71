"""Trajectories: the tracks of a flight as flat arrays in metres, smoothed, and resampled along their paths."""

import re
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from schemas.arrays import FloatArray, IntArray, Mask
from velfield.compiled import kernel

VEHICLE_LENGTH_M, VEHICLE_WIDTH_M = 4.5, 1.8
"""Dimensions assumed for a vehicle that was not measured."""
_LENGTH_SD_M = 0.5
"""A length that is known worse says less than that most vehicles are cars."""
_SMOOTHING_S = 1.0
"""Half the window in which the errors of positions are averaged along the measured displacements."""
_VELOCITY_S = 0.3
"""Half the window of a velocity: an acceleration is about constant for so long."""
_DIRECTION_M = 2.0
"""A direction of travel is that of the path from so far behind to so far ahead."""
_BRIDGE_S, _BRIDGE_M = 1.0, 0.9
"""Displacements that were not measured, over no longer than this, are those of the velocity beside them, unless the
positions differ from that by more than this."""
_ALIGNED_SD_PX = 0.5
"""A displacement with a larger standard deviation is that of two detections, whose crops did not align."""
_THREADS = 2
TrackId = int | str
"""The id of a track: a whole number, or the text of the user's file."""
MOVES_M = 6.0
"""Least extent of a vehicle's path for it to be in the analysis."""
SAMPLES_M = 1.0
"""Distance between the samples of a path."""
_MIN_STEP_M = 0.3
"""Jitter of a stationary vehicle is below it: its path does not grow by it."""


@dataclass(frozen=True)
class Trajectories:
    """Tracks as flat arrays: track k has the rows ``first[k]:first[k + 1]``, in time order."""

    track_id: IntArray
    """(n,) numbers of the tracks."""
    first: IntArray
    """(n + 1,) rows."""
    frame: IntArray
    time_s: FloatArray
    """(m,) frame and time of each position."""
    xy_m: FloatArray
    velocity_m_per_s: FloatArray
    """(m, 2) position, and velocity."""
    gsd_m: float
    """Metres a base pixel."""
    measured_length_m: FloatArray | None = None
    """(n,) lengths of the vehicles, NaN where one was not measured; None: none was."""
    position_sd_m: float = 0.0
    """Standard deviation of a position along one axis, of errors that last; 0: less than a lane's width matters to."""
    gaps_s: FloatArray | None = None
    """(k, 2) begins and ends of longer times without frames, as between clips, in time order; None: there are none."""
    seen_s: tuple[float, float] | None = None
    """Times of the first and the last frame; None: not known, those of the first and the last position."""
    source_id: Mapping[int, TrackId] | None = None
    """Ids of the tracks in the file of another program, by ``track_id``; None: they have no others."""

    def __len__(self) -> int:
        return len(self.track_id)

    def __iter__(self) -> Iterator[slice]:
        for a, b in zip(self.first[:-1], self.first[1:], strict=True):
            yield slice(int(a), int(b))

    def id_of(self, track: int) -> TrackId:
        """The id by which people know a track, by its row in ``track_id``: the one of the user's file, if there is
        one."""
        number = int(self.track_id[track])
        return number if self.source_id is None else self.source_id[number]

    @property
    def ids(self) -> NDArray[np.generic]:
        """(n,) `id_of` of each track."""
        return self.track_id if self.source_id is None else np.array([self.id_of(k) for k in range(len(self))])

    @property
    def owner(self) -> IntArray:
        """(m,) number of the track of each position."""
        return np.repeat(np.arange(len(self)), np.diff(self.first))

    @property
    def speed_m_per_s(self) -> FloatArray:
        """(m,) speed."""
        return np.asarray(np.hypot(self.velocity_m_per_s[:, 0], self.velocity_m_per_s[:, 1]))

    @property
    def length_m(self) -> FloatArray:
        """(n,) lengths of the vehicles; `VEHICLE_LENGTH_M` of those that were not measured."""
        if self.measured_length_m is None:
            return np.full(len(self), VEHICLE_LENGTH_M)
        return np.where(np.isfinite(self.measured_length_m), self.measured_length_m, VEHICLE_LENGTH_M)

    def with_lengths(self, dimensions: pd.DataFrame) -> "Trajectories":
        """With the lengths of ``dimensions`` (`schemas.tables.DIMENSION_COLUMNS`) that are known to half a metre."""
        known = dimensions.set_index("track_id")[["length_px", "length_sd_px"]].reindex(self.track_id) * self.gsd_m
        length, sd = known["length_px"].to_numpy(np.float64), known["length_sd_px"].to_numpy(np.float64)
        return replace(self, measured_length_m=np.where(sd <= _LENGTH_SD_M, length, np.nan))

    @property
    def window_s(self) -> tuple[float, float]:
        """First and last time that is seen."""
        if self.seen_s is not None:
            return self.seen_s
        return (float(self.time_s.min()), float(self.time_s.max())) if len(self.time_s) else (0.0, 0.0)

    @property
    def observed_s(self) -> FloatArray:
        """(k, 2) begins and ends of the times with frames."""
        begin, end = self.window_s
        if end <= begin:
            return np.empty((0, 2))
        gaps = np.empty((0, 2)) if self.gaps_s is None else self.gaps_s
        gaps = gaps[(gaps[:, 0] > begin) & (gaps[:, 1] < end)]
        return np.column_stack([np.r_[begin, gaps[:, 1]], np.r_[gaps[:, 0], end]])

    def observed_within(self, edges_s: FloatArray) -> FloatArray:
        """Length (k,) of the times with frames between successive edges (k + 1,), s."""
        begin, end = self.observed_s.T[:, :, None]
        return np.asarray(np.clip(np.minimum(end, edges_s[1:]) - np.maximum(begin, edges_s[:-1]), 0, None).sum(axis=0))

    def is_cut_by_time(self, time_s: FloatArray, within_s: float, *, begins: bool) -> Mask:
        """Whether each time (n,) at which a track begins, or ends, is so near to where a time with frames does."""
        edges = self.observed_s[:, 0 if begins else 1]
        after = time_s[:, None] - edges if begins else edges - time_s[:, None]
        return np.asarray(((after >= 0) & (after < within_s)).any(axis=1))

    @property
    def duration_s(self) -> float:
        """Length of the times with frames, s."""
        return float(np.diff(self.observed_s, axis=1).sum())

    def select(self, keep: Mask) -> "Trajectories":
        """The tracks (n,) that are kept."""
        if keep.all():
            return self
        rows = np.repeat(keep, np.diff(self.first))
        first = np.concatenate([[0], np.cumsum(np.diff(self.first)[keep])]).astype(np.int64)
        return Trajectories(
            self.track_id[keep],
            first,
            self.frame[rows],
            self.time_s[rows],
            np.compress(rows, self.xy_m, axis=0),  # a fifth of the time of an index by a mask
            np.compress(rows, self.velocity_m_per_s, axis=0),
            self.gsd_m,
            None if self.measured_length_m is None else self.measured_length_m[keep],
            self.position_sd_m,
            self.gaps_s,
            self.seen_s,
            self.source_id,
        )


def read_ids(track_id: IntArray, names: Sequence[str]) -> dict[int, TrackId]:
    """Ids of tracks by their numbers, of names in a file: whole numbers where all are, else text.

    Examples
    --------
    >>> read_ids(np.array([0, 1]), ["64", "7"]), read_ids(np.array([0, 1]), ["64", "car.7"])
    ({0: 64, 1: 7}, {0: '64', 1: 'car.7'})
    """
    whole = all(re.fullmatch(r"-?(0|[1-9]\d*)", name) for name in names)
    return {int(k): int(name) if whole else name for k, name in zip(track_id, names, strict=True)}


def moving(trajectories: Trajectories) -> Trajectories:
    """The tracks that reach `MOVES_M` or farther: of vehicles that move."""
    if not len(trajectories):
        return trajectories
    low, high = (
        reduce.reduceat(trajectories.xy_m, trajectories.first[:-1], axis=0) for reduce in (np.minimum, np.maximum)
    )
    return trajectories.select(np.hypot(*(high - low).T) >= MOVES_M)


def make_trajectories(
    track: IntArray,
    frame: IntArray,
    time_s: FloatArray,
    xy_m: FloatArray,
    *,
    gsd_m: float,
    displacement_m: FloatArray | None = None,
    position_sd_m: float = 0.0,
) -> Trajectories:
    """Trajectories of positions (m,) in any order; those of a track at one time are taken once.

    Parameters
    ----------
    track, frame, time_s, xy_m
        (m,) track and frame, (m,) time and (m, 2) position of each.
    gsd_m
        Metres a base pixel.
    displacement_m
        (m, 2) measured displacement to the track's next position, NaN where there is none; more accurate than the
        difference of the positions.
    position_sd_m
        Standard deviation of a position along one axis, of errors that last.
    """
    same = track[1:] == track[:-1]
    if (track[1:] < track[:-1]).any() or (same & (time_s[1:] <= time_s[:-1])).any():
        order = np.lexsort((time_s, track))
        order = order[np.r_[True, (np.diff(track[order]) != 0) | (np.diff(time_s[order]) > 0)]]
        track, frame, time_s, xy_m = track[order], frame[order], time_s[order], xy_m[order]
        displacement_m = None if displacement_m is None else displacement_m[order]
    starts = np.flatnonzero(np.r_[True, track[1:] != track[:-1]]) if len(track) else np.empty(0, np.int64)
    first = np.r_[starts, len(track)].astype(np.int64)
    step = np.zeros_like(xy_m)
    np.subtract(xy_m[1:], xy_m[:-1], out=step[:-1])
    if displacement_m is not None:
        known = np.isfinite(displacement_m[:, 0]) & np.isfinite(displacement_m[:, 1])
        np.copyto(step, displacement_m, where=known[:, None])
        _bridge(first, time_s, step, known, _BRIDGE_S, _BRIDGE_M)
    xy, velocity = _smooth(first, time_s, xy_m, step, _SMOOTHING_S, _VELOCITY_S)
    return Trajectories(track[starts], first, frame, time_s, xy, velocity, gsd_m, position_sd_m=position_sd_m)


def from_tracklets(tracklets: pd.DataFrame, gsd_m: float) -> Trajectories:
    """Trajectories of a table of tracklets (`schemas.tables.TRACKLET_COLUMNS`); tracklets of no track are left out."""
    table = tracklets[tracklets["track_id"] >= 0]
    parts: dict[str, list[FloatArray]] = {name: [] for name in ("track", "frame", "time", "id", "x", "y", "dx", "dy")}
    for k, link in ((1, "12"), (0, "01"), (2, None)):
        parts["track"].append(table["track_id"].to_numpy())
        parts["frame"].append(table[f"frame_{k}"].to_numpy())
        parts["time"].append(table[f"time_{k}_s"].to_numpy(np.float64))
        parts["id"].append(table[f"detection_id_{k}"].to_numpy())
        for axis in "xy":
            parts[axis].append(table[f"{axis}_{k}_px"].to_numpy(np.float64))
            if link is None:
                parts[f"d{axis}"].append(np.full(len(table), np.nan))
            else:
                duration = table[f"time_{k + 1}_s"].to_numpy() - table[f"time_{k}_s"].to_numpy()
                aligned = table[f"displacement_sd_{link}_px"].to_numpy() <= _ALIGNED_SD_PX
                moved = table[f"v{axis}_{link}_px_per_s"].to_numpy(np.float64) * duration
                parts[f"d{axis}"].append(np.where(aligned, moved, np.nan))
    whole = {name: np.concatenate(values) for name, values in parts.items()}
    _, once = np.unique(whole["id"], return_index=True)  # the first: as a middle detection it has a displacement
    whole = {name: values[once] for name, values in whole.items()}
    return make_trajectories(
        whole["track"].astype(np.int64),
        whole["frame"].astype(np.int64),
        whole["time"],
        np.column_stack([whole["x"], whole["y"]]) * gsd_m,
        gsd_m=gsd_m,
        displacement_m=np.column_stack([whole["dx"], whole["dy"]]) * gsd_m,
    )


@kernel
def _smooth(
    first: IntArray, time_s: FloatArray, xy: FloatArray, step: FloatArray, reach_s: float, velocity_s: float
) -> tuple[FloatArray, FloatArray]:
    """Positions: the measured displacements, plus the mean of the positions' differences from them within ``reach_s``;
    velocities: displacements over the time within ``velocity_s``."""
    out = xy.copy()
    velocity = np.zeros_like(xy)
    for k in range(len(first) - 1):
        a, b = first[k], first[k + 1]
        driven = np.zeros((b - a + 1, 2))
        for i in range(a, b - 1):
            for axis in range(2):
                driven[i - a + 1, axis] = driven[i - a, axis] + step[i, axis]
        low = high = a
        for i in range(a, b):
            reach = min(reach_s, max(time_s[i] - time_s[a], 0.0) + 0.25, max(time_s[b - 1] - time_s[i], 0.0) + 0.25)
            low = i
            while low > a and time_s[i] - time_s[low - 1] <= reach:
                low -= 1
            high = i
            while high < b - 1 and time_s[high + 1] - time_s[i] <= reach:
                high += 1
            sx = sy = 0.0
            for j in range(low, high + 1):
                sx += xy[j, 0] - driven[j - a, 0]
                sy += xy[j, 1] - driven[j - a, 1]
            n = high - low + 1
            out[i, 0] = driven[i - a, 0] + sx / n
            out[i, 1] = driven[i - a, 1] + sy / n
            low, high = max(i - 1, a), min(i + 1, b - 1)
            while low > a and time_s[i] - time_s[low - 1] <= velocity_s:
                low -= 1
            while high < b - 1 and time_s[high + 1] - time_s[i] <= velocity_s:
                high += 1
            for axis in range(2 if high > low else 0):
                velocity[i, axis] = (driven[high - a, axis] - driven[low - a, axis]) / (time_s[high] - time_s[low])
    return out, velocity


@kernel
def _bridge(first: IntArray, time_s: FloatArray, step: FloatArray, known: Mask, longest_s: float, reach: float) -> None:
    """Give displacements that were not measured, in place, the mean velocity of the measured ones beside them, where
    the positions do not contradict it."""
    for k in range(len(first) - 1):
        a, b = first[k], first[k + 1] - 1
        for i in range(a, b):
            if known[i]:
                continue
            low, high = i - 1, i + 1
            while low >= a and not known[low]:
                low -= 1
            while high < b and not known[high]:
                high += 1
            if low < a or high >= b or time_s[high] - time_s[low + 1] > longest_s:
                continue
            dt = time_s[i + 1] - time_s[i]
            before, after = time_s[low + 1] - time_s[low], time_s[high + 1] - time_s[high]
            x = 0.5 * dt * (step[low, 0] / before + step[high, 0] / after)
            y = 0.5 * dt * (step[low, 1] / before + step[high, 1] / after)
            if np.hypot(x - step[i, 0], y - step[i, 1]) < reach:
                step[i, 0], step[i, 1] = x, y


@dataclass(frozen=True)
class PathSamples:
    """Points at equal distances along the paths of tracks."""

    track: IntArray
    """(k,) number of the track, in its order along the path."""
    xy_m: FloatArray
    """(k, 2) position."""
    direction_rad: FloatArray
    """(k,) direction of travel."""
    time_s: FloatArray
    speed_m_per_s: FloatArray
    """(k,) when the vehicle was there, and how fast."""

    def __len__(self) -> int:
        return len(self.track)

    @cached_property
    def bounds_m(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest x and y (2,) of all points."""
        # by column: numpy reduces a long array of two columns along its rows many times as slowly
        columns = self.xy_m[:, 0], self.xy_m[:, 1]
        return np.array([c.min() for c in columns]), np.array([c.max() for c in columns])


def within(xy_m: FloatArray, low_m: FloatArray, high_m: FloatArray) -> IntArray:
    """Rows of the positions (n, 2) in a box with its corners at ``low_m`` and ``high_m`` (2,)."""
    rows = np.flatnonzero((xy_m[:, 0] >= low_m[0]) & (xy_m[:, 0] <= high_m[0]))  # few: the second test is of these
    y = xy_m[rows, 1]
    return np.asarray(rows[(y >= low_m[1]) & (y <= high_m[1])])


def group_rows(group: IntArray, n: int) -> tuple[IntArray, IntArray]:
    """Rows in the order of their group (rows,), each from 0 below n, and the borders (n + 1,) of the n groups."""
    small = group.astype(np.int16) if n < 1 << 15 else group  # numpy sorts these by their digits
    return np.argsort(small, kind="stable"), np.concatenate([[0], np.cumsum(np.bincount(group, minlength=n))])


def sample_paths(trajectories: Trajectories) -> PathSamples:
    """Points every `SAMPLES_M` along each track; a stationary vehicle gives none."""
    first, xy, speed = trajectories.first, trajectories.xy_m, trajectories.speed_m_per_s
    border = np.r_[0, np.cumsum(_count_samples(first, xy, SAMPLES_M, _MIN_STEP_M))].astype(np.int64)
    n = int(border[-1])
    out = PathSamples(np.empty(n, np.int64), np.empty((n, 2)), np.empty(n), np.empty(n), np.empty(n))

    def fill(tracks: IntArray) -> None:
        columns = out.track, out.xy_m, out.direction_rad, out.time_s, out.speed_m_per_s
        _resample(tracks, first, trajectories.time_s, xy, speed, border, SAMPLES_M, _DIRECTION_M, _MIN_STEP_M, *columns)

    with ThreadPoolExecutor(_THREADS) as pool:
        list(pool.map(fill, np.array_split(np.arange(len(trajectories)), _THREADS)))
    return out


@kernel
def _find_vertices(
    xy: FloatArray, a: int, b: int, min_step: float, vertex: IntArray, along: FloatArray
) -> tuple[int, float]:
    """Number of vertices of the path of the rows ``a`` to ``b``, and its length; writes their rows and distances along.

    Vertices are positions at least ``min_step`` from the vertex before.
    """
    count = 0
    for i in range(a, b):
        if count == 0:
            vertex[0], along[0], count = i, 0.0, 1
            continue
        j = vertex[count - 1]
        d = np.hypot(xy[i, 0] - xy[j, 0], xy[i, 1] - xy[j, 1])
        if d >= min_step:
            vertex[count], along[count] = i, along[count - 1] + d
            count += 1
    return count, along[count - 1] if count else 0.0


@kernel
def _count_samples(first: IntArray, xy: FloatArray, spacing: float, min_step: float) -> IntArray:
    """Points ``spacing`` apart along each track (tracks,)."""
    steps = np.zeros(len(first) - 1, np.int64)
    for k in range(len(steps)):
        a, b = first[k], first[k + 1]
        _, length = _find_vertices(xy, a, b, min_step, np.empty(b - a, np.int64), np.empty(b - a))
        steps[k] = int(length / spacing) + 1 if length >= 2 * spacing else 0
    return steps


@kernel
def _resample(
    tracks: IntArray,
    first: IntArray,
    time_s: FloatArray,
    xy: FloatArray,
    speed: FloatArray,
    border: IntArray,
    spacing: float,
    reach: float,
    min_step: float,
    out_track: IntArray,
    out_xy: FloatArray,
    out_direction: FloatArray,
    out_time: FloatArray,
    out_speed: FloatArray,
) -> None:
    """Fill the rows ``border[k]:border[k + 1]`` of the outputs with points ``spacing`` apart along track k."""
    for k in tracks:
        a, b = first[k], first[k + 1]
        vertex, along = np.empty(b - a, np.int64), np.empty(b - a)
        count, length = _find_vertices(xy, a, b, min_step, vertex, along)
        steps = border[k + 1] - border[k]
        begin = 0.5 * (length - (steps - 1) * spacing)
        at = behind = ahead = 0
        for q in range(steps):
            n, s = border[k] + q, begin + q * spacing
            x, y, at = _vertex_at(xy, vertex, along, count, s, at)
            x0, y0, behind = _vertex_at(xy, vertex, along, count, max(s - reach, 0.0), behind)
            x1, y1, ahead = _vertex_at(xy, vertex, along, count, min(s + reach, length), ahead)
            i, j = vertex[at], vertex[min(at + 1, count - 1)]
            f = (s - along[at]) / max(along[min(at + 1, count - 1)] - along[at], 1e-9)
            out_track[n], out_xy[n, 0], out_xy[n, 1] = k, x, y
            out_direction[n] = np.arctan2(y1 - y0, x1 - x0)
            out_time[n] = time_s[i] + f * (time_s[j] - time_s[i])
            out_speed[n] = speed[i] + f * (speed[j] - speed[i])


@kernel
def _vertex_at(
    xy: FloatArray, vertex: IntArray, along: FloatArray, count: int, s: float, at: int
) -> tuple[float, float, int]:
    """Position at distance ``s`` along the vertices, and the vertex before it, looked for from ``at`` on."""
    while at < count - 2 and along[at + 1] < s:
        at += 1
    i, j = vertex[at], vertex[at + 1]
    f = (s - along[at]) / max(along[at + 1] - along[at], 1e-9)
    return xy[i, 0] + f * (xy[j, 0] - xy[i, 0]), xy[i, 1] + f * (xy[j, 1] - xy[i, 1]), at
