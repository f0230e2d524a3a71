"""Region proposals: a coarse boosted classifier, dense over the image at six rotations, and its local maxima.

It works at half the resolution and every fourth pixel, and is trained on cars displaced and rotated by up to half a
step. Extrema of a difference of Gaussians would need three times as many proposals, and lie on bonnets and boots.
"""

import cv2
import numpy as np
from numba import njit

from schemas.arrays import FloatArray, Mask
from velfield.detection.boosting import BoostedStumps
from velfield.detection.cascade.feature_image import FeatureImage, score_poses

ROTATIONS = np.arange(6) * (np.pi / 6)
PER_MEGAPIXEL = 4000
"""The best proposals, so many, are classified."""
_TILE = 6
"""Positions in a tile, along and across: one patch serves them all."""
_STEP = 2
"""Coarse px between positions."""
_POSITIONS = [_STEP * k - (_TILE - 1) for k in range(_TILE)]
_OFFSETS = np.array([(u, v) for v in _POSITIONS for u in _POSITIONS], np.int64)
_NMS_RADIUS_PX = 5.0
_CELL_PX = 2


def propose_regions(
    coarse: FeatureImage,
    shape: tuple[int, int],
    valid: Mask | None,
    stumps: BoostedStumps,
    *,
    contrast_floor: float,
    min_score: float = -np.inf,
    per_megapixel: float = PER_MEGAPIXEL,
) -> FloatArray:
    """Local maxima of the coarse classifier over position and rotation.

    Parameters
    ----------
    coarse
        Features of the image at the scale `feature_image.COARSE`.
    shape
        Height and width of the image itself.

    Returns
    -------
    (n, 4): x, y in px of the image, axis, score; the best first.
    """
    rows = np.concatenate([_local_maxima(coarse, shape, stumps, float(angle), contrast_floor) for angle in ROTATIONS])
    rows = rows[in_view(rows, shape, valid) & (rows[:, 3] > min_score)]
    rows = rows[np.argsort(-rows[:, 3], kind="stable")]
    max_count = int(per_megapixel * shape[0] * shape[1] / 1e6) + 8
    rotation = np.rint(rows[:, 2] / ROTATIONS[1]).astype(np.int64)
    taken = np.zeros((len(ROTATIONS), shape[0] // _CELL_PX + 1, shape[1] // _CELL_PX + 1), np.bool_)
    return np.asarray(rows[_suppress(rows[:, :2].copy(), rotation, taken, _NMS_RADIUS_PX, _CELL_PX, max_count)])


def in_view(xy: FloatArray, shape: tuple[int, int], valid: Mask | None) -> Mask:
    """Whether positions (n, 2...) lie in an image (h, w), and where it is ``valid``."""
    x, y = (np.clip(np.rint(xy[:, k]), 0, shape[1 - k] - 1).astype(np.int64) for k in (0, 1))
    inside = (np.abs(xy[:, 0] - x) <= 0.5) & (np.abs(xy[:, 1] - y) <= 0.5)
    return np.asarray(inside if valid is None else inside & valid[y, x])


def _local_maxima(
    coarse: FeatureImage, shape: tuple[int, int], stumps: BoostedStumps, angle: float, contrast_floor: float
) -> FloatArray:
    """Local maxima (n, 4) at one rotation, on a grid rotated likewise, so that its tiles lie side by side."""
    step = coarse.scale.step
    pitch = float(_TILE * _STEP * step)
    centre = np.array([shape[1], shape[0]]) / 2
    reach = np.arange(-np.hypot(*shape) / 2 - pitch, np.hypot(*shape) / 2 + pitch, pitch)
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, s], [-s, c]])
    tiles = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    xy = centre + tiles @ rotation
    margin = 0.75 * pitch
    chosen = np.flatnonzero(((xy > -margin) & (xy < [shape[1] + margin, shape[0] + margin])).all(axis=1))
    axes = np.full(len(chosen), angle)
    scores = score_poses(stumps, coarse, xy[chosen], axes, _OFFSETS, contrast_floor=contrast_floor)
    n = len(reach)
    tiled = np.full((n, _TILE, n, _TILE), -np.inf, np.float32)
    tiled[chosen // n, :, chosen % n, :] = scores.reshape(-1, _TILE, _TILE)
    score = tiled.reshape(n * _TILE, n * _TILE)
    row, column = np.nonzero((score >= cv2.dilate(score, np.ones((3, 3), np.uint8))) & np.isfinite(score))
    positions = reach[0] + (np.stack([column, row], axis=1) * _STEP - (_TILE - 1)) * float(step)
    return np.column_stack([centre + positions @ rotation, np.full(len(row), angle), score[row, column]])


@njit(cache=True, nogil=True)
def _suppress(xy, rotation, taken, radius, cell, max_count):  # type: ignore[no-untyped-def]
    """Non-maximum suppression: rows, the best first, with no better one near of the same or a neighbouring rotation."""
    chosen = np.empty(min(max_count, len(xy)), np.int64)
    rotations, height, width = taken.shape
    reach, n = int(radius / cell) + 1, 0
    for k in range(len(xy)):
        if n == len(chosen):
            break
        x, y = int(xy[k, 0] / cell), int(xy[k, 1] / cell)
        if taken[rotation[k], y, x]:
            continue
        chosen[n] = k
        n += 1
        for i in range(max(0, y - reach), min(height, y + reach + 1)):
            for j in range(max(0, x - reach), min(width, x + reach + 1)):
                dx, dy = cell * (j + 0.5) - xy[k, 0], cell * (i + 0.5) - xy[k, 1]
                if dx * dx + dy * dy < radius * radius:
                    for d in range(-1, 2):
                        taken[(rotation[k] + d) % rotations, i, j] = True
    return chosen[:n]
