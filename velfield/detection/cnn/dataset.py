"""What the network learns from: pieces of labelled pictures, turned, scaled and toned as others would show them."""

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import Float32Array, FloatArray
from velfield.detection.cnn.model import STRIDE
from velfield.detection.cnn.trainer import Batch
from velfield.detection.label_orientation import with_axes
from velfield.detection.samples import LabelledImage

SIDE_PX = 96
"""Side of a piece: six cars."""
PIECES = 16
"""Pieces a step."""
_MIDDLE_SIGMA_PX = 2.2
_AT_A_CAR, _ABOUT_IT_PX = 0.7, 19.0
"""Share of the pieces about a marked car, and how far its place in them varies."""
_SCALE_SPREAD = 0.2
_REACH = 2
"""Sides of a piece from its middle within which lies all that it can show."""
_GAMMA_SPREAD, _CONTRAST, _LIGHT = 0.7, (0.5, 1.4), 0.15
_GREY_MIDDLE = 0.45
_BLURRED, _BLUR_PX = 0.3, (0.3, 0.9)
_SHADED, _SHADE, _SHADE_EDGE_PX = 0.25, (0.2, 0.6), (0.5, 2.0)
_NOISE = 0.03


class Pieces:
    """Batches of pieces of labelled pictures, each by its number and a seed alone.

    Parameters
    ----------
    groups
        Labelled pictures that count together, whatever their number.
    shares
        How often each group is taken from.
    seed
        Of all that is random.
    """

    def __init__(self, groups: Sequence[Sequence[LabelledImage]], shares: Sequence[float], seed: int) -> None:
        self._groups = [[_ready(sample) for sample in group] for group in groups]
        self._shares = np.array(shares, float) / np.sum(shares)
        self._seed = seed
        self._pool = ThreadPoolExecutor(1)
        self._next: tuple[int, Future[Batch]] | None = None

    def __call__(self, step: int) -> Batch:
        """The batch of a step; the next one is made meanwhile."""
        waited, self._next = self._next, (step + 1, self._pool.submit(self._made, step + 1))
        return waited[1].result() if waited is not None and waited[0] == step else self._made(step)

    def _made(self, step: int) -> Batch:
        rng = np.random.default_rng((self._seed, step))
        pieces = []
        for _ in range(PIECES):
            group = self._groups[rng.choice(len(self._groups), p=self._shares)]
            pieces.append(_piece(group[rng.integers(len(group))], rng))
        return Batch(*(np.stack(part) for part in zip(*pieces, strict=True)))


def _ready(sample: LabelledImage) -> LabelledImage:
    return replace(sample, cars=with_axes(sample.image, sample.cars, sample.tilts))


def _piece(
    sample: LabelledImage, rng: np.random.Generator
) -> tuple[Float32Array, Float32Array, Float32Array, Float32Array, Float32Array]:
    matrix = _placed(sample, rng)
    rows, columns, near = _about(matrix)
    image = sample.image[rows, columns].astype(np.float32) / 255
    picture = cv2.warpAffine(image, near, (SIDE_PX, SIDE_PX), borderMode=cv2.BORDER_REFLECT_101)
    cars = sample.cars[:, :2] @ matrix[:, :2].T + matrix[:, 2]
    along = np.column_stack([np.cos(sample.cars[:, 2]), np.sin(sample.cars[:, 2])]) @ matrix[:, :2].T
    middles, axes, counted_axes = _told_of(cars, np.arctan2(along[:, 1], along[:, 0]))
    seen = np.ones(image.shape, bool) if sample.valid is None else sample.valid[rows, columns]
    counted = (
        cv2.warpAffine(seen.astype(np.uint8), near, (SIDE_PX, SIDE_PX), flags=cv2.INTER_NEAREST)[::STRIDE, ::STRIDE] > 0
    )
    scale = float(np.sqrt(abs(np.linalg.det(matrix[:, :2]))))
    circles = np.column_stack([sample.ignore[:, :2] @ matrix[:, :2].T + matrix[:, 2], scale * sample.ignore[:, 2]])
    reach = circles[:, 2:] + STRIDE
    within = ((circles[:, :2] > -reach) & (circles[:, :2] < SIDE_PX + reach)).all(axis=1)
    for x, y, radius in circles[within]:
        circle = np.hypot(_CELLS[None, :] - x, _CELLS[:, None] - y) < radius + STRIDE
        counted &= ~circle | (middles > 0.1)
    return _toned(picture, rng), middles, counted.astype(np.float32), axes, counted_axes * counted


