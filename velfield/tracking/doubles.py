"""Tracks of one vehicle beside each other: doubles, and tracks that were split.

A vehicle's shadow, or the cab and the load of a lorry, may each have a track. Two vehicles that drive in one lane keep
a distance of more than a vehicle's length; two tracks that keep a shorter one, and the same one, while they move are
one vehicle's, and one of them is a double. Where a vehicle is detected now in one of its parts, now in the other, each
track is inferred while the other is seen: they are joined.
"""

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from schemas.arrays import FloatArray, IntArray
from velfield.tracking.joins import component_minimum

_SPACING_M, _SPACING_S, _MAX_SPACING_M = 5.0, 0.25, 8.0
"""From centre to centre, and more with speed: two cars that queue bumper to bumper are 6 m apart, and driving ones keep
a gap of half a second and more."""
_MAX_ASIDE_M = 1.8
"""Across the direction of travel: a vehicle in the next lane is 3 m and more away."""
_ABREAST_M, _BLACK_ABREAST_M, _BLACK = 2.6, 3.2, 0.3
"""Two vehicles are not nearer to each other, side by side either; nor is one, for long, to one that has so small a part
of its grey level, as the shadow of a van in a low sun has."""
_MAX_SPREAD_M = 0.8
"""Standard deviation of the spacing: of detections' positions, not of driving."""
_MIN_SPEED_M_PER_S, _MIN_EXTENT_M = 2.5, 8.0
_MIN_FRAMES, _MIN_SHARE = 4, 0.6
"""Frames that both have, and their share of those of the shorter one."""
_PARTS_M, _SPLIT_SHARE, _MAX_SEEN_SHARE, _MAX_SPLIT_S = 3.5, 0.8, 0.35, 4.0
"""Of tracks that were split: how far apart along the way the parts of a lorry are; of the frames that both have, the
share in which they are in one place, at least, and in which both are seen, at most; and how long either is inferred,
beyond which its place is too uncertain."""
_SEEN = 2
"""Positions whose ``source`` is below this are seen; the others are inferred."""


def find_doubles(positions: pd.DataFrame, grey: pd.Series, metres: float) -> IntArray:
    """Ids of the tracks that are doubles of another, which is brighter: a shadow is darker than what casts it.

    Parameters
    ----------
    positions
        ``track_id, frame, time_s, x_px, y_px, source`` of every track, inferred ones too.
    grey
        Mean grey level of each track's vehicle, by ``track_id``; of tracks that it lacks nothing is known.
    metres
        A base pixel, m.

    Examples
    --------
    >>> t = np.arange(8) * 0.2
    >>> car = pd.DataFrame({"track_id": 1, "frame": range(8), "time_s": t, "x_px": 50 * t, "y_px": 0.0, "source": 0})
    >>> shadow = car[1:].assign(track_id=2, x_px=50 * t[1:] + 14)
    >>> find_doubles(pd.concat([car, shadow]), pd.Series({1: 140.0, 2: 40.0}), 0.25).tolist()
    [2]
    """
    if not len(positions):
        return np.empty(0, np.int64)
    table = positions.sort_values(["track_id", "frame"], ignore_index=True)
    table = _moving(table, metres)
    pairs = _near_pairs(table, metres)
    if not len(pairs):
        return np.empty(0, np.int64)
    count = table["track_id"].value_counts()
    doubles: set[int] = set()
    part, _, both_seen = _count_seen(pairs)
    for rows in (pairs[part[k] : part[k + 1]] for k in np.flatnonzero(both_seen >= _MIN_FRAMES)):
        both = [int(rows[name].iloc[0]) for name in ("one", "other")]
        darker, brighter = sorted(both, key=lambda track: (grey.get(track, np.inf), -track))
        black = grey.get(darker, np.nan) <= _BLACK * grey.get(brighter, np.nan)
        long_enough = len(rows) >= _MIN_SHARE * min(count[darker], count[brighter])
        abreast_m = _BLACK_ABREAST_M if black else _ABREAST_M
        if long_enough and brighter not in doubles and _in_lockstep(rows[rows["seen"] == 2], abreast_m):
            doubles.add(darker)
    return np.array(sorted(doubles), np.int64)


