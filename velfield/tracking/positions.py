"""Positions of tracks in frames, seen, confirmed or interpolated; and tracklets that only a track confirms."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from schemas.arrays import FloatArray, IntArray, Mask
from velfield.tracking.recovery import Candidates, Recovered, interpolate_gap

_Columns = dict[str, np.ndarray]
"""Columns of positions, (n,) each, by name."""
IDS = [f"detection_id_{k}" for k in range(3)]
"""Columns of a tracklet's detections."""
_MISSED_S = 1.0
"""A track that misses frames for so long goes on linearly meanwhile."""


@dataclass(frozen=True)
class TrackFrames:
    """Times (frames,) and which are usable."""

    times_s: FloatArray
    usable: Mask


def all_positions(
    tracklets: pd.DataFrame, found: Recovered, candidates: Candidates, metres: float, frames: TrackFrames
) -> pd.DataFrame:
    """Positions of every track (`TRACK_POSITION_COLUMNS`) by frame and track: seen, confirmed and interpolated."""
    ids = np.concatenate([tracklets[name].to_numpy() for name in IDS])
    first = np.sort(np.unique(ids, return_index=True)[1])  # of each detection
    found_in = first % max(len(tracklets), 1)
    xy = candidates.position_m[found.candidate] / metres
    confirmed = {
        "track_id": found.track_id,
        "frame": candidates.frame[found.candidate],
        "time_s": candidates.time_s[found.candidate],
        "x_px": xy[:, 0],
        "y_px": xy[:, 1],
        "detection_id": candidates.detection_id[found.candidate],
    }
    known = {"track_id": tracklets["track_id"].to_numpy()[found_in], "detection_id": ids[first]}
    for name, of_detection in (
        ("frame", "frame_{}"),
        ("time_s", "time_{}_s"),
        ("x_px", "x_{}_px"),
        ("y_px", "y_{}_px"),
    ):
        known[name] = np.concatenate([tracklets[of_detection.format(k)].to_numpy() for k in range(3)])[first]
    known = {name: np.concatenate([known[name], values]) for name, values in confirmed.items()}
    known["source"] = np.repeat([0, 1], [len(first), len(xy)])
    numbers, times_s = np.flatnonzero(frames.usable), frames.times_s
    inferred = [_between_frames(known, numbers, times_s), _across_gaps(found, candidates, metres, numbers, times_s)]
    parts = [known]
    for one in inferred:
        parts.append({**one, "detection_id": np.full_like(one["frame"], -1), "source": np.full_like(one["frame"], 2)})

    def column(name: str) -> np.ndarray:
        return np.concatenate([part[name] for part in parts])

    rows = _surest(column("frame"), column("track_id"), column("source"))
    return pd.DataFrame({name: column(name)[rows] for name in known}, copy=False)


def _surest(frame: IntArray, track: IntArray, source: IntArray) -> IntArray:
    """Row of the most certain position of each track in each frame, sorted by frame and track."""
    order = np.lexsort((source, track, frame))
    frame, track = frame[order], track[order]
    changes = (np.diff(frame) != 0) | (np.diff(track) != 0)
    return np.asarray(order[np.r_[True, changes][: len(order)]])


def keep_surest(positions: pd.DataFrame) -> pd.DataFrame:
    """The most certain position of each track in each frame."""
    rows = _surest(*(positions[name].to_numpy() for name in ("frame", "track_id", "source")))
    return positions.iloc[rows].reset_index(drop=True)


def _between_frames(known: _Columns, frames: IntArray, times_s: FloatArray) -> _Columns:
    """Frames that a track misses for a moment, linearly in time."""
    order = np.lexsort((known["frame"], known["track_id"]))
    track, time_s = known["track_id"][order], known["time_s"][order]
    rank = np.searchsorted(frames, known["frame"][order])
    same = np.diff(track) == 0
    missed = np.where(same & (np.diff(time_s) <= _MISSED_S), np.maximum(np.diff(rank) - 1, 0), 0)
    row = np.repeat(np.arange(len(missed)), missed)
    step = np.arange(len(row)) - np.repeat(np.cumsum(missed) - missed, missed) + 1
    frame = frames[rank[row] + step] if len(row) else np.empty(0, np.int64)
    part = (times_s[frame] - time_s[row]) / (time_s[row + 1] - time_s[row])
    before, after = order[row], order[row + 1]
    xy = {one: known[one][before] + part * (known[one][after] - known[one][before]) for one in ("x_px", "y_px")}
    return {"track_id": track[row], "frame": frame, "time_s": times_s[frame], **xy}


def _across_gaps(
    found: Recovered, candidates: Candidates, metres: float, frames: IntArray, times_s: FloatArray
) -> _Columns:
    """Frames within the gaps that were closed, on the way across them."""
    usable_s = times_s[frames]  # ascending
    tracks, inside, places = [np.empty(0, np.int64)], [np.empty(0, np.int64)], [np.empty((0, 2))]
    for gap in found.gaps:
        here = frames[slice(*(np.searchsorted(usable_s, gap.time_s[k], side=("right", "left")[k]) for k in (0, 1)))]
        if len(here):
            tracks.append(np.full(len(here), gap.track_id))
            inside.append(here)
            places.append(interpolate_gap(gap, candidates, times_s[here]) / metres)
    frame, xy = np.concatenate(inside), np.concatenate(places)
    columns = {"track_id": np.concatenate(tracks), "frame": frame, "time_s": times_s[frame]}
    return {**columns, "x_px": xy[:, 0], "y_px": xy[:, 1]}


@dataclass(frozen=True)
class Triples:
    """Detections of a track in three usable frames in a row of which only the track confirmed one, by track and frame.

    ``track_id`` (n,), ``frame`` (n,) of the first, ``ids`` (n, 3) of the detections.
    """

    track_id: IntArray
    frame: IntArray
    ids: IntArray

    def take(self, rows: IntArray) -> "Triples":
        return Triples(self.track_id[rows], self.frame[rows], self.ids[rows])


def find_triples(positions: pd.DataFrame, frames: TrackFrames, max_interval_s: float) -> Triples:
    """Candidate tracklets that contain a detection confirmed by its track only, from `TRACK_POSITION_COLUMNS`."""
    known = positions[positions["source"] < 2].sort_values(["track_id", "frame"], ignore_index=True)
    track, frame = known["track_id"].to_numpy(), known["frame"].to_numpy()
    near = (np.diff(track) == 0) & (np.diff(np.cumsum(frames.usable)[frame]) == 1)
    near &= np.diff(known["time_s"].to_numpy()) <= max_interval_s
    confirmed = known["source"].to_numpy() == 1
    first = np.flatnonzero(near[:-1] & near[1:]) if len(near) > 1 else np.empty(0, np.int64)
    first = first[(confirmed[first] | confirmed[first + 1] | confirmed[first + 2])]
    ids = known["detection_id"].to_numpy()
    return Triples(track[first], frame[first], np.stack([ids[first + k] for k in range(3)], axis=1))