_CELLS = np.arange(SIDE_PX // STRIDE) * STRIDE + (STRIDE - 1) / 2


def _placed(sample: LabelledImage, rng: np.random.Generator) -> FloatArray:
    """From the picture to the piece: about a car or anywhere, turned, mirrored, scaled."""
    height, width = sample.image.shape
    if len(sample.cars) and rng.random() < _AT_A_CAR:
        at = sample.cars[rng.integers(len(sample.cars)), :2] + rng.normal(0, _ABOUT_IT_PX, 2)
    else:
        at = rng.uniform(0, (width, height))
    turn, scale = rng.uniform(0, 2 * np.pi), np.exp(rng.uniform(-_SCALE_SPREAD, _SCALE_SPREAD))
    c, s = scale * np.cos(turn), scale * np.sin(turn)
    turned = np.array([[c, -s], [s, c]]) * (rng.choice([-1.0, 1.0]), 1.0)
    return np.column_stack([turned, np.full(2, SIDE_PX / 2) - turned @ at])


def _about(matrix: FloatArray) -> tuple[slice, slice, FloatArray]:
    """Rows and columns of all that a piece can show, mirrored at the picture's edge too, and the matrix from there."""
    middle = np.linalg.solve(matrix[:, :2], np.full(2, SIDE_PX / 2) - matrix[:, 2])
    first = np.maximum(middle - _REACH * SIDE_PX, 0).astype(int)
    last = np.maximum(middle + _REACH * SIDE_PX, 1).astype(int)
    moved = np.column_stack([matrix[:, :2], matrix[:, 2] + matrix[:, :2] @ first])
    return slice(first[1], last[1]), slice(first[0], last[0]), moved


def _told_of(cars: FloatArray, axis: FloatArray) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Middles, axes and how much these count, in cells."""
    cells = len(_CELLS)
    middles, axes = np.zeros((cells, cells), np.float32), np.zeros((cells, cells, 2), np.float32)
    for (x, y), angle in zip(cars, axis, strict=True):
        if not (-8 < x < SIDE_PX + 8 and -8 < y < SIDE_PX + 8):
            continue
        off = (_CELLS[None, :] - x) ** 2 + (_CELLS[:, None] - y) ** 2
        blob = np.exp(-off / (2 * _MIDDLE_SIGMA_PX**2)).astype(np.float32)
        nearest = blob > middles
        middles[nearest] = blob[nearest]
        axes[nearest] = np.cos(2 * angle), np.sin(2 * angle)
    return middles, axes, np.square(middles)


def _toned(picture: NDArray[np.float32], rng: np.random.Generator) -> Float32Array:
    """The piece as another sensor, or in other light, would show it."""
    tone = np.clip(picture, 0, 1) ** np.exp(rng.uniform(-_GAMMA_SPREAD, _GAMMA_SPREAD))
    tone = (tone - _GREY_MIDDLE) * rng.uniform(*_CONTRAST) + _GREY_MIDDLE + rng.uniform(-_LIGHT, _LIGHT)
    if rng.random() < _BLURRED:
        tone = cv2.GaussianBlur(tone, (0, 0), rng.uniform(*_BLUR_PX))
    if rng.random() < _SHADED:
        tone = tone * (1 - rng.uniform(*_SHADE) * _shade(rng))
    tone = tone + rng.normal(0, rng.uniform(0, _NOISE), tone.shape)
    return np.asarray(np.clip(tone, 0, 1), np.float32)


def _shade(rng: np.random.Generator) -> FloatArray:
    """0 to 1: a shadow's straight edge across the piece."""
    turn, off = rng.uniform(0, 2 * np.pi), rng.uniform(-SIDE_PX / 3, SIDE_PX / 3)
    place = np.arange(SIDE_PX) - SIDE_PX / 2
    shaded = place[None, :] * np.cos(turn) + place[:, None] * np.sin(turn) > off
    return np.asarray(cv2.GaussianBlur(shaded.astype(np.float64), (0, 0), rng.uniform(*_SHADE_EDGE_PX)))
