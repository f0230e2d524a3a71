"""Training patches for the network: random crops of labelled images with augmentation, and their target maps.

A patch is cut by a random similarity transform (position, rotation, mirroring, scale) and then augmented
photometrically (gamma, contrast, brightness, blur, a shadow's edge, noise), to resemble images of other sensors and in
other light. Targets are a heatmap with a Gaussian at each vehicle's centre, and the orientation at each of its pixels.
"""

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from math import sqrt
from typing import NamedTuple

import cv2
import numpy as np

from schemas.arrays import Float32Array, FloatArray, IntArray, Mask
from velfield.detection.cnn.network import STRIDE, USUAL_SIZE_PX
from velfield.detection.cnn.trainer import Batch
from velfield.detection.orientation import fill_missing_orientation
from velfield.detection.samples import LabelledImage

PATCH_PX = 96
"""Side of a patch: six cars."""
BATCH_SIZE = 16
HEATMAP_SIGMA_PX = 2.2
"""Standard deviation of a car's peak, and of any vehicle's across its axis. Along the axis it grows with the square
root of the length, because the centre of a bus is less sharp; in pre-training only."""
_CENTRED_FRACTION, _CENTRING_SD_PX = 0.7, 19.0
"""Fraction of the patches that are centred near a labelled car, and standard deviation of that position."""
_LOG_SCALE_RANGE = 0.2
_WINDOW_MARGIN_PX = 2
"""Margin of the source window, for interpolation."""
_LOG_GAMMA_RANGE, _CONTRAST_RANGE, _BRIGHTNESS_RANGE = 0.7, (0.5, 1.4), 0.15
_MEAN_GREY = 0.45
"""Contrast is changed about this grey."""
_BLUR_PROBABILITY, _BLUR_SIGMA_PX = 0.3, (0.3, 0.9)
_SHADOW_PROBABILITY, _SHADOW_DEPTH, _SHADOW_EDGE_SIGMA_PX = 0.25, (0.2, 0.6), (0.5, 2.0)
_MAX_NOISE_SD = 0.03
_TARGET_MARGIN_PX = 8
"""Cars beyond the border of a patch by no more than this still show in its targets."""
_HEATMAP_REACH = 10
"""Pixels of the heatmap: farther from a vehicle's centre its Gaussian is below 1e-6, and zero is taken."""
_HEATMAP_PX = np.arange(PATCH_PX // STRIDE) * STRIDE + (STRIDE - 1) / 2
"""Positions of the heatmap's rows and columns in the patch, px."""


class Patch(NamedTuple):
    """A patch and its targets, in the order of `Batch`; its vehicles (n, 5): x, y, axis, length and width, px of it."""

    image: Float32Array
    heatmap: Float32Array
    mask: Float32Array
    orientation: Float32Array
    orientation_weight: Float32Array
    vehicles: FloatArray


class PatchDataset:
    """Batches of random patches; each follows from its number and the seed alone.

    Parameters
    ----------
    groups
        Groups of labelled images, such as one a site.
    weights
        Sampling weight of each group, whatever its number of images.
    seed
        Seed of all random numbers.
    log_scale_range
        Greatest logarithm of the factor by which a patch is scaled, either way.
    """

    def __init__(
        self,
        groups: Sequence[Sequence[LabelledImage]],
        weights: Sequence[float],
        seed: int,
        *,
        log_scale_range: float = _LOG_SCALE_RANGE,
    ) -> None:
        self._log_scale_range = log_scale_range
        self._groups = [[_with_orientations(sample) for sample in group] for group in groups]
        self._probabilities = np.array(weights, float) / np.sum(weights)
        self._seed = seed
        self._pool: ThreadPoolExecutor | None = None
        self._next: tuple[int, Future[Batch]] | None = None

    def __call__(self, step: int) -> Batch:
        """Batch of a step; that of the next step is prepared in the background."""
        self._pool = self._pool or ThreadPoolExecutor(1)
        prepared, self._next = self._next, (step + 1, self._pool.submit(self.make_batch, step + 1))
        return prepared[1].result() if prepared is not None and prepared[0] == step else self.make_batch(step)

    def make_batch(self, step: int) -> Batch:
        """Batch of a step."""
        return to_batch(self.make_patches(step))

    def make_patches(self, step: int) -> list[Patch]:
        """The patches of a step."""
        rng = np.random.default_rng((self._seed, step))
        patches = []
        for _ in range(BATCH_SIZE):
            group = self._groups[rng.choice(len(self._groups), p=self._probabilities)]
            sample = group[rng.integers(len(group))]
            patches.append(self._sample_patch(sample, rng))
        return patches

    def choose_car(self, cars: FloatArray, rng: np.random.Generator) -> int:
        """Which of the cars (n, 5) of an image a patch is centred near."""
        return int(rng.integers(len(cars)))

    def redraw(self, patch: Float32Array, vehicles: FloatArray, rng: np.random.Generator) -> Float32Array:
        """A patch with vehicles (n, 5), px of it, before it is exposed; as it is."""
        return patch

    def target_lengths_px(self, vehicles: FloatArray) -> FloatArray | None:
        """Lengths (n,) by which Gaussians grow; none: those of usual cars."""
        return None

    def augment_photometry(self, patch: Float32Array, mask: Mask, rng: np.random.Generator) -> Float32Array:
        """The patch as another sensor would see it; ``mask`` (m, m), changed in place, is where its targets count."""
        return add_noise(expose(patch, rng), rng)

    def _sample_patch(self, sample: LabelledImage, rng: np.random.Generator) -> Patch:
        if len(sample.cars) and rng.random() < _CENTRED_FRACTION:
            centre = sample.cars[self.choose_car(sample.cars, rng), :2] + rng.normal(0, _CENTRING_SD_PX, 2)
        else:
            centre = rng.uniform(0, sample.image.shape[::-1])
        matrix = _random_similarity(centre, rng, self._log_scale_range)
        rows, columns, window_matrix = _source_window(matrix, sample.image.shape)
        image = sample.image[rows, columns].astype(np.float32)
        patch = cv2.warpAffine(image, window_matrix, (PATCH_PX, PATCH_PX), borderMode=cv2.BORDER_REFLECT_101)
        patch *= np.float32(1 / 255)
        vehicles, scale = sample.cars[:, :5].copy(), float(np.sqrt(abs(np.linalg.det(matrix[:, :2]))))
        vehicles[:, :2] = vehicles[:, :2] @ matrix[:, :2].T + matrix[:, 2]
        direction = np.column_stack([np.cos(sample.cars[:, 2]), np.sin(sample.cars[:, 2])]) @ matrix[:, :2].T
        vehicles[:, 2] = np.arctan2(direction[:, 1], direction[:, 0])
        vehicles[:, 3:] *= scale
        patch = self.redraw(patch, vehicles, rng)
        heatmap, orientation, weight = encode_targets(vehicles[:, :2], vehicles[:, 2], self.target_lengths_px(vehicles))
        valid = np.ones(image.shape, np.uint8) if sample.valid is None else sample.valid[rows, columns].astype(np.uint8)
        on_heatmap = window_matrix / STRIDE  # every second pixel of the patch
        mask = cv2.warpAffine(valid, on_heatmap, (len(_HEATMAP_PX), len(_HEATMAP_PX)), flags=cv2.INTER_NEAREST) > 0
        circles = np.column_stack([sample.ignore[:, :2] @ matrix[:, :2].T + matrix[:, 2], scale * sample.ignore[:, 2]])
        reach = circles[:, 2:] + STRIDE
        nearby = ((circles[:, :2] > -reach) & (circles[:, :2] < PATCH_PX + reach)).all(axis=1)
        for x, y, radius in circles[nearby]:
            ignored = np.hypot(_HEATMAP_PX[None, :] - x, _HEATMAP_PX[:, None] - y) < radius + STRIDE
            mask &= ~ignored | (heatmap > 0.1)
        patch = self.augment_photometry(patch, mask, rng)
        return Patch(patch, heatmap, mask.astype(np.float32), orientation, weight * mask, vehicles)


def to_batch(patches: Sequence[Patch]) -> Batch:
    """Patches as a batch of training, without their vehicles."""
    return Batch(*(np.stack(part) for part in list(zip(*patches, strict=True))[:-1]))


def _with_orientations(sample: LabelledImage) -> LabelledImage:
    return replace(sample, cars=fill_missing_orientation(sample.image, sample.cars, sample.abs_box_angle_rad))


def _random_similarity(centre: FloatArray, rng: np.random.Generator, log_scale_range: float) -> FloatArray:
    """Affine matrix (2, 3) from image to patch: centred on a position, rotated, mirrored, scaled."""
    angle, scale = rng.uniform(0, 2 * np.pi), np.exp(rng.uniform(-log_scale_range, log_scale_range))
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    linear = np.array([[c, -s], [s, c]]) * (rng.choice([-1.0, 1.0]), 1.0)
    return np.column_stack([linear, np.full(2, PATCH_PX / 2) - linear @ centre])


def _source_window(matrix: FloatArray, shape: tuple[int, ...]) -> tuple[slice, slice, FloatArray]:
    """Rows and columns of an image (h, w) that a patch shows, reflection at the border included, and the matrix from
    that window to the patch.
    """
    to_image = np.linalg.inv(matrix[:, :2])
    centre = to_image @ (np.full(2, PATCH_PX / 2) - matrix[:, 2])
    reach = np.abs(to_image).sum(axis=1) * PATCH_PX / 2 + _WINDOW_MARGIN_PX
    last_px = np.array(shape[::-1]) - 1
    low, high = centre - reach, centre + reach
    # What lies beyond the first or the last pixel shows what is as far from it inside.
    first = np.clip(np.minimum(low, 2 * last_px - high), 0, last_px).astype(int)
    last = np.clip(np.maximum(high, -low), 0, last_px).astype(int)
    shifted = np.column_stack([matrix[:, :2], matrix[:, 2] + matrix[:, :2] @ first])
    return slice(first[1], last[1] + 1), slice(first[0], last[0] + 1), shifted


def near_patch(vehicles: FloatArray) -> IntArray:
    """Rows of vehicles (n, 2...) whose centre is in the patch, or near its border."""
    xy = vehicles[:, :2]
    return np.flatnonzero(((xy > -_TARGET_MARGIN_PX) & (xy < PATCH_PX + _TARGET_MARGIN_PX)).all(axis=1))


def with_usual_size(vehicles: FloatArray) -> FloatArray:
    """Vehicles (n, 5), those of unknown length or width with that of a usual car."""
    return np.column_stack([vehicles[:, :3], np.where(np.isfinite(vehicles[:, 3:5]), vehicles[:, 3:5], USUAL_SIZE_PX)])


def encode_targets(
    centres: FloatArray, orientation_rad: FloatArray, lengths_px: FloatArray | None = None
) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Target maps of a patch.

    Parameters
    ----------
    centres, orientation_rad, lengths_px
        (n, 2) positions, (n,) axial orientations and lengths of vehicles in the patch, px and rad; NaN or none: of a
        usual car.

    Returns
    -------
    (m, m) heatmap, 1 at a vehicle's centre and a Gaussian around it (the highest one where they overlap); (m, m, 2)
    cosine and sine of twice the orientation of that vehicle; (m, m) weight of the orientation in the loss. m =
    `PATCH_PX` / `STRIDE`.
    """
    lengths = np.full(len(centres), np.nan) if lengths_px is None else lengths_px
    heatmap, number = highest_gaussians(np.column_stack([centres, orientation_rad, lengths]))
    vectors = np.column_stack([np.cos(2 * orientation_rad), np.sin(2 * orientation_rad)]).astype(np.float32)
    orientation = np.concatenate([vectors, np.zeros((1, 2), np.float32)])[number]
    return heatmap, orientation, np.square(heatmap)


def highest_gaussians(vehicles: FloatArray) -> tuple[Float32Array, IntArray]:
    """Heatmap (m, m) of vehicles (n, 4...) as x, y, axis, length, and whose Gaussian each pixel shows; -1: none's."""
    size = len(_HEATMAP_PX)
    heatmap, number = np.zeros((size, size), np.float32), np.full((size, size), -1)
    near = near_patch(vehicles)
    first = np.rint((vehicles[near, :2] - _HEATMAP_PX[0]) / STRIDE).astype(int) - _HEATMAP_REACH
    last = (first + 2 * _HEATMAP_REACH + 1).clip(0).tolist()
    stretch = np.sqrt(np.fmax(vehicles[near, 3] / USUAL_SIZE_PX[0], 1.0))  # of an unknown length: 1
    along_xy = np.column_stack([np.cos(vehicles[near, 2]), np.sin(vehicles[near, 2])]) / (sqrt(2) * HEATMAP_SIGMA_PX)
    for k, (left, top), (right, bottom), (c, s), longer in zip(
        near.tolist(), first.clip(0).tolist(), last, along_xy.tolist(), stretch.tolist(), strict=True
    ):
        dx, dy = _HEATMAP_PX[None, left:right] - vehicles[k, 0], _HEATMAP_PX[top:bottom, None] - vehicles[k, 1]
        along, across = (dx * c + dy * s) / longer, dy * c - dx * s
        gaussian = np.exp(-(along * along + across * across)).astype(np.float32)
        window, numbers = heatmap[top:bottom, left:right], number[top:bottom, left:right]
        nearest = gaussian > window
        window[nearest] = gaussian[nearest]
        numbers[nearest] = k
    return heatmap, number


def expose(patch: Float32Array, rng: np.random.Generator) -> Float32Array:
    """A patch, grey in [0, 1], under another gamma, contrast, brightness, blur and a shadow; beyond [0, 1] too."""
    grey = cv2.pow(np.clip(patch, 0, 1), float(np.exp(rng.uniform(-_LOG_GAMMA_RANGE, _LOG_GAMMA_RANGE))))
    contrast, brightness = rng.uniform(*_CONTRAST_RANGE), rng.uniform(-_BRIGHTNESS_RANGE, _BRIGHTNESS_RANGE)
    grey *= np.float32(contrast)
    grey += np.float32(_MEAN_GREY * (1 - contrast) + brightness)
    if rng.random() < _BLUR_PROBABILITY:
        grey = cv2.GaussianBlur(grey, (0, 0), rng.uniform(*_BLUR_SIGMA_PX))
    if rng.random() < _SHADOW_PROBABILITY:
        grey *= 1 - np.float32(rng.uniform(*_SHADOW_DEPTH)) * _random_shadow(rng)
    return np.asarray(grey, np.float32)


def add_noise(grey: Float32Array, rng: np.random.Generator) -> Float32Array:
    """An exposed patch with a sensor's noise, in [0, 1]."""
    grey += rng.normal(0, rng.uniform(0, _MAX_NOISE_SD), grey.shape).astype(np.float32)
    return np.asarray(np.clip(grey, 0, 1, out=grey), np.float32)


def _random_shadow(rng: np.random.Generator) -> Float32Array:
    """Mask of a shadow with a straight, blurred edge across the patch, 0 to 1."""
    angle, offset = rng.uniform(0, 2 * np.pi), rng.uniform(-PATCH_PX / 3, PATCH_PX / 3)
    position = np.arange(PATCH_PX) - PATCH_PX / 2
    shadow = position[None, :] * np.cos(angle) + position[:, None] * np.sin(angle) > offset
    return np.asarray(cv2.GaussianBlur(shadow.astype(np.float32), (0, 0), rng.uniform(*_SHADOW_EDGE_SIGMA_PX)))
