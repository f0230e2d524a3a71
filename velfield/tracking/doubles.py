"""Tracks of one vehicle beside each other.

A vehicle's shadow, or the cab and the load of a lorry, may each have a track. Two vehicles that drive in one lane keep
a distance of more than a vehicle's length; two tracks that keep a shorter one, and the same one, while they move are
one vehicle's, and one of them is a double. Where a vehicle is detected now in one of its parts, now in the other, each
track is inferred while the other is seen: they are joined.
"""

from dataclasses import dataclass

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
"""Tracks that were split: maximum distance along the way between the parts of a lorry; minimum fraction of the common
frames in which they are in one place; maximum fraction in which both are seen; and maximum duration for which either
is inferred, as its place is too uncertain beyond it."""
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
    ids, counts = np.unique(table["track_id"].to_numpy(), return_counts=True)
    count, level = dict(zip(ids.tolist(), counts.tolist(), strict=True)), grey.to_dict()
    doubles: set[int] = set()
    part, _, both_seen = _count_seen(pairs)
    for k in np.flatnonzero(both_seen >= _MIN_FRAMES).tolist():
        rows = pairs.take(np.arange(part[k], part[k + 1]))
        darker, brighter = sorted(rows.ids(), key=lambda track: (level.get(track, np.inf), -track))
        black = level.get(darker, np.nan) <= _BLACK * level.get(brighter, np.nan)
        long_enough = len(rows) >= _MIN_SHARE * min(count[darker], count[brighter])
        abreast_m = _BLACK_ABREAST_M if black else _ABREAST_M
        both = rows.take(np.flatnonzero(rows.seen == 2))
        if long_enough and brighter not in doubles and _in_lockstep(both, abreast_m):
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
    for rows in (pairs.take(np.arange(part[k], part[k + 1])) for k in np.flatnonzero(possible)):
        both = rows.ids()
        first, second = (frame[slice(*np.searchsorted(track, [number, number + 1]))] for number in both)
        if _in_one_place(rows).sum() >= max(_SPLIT_SHARE * len(np.intersect1d(first, second)), _MIN_FRAMES):
            found.append(both)
    if not found:
        return pd.Series(dtype=np.int64)
    ids, edges = np.unique(np.array(found, np.int64), return_inverse=True)
    return pd.Series(component_minimum(ids, edges.reshape(-1, 2)), index=ids)


@dataclass(frozen=True)
class _Pairs:
    """Pairs of tracks that are near in a frame, by track and time."""

    one: IntArray
    other: IntArray
    """(n,) ids of the tracks."""
    time_s: FloatArray
    xy_m: FloatArray
    offset_m: FloatArray
    """(2, n) position of one, and offset of the other, m: a row is in one piece of memory, so that sums over it are
    accurate."""
    seen: IntArray
    """(n,) how many of the two are seen."""

    def __len__(self) -> int:
        return len(self.one)

    def take(self, rows: IntArray) -> "_Pairs":
        return _Pairs(*(np.take(getattr(self, name), rows, axis=-1) for name in self.__dataclass_fields__))

    def ids(self) -> tuple[int, int]:
        """Both tracks, of rows of one pair."""
        return int(self.one[0]), int(self.other[0])


def _count_seen(pairs: _Pairs) -> tuple[IntArray, IntArray, IntArray]:
    """First row of each pair of tracks (k + 1,), and the numbers of rows in which one is seen, and both (k,)."""
    changes = (np.diff(pairs.one) != 0) | (np.diff(pairs.other) != 0)
    begin = np.flatnonzero(np.r_[True, changes][: len(pairs)])
    counts = [np.add.reduceat((pairs.seen == n).astype(np.int64), begin) if len(begin) else begin for n in (1, 2)]
    return np.r_[begin, len(pairs)], counts[0], counts[1]


