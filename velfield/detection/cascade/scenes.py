"""Training scenes of the cascade: labelled images with their features, poses of cars, poses of everything else."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial import KDTree

from schemas.arrays import FloatArray, GreyImage, Mask
from velfield.detection.cascade.feature_image import COARSE, FINE, Picture, picture_of
from velfield.detection.orientation import at_places, axial_difference, structure_axis, with_axes
from velfield.detection.samples import LabelledImage, distance, lies_in, within

FINE_SIGMA_PX, COARSE_SIGMA_PX = 2.5, 4.0
PER_MEGAPIXEL = 5000
OFF_CENTRE_PX = (4.5, 10.0)
WRONG_TURN_RAD = 0.45
FAR_PX = 9.0
"""Farther than this from every car is background."""
_SIZE_SPREAD = 0.06
_CANDIDATES, _ANYWHERE, _TURNED, _BESIDE = 0.5, 0.15, 0.15, 0.2
"""Shares of the poses that are no car."""


@dataclass(frozen=True)
class Scene:
    """A labelled picture, made ready.

    Attributes
    ----------
    fine, coarse : the picture at both grains.
    cars : (n, 3): x, y, axis.
    told : (n,) whether the label gave the axis.
    places : (m, 3): x, y, axis of places where a car may be.
    """

    sample: LabelledImage
    fine: Picture
    coarse: Picture
    cars: FloatArray
    told: Mask
    places: FloatArray


def scene_of(sample: LabelledImage, has_background: bool) -> Scene:
    """Make a labelled picture ready; the axis of a car whose label does not tell comes from the picture and the box."""
    background = sample.background if has_background else None
    fine, coarse = (picture_of(sample.image, background, grain) for grain in (FINE, COARSE))
    xy = candidate_places(sample.image, sample.valid)
    axis, _ = structure_axis(sample.image)
    places = np.column_stack([xy, at_places(axis, xy)])
    cars = with_axes(sample.image, sample.cars, sample.tilts)
    return Scene(sample, fine, coarse, cars[:, :3], np.isfinite(sample.cars[:, 2]), places)


def part_of(scene: Scene, region: Mask) -> Scene:
    """The scene with nothing known outside a region (h, w)."""
    inside = lies_in(region, scene.cars)
    places = scene.places[lies_in(region, scene.places)]
    return replace(
        scene, sample=within(scene.sample, region), cars=scene.cars[inside], told=scene.told[inside], places=places
    )


def candidate_places(
    image: GreyImage, valid: Mask | None = None, *, per_megapixel: float = PER_MEGAPIXEL
) -> FloatArray:
    """The strongest extrema of the DoG of 16 sqrt(grey), bright or dark.

    Returns
    -------
    (n, 2) working px, strongest first.
    """
    root = 16 * np.sqrt(image.astype(np.float32))
    dog = np.abs(cv2.GaussianBlur(root, (0, 0), FINE_SIGMA_PX) - cv2.GaussianBlur(root, (0, 0), COARSE_SIGMA_PX))
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
    """Poses (n, 3) as x, y, axis; with a size and a mirroring each."""

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


def varied(rows: FloatArray, rng: np.random.Generator, spread: float = _SIZE_SPREAD) -> Poses:
    """Either way round, mirrored or not, a little larger or smaller: a car is as likely one as the other."""
    rows = rows[:, :3].copy()
    rows[:, 2] += np.where(rng.random(len(rows)) < 0.5, np.pi, 0)
    return Poses(rows, np.exp(rng.normal(0, spread, len(rows))), rng.random(len(rows)) < 0.5)


def other_poses(scene: Scene, wanted: int, rng: np.random.Generator) -> Poses:
    """Poses that are no car: candidates and places anywhere, cars wrongly turned, places beside a car."""
    parts = [_candidates(scene, int(_CANDIDATES * wanted), rng), _anywhere(scene, int(_ANYWHERE * wanted), rng)]
    if len(scene.cars):
        parts += [_turned(scene, int(_TURNED * wanted), rng), _beside(scene, int(_BESIDE * wanted), rng)]
    return varied(np.concatenate(parts), rng)


def _candidates(scene: Scene, wanted: int, rng: np.random.Generator) -> FloatArray:
    far = np.flatnonzero(is_far(scene.places, scene))
    if not len(far):
        return np.empty((0, 3))
    # A picture that is not wholly marked may hold unmarked cars, few among all candidates: take each but once.
    chosen = rng.choice(far, wanted) if scene.sample.complete else rng.permutation(far)[:wanted]
    rows = scene.places[chosen].copy()
    rows[:, :2] += rng.normal(0, 2.0, (len(rows), 2))
    rows[:, 2] += np.where(rng.random(len(rows)) < 0.5, rng.normal(0, 0.2, len(rows)), rng.uniform(0, np.pi, len(rows)))
    return np.asarray(rows)


def _anywhere(scene: Scene, wanted: int, rng: np.random.Generator) -> FloatArray:
    height, width = scene.sample.image.shape
    xy = rng.uniform(0, 1, (3 * wanted, 2)) * [width - 1, height - 1]
    if scene.sample.valid is not None:
        xy = xy[lies_in(scene.sample.valid, xy)]
    xy = xy[is_far(xy, scene)][:wanted]
    return np.column_stack([xy, rng.uniform(0, np.pi, len(xy))])


def _turned(scene: Scene, wanted: int, rng: np.random.Generator) -> FloatArray:
    rows = scene.cars[rng.integers(len(scene.cars), size=wanted)]
    turn = rng.uniform(WRONG_TURN_RAD, np.pi - WRONG_TURN_RAD, wanted)
    return np.asarray(rows + np.column_stack([rng.normal(0, 1.5, (wanted, 2)), turn]))


def _beside(scene: Scene, wanted: int, rng: np.random.Generator) -> FloatArray:
    rows = scene.cars[rng.integers(len(scene.cars), size=wanted)].copy()
    radius, angle = rng.uniform(*OFF_CENTRE_PX, wanted), rng.uniform(0, 2 * np.pi, wanted)
    rows[:, :2] += radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    rows[:, 2] += rng.normal(0, 0.15, wanted)
    return np.asarray(rows[distance(rows, scene.cars) >= OFF_CENTRE_PX[0]])


def is_far(xy: FloatArray, scene: Scene) -> Mask:
    """Whether places (n, 2...) are background: away from every car and all that is to be ignored."""
    far = distance(xy, scene.cars) > FAR_PX
    ignore = scene.sample.ignore
    if len(ignore) and len(xy):
        # Only circles within reach: motion gives hundreds of them, a scan tens of thousands of places.
        near = KDTree(ignore[:, :2]).query_ball_point(xy[:, :2], float(ignore[:, 2].max()) + FAR_PX / 2)
        for k, circles in enumerate(near):
            if far[k] and circles:
                around = ignore[circles]
                gap = np.hypot(xy[k, 0] - around[:, 0], xy[k, 1] - around[:, 1]) - around[:, 2]
                far[k] = gap.min() > FAR_PX / 2
    return np.asarray(far)


def is_wrong(found: FloatArray, scene: Scene) -> Mask:
    """Whether finds (n, 3...) are no car: background, or on a car but across it."""
    wrong = is_far(found, scene)
    if len(scene.cars) and len(found):
        gap = np.hypot(found[:, None, 0] - scene.cars[:, 0], found[:, None, 1] - scene.cars[:, 1])
        across = axial_difference(found[:, 2], scene.cars[gap.argmin(axis=1), 2]) > 2 * WRONG_TURN_RAD
        wrong |= (gap.min(axis=1) < OFF_CENTRE_PX[0]) & across
    return np.asarray(wrong)