def find_split_tracks(positions: pd.DataFrame, metres: float) -> pd.Series:
    """Tracks that are parts of one vehicle's: each is inferred while another one is seen in its place.

    Parameters
    ----------
    positions
        ``track_id, frame, time_s, x_px, y_px, source`` of every track, inferred ones too.
    metres
        A base pixel, m.

    Returns
    -------
    The id of the whole, by the id of each part; only of tracks that are parts.

    Examples
    --------
    >>> t = np.arange(12) * 0.2
    >>> seen = np.repeat([0, 2, 0], 4)  # by `source`: four frames seen, four inferred, four seen
    >>> cab = pd.DataFrame({"track_id": 1, "frame": range(12), "time_s": t, "x_px": 50 * t, "y_px": 0.0})
    >>> cab = cab.assign(source=seen)
    >>> load = cab.assign(track_id=2, x_px=50 * t - 6, source=2 - seen)
    >>> find_split_tracks(pd.concat([cab, load]), 0.25).to_dict()
    {1: 1, 2: 1}
    """
    table = _moving(positions.sort_values(["track_id", "frame"], ignore_index=True), metres)
    table = table[_inferred_s(table) <= _MAX_SPLIT_S].reset_index(drop=True)
    pairs = _near_pairs(table, metres)
    part, one_seen, both_seen = _count_seen(pairs)
    possible = (np.diff(part) >= _MIN_FRAMES) & (both_seen <= _MAX_SEEN_SHARE * np.diff(part)) & (one_seen > 0)
    track, frame = table["track_id"].to_numpy(np.int64), table["frame"].to_numpy(np.int64)
    found = []
    for rows in (pairs[part[k] : part[k + 1]] for k in np.flatnonzero(possible)):
        both = [int(rows[name].iloc[0]) for name in ("one", "other")]
        first, second = (frame[slice(*np.searchsorted(track, [number, number + 1]))] for number in both)
        if _in_one_place(rows).sum() >= max(_SPLIT_SHARE * len(np.intersect1d(first, second)), _MIN_FRAMES):
            found.append(both)
    if not found:
        return pd.Series(dtype=np.int64)
    ids, edges = np.unique(np.array(found, np.int64), return_inverse=True)
    return pd.Series(component_minimum(ids, edges.reshape(-1, 2)), index=ids)


def _count_seen(pairs: pd.DataFrame) -> tuple[IntArray, IntArray, IntArray]:
    """Of a table of `_near_pairs`, where the rows of each pair begin (k + 1,), and in how many of them one is seen, and
    both (k,)."""
    numbers, seen = pairs[["one", "other"]].to_numpy(), pairs["seen"].to_numpy()
    begin = np.flatnonzero(np.r_[True, (np.diff(numbers, axis=0) != 0).any(axis=1)][: len(pairs)])
    counts = [np.add.reduceat((seen == n).astype(np.int64), begin) if len(begin) else begin for n in (1, 2)]
    return np.r_[begin, len(pairs)], counts[0], counts[1]


def _moving(table: pd.DataFrame, metres: float) -> pd.DataFrame:
    """Positions, sorted by track, of the tracks that get somewhere."""
    xy = table.groupby("track_id")[["x_px", "y_px"]]
    extent = np.hypot(*(xy.max() - xy.min()).to_numpy().T) * metres
    moves = extent[np.unique(table["track_id"], return_inverse=True)[1]] >= _MIN_EXTENT_M
    kept: pd.DataFrame = table[moves].reset_index(drop=True)
    return kept


