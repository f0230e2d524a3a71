"""Cars from what the network says of every place, those that it likes looked at again in two turns.

The network learnt cars of every direction; what it says of one still depends on how the car lies to its pixels. Turned
to the axis that was told first, and across it, every car is looked at alike.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import Float32Array, FloatArray, GreyImage, IntArray
from velfield.detection.cascade.classifier import moved
from velfield.detection.cascade.proposals import in_sight
from velfield.detection.cnn.model import STRIDE, Network, odds_map, said_of

LIKELY = 0.35
"""Said of a place that is as often a car as not: near middles the loss lets it say less than it knows."""
_BLUR_CELLS = 0.8
_LEAST = 0.2
"""Places less likely than this at the first look are let go."""
SCORE_FLOOR = _LEAST - LIKELY
"""Finds are hardly ever liked less."""
_QUARTER_CAR_PX = 4.0
_AGAIN_PX = 44
_MIDDLE = _AGAIN_PX // (2 * STRIDE)
_TURNS = np.radians([0.0, 90.0])
"""Four turns, or more about a place, found no more on minsk, and took up to three times as long."""
_AT_ONCE = 8


def network_finds(network: Network, image: GreyImage, valid: NDArray[np.bool_] | None) -> FloatArray:
    """Cars (n, 5) as x, y, axis, score, axis' standard deviation, working px; several a car (see `aligned.distinct`).

    The score is how likely a car is, less `LIKELY`.
    """
    likely, axes = odds_map(network, image)
    smooth = cv2.GaussianBlur(likely, (0, 0), _BLUR_CELLS)
    peak = (smooth >= cv2.dilate(smooth, np.ones((3, 3), np.uint8))) & (smooth > _LEAST)
    if valid is not None:
        peak &= valid[::STRIDE, ::STRIDE]
    y, x = np.nonzero(peak)
    if not len(x):
        return np.empty((0, 5))
    off = _below_the_cell(smooth, y, x)
    xy = (np.column_stack([x, y]) + off) * STRIDE + (STRIDE - 1) / 2
    told = axes[y, x].astype(np.float64)
    again, vectors = _looked_at_again(network, image, xy, 0.5 * np.arctan2(told[:, 1], told[:, 0]))
    score = again.mean(axis=1)
    mean = (vectors * again[..., None]).sum(axis=1) / np.maximum(again.sum(axis=1), 1e-9)[:, None]
    sure = np.clip(np.hypot(mean[:, 0], mean[:, 1]), 1e-3, 1 - 1e-3)
    axis = np.mod(0.5 * np.arctan2(mean[:, 1], mean[:, 0]), np.pi)
    found = np.column_stack([xy, axis, score - LIKELY, 0.5 * np.sqrt(-2 * np.log(sure))])
    return found[_mostly_seen(found, image.shape, valid)]


def _mostly_seen(cars: FloatArray, shape: tuple[int, int], valid: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """Whether three quarters of a car lie in the frame: of what is cut farther in, the middle is not where it seems."""
    seen = np.ones(len(cars), bool)
    for along in (-_QUARTER_CAR_PX, _QUARTER_CAR_PX):
        seen &= in_sight(moved(cars[:, :2], cars[:, 2], np.array([[along, 0.0]])), shape, valid)
    return seen


def _below_the_cell(values: Float32Array, y: IntArray, x: IntArray) -> FloatArray:
    """How far off a cell's middle, right and down, parabolas through it and its neighbours have their peak, (n, 2)."""
    at = np.log(np.maximum(np.pad(values, 1, mode="edge"), 1e-6)).astype(np.float64)
    here, off = at[y + 1, x + 1], []
    for down, right in ((0, 1), (1, 0)):
        before, after = at[y + 1 - down, x + 1 - right], at[y + 1 + down, x + 1 + right]
        off.append(np.clip((after - before) / (2 * np.maximum(2 * here - before - after, 1e-6)), -0.5, 0.5))
    return np.column_stack(off)


def _looked_at_again(
    network: Network, image: GreyImage, xy: FloatArray, axis: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """How likely (n, 2) places are, turned by their axis and across, and twice their axis (n, 2, 2) in the picture."""
    turns = axis[:, None] + _TURNS
    place = np.arange(_AGAIN_PX) - (_MIDDLE * STRIDE + (STRIDE - 1) / 2)
    v, u = np.meshgrid(place, place, indexing="ij")
    likely, vectors = np.empty(turns.shape), np.empty((*turns.shape, 2))
    for start in range(0, len(xy), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        c, s = np.cos(turns[part])[..., None, None], np.sin(turns[part])[..., None, None]
        map_x, map_y = xy[part, 0, None, None, None] + u * c - v * s, xy[part, 1, None, None, None] + u * s + v * c
        flat = (-1, _AGAIN_PX)
        maps = map_x.reshape(flat).astype(np.float32), map_y.reshape(flat).astype(np.float32)
        seen = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        pictures = seen.reshape(-1, _AGAIN_PX, _AGAIN_PX) / np.float32(255)
        likely[part], vectors[part] = _at_the_middle(said_of(network, pictures), turns[part])
    return likely, vectors


def _at_the_middle(said: Float32Array, turns: FloatArray) -> tuple[FloatArray, FloatArray]:
    about = said[:, _MIDDLE - 3 : _MIDDLE + 4, _MIDDLE - 3 : _MIDDLE + 4]
    odds = 1 / (1 + np.exp(-about[..., 0].astype(np.float64)))
    kernel = cv2.getGaussianKernel(5, _BLUR_CELLS)[:, 0]
    rows = sum(kernel[k] * odds[:, k : k + 3] for k in range(5))
    smooth = sum(kernel[k] * rows[:, :, k : k + 3] for k in range(5))
    likely = np.asarray(smooth).max(axis=(1, 2)).reshape(turns.shape)
    told = said[:, _MIDDLE, _MIDDLE, 1:].astype(np.float64).reshape(*turns.shape, 2)
    c, s = np.cos(2 * turns), np.sin(2 * turns)
    return likely, np.stack([told[..., 0] * c - told[..., 1] * s, told[..., 0] * s + told[..., 1] * c], axis=-1)
