"""Training scenes of the cascade: labelled images with their features, positive and negative samples from them.

A sample is a pose, that is a position and an axis. Positives are labelled cars, augmented. Negatives are candidate
regions and random positions on the background, cars at a wrong rotation, and positions beside a car, which teach the
classifier to localise.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial import KDTree

from schemas.arrays import FloatArray, GreyImage, Mask
from velfield.detection.cascade.feature_image import COARSE, FINE, FeatureImage, compute_features
from velfield.detection.orientation import (
    axial_difference,
    fill_missing_orientation,
    sample_nearest,
    structure_tensor_axis,
)
from velfield.detection.samples import LabelledImage, distance_to_nearest_car, in_region, restrict_to_region

OFF_CENTRE_PX = (4.5, 10.0)
"""Distance from a car's centre of the negatives beside it."""
WRONG_ROTATION_RAD = 0.45
"""A car rotated by more than this is a negative."""
BACKGROUND_PX = 9.0
"""Farther than this from every car is background."""
_DOG_SIGMAS_PX = 2.5, 4.0
_DOG_PER_MEGAPIXEL = 5000
_LOG_SIZE_SD = 0.06
_CANDIDATES, _ANYWHERE, _ROTATED, _BESIDE = 0.5, 0.15, 0.15, 0.2
"""Fractions of the negatives."""


@dataclass(frozen=True)
class TrainingScene:
    """A labelled image, and what training reads of it.

    Attributes
    ----------
    fine, coarse : its features at both scales.
    cars : (n, 3): x, y, axis.
    has_orientation : (n,) whether the label gave the axis.
    proposals : (m, 3): x, y, axis of candidate regions.
    """

    sample: LabelledImage
    fine: FeatureImage
    coarse: FeatureImage
    cars: FloatArray
    has_orientation: Mask
    proposals: FloatArray


def make_scene(sample: LabelledImage, has_background: bool) -> TrainingScene:
    """Compute features, candidate regions, and the orientations that labels lack."""
    background = sample.background if has_background else None
    fine, coarse = (compute_features(sample.image, background, scale) for scale in (FINE, COARSE))
    xy = dog_extrema(sample.image, sample.valid)
    axis, _ = structure_tensor_axis(sample.image)
    proposals = np.column_stack([xy, sample_nearest(axis, xy)])
    cars = fill_missing_orientation(sample.image, sample.cars, sample.abs_box_angle_rad)
    return TrainingScene(sample, fine, coarse, cars[:, :3], np.isfinite(sample.cars[:, 2]), proposals)


def restrict_scene(scene: TrainingScene, region: Mask) -> TrainingScene:
    """The scene with nothing known outside a region (h, w)."""
    inside = in_region(region, scene.cars)
    return replace(
        scene,
        sample=restrict_to_region(scene.sample, region),
        cars=scene.cars[inside],
        has_orientation=scene.has_orientation[inside],
        proposals=scene.proposals[in_region(region, scene.proposals)],
    )


def dog_extrema(
    image: GreyImage, valid: Mask | None = None, *, per_megapixel: float = _DOG_PER_MEGAPIXEL
) -> FloatArray:
    """The strongest extrema of a difference of Gaussians of 16 sqrt(grey), bright or dark: candidates untrained.

    Returns
    -------
    (n, 2) working px, strongest first.
    """
    root = 16 * np.sqrt(image.astype(np.float32))
    fine, coarse = (cv2.GaussianBlur(root, (0, 0), sigma) for sigma in _DOG_SIGMAS_PX)
    dog = np.abs(fine - coarse)
    peak = dog >= cv2.dilate(dog, np.ones((3, 3), np.uint8))
    peak &= dog > 0.05
    if valid is not None:
        peak &= valid
    y, x = np.nonzero(peak)
    count = int(per_megapixel * image.size / 1e6) + 1
    order = np.argsort(-dog[y, x], kind="stable")[:count]
    return np.column_stack([x[order], y[order]]).astype(np.float64)


@dataclass(frozen=True)
class Poses:
    """Samples: poses (n, 3) as x, y, axis, with a relative size and a mirroring each."""

    rows: FloatArray
    sizes: FloatArray
    mirrored: Mask

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, part: slice) -> "Poses":
        return Poses(self.rows[part], self.sizes[part], self.mirrored[part])

    def where(self, chosen: Mask) -> "Poses":
        """Those that are chosen (n,)."""
        return Poses(self.rows[chosen], self.sizes[chosen], self.mirrored[chosen])


