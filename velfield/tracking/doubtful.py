"""Doubtful things: tracks that never moved, far from vehicles, of which the detector is less sure than of the traffic;
and detections that no track confirms.

A detector reports roof gear, sheds and shadows as well as parked cars, and all of them stand still. What moved is a
vehicle: its score shows how sure the detector is of vehicles in this flight. A thing that stands next to a sure vehicle
or where others drove is taken for one; the farther away it stands, and the less often it is found, the higher a score
it needs, up to a limit. What is found in few of the frames that show its place is mostly a tree or a roof.

A vehicle is found again in the frames before and after, a leaf or a part of a shadow is not.
"""

from collections.abc import Callable

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from schemas.arrays import FloatArray, IntArray, Mask
from schemas.flight import STATIONARY_SPEED_M_PER_S

MOVED_M = 2.0
"""A displacement of half a car's length is no error of its position."""
_ENDS = 3
"""Positions averaged at each end of a track that has twice as many; of a shorter one fewer."""
_STANDS_M = 1.0
"""A thing that may have moved farther, or faster than what is stationary, is not doubted."""
_MIN_TRAFFIC = 10
"""Fewer moving vehicles do not give the usual score."""
_DRIVEN_M = 6.0
"""A thing nearer than this to a path of the traffic stands in a lane or at the kerb."""
_LEAST, _SLOPE, _SCALE_M, _SEEN, _ENOUGH = -0.27, 1.16, 5.0, 1.17, 0.85
_MANY = 40
"""Least score, over the median score of the traffic, at a distance d from the nearest sure vehicle, of a thing that is
found in a fraction s of the frames that show its place, or of `_MANY` of them:
_LEAST + _SLOPE ln(1 + d / _SCALE_M) - _SEEN s, which is 0 at 12 m and 0.5 at 22 m for what is always found, at 5 and
11 m for what is found in every other frame; at most _ENOUGH.

By logistic regression on what stands in three simulated cities (317 vehicles, 58 other things) and a clip of 1080p (42,
144), each flight and each kind weighing alike. Of the cities it keeps 0.987 of the vehicles and 5 other things, of the
clip 0.810 and 44; without s 0.990, 10, 0.833 and 61.
"""

_LONE_RANK = 0.1
"""A detection in no track needs a higher score than this fraction of the tracks: a vehicle at the edge of the picture,
or too fast for its frame rate, has one. In a frame of the clip of 1080p it sets apart 23 others and no vehicle; in two
simulated cities 57 and 51 for 3 and 1 of 3,559 and 4,498; of pictures at 2 frames a second 19 and 8 for 8 and 8 of
1,311 and 509.
"""


def find_doubtful(
    positions: pd.DataFrame, score: pd.Series, metres: float, count_views: Callable[[FloatArray], FloatArray]
) -> IntArray:
    """Tracks of things that are no vehicles more often than not, ascending.

    Parameters
    ----------
    positions
        ``track_id, time_s, x_px, y_px`` of detections of tracks.
    score
        Mean score of the detections of each track, by ``track_id``.
    metres
        A base pixel, m.
    count_views
        From positions (n, 2), base px, to the number of frames (n,) that show each.
    """
    table = positions.sort_values(["track_id", "time_s"], ignore_index=True)
    groups = table.groupby("track_id")
    places = groups[["x_px", "y_px"]].median()
    xy_m, scores = places.to_numpy(np.float64) * metres, score.reindex(places.index).to_numpy(np.float64)
    between = end_means(table, last=True) - end_means(table, last=False)
    displacement_m = np.hypot(*between[["x_px", "y_px"]].to_numpy(np.float64).T) * metres
    moved = displacement_m > MOVED_M
    speed_m_per_s = displacement_m / np.maximum(between["time_s"].to_numpy(np.float64), 1e-9)
    usual = float(np.median(scores[moved])) if moved.sum() >= _MIN_TRAFFIC else 0.0
    if usual <= 0:
        return np.empty(0, np.int64)
    moving = np.repeat(moved, groups.size().to_numpy())
    driven_m = table.loc[moving, ["x_px", "y_px"]].to_numpy(np.float64) * metres
    cells = np.unique(np.rint(driven_m), axis=0)  # of 1 m: a long flight has many positions
    stands = (displacement_m < _STANDS_M) & (speed_m_per_s < STATIONARY_SPEED_M_PER_S)
    at_road = cKDTree(cells).query(xy_m)[0] < _DRIVEN_M
    distance_m = _distances_to_others(xy_m, scores >= usual)
    seen = np.minimum(groups.size() / np.clip(count_views(places.to_numpy(np.float64)), 1, _MANY), 1.0)
    least = np.minimum(_LEAST + _SLOPE * np.log1p(distance_m / _SCALE_M) - _SEEN * seen, _ENOUGH)
    return np.asarray(places.index.to_numpy(np.int64)[stands & ~at_road & (scores < usual * least)])


def find_lone(detections: pd.DataFrame, in_tracks: pd.DataFrame, track_score: pd.Series) -> pd.DataFrame:
    """Rows of detections that no track confirms, and whose score is low.

    Parameters
    ----------
    detections
        ``detection_id, frame, score`` of some frames.
    in_tracks
        ``detection_id, frame`` of the detections of tracks, in these frames. A frame without any is not judged: nothing
        could be followed through it.
    track_score
        Mean score of the detections of each track that is not doubtful. Fewer than `_MIN_TRAFFIC` give no usual score.
    """
    if len(track_score) < _MIN_TRAFFIC:
        return detections[:0]
    judged = detections["frame"].isin(in_tracks["frame"]) & ~detections["detection_id"].isin(in_tracks["detection_id"])
    lone: pd.DataFrame = detections[judged & (detections["score"] < track_score.quantile(_LONE_RANK))]
    return lone


def end_means(positions: pd.DataFrame, *, last: bool) -> pd.DataFrame:
    """Mean ``time_s, x_px, y_px`` of the first or last positions of each track, by ``track_id``, from a table in time
    order."""
    groups = positions.groupby("track_id")
    rank, size = groups.cumcount(ascending=not last), groups["time_s"].transform("size")
    ends = positions[rank < np.clip(size // 2, 1, _ENDS)]
    return pd.DataFrame(ends.groupby("track_id")[["time_s", "x_px", "y_px"]].mean())


def _distances_to_others(xy_m: FloatArray, sure: Mask) -> FloatArray:
    """Distance (n,) of each place to the nearest other one that is sure."""
    distances_m = np.asarray(cKDTree(xy_m[sure]).query(xy_m, k=2)[0], np.float64)
    return np.where(sure, distances_m[:, 1], distances_m[:, 0])
