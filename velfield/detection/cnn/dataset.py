"""Training patches for the network: random crops of labelled images with augmentation, and their target maps.

A patch is cut by a random similarity transform (position, rotation, mirroring, scale) and then augmented
photometrically (gamma, contrast, brightness, blur, a shadow's edge, noise), to resemble images of other sensors and in
other light. Targets are a Gaussian heatmap of car centres and the orientation at each heatmap pixel.
"""

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from math import cos, sin

import cv2
import numpy as np

from schemas.arrays import Float32Array, FloatArray, Mask
from velfield.detection.cnn.network import STRIDE
from velfield.detection.cnn.trainer import Batch
from velfield.detection.orientation import fill_missing_orientation
from velfield.detection.samples import LabelledImage

PATCH_PX = 96
"""Side of a patch: six cars."""
BATCH_SIZE = 16
HEATMAP_SIGMA_PX = 2.2
_CENTRED_FRACTION, _CENTRING_SD_PX = 0.7, 19.0
"""Fraction of the patches that are centred near a labelled car, and standard deviation of that position."""
_LOG_SCALE_RANGE = 0.2
_WINDOW_MARGIN_PX = 2
"""Of the source window, for interpolation."""
_LOG_GAMMA_RANGE, _CONTRAST_RANGE, _BRIGHTNESS_RANGE = 0.7, (0.5, 1.4), 0.15
_MEAN_GREY = 0.45
"""Contrast is changed about this grey."""
_BLUR_PROBABILITY, _BLUR_SIGMA_PX = 0.3, (0.3, 0.9)
_SHADOW_PROBABILITY, _SHADOW_DEPTH, _SHADOW_EDGE_SIGMA_PX = 0.25, (0.2, 0.6), (0.5, 2.0)
_MAX_NOISE_SD = 0.03
_TARGET_MARGIN_PX = 8
"""Cars beyond the border of a patch by no more than this still show in its targets."""
_HEATMAP_REACH = 8
"""Pixels of the heatmap: farther from a car's centre its Gaussian is below 1e-11, and zero is taken."""
_HEATMAP_PX = np.arange(PATCH_PX // STRIDE) * STRIDE + (STRIDE - 1) / 2
"""Positions of the heatmap's rows and columns in the patch, px."""

_CAMOUFLAGE_PROBABILITY, _CAMOUFLAGED_FRACTION = 0.5, 0.5
"""Of the patches, and of the cars in such a patch."""
_CAMOUFLAGE_CONTRAST, _CAMOUFLAGE_SHIFT = (0.25, 0.9), (-0.08, 0.02)
_CAR_HALF_PX, _ROAD_MEDIAN_PX = (10.0, 5.5), 31
_EDGE_PROBABILITY = 0.12


class PatchDataset:
    """Batches of random patches; each follows from its number and the seed alone.

    Parameters
    ----------
    groups
        Groups of labelled images, such as one a site.
    weights
        Sampling weight of each group, whatever its number of images.
    seed
        Of all random numbers.
    hard
        Bring cars near to the tone of the road about them, and cut patches as the image's edge does: for pre-training.
    """

    def __init__(
        self, groups: Sequence[Sequence[LabelledImage]], weights: Sequence[float], seed: int, *, hard: bool = False
    ) -> None:
        self._hard = hard
        self._groups = [[_with_orientations(sample) for sample in group] for group in groups]
        self._probabilities = np.array(weights, float) / np.sum(weights)
        self._seed = seed
        self._pool = ThreadPoolExecutor(1)
        self._next: tuple[int, Future[Batch]] | None = None

    def __call__(self, step: int) -> Batch:
        """Batch of a step; that of the next step is prepared in the background."""
        prepared, self._next = self._next, (step + 1, self._pool.submit(self._make_batch, step + 1))
        return prepared[1].result() if prepared is not None and prepared[0] == step else self._make_batch(step)

    def _make_batch(self, step: int) -> Batch:
        rng = np.random.default_rng((self._seed, step))
        patches = []
        for _ in range(BATCH_SIZE):
            group = self._groups[rng.choice(len(self._groups), p=self._probabilities)]
            patches.append(_sample_patch(group[rng.integers(len(group))], rng, hard=self._hard))
        return Batch(*(np.stack(part) for part in zip(*patches, strict=True)))


def _with_orientations(sample: LabelledImage) -> LabelledImage:
    return replace(sample, cars=fill_missing_orientation(sample.image, sample.cars, sample.abs_box_angle_rad))


def _sample_patch(
    sample: LabelledImage, rng: np.random.Generator, *, hard: bool = False
) -> tuple[Float32Array, Float32Array, Float32Array, Float32Array, Float32Array]:
    """A patch and its targets, in the order of `Batch`."""
    matrix = _random_similarity(sample, rng)
    rows, columns, window_matrix = _source_window(matrix, sample.image.shape)
    image = sample.image[rows, columns].astype(np.float32)
    patch = cv2.warpAffine(image, window_matrix, (PATCH_PX, PATCH_PX), borderMode=cv2.BORDER_REFLECT_101)
    patch *= np.float32(1 / 255)
    centres = sample.cars[:, :2] @ matrix[:, :2].T + matrix[:, 2]
    direction = np.column_stack([np.cos(sample.cars[:, 2]), np.sin(sample.cars[:, 2])]) @ matrix[:, :2].T
    angles = np.arctan2(direction[:, 1], direction[:, 0])
    if hard:
        patch = _camouflage_cars(patch, centres, angles, rng)
    heatmap, orientation, orientation_weight = encode_targets(centres, angles)
    valid = np.ones(image.shape, np.uint8) if sample.valid is None else sample.valid[rows, columns].astype(np.uint8)
    on_heatmap = window_matrix / STRIDE  # every second pixel of the patch
    mask = cv2.warpAffine(valid, on_heatmap, (len(_HEATMAP_PX), len(_HEATMAP_PX)), flags=cv2.INTER_NEAREST) > 0
    scale = float(np.sqrt(abs(np.linalg.det(matrix[:, :2]))))
    circles = np.column_stack([sample.ignore[:, :2] @ matrix[:, :2].T + matrix[:, 2], scale * sample.ignore[:, 2]])
    reach = circles[:, 2:] + STRIDE
    nearby = ((circles[:, :2] > -reach) & (circles[:, :2] < PATCH_PX + reach)).all(axis=1)
    for x, y, radius in circles[nearby]:
        ignored = np.hypot(_HEATMAP_PX[None, :] - x, _HEATMAP_PX[:, None] - y) < radius + STRIDE
        mask &= ~ignored | (heatmap > 0.1)
    if hard and rng.random() < _EDGE_PROBABILITY:
        patch = _cut_by_edge(patch, mask, rng)
    return _augment_photometry(patch, rng), heatmap, mask.astype(np.float32), orientation, orientation_weight * mask


def _camouflage_cars(
    patch: Float32Array, centres: FloatArray, angles: FloatArray, rng: np.random.Generator
) -> Float32Array:
    """Draw some cars in a tone nearer to that of the road about them, and darker: what a detector misses most."""
    near = np.flatnonzero(((centres > -_TARGET_MARGIN_PX) & (centres < PATCH_PX + _TARGET_MARGIN_PX)).all(axis=1))
    if not len(near) or rng.random() > _CAMOUFLAGE_PROBABILITY:
        return patch
    road = cv2.medianBlur((np.clip(patch, 0, 1) * 255).astype(np.uint8), _ROAD_MEDIAN_PX).astype(np.float32) / 255
    y, x = np.mgrid[:PATCH_PX, :PATCH_PX].astype(np.float32)
    for (cx, cy), angle in zip(centres[near], angles[near], strict=True):
        if rng.random() > _CAMOUFLAGED_FRACTION:
            continue
        along = np.abs(np.cos(angle) * (x - cx) + np.sin(angle) * (y - cy)) / _CAR_HALF_PX[0]
        across = np.abs(-np.sin(angle) * (x - cx) + np.cos(angle) * (y - cy)) / _CAR_HALF_PX[1]
        cover = np.clip(3 - 2 * np.maximum(along, across), 0, 1).astype(np.float32)
        contrast, darker = rng.uniform(*_CAMOUFLAGE_CONTRAST), rng.uniform(*_CAMOUFLAGE_SHIFT)
        patch = patch * (1 - cover) + cover * (road + contrast * (patch - road) + darker)
    return np.asarray(patch, np.float32)


def _cut_by_edge(patch: Float32Array, mask: Mask, rng: np.random.Generator) -> Float32Array:
    """Continue a patch beyond a vertical line by its mirror image, as inference pads a frame; what is beyond it is not
    counted."""
    edge = int(rng.integers(20, PATCH_PX - 20))
    if edge > PATCH_PX // 2:
        mask[:, (edge + 1) // STRIDE :] = False
        cut = cv2.copyMakeBorder(patch[:, :edge], 0, 0, 0, PATCH_PX - edge, cv2.BORDER_REFLECT_101)
    else:
        mask[:, : edge // STRIDE] = False
        cut = cv2.copyMakeBorder(patch[:, edge:], 0, 0, edge, 0, cv2.BORDER_REFLECT_101)
    return np.asarray(cut, np.float32)


def _random_similarity(sample: LabelledImage, rng: np.random.Generator) -> FloatArray:
    """Affine matrix (2, 3) from image to patch: centred near a car or anywhere, rotated, mirrored, scaled."""
    height, width = sample.image.shape
    if len(sample.cars) and rng.random() < _CENTRED_FRACTION:
        centre = sample.cars[rng.integers(len(sample.cars)), :2] + rng.normal(0, _CENTRING_SD_PX, 2)
    else:
        centre = rng.uniform(0, (width, height))
    angle, scale = rng.uniform(0, 2 * np.pi), np.exp(rng.uniform(-_LOG_SCALE_RANGE, _LOG_SCALE_RANGE))
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


def encode_targets(centres: FloatArray, orientation_rad: FloatArray) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Target maps of a patch.

    Parameters
    ----------
    centres, orientation_rad
        (n, 2) positions and (n,) axial orientations of cars in the patch, px and rad.

    Returns
    -------
    (m, m) heatmap, 1 at a car's centre and a Gaussian around it (the highest one where cars overlap); (m, m, 2) cosine
    and sine of twice the orientation of that car; (m, m) weight of the orientation in the loss. m = `PATCH_PX` /
    `STRIDE`.
    """
    size = len(_HEATMAP_PX)
    heatmap, orientation = np.zeros((size, size), np.float32), np.zeros((size, size, 2), np.float32)
    near = ((centres > -_TARGET_MARGIN_PX) & (centres < PATCH_PX + _TARGET_MARGIN_PX)).all(axis=1)
    squared_distance = (_HEATMAP_PX - centres[near, :2, None]) ** 2
    profiles = np.exp(-squared_distance / (2 * HEATMAP_SIGMA_PX**2)).astype(np.float32)
    cells = np.rint((centres[near] - _HEATMAP_PX[0]) / STRIDE).astype(int)
    for (along_x, along_y), (x, y), angle in zip(profiles, cells, orientation_rad[near], strict=True):
        rows, columns = (slice(max(0, at - _HEATMAP_REACH), max(0, at + _HEATMAP_REACH + 1)) for at in (y, x))
        gaussian, part = along_y[rows, None] * along_x[columns], heatmap[rows, columns]
        nearest = gaussian > part
        part[nearest] = gaussian[nearest]
        orientation[rows, columns][nearest] = cos(2 * angle), sin(2 * angle)
    return heatmap, orientation, np.square(heatmap)


def _augment_photometry(patch: Float32Array, rng: np.random.Generator) -> Float32Array:
    """Photometric augmentation: gamma, contrast, brightness, blur, shadow, noise; grey stays in [0, 1]."""
    grey = cv2.pow(np.clip(patch, 0, 1), float(np.exp(rng.uniform(-_LOG_GAMMA_RANGE, _LOG_GAMMA_RANGE))))
    contrast, brightness = rng.uniform(*_CONTRAST_RANGE), rng.uniform(-_BRIGHTNESS_RANGE, _BRIGHTNESS_RANGE)
    grey *= np.float32(contrast)
    grey += np.float32(_MEAN_GREY * (1 - contrast) + brightness)
    if rng.random() < _BLUR_PROBABILITY:
        grey = cv2.GaussianBlur(grey, (0, 0), rng.uniform(*_BLUR_SIGMA_PX))
    if rng.random() < _SHADOW_PROBABILITY:
        grey *= 1 - np.float32(rng.uniform(*_SHADOW_DEPTH)) * _random_shadow(rng)
    grey += rng.normal(0, rng.uniform(0, _MAX_NOISE_SD), grey.shape).astype(np.float32)
    return np.asarray(np.clip(grey, 0, 1, out=grey), np.float32)


def _random_shadow(rng: np.random.Generator) -> Float32Array:
    """Mask of a shadow with a straight, blurred edge across the patch, 0 to 1."""
    angle, offset = rng.uniform(0, 2 * np.pi), rng.uniform(-PATCH_PX / 3, PATCH_PX / 3)
    position = np.arange(PATCH_PX) - PATCH_PX / 2
    shadow = position[None, :] * np.cos(angle) + position[:, None] * np.sin(angle) > offset
    return np.asarray(cv2.GaussianBlur(shadow.astype(np.float32), (0, 0), rng.uniform(*_SHADOW_EDGE_SIGMA_PX)))
