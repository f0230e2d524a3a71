"""Shadows that are tracked in place of the vehicle that casts them.

A large white vehicle is sometimes not detected, while its shadow is, as a black car. Nothing in the shadow itself
separates it from one. What does is beside it: towards the sun, and touching it, there is a bright body of a vehicle's
shape that moves with it. So the frames of a black track are compared with the same ground in other frames, while the
vehicle is elsewhere, which takes away the road, its markings and the buildings beside it, and are laid over each other
along the track, which blurs what drives at another pace. Where such a body stays, the track is of its shadow. Where no
other track is on the body, it is where the vehicle is; else the vehicle has a track, and its shadow should have none.

Which tracks are looked at, and in which direction shadows lie, follows without frames from what is stored of each
detection (`velfield.tracking.dimensions.may_be_shadows`, `shadow_direction`).
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import groupby
from operator import itemgetter

import cv2
import numpy as np
import pandas as pd

from schemas.arrays import Float32Array, FloatArray, IntArray, Mask

HALF_WINDOW_M = 22.0
"""About a position: a long bus, half of its shadow, and what ends them."""
_DARK, _BODY = 0.3, 0.2
"""How much darker than the road the pixels of a shadow are, of the road's grey level; and how much brighter those of a
caster, of the contrast of road and shadow."""
_MIN_SEEN, _FRAMES, _BACKGROUND = 8, 8, 3
"""Positions that are seen, the fewest; frames that are laid over each other; frames that show the ground of each."""
MIN_DRIVEN_M, _CLEAR_M = 15.0, 16.0
"""How far a track gets, at least; how far away a vehicle leaves its ground free."""
_STRAIGHT_RAD = np.radians(15)
"""Directions of travel of frames that are laid over each other differ from the middle one by no more."""
_MIN_SHARE = 0.75
"""Of the frames in which a pixel is bright, or dark: what moves with the track."""
_LENGTH_M, _WIDTH_M, _MIN_FILL, _MAX_GAP_M = (3.5, 20.0), (1.4, 3.6), 0.6, 1.0
"""A vehicle along its way and across it; how much of that rectangle it fills; what may lie between it and its shadow,
as a front that faces away from the sun."""
_MIN_SHADOW_M2, _MAX_EXTENT_RATIO = 2.0, 1.7
"""Of a shadow; and how far its extent across the sun's direction may differ from the caster's."""
_MAX_SIDE_RAD = np.radians(60)
"""A long caster's shadow as a whole lies off the sun's direction by up to so much."""
Look = Callable[[int, FloatArray], Float32Array]
"""``(frame, xy_px (k, 2)) -> (k, n, n)``: a frame about positions in the base image, grey levels; NaN outside it."""


@dataclass(frozen=True)
class Caster:
    """A vehicle beside its shadow.

    ``offset_m`` (2,) of its centre from the positions of the shadow's track; its dimensions; whether it has a track of
    its own.
    """

    offset_m: FloatArray
    length_m: float
    width_m: float
    tracked: bool = False


@dataclass(frozen=True)
class _Views:
    """Where a track is looked at: positions (k, 2) px and frames (k,), the mean heading (2,), and of each position the
    rows of the frames that show its ground, (k, 3)."""

    frame: IntArray
    xy_px: FloatArray
    heading: FloatArray
    ground: IntArray

    def served_by(self, k: int) -> IntArray:
        """The positions that the k-th frame is read for: its own, and those whose ground it shows."""
        return np.flatnonzero((self.ground == k).any(axis=1) | (np.arange(len(self.frame)) == k))


def find_casters(
    positions: pd.DataFrame, suspects: IntArray, direction: FloatArray, look: Look, pixel_m: float, metres: float
) -> dict[int, Caster]:
    """The vehicles that cast what is tracked, by the tracks of their shadows.

    Parameters
    ----------
    positions
        ``track_id, frame, x_px, y_px, source`` of every track.
    suspects
        Ids of tracks that may be of shadows.
    direction
        Where shadows lie from what casts them, a unit vector (2,).
    look
        Reads frames; each frame is asked for once, in order.
    pixel_m, metres
        A pixel of what ``look`` gives, and a base pixel, m.
    """
    views = {}
    for track in sorted(suspects.tolist()):
        view = _choose_views(positions[positions["track_id"] == track], metres)
        if view is not None:
            views[track] = view
    casters = {}
    for track, images in _read_views(views, look):
        view = views[track]
        changes = images - _median_ground(view, images)
        own = np.stack([changes[k, k] for k in range(len(view.frame))])
        ground = np.stack([images[k, k] for k in range(len(view.frame))]) - own
        seen = ground[np.isfinite(ground)]
        if not len(seen):
            continue
        caster = find_caster(own, float(np.median(seen)), view.heading, direction, pixel_m)
        if caster is not None:
            tracked = _is_tracked(caster, view, positions[positions["track_id"] != track], metres)
            casters[track] = replace(caster, tracked=tracked)
    return casters


def _choose_views(track: pd.DataFrame, metres: float) -> _Views | None:
    """Frames of a stretch of one direction, spread over it; None where a track is too short to be judged."""
    seen = track[track["source"] < 2].sort_values("frame")
    if len(seen) < _MIN_SEEN:
        return None
    xy = seen[["x_px", "y_px"]].to_numpy(np.float64)
    step = np.gradient(xy, axis=0)
    mean = np.median(step, axis=0)
    turn = np.arctan2(mean[0] * step[:, 1] - mean[1] * step[:, 0], step @ mean)
    straight = np.flatnonzero((np.abs(turn) <= _STRAIGHT_RAD) & (np.hypot(*step.T) > 0))
    if len(straight) < _MIN_SEEN or np.hypot(*(xy[straight[-1]] - xy[straight[0]])) * metres < MIN_DRIVEN_M:
        return None
    driven = np.abs((xy[straight] - xy[straight[0]]) @ mean)
    goals = np.linspace(driven.min(), driven.max(), _FRAMES)
    rows = np.unique(straight[np.abs(driven - goals[:, None]).argmin(axis=1)])
    if len(rows) <= _BACKGROUND:
        return None
    heading = xy[rows[-1]] - xy[rows[0]]
    distance = np.hypot(*(xy[rows][:, None] - xy[rows]).transpose(2, 0, 1)) * metres
    # The nearest ones of those that are clear of it, then the farthest of the others: the camera may fly on.
    order = np.where(distance >= _CLEAR_M, distance, 1e6 - distance)
    ground = np.argsort(order, axis=1, kind="stable")[:, :_BACKGROUND]
    frame = seen["frame"].to_numpy(np.int64)[rows]
    return _Views(frame, xy[rows], heading / np.hypot(*heading), ground)


def _read_views(views: Mapping[int, _Views], look: Look) -> Iterator[tuple[int, Float32Array]]:
    """Each track, once all of its frames are read, with (k, k, n, n): each frame about each position that it serves,
    NaN about the others."""
    images: dict[int, Float32Array] = {}
    served = sorted((frame, track, k) for track, view in views.items() for k, frame in enumerate(view.frame.tolist()))
    for frame, group in groupby(served, key=itemgetter(0)):
        parts = [(track, k, views[track].served_by(k)) for _, track, k in group]
        seen = look(frame, np.concatenate([views[track].xy_px[asked] for track, _, asked in parts]))
        for track, k, asked in parts:
            count = len(views[track].frame)
            if track not in images:
                images[track] = np.full((count, count, *seen.shape[1:]), np.nan, np.float32)
            images[track][k, asked], seen = seen[: len(asked)], seen[len(asked) :]
            if k == count - 1:
                yield track, images.pop(track)


def _median_ground(view: _Views, images: Float32Array) -> Float32Array:
    """(k, n, n): what the ground about each position looks like without the vehicle; NaN where it is not seen."""
    own = np.stack([images[rows, at] for at, rows in enumerate(view.ground)])
    return np.asarray(np.median(own, axis=1))


def find_caster(
    changes: Float32Array, road: float, heading: FloatArray, direction: FloatArray, pixel_m: float
) -> Caster | None:
    """The bright body that casts a shadow, which is in the middle of images that are laid over each other.

    Parameters
    ----------
    changes
        (k, n, n) grey levels less those of the ground without vehicles; NaN where that is not seen.
    road
        Grey level of the ground.
    heading, direction
        Of travel, and from what casts shadows to its shadow; unit vectors (2,).
    """
    n = changes.shape[1]
    dark = (changes < -_DARK * road).mean(axis=0) >= _MIN_SHARE  # NaN is neither
    shadow = _nearest_component(dark, np.array([n // 2, n // 2]), _MAX_GAP_M / pixel_m)
    if shadow is None or shadow.sum() * pixel_m**2 < _MIN_SHADOW_M2:
        return None
    contrast = -float(np.nanmedian(changes[:, shadow]))
    bright = (changes > _BODY * contrast).mean(axis=0) >= _MIN_SHARE
    reach = 2 * (int(_MAX_GAP_M / pixel_m) + 1) + 1  # so many pixels may lie between
    near = cv2.dilate(shadow.astype(np.uint8), np.ones((reach, reach), np.uint8)).astype(bool)
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(bright.astype(np.uint8), connectivity=4)
    touching = np.unique(labels[near & bright])
    if count < 2 or not len(touching):
        return None
    body = labels == touching[np.argmax(statistics[touching, cv2.CC_STAT_AREA])]
    return _measure_pair(body, shadow, heading, direction, pixel_m)


def _nearest_component(mask: Mask, at: IntArray, reach_px: float) -> Mask | None:
    """The part of a mask (n, n) that is connected with its pixel nearest to ``at`` (row, column), if that is near."""
    rows = np.argwhere(mask)
    distance = np.hypot(*(rows - at).T)
    if not len(rows) or distance.min() > reach_px:
        return None
    labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)[1]
    nearest = rows[distance.argmin()]
    return np.asarray(labels == labels[nearest[0], nearest[1]])


def _measure_pair(
    body: Mask, shadow: Mask, heading: FloatArray, direction: FloatArray, pixel_m: float
) -> Caster | None:
    """The body as a vehicle, if it has the shape of one and the shadow is its."""
    if body[[0, -1]].any() or body[:, [0, -1]].any():
        return None  # it goes on outside
    middle = (len(body) - 1) / 2
    here, there = ((np.argwhere(mask)[:, ::-1] - middle) * pixel_m for mask in (body, shadow))
    side = np.array([-heading[1], heading[0]])
    (along, length), (across, width) = (_extent(here @ axis, pixel_m) for axis in (heading, side))
    filled = len(here) * pixel_m**2 / (length * width)
    if not (_within(length, _LENGTH_M) and _within(width, _WIDTH_M) and filled >= _MIN_FILL):
        return None
    offset = along * heading + across * side
    away = there.mean(axis=0) - offset
    if away @ direction < np.cos(_MAX_SIDE_RAD) * np.hypot(*away):
        return None
    # A shadow is as wide as what casts it, seen along the light.
    athwart = np.array([-direction[1], direction[0]])
    extents = [_extent(points @ athwart, pixel_m)[1] for points in (here, there)]
    if max(extents) > _MAX_EXTENT_RATIO * min(extents):
        return None
    return Caster(offset, length, width)


def _extent(along: FloatArray, pixel_m: float) -> tuple[float, float]:
    """Middle and length of points (n,) m along an axis, without single pixels that stick out."""
    low, high = np.quantile(along, [0.02, 0.98])
    return float(low + high) / 2, float(high - low) + pixel_m


def _within(value: float, limits: tuple[float, float]) -> bool:
    return limits[0] <= value <= limits[1]


def _is_tracked(caster: Caster, view: _Views, others: pd.DataFrame, metres: float) -> bool:
    """Whether another track is on the caster in more than one of the frames."""
    side = np.array([-view.heading[1], view.heading[0]])
    found = 0
    for frame, xy in zip(view.frame, view.xy_px, strict=True):
        there = others.loc[others["frame"] == frame, ["x_px", "y_px"]].to_numpy(np.float64)
        offset = (there - xy) * metres - caster.offset_m
        along, across = np.abs(offset @ view.heading), np.abs(offset @ side)
        found += bool(((along <= caster.length_m / 2) & (across <= caster.width_m / 2)).any())
    return found > 1


def keeps_direction(track: pd.DataFrame, metres: float) -> bool:
    """Whether a track (``frame, x_px, y_px``) goes straight on, so that its shadow keeps its place beside a
    vehicle."""
    xy = track.sort_values("frame")[["x_px", "y_px"]].to_numpy(np.float64) * metres
    whole = xy[-1] - xy[0]
    length = float(np.hypot(*whole))
    if length == 0:
        return False
    aside = np.abs(whole[0] * (xy - xy[0])[:, 1] - whole[1] * (xy - xy[0])[:, 0]) / length
    return bool(aside.max() <= np.tan(_STRAIGHT_RAD) * length / 2)
