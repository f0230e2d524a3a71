"""Step one of the aligned method: a coarse boosted classifier, dense over the picture and over six turns of it.

It looks at half the resolution, at every fourth pixel, and is learnt on cars that lie a little beside the place and a
little turned. Of extrema of a difference of Gaussians three times as many are wanted; they lie on bonnets and boots.
"""

import cv2
import numpy as np
from numba import njit

from schemas.arrays import FloatArray, Mask
from velfield.detection.boosting import BoostedSums
from velfield.detection.cascade.feature_image import Picture, scores_at

TURNS = np.arange(6) * (np.pi / 6)
PER_MEGAPIXEL = 4000
"""No more places than this, the best, are looked at again."""
_TILE = 6
"""Places in a tile, along and across: one patch serves them all."""
_STEP = 2
"""Coarse px between places."""
_PLACES = [_STEP * k - (_TILE - 1) for k in range(_TILE)]
_OFFSETS = np.array([(u, v) for v in _PLACES for u in _PLACES], np.int64)
_NEAR_PX = 5.0
_CELL_PX = 2


def propose(
    coarse: Picture,
    shape: tuple[int, int],
    valid: Mask | None,
    sums: BoostedSums,
    *,
    contrast_floor: float,
    min_score: float = -np.inf,
    per_megapixel: float = PER_MEGAPIXEL,
) -> FloatArray:
    """Places and turns that the coarse classifier likes better than their neighbours.

    Parameters
    ----------
    coarse
        The picture, packed at `turned.COARSE`.
    shape
        Height and width of the picture itself.

    Returns
    -------
    (n, 4): x, y in px of the picture, axis, score; the best first.
    """
    rows = np.concatenate([_peaks(coarse, shape, sums, float(turn), contrast_floor) for turn in TURNS])
    rows = rows[in_sight(rows, shape, valid) & (rows[:, 3] > min_score)]
    rows = rows[np.argsort(-rows[:, 3], kind="stable")]
    most = int(per_megapixel * shape[0] * shape[1] / 1e6) + 8
    turn = np.rint(rows[:, 2] / TURNS[1]).astype(np.int64)
    taken = np.zeros((len(TURNS), shape[0] // _CELL_PX + 1, shape[1] // _CELL_PX + 1), np.bool_)
    return np.asarray(rows[_first_of_each(rows[:, :2].copy(), turn, taken, _NEAR_PX, _CELL_PX, most)])


def in_sight(xy: FloatArray, shape: tuple[int, int], valid: Mask | None) -> Mask:
    """Whether places (n, 2...) lie in a picture (h, w), and where it is ``valid``."""
    x, y = (np.clip(np.rint(xy[:, k]), 0, shape[1 - k] - 1).astype(np.int64) for k in (0, 1))
    within = (np.abs(xy[:, 0] - x) <= 0.5) & (np.abs(xy[:, 1] - y) <= 0.5)
    return np.asarray(within if valid is None else within & valid[y, x])


def _peaks(
    coarse: Picture, shape: tuple[int, int], sums: BoostedSums, turn: float, contrast_floor: float
) -> FloatArray:
    """Local maxima (n, 4) at one turn, on a grid turned likewise: tiles lie side by side, whatever the turn."""
    step = coarse.grain.step
    pitch = float(_TILE * _STEP * step)
    middle = np.array([shape[1], shape[0]]) / 2
    reach = np.arange(-np.hypot(*shape) / 2 - pitch, np.hypot(*shape) / 2 + pitch, pitch)
    c, s = np.cos(turn), np.sin(turn)
    turned = np.array([[c, s], [-s, c]])
    tiles = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    xy = middle + tiles @ turned
    margin = 0.75 * pitch
    chosen = np.flatnonzero(((xy > -margin) & (xy < [shape[1] + margin, shape[0] + margin])).all(axis=1))
    scores = scores_at(sums, coarse, xy[chosen], np.full(len(chosen), turn), _OFFSETS, contrast_floor=contrast_floor)
    n = len(reach)
    tiled = np.full((n, _TILE, n, _TILE), -np.inf, np.float32)
    tiled[chosen // n, :, chosen % n, :] = scores.reshape(-1, _TILE, _TILE)
    score = tiled.reshape(n * _TILE, n * _TILE)
    row, column = np.nonzero((score >= cv2.dilate(score, np.ones((3, 3), np.uint8))) & np.isfinite(score))
    places = reach[0] + (np.stack([column, row], axis=1) * _STEP - (_TILE - 1)) * float(step)
    return np.column_stack([middle + places @ turned, np.full(len(row), turn), score[row, column]])


@njit(cache=True, nogil=True)
def _first_of_each(xy, turn, taken, radius, cell, most):  # type: ignore[no-untyped-def]
    """Rows, in their order, that no earlier one of the same or a neighbouring turn lies near to."""
    chosen = np.empty(min(most, len(xy)), np.int64)
    turns, height, width = taken.shape
    reach, n = int(radius / cell) + 1, 0
    for k in range(len(xy)):
        if n == len(chosen):
            break
        x, y = int(xy[k, 0] / cell), int(xy[k, 1] / cell)
        if taken[turn[k], y, x]:
            continue
        chosen[n] = k
        n += 1
        for i in range(max(0, y - reach), min(height, y + reach + 1)):
            for j in range(max(0, x - reach), min(width, x + reach + 1)):
                dx, dy = cell * (j + 0.5) - xy[k, 0], cell * (i + 0.5) - xy[k, 1]
                if dx * dx + dy * dy < radius * radius:
                    for d in range(-1, 2):
                        taken[(turn[k] + d) % turns, i, j] = True
    return chosen[:n]
