"""Patches for pre-training: what detectors miss most.

Added to `PatchDataset`: cars in the tone of the road, cars that the image's edge cuts, inverted polarity (as heat has),
haze, the halos and the losses of video.
"""

import cv2
import numpy as np

from schemas.arrays import Float32Array, FloatArray, Mask
from velfield.detection.cnn.dataset import (
    PATCH_PX,
    PatchDataset,
    add_noise,
    expose,
    near_patch,
    with_usual_size,
)
from velfield.detection.cnn.network import STRIDE, USUAL_SIZE_PX

_CAMOUFLAGE_PROBABILITY, _CAMOUFLAGED_FRACTION = 0.5, 0.5
"""Fraction of the patches with camouflaged cars, and fraction of the cars in such a patch."""
_CAMOUFLAGE_CONTRAST, _CAMOUFLAGE_SHIFT = (0.25, 0.9), (-0.08, 0.02)
_COVER_RATIO, _ROAD_MEDIAN_PX = (1.25, 1.5), 31
"""Length and width of what is redrawn, over the vehicle's."""
_EDGE_PROBABILITY = 0.12
_LARGE_RATIO, _LARGE_WEIGHT = 1.35, 5.0
"""A vehicle this many times as long as a car is that many times as often the one that a patch is centred near."""
_INVERSION_PROBABILITY = 0.1
_HAZE_PROBABILITY, _HAZE_CONTRAST, _HAZE_LEVEL = 0.15, (0.15, 0.5), (0.4, 0.8)
_VIDEO_PROBABILITY, _VIDEO_QUALITY, _VIDEO_REDUCTION = 0.35, (12, 70), (0.5, 1.0)
_SHARPENING_PROBABILITY, _SHARPENING, _SHARPENING_SIGMA_PX = 0.2, (0.3, 1.5), (0.6, 1.2)
"""Drones sharpen their video: halos about cars."""


class HardPatchDataset(PatchDataset):
    """Batches of patches for pre-training; parameters as of `PatchDataset`."""

    def choose_car(self, cars: FloatArray, rng: np.random.Generator) -> int:
        """A long one more often."""
        chance = np.where(cars[:, 3] > _LARGE_RATIO * USUAL_SIZE_PX[0], _LARGE_WEIGHT, 1.0)
        return int(np.searchsorted(np.cumsum(chance), rng.random() * chance.sum(), side="right"))

    def redraw(self, patch: Float32Array, vehicles: FloatArray, rng: np.random.Generator) -> Float32Array:
        """With camouflaged cars."""
        return camouflage_cars(patch, vehicles, rng)

    def target_lengths_px(self, vehicles: FloatArray) -> FloatArray | None:
        """Their own."""
        return vehicles[:, 3]

    def augment_photometry(self, patch: Float32Array, mask: Mask, rng: np.random.Generator) -> Float32Array:
        """Cut by the image's edge, inverted, hazy, sharpened, or lossy too."""
        if rng.random() < _EDGE_PROBABILITY:
            patch = cut_by_edge(patch, mask, rng)
        grey = expose(1 - patch if rng.random() < _INVERSION_PROBABILITY else patch, rng)
        if rng.random() < _HAZE_PROBABILITY:
            share, level = np.float32(rng.uniform(*_HAZE_CONTRAST)), np.float32(rng.uniform(*_HAZE_LEVEL))
            grey = share * grey + (1 - share) * level
        if rng.random() < _SHARPENING_PROBABILITY:
            smooth = cv2.GaussianBlur(grey, (0, 0), rng.uniform(*_SHARPENING_SIGMA_PX))
            grey += np.float32(rng.uniform(*_SHARPENING)) * (grey - smooth)
        grey = add_noise(grey, rng)
        return compress(grey, rng) if rng.random() < _VIDEO_PROBABILITY else grey


def camouflage_cars(patch: Float32Array, vehicles: FloatArray, rng: np.random.Generator) -> Float32Array:
    """Draw some cars in a tone nearer to that of the road about them, and darker: what a detector misses most."""
    near = near_patch(vehicles)
    if not len(near) or rng.random() > _CAMOUFLAGE_PROBABILITY:
        return patch
    road = cv2.medianBlur((np.clip(patch, 0, 1) * 255).astype(np.uint8), _ROAD_MEDIAN_PX).astype(np.float32) / 255
    y, x = np.mgrid[:PATCH_PX, :PATCH_PX].astype(np.float32)
    for cx, cy, angle, length, width in with_usual_size(vehicles[near]):
        if rng.random() > _CAMOUFLAGED_FRACTION:
            continue
        half_length, half_width = _COVER_RATIO[0] * length / 2, _COVER_RATIO[1] * width / 2
        along = np.abs(np.cos(angle) * (x - cx) + np.sin(angle) * (y - cy)) / half_length
        across = np.abs(-np.sin(angle) * (x - cx) + np.cos(angle) * (y - cy)) / half_width
        cover = np.clip(3 - 2 * np.maximum(along, across), 0, 1).astype(np.float32)
        contrast, darker = rng.uniform(*_CAMOUFLAGE_CONTRAST), rng.uniform(*_CAMOUFLAGE_SHIFT)
        patch = patch * (1 - cover) + cover * (road + contrast * (patch - road) + darker)
    return np.asarray(patch, np.float32)


def cut_by_edge(patch: Float32Array, mask: Mask, rng: np.random.Generator) -> Float32Array:
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


def compress(grey: Float32Array, rng: np.random.Generator) -> Float32Array:
    """A patch as a frame of video that was made smaller, compressed and made larger again."""
    side = round(PATCH_PX * rng.uniform(*_VIDEO_REDUCTION))
    small = cv2.resize(grey, (side, side), interpolation=cv2.INTER_AREA)
    quality = int(rng.integers(*_VIDEO_QUALITY))
    _, coded = cv2.imencode(".jpg", np.rint(small * 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality])
    decoded = np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), np.float32) / 255
    return np.asarray(cv2.resize(decoded, (PATCH_PX, PATCH_PX), interpolation=cv2.INTER_LINEAR), np.float32)