def _moving(table: pd.DataFrame, metres: float) -> pd.DataFrame:
    """Positions, sorted by track, of the tracks that get somewhere."""
    xy = table.groupby("track_id")[["x_px", "y_px"]]
    extent = np.hypot(*(xy.max() - xy.min()).to_numpy().T) * metres
    moves = extent[np.unique(table["track_id"], return_inverse=True)[1]] >= _MIN_EXTENT_M
    kept: pd.DataFrame = table[moves].reset_index(drop=True)
    return kept


def _inferred_s(table: pd.DataFrame) -> FloatArray:
    """Duration of the inferred part of the track around each position (n,), sorted by track and frame; 0 where seen."""
    seen = table["time_s"].where(table["source"] < _SEEN)
    before, after = seen.groupby(table["track_id"]).ffill(), seen.groupby(table["track_id"]).bfill()
    return np.asarray((after - before).fillna(np.inf), dtype=np.float64)


def _in_one_place(rows: _Pairs) -> FloatArray:
    """Whether a pair is nearer in each row than two vehicles are, along the way and across it."""
    offset, heading, _ = _driven(rows)
    along = (offset * heading).sum(axis=1)
    across = np.hypot(*(offset - along[:, None] * heading).T)
    return np.asarray((np.abs(along) <= _PARTS_M) & (across <= _MAX_ASIDE_M))


def _near_pairs(table: pd.DataFrame, metres: float) -> _Pairs:
    """Pairs of tracks that are near in a frame."""
    xy, track = table[["x_px", "y_px"]].to_numpy(np.float64) * metres, table["track_id"].to_numpy(np.int64)
    found: list[IntArray] = [np.empty((0, 2), np.int64)]
    frame = table["frame"].to_numpy(np.int64)
    order = np.argsort(frame, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(frame[order])) + 1):
        near = cKDTree(xy[rows]).query_pairs(_MAX_SPACING_M + _MAX_SPREAD_M, output_type="ndarray")
        found.append(rows[near])
    pair = np.concatenate(found)
    one, other = np.where(track[pair[:, 0]] > track[pair[:, 1]], pair[:, ::-1].T, pair.T)
    time_s = table["time_s"].to_numpy(np.float64)[one]
    rank = np.lexsort((time_s, track[other], track[one]))
    one, other = one[rank], other[rank]
    seen = (table["source"].to_numpy() < _SEEN).astype(np.int64)
    place, further = (np.take(xy.T, rows, axis=1) for rows in (one, other))
    return _Pairs(track[one], track[other], time_s[rank], place, further - place, seen[one] + seen[other])


def _in_lockstep(rows: _Pairs, abreast_m: float) -> bool:
    """Whether the pair keeps its spacing, in the world as a shadow does, or along the vehicle as a load does.

    To any side up to ``abreast_m``.
    """
    offset, heading, speed = _driven(rows)
    if np.median(speed) < _MIN_SPEED_M_PER_S:
        return False
    along = (offset * heading).sum(axis=1)
    across = heading[:, 0] * offset[:, 1] - heading[:, 1] * offset[:, 0]
    spacing = min(_SPACING_M + _SPACING_S * float(np.median(speed)), _MAX_SPACING_M)
    distance = float(np.hypot(*np.median(offset, axis=0)))
    near = distance <= abreast_m or (distance <= spacing and abs(np.median(across)) <= _MAX_ASIDE_M)
    spread = min(_spread(offset), _spread(np.column_stack([along, across])))
    return bool(near and spread <= _MAX_SPREAD_M)


def _driven(rows: _Pairs) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Offsets (n, 2) m of a pair of tracks, and the first one's headings (n, 2), unit vectors, and speeds (n,) m/s."""
    velocity = np.gradient(rows.xy_m.T, rows.time_s, axis=0)
    speed = np.hypot(*velocity.T)
    return rows.offset_m.T, velocity / np.maximum(speed, 1e-9)[:, None], speed


def _spread(offset: FloatArray) -> float:
    return float(np.sqrt(offset.var(axis=0).sum()))
