"""The aligned classifier, run as a cascade: places from the scan, a few turns and offsets, then all rounds on the best.

A classifier of upright cars must learn every direction at once; learnt on cars turned to the horizontal it learns one
car, and tells the axis besides. Dense over all turns it would take a minute a frame; so places come first (`scan`), and
each stage lets go of those that it likes less than it liked nearly all of the cars that were left out of training.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from schemas.arrays import Float32Array, FloatArray, IntArray
from velfield.detection.boosting import BoostedSums
from velfield.detection.cascade.feature_image import Picture, scores_at
from velfield.detection.orientation import CAR_ASPECT

FIRST_ROUNDS, SECOND_ROUNDS = 60, 150
_FIRST_TURNS = np.radians([-18.0, 0.0, 18.0])
_SECOND_TURNS = np.radians([-12.0, 0.0, 12.0])
_LAST_TURNS = np.radians([-8.0, 0.0, 8.0])
_HOPE = 0.15
"""A place this far below the least score after the second rounds is let go: few come back from there."""
_NMS_ALONG, _NMS_ACROSS = 0.66, 0.4
"""Two finds within this ellipse, in car lengths, are one."""
_MAX_SHARED = 0.25
"""A find with more of its rectangle than this on better ones' is none."""
_SPOTS_ALONG, _SPOTS_ACROSS = 12, 5
_SHARP = 15.0
"""How strongly the best places and turns outweigh the others when they are averaged."""
_LEAST_SD_RAD = 0.02


def offset_grid(along: int, across: int, step: int = 1) -> IntArray:
    """Whole-pixel offsets (m, 2)."""
    return np.array(
        [(u, v) for u in range(-along, along + 1, step) for v in range(-across, across + 1, step)], np.int64
    )


_ROUGH, _FINE, _CLOSE = offset_grid(4, 4, 2), offset_grid(2, 2), offset_grid(1, 1)


@dataclass(frozen=True)
class Look:
    """A classifier looking at a picture."""

    picture: Picture
    sums: BoostedSums
    contrast_floor: float

    def scores(
        self, xy: FloatArray, axes: FloatArray, turns: FloatArray, offsets: IntArray, rounds: int | None = None
    ) -> Float32Array:
        """Scores (n, turns, offsets) of places (n, 2), turned and moved from their axes (n,)."""
        found = scores_at(
            self.sums,
            self.picture,
            np.repeat(xy, len(turns), axis=0),
            (axes[:, None] + turns).ravel(),
            offsets,
            contrast_floor=self.contrast_floor,
            rounds=rounds,
        )
        return found.reshape(len(xy), len(turns), len(offsets))

    def best(
        self, xy: FloatArray, axes: FloatArray, turns: FloatArray, offsets: IntArray, rounds: int | None = None
    ) -> tuple[FloatArray, FloatArray, Float32Array]:
        """Each place moved and turned to where the first rounds like it best, and how much they do."""
        found = self.scores(xy, axes, turns, offsets, rounds)
        flat = found.reshape(len(xy), -1)
        best = flat.argmax(axis=1)
        turn, offset = np.unravel_index(best, found.shape[1:])
        axes = axes + turns[turn]
        return moved(xy, axes, offsets[offset].astype(np.float64)), axes, flat[np.arange(len(xy)), best]


def find_cars(look: Look, places: FloatArray, *, min_score: float, min_stage1_score: float = -np.inf) -> FloatArray:
    """Where the classifier sees a car: one row a place, so several a car (see `distinct`).

    Parameters
    ----------
    places
        (n, 3...): x, y, axis, as `scan.propose` gives them.
    min_score
        Finds at or below this are not told.
    min_stage1_score
        Places that the first rounds like less are let go.

    Returns
    -------
    (n, 5): x, y, axis, score, standard deviation of the axis.
    """
    xy, axes = places[:, :2], places[:, 2]
    if not len(xy):
        return np.empty((0, 5))
    xy, axes, score = look.best(xy, axes, _FIRST_TURNS, _ROUGH, FIRST_ROUNDS)
    kept = np.flatnonzero(score > min_stage1_score)
    kept = kept[_one_each(xy[kept], axes[kept], score[kept])]
    if not len(kept):
        return np.empty((0, 5))
    xy, axes, score = look.best(xy[kept], axes[kept], _SECOND_TURNS, _FINE, SECOND_ROUNDS)
    kept = np.flatnonzero(score > min_score - _HOPE)
    return _closely(look, xy[kept], axes[kept], min_score)