def _inferred_s(table: pd.DataFrame) -> FloatArray:
    """How long the track is inferred around each position (n,), of a table by track and frame; 0 where it is seen."""
    seen = table["time_s"].where(table["source"] < _SEEN)
    before, after = seen.groupby(table["track_id"]).ffill(), seen.groupby(table["track_id"]).bfill()
    return np.asarray((after - before).fillna(np.inf), dtype=np.float64)


def _in_one_place(rows: pd.DataFrame) -> FloatArray:
    """Whether a pair is nearer in each row than two vehicles are, along the way and across it."""
    time, offset = rows["time_s"].to_numpy(), rows[["dx", "dy"]].to_numpy()
    velocity = np.gradient(rows[["x", "y"]].to_numpy(), time, axis=0)
    heading = velocity / np.maximum(np.hypot(*velocity.T), 1e-9)[:, None]
    along = (offset * heading).sum(axis=1)
    across = np.hypot(*(offset - along[:, None] * heading).T)
    return np.asarray((np.abs(along) <= _PARTS_M) & (across <= _MAX_ASIDE_M))


def _near_pairs(table: pd.DataFrame, metres: float) -> pd.DataFrame:
    """Pairs of tracks that are near in a frame, by track and time.

    Columns ``one, other, time_s``; how many of the two are ``seen``; position ``x, y`` of one and offset ``dx, dy`` of
    the other, m.
    """
    xy, track = table[["x_px", "y_px"]].to_numpy(np.float64) * metres, table["track_id"].to_numpy(np.int64)
    found: list[IntArray] = [np.empty((0, 2), np.int64)]
    frame = table["frame"].to_numpy(np.int64)
    order = np.argsort(frame, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(frame[order])) + 1):
        near = cKDTree(xy[rows]).query_pairs(_MAX_SPACING_M + _MAX_SPREAD_M, output_type="ndarray")
        found.append(rows[near])
    pair = np.concatenate(found)
    pair = np.where((track[pair[:, 0]] > track[pair[:, 1]])[:, None], pair[:, ::-1], pair)
    offset = xy[pair[:, 1]] - xy[pair[:, 0]]
    columns = {"one": track[pair[:, 0]], "other": track[pair[:, 1]], "time_s": table["time_s"].to_numpy()[pair[:, 0]]}
    seen = (table["source"].to_numpy() < _SEEN)[pair].sum(axis=1)
    places = {"x": xy[pair[:, 0], 0], "y": xy[pair[:, 0], 1], "dx": offset[:, 0], "dy": offset[:, 1]}
    pairs = pd.DataFrame({**columns, **places, "seen": seen})
    return pairs.sort_values(["one", "other", "time_s"], ignore_index=True)


def _in_lockstep(rows: pd.DataFrame, abreast_m: float) -> bool:
    """Whether the pair keeps its spacing, in the world as a shadow does, or along the vehicle as a load does.

    To any side up to ``abreast_m``.
    """
    time, offset = rows["time_s"].to_numpy(), rows[["dx", "dy"]].to_numpy()
    velocity = np.gradient(rows[["x", "y"]].to_numpy(), time, axis=0)
    speed = np.hypot(*velocity.T)
    if np.median(speed) < _MIN_SPEED_M_PER_S:
        return False
    heading = velocity / np.maximum(speed, 1e-9)[:, None]
    along = (offset * heading).sum(axis=1)
    across = heading[:, 0] * offset[:, 1] - heading[:, 1] * offset[:, 0]
    spacing = min(_SPACING_M + _SPACING_S * float(np.median(speed)), _MAX_SPACING_M)
    distance = float(np.hypot(*np.median(offset, axis=0)))
    near = distance <= abreast_m or (distance <= spacing and abs(np.median(across)) <= _MAX_ASIDE_M)
    spread = min(_spread(offset), _spread(np.column_stack([along, across])))
    return bool(near and spread <= _MAX_SPREAD_M)


def _spread(offset: FloatArray) -> float:
    return float(np.sqrt(offset.var(axis=0).sum()))
