"""Scores of a run's tracks against the truth: CLEAR MOT and identity metrics, by TrackEval's definitions.

- MOTA = 1 - (misses + false positives + identity switches) / true positions (Bernardin and Stiefelhagen 2008). Frame by
  frame, positions are matched to vehicles one to one; a match of the frame before is kept where it is still within
  reach. A switch is a vehicle matched to another track than the last time that it was matched.
- IDF1 = 2 IDTP / (true positions + positions of tracks) (Ristani and others 2016): over the whole flight each vehicle
  is assigned to at most one track, so that the number of positions they share, IDTP, is greatest.

Only vehicles that are visible and not cut by the frame's border count. A position on another vehicle is neither right
nor wrong, as with the ignored regions of MOTChallenge.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.optimize import linear_sum_assignment

from schemas.arrays import FloatArray, IntArray, Mask
from velfield.synthetic.score import MATCH_PX, apply_homography, cars_near_frame
from velfield.synthetic.truth import Truth

_KEPT_MATCH = 1000.0
"""A match of the frame before outweighs any distance, as in TrackEval."""


@dataclass(frozen=True)
class TrackScore:
    """Scores of the tracks of a flight."""

    idf1: float
    id_precision: float
    id_recall: float
    """Identity metrics."""
    mota: float
    """Multiple object tracking accuracy."""
    switches: int
    misses: int
    false_positives: int
    """Counts: of vehicles that change their track, of positions of vehicles without one of a track, and the other
    way."""
    positions: int
    """Number of true positions."""
    tracks_per_vehicle: float
    """Mean number of tracks of a vehicle, each track being that of the vehicle that it is matched to most."""
    mixed_tracks: float
    """Fraction of the tracks that are matched to two vehicles or more, in two frames or more each."""


def score_run_tracks(
    truth: Truth,
    tracks: pd.DataFrame,
    *,
    frame_of: Mapping[int, int],
    to_truth: FloatArray | None = None,
    moving_only: bool = False,
) -> TrackScore:
    """Score the positions of a run's tracks (`Run.track_positions`) over its registered frames.

    ``frame_of`` gives the flight's frame of each of these, ``to_truth`` the homography to the truth's base image where
    the run has another one. With ``moving_only`` the vehicles that never move and their tracks are ignored.
    """
    by_frame = dict(list(tracks.groupby("frame")))
    moving = truth.cars.loc[truth.cars["moving"], "vehicle_id"].unique()

    def objects(frame: int, flight_frame: int) -> FrameObjects:
        cars = cars_near_frame(truth, flight_frame)
        mine = by_frame.get(frame, tracks.iloc[:0])
        counts = cars["evaluated"].to_numpy(bool)
        return FrameObjects(
            vehicle=cars["vehicle_id"].to_numpy(np.int64),
            vehicle_xy=cars[["x_base_px", "y_base_px"]].to_numpy(np.float64),
            counts=counts & cars["vehicle_id"].isin(moving).to_numpy() if moving_only else counts,
            direction_rad=cars["orientation_rad"].to_numpy(np.float64),
            length_px=cars["length_px"].to_numpy(np.float64),
            track=mine["track_id"].to_numpy(np.int64),
            track_xy=apply_homography(to_truth, mine[["x_px", "y_px"]].to_numpy(np.float64)),
        )

    return score_tracks((objects(*pair) for pair in sorted(frame_of.items())), match_px=MATCH_PX)


@dataclass(frozen=True)
class FrameObjects:
    """Vehicles and track positions of one frame."""

    vehicle: IntArray
    vehicle_xy: FloatArray
    counts: Mask
    """(n,) ids, (n, 2) px, and (n,) whether the vehicle counts; the others are ignored."""
    direction_rad: FloatArray
    length_px: FloatArray
    """(n,) axes and lengths of the vehicles."""
    track: IntArray
    track_xy: FloatArray
    """(m,) ids and (m, 2) px."""


def score_tracks(frames: Iterator[FrameObjects], *, match_px: float) -> TrackScore:
    """Score tracks, frame by frame; a position within ``match_px`` of a vehicle's centre can match it, along a long
    vehicle within a third of its length (boxes that overlap by half, TrackEval's limit).
    """
    last: dict[int, int] = {}
    before: dict[int, int] = {}
    shared: dict[tuple[int, int], int] = {}
    followed: dict[tuple[int, int], int] = {}
    switches = matched = positions = claimed = 0
    for one in frames:
        pairs = _match_frame(one, before, match_px)
        ignored = np.zeros(len(one.track), bool)
        before = {}
        for vehicle_row, track_row in pairs:
            vehicle, track = int(one.vehicle[vehicle_row]), int(one.track[track_row])
            before[vehicle] = track
            if not one.counts[vehicle_row]:
                ignored[track_row] = True
                continue
            matched += 1
            switches += last.get(vehicle, track) != track
            last[vehicle] = track
            followed[vehicle, track] = followed.get((vehicle, track), 0) + 1
        positions += int(one.counts.sum())
        claimed += int((~ignored).sum())
        near = _distances(one, match_px) <= match_px
        for vehicle_row, track_row in np.argwhere(near & one.counts[:, None] & ~ignored[None, :]):
            key = int(one.vehicle[vehicle_row]), int(one.track[track_row])
            shared[key] = shared.get(key, 0) + 1
    true_positives = _identity_true_positives(shared)
    misses, false_positives = positions - matched, claimed - matched
    return TrackScore(
        idf1=2 * true_positives / max(positions + claimed, 1),
        id_precision=true_positives / max(claimed, 1),
        id_recall=true_positives / max(positions, 1),
        mota=1 - (misses + false_positives + switches) / max(positions, 1),
        switches=switches,
        misses=misses,
        false_positives=false_positives,
        positions=positions,
        **_continuity(followed),
    )


def _match_frame(one: FrameObjects, before: Mapping[int, int], match_px: float) -> IntArray:
    """(k, 2) rows of vehicles and of tracks: the best one-to-one match within reach, matches of the frame before
    first."""
    distance = _distances(one, match_px)
    kept = np.array([before.get(int(vehicle), -1) for vehicle in one.vehicle])[:, None] == one.track[None, :]
    gain = np.where(distance <= match_px, 1 - distance / (2 * match_px) + _KEPT_MATCH * kept, 0.0)
    rows, columns = linear_sum_assignment(-gain)
    real = gain[rows, columns] > 0
    return np.column_stack([rows[real], columns[real]])


def _distances(one: FrameObjects, match_px: float) -> FloatArray:
    """(vehicles, positions) px; along a long vehicle shortened so that ``match_px`` is a third of its length."""
    difference = one.track_xy[None, :] - one.vehicle_xy[:, None]
    cos, sin = np.cos(one.direction_rad)[:, None], np.sin(one.direction_rad)[:, None]
    along = difference[..., 0] * cos + difference[..., 1] * sin
    across = difference[..., 1] * cos - difference[..., 0] * sin
    shortened = along * np.minimum(match_px / (one.length_px / 3), 1.0)[:, None]
    return np.asarray(np.hypot(shortened, across))


def _identity_true_positives(shared: Mapping[tuple[int, int], int]) -> int:
    """The greatest number of shared positions, each vehicle with at most one track and each track with one vehicle.

    An assignment that leaves one out loses just what they share, so only pairs that share positions matter.
    """
    vehicles, tracks = (sorted({pair[side] for pair in shared}) for side in (0, 1))
    table = np.zeros((len(vehicles), len(tracks)))
    row, column = ({one: k for k, one in enumerate(ids)} for ids in (vehicles, tracks))
    for (vehicle, track), count in shared.items():
        table[row[vehicle], column[track]] = count
    rows, columns = linear_sum_assignment(-table)
    return int(table[rows, columns].sum())


def _continuity(followed: Mapping[tuple[int, int], int]) -> dict[str, float]:
    best: dict[int, tuple[int, int]] = {}
    strong: dict[int, int] = {}
    for (vehicle, track), count in followed.items():
        best[track] = max(best.get(track, (0, -1)), (count, vehicle))
        strong[track] = strong.get(track, 0) + (count >= 2)
    owners = {vehicle for _, vehicle in best.values()}
    return {
        "tracks_per_vehicle": len(best) / max(len(owners), 1),
        "mixed_tracks": sum(count > 1 for count in strong.values()) / max(len(best), 1),
    }