def _one_each(xy: FloatArray, axes: FloatArray, score: Float32Array) -> IntArray:
    """The best of the places that came to lie on one another."""
    order = np.argsort(-score, kind="stable")
    key = np.column_stack([np.rint(xy / 2), np.rint(np.mod(axes, np.pi) * (9 / np.pi)) % 9])[order]
    _, first = np.unique(key, axis=0, return_index=True)
    return np.asarray(np.sort(order[first]), np.int64)


def _closely(look: Look, xy: FloatArray, axes: FloatArray, min_score: float) -> FloatArray:
    """All rounds; the place and the turn below the step, from how the score falls about its peak."""
    found = look.scores(xy, axes, _LAST_TURNS, _CLOSE) if len(xy) else np.empty((0, 1, 1), np.float32)
    hopeful = found.max(axis=(1, 2), initial=-np.inf) > min_score
    xy, axes, found = xy[hopeful], axes[hopeful], found[hopeful]
    if not len(xy):
        return np.empty((0, 5))
    peak = found.max(axis=(1, 2))
    weights = np.exp(_SHARP * (found - peak[:, None, None]).astype(np.float64))
    weights /= weights.sum(axis=(1, 2), keepdims=True)
    by_turn = weights.sum(axis=2)
    turn = by_turn @ _LAST_TURNS
    spread = np.sqrt(np.maximum(by_turn @ _LAST_TURNS**2 - turn**2, 0.0))
    xy = moved(xy, axes + turn, weights.sum(axis=1) @ _CLOSE.astype(np.float64))
    return np.column_stack([xy, np.mod(axes + turn, np.pi), peak, np.maximum(spread, _LEAST_SD_RAD)])


def moved(xy: FloatArray, angles: FloatArray, offsets: FloatArray) -> FloatArray:
    """Places moved by offsets along and across their axes."""
    c, s = np.cos(angles), np.sin(angles)
    u, v = offsets[:, 0], offsets[:, 1]
    return xy + np.column_stack([u * c - v * s, u * s + v * c])


def distinct(cars: FloatArray, car_length_px: float) -> FloatArray:
    """The cars without those that better ones stand on, the best first."""
    cars = np.ascontiguousarray(cars[np.argsort(-cars[:, 3], kind="stable")])
    return np.asarray(cars[_free(cars, car_length_px, CAR_ASPECT * car_length_px)])


@njit(cache=True, nogil=True)
def _free(cars, length, width):  # type: ignore[no-untyped-def]
    """Which cars, the best first, have no better one at their place and enough of their own ground.

    In a queue the classifier likes the gap as well: a boot and a bonnet. Such a find shares its ground with two cars,
    each of which it leaves too far away to be one with it.
    """
    kept = np.zeros(len(cars), np.bool_)
    ground = np.empty(_SPOTS_ALONG * _SPOTS_ACROSS, np.bool_)
    for i in range(len(cars)):
        c, s = np.cos(cars[i, 2]), np.sin(cars[i, 2])
        ground[:] = False
        alone = True
        for j in range(i):
            dx, dy = cars[i, 0] - cars[j, 0], cars[i, 1] - cars[j, 1]
            if not kept[j] or dx * dx + dy * dy > (length + width) ** 2:
                continue
            cj, sj = np.cos(cars[j, 2]), np.sin(cars[j, 2])
            u, v = dx * cj + dy * sj, dy * cj - dx * sj
            if (u / (_NMS_ALONG * length)) ** 2 + (v / (_NMS_ACROSS * length)) ** 2 < 1:
                alone = False
                break
            for k in range(len(ground)):
                a = ((k // _SPOTS_ACROSS + 0.5) / _SPOTS_ALONG - 0.5) * length
                b = ((k % _SPOTS_ACROSS + 0.5) / _SPOTS_ACROSS - 0.5) * width
                x, y = dx + a * c - b * s, dy + a * s + b * c
                if abs(x * cj + y * sj) < length / 2 and abs(y * cj - x * sj) < width / 2:
                    ground[k] = True
        kept[i] = alone and ground.mean() < _MAX_SHARED
    return kept