def augment_poses(rows: FloatArray, rng: np.random.Generator) -> Poses:
    """Random augmentation: either direction along the axis, mirroring, size."""
    rows = rows[:, :3].copy()
    rows[:, 2] += np.where(rng.random(len(rows)) < 0.5, np.pi, 0)
    return Poses(rows, np.exp(rng.normal(0, _LOG_SIZE_SD, len(rows))), rng.random(len(rows)) < 0.5)


def sample_negatives(scene: TrainingScene, count: int, rng: np.random.Generator) -> Poses:
    """About so many negatives: candidate regions, random positions, rotated cars, positions beside a car."""
    parts = [_candidates(scene, int(_CANDIDATES * count), rng), _anywhere(scene, int(_ANYWHERE * count), rng)]
    if len(scene.cars):
        parts += [_rotated_cars(scene, int(_ROTATED * count), rng), _beside_cars(scene, int(_BESIDE * count), rng)]
    return augment_poses(np.concatenate(parts), rng)


def _candidates(scene: TrainingScene, count: int, rng: np.random.Generator) -> FloatArray:
    background = np.flatnonzero(is_background(scene.proposals, scene))
    if not len(background):
        return np.empty((0, 3))
    # An incompletely labelled image may hold unlabelled cars, few among all candidates: draw each but once.
    chosen = rng.choice(background, count) if scene.sample.complete else rng.permutation(background)[:count]
    rows = scene.proposals[chosen].copy()
    rows[:, :2] += rng.normal(0, 2.0, (len(rows), 2))
    rows[:, 2] += np.where(rng.random(len(rows)) < 0.5, rng.normal(0, 0.2, len(rows)), rng.uniform(0, np.pi, len(rows)))
    return np.asarray(rows)


def _anywhere(scene: TrainingScene, count: int, rng: np.random.Generator) -> FloatArray:
    height, width = scene.sample.image.shape
    xy = rng.uniform(0, 1, (3 * count, 2)) * [width - 1, height - 1]
    if scene.sample.valid is not None:
        xy = xy[in_region(scene.sample.valid, xy)]
    xy = xy[is_background(xy, scene)][:count]
    return np.column_stack([xy, rng.uniform(0, np.pi, len(xy))])


def _rotated_cars(scene: TrainingScene, count: int, rng: np.random.Generator) -> FloatArray:
    rows = scene.cars[rng.integers(len(scene.cars), size=count)]
    rotation = rng.uniform(WRONG_ROTATION_RAD, np.pi - WRONG_ROTATION_RAD, count)
    return np.asarray(rows + np.column_stack([rng.normal(0, 1.5, (count, 2)), rotation]))


def _beside_cars(scene: TrainingScene, count: int, rng: np.random.Generator) -> FloatArray:
    rows = scene.cars[rng.integers(len(scene.cars), size=count)].copy()
    radius, angle = rng.uniform(*OFF_CENTRE_PX, count), rng.uniform(0, 2 * np.pi, count)
    rows[:, :2] += radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    rows[:, 2] += rng.normal(0, 0.15, count)
    return np.asarray(rows[distance_to_nearest_car(rows, scene.cars) >= OFF_CENTRE_PX[0]])


def is_background(xy: FloatArray, scene: TrainingScene) -> Mask:
    """Whether positions (n, 2...) are away from every car and from every object to be ignored."""
    background = distance_to_nearest_car(xy, scene.cars) > BACKGROUND_PX
    ignore = scene.sample.ignore
    if len(ignore) and len(xy):
        # Only circles within reach: motion gives hundreds of them, the proposals are tens of thousands.
        near = KDTree(ignore[:, :2]).query_ball_point(xy[:, :2], float(ignore[:, 2].max()) + BACKGROUND_PX / 2)
        for k, circles in enumerate(near):
            if background[k] and circles:
                around = ignore[circles]
                gap = np.hypot(xy[k, 0] - around[:, 0], xy[k, 1] - around[:, 1]) - around[:, 2]
                background[k] = gap.min() > BACKGROUND_PX / 2
    return np.asarray(background)


def is_false_positive(detections: FloatArray, scene: TrainingScene) -> Mask:
    """Whether detections (n, 3...) are no car: on the background, or on a car but across it."""
    false = is_background(detections, scene)
    if len(scene.cars) and len(detections):
        gap = np.hypot(detections[:, None, 0] - scene.cars[:, 0], detections[:, None, 1] - scene.cars[:, 1])
        nearest = gap.argmin(axis=1)
        across = axial_difference(detections[:, 2], scene.cars[nearest, 2]) > 2 * WRONG_ROTATION_RAD
        false |= (gap.min(axis=1) < OFF_CENTRE_PX[0]) & across
    return np.asarray(false)
