"""What the aligned method learns from: labelled pictures, poses of the cars in them, poses of all else."""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import KDTree

from schemas.arrays import FloatArray, GreyImage, Mask
from velfield.detection.cascade.candidates import candidate_places
from velfield.detection.cascade.feature_image import COARSE, FINE, Picture, picture_of
from velfield.detection.label_orientation import with_axes
from velfield.detection.orientation import at_places, axial_difference, structure_axis

OFF_CENTRE_PX = (4.5, 10.0)
WRONG_TURN_RAD = 0.45
FAR_PX = 9.0
"""Farther than this from every car is background."""
_SIZE_SPREAD = 0.06
_CANDIDATES, _ANYWHERE, _TURNED, _BESIDE = 0.5, 0.15, 0.15, 0.2
"""Shares of the poses that are no car."""


def _no_circles() -> FloatArray:
    return np.empty((0, 3))


@dataclass(frozen=True)
class LabelledImage:
    """A picture on the working grid and what is known to be a car in it.

    Attributes
    ----------
    image : (h, w) uint8.
    cars : (n, 5): x, y, orientation, length, width in working px; NaN where it is not told.
    tilts : (n,) of cars whose orientation is not told |angle| to the rows, NaN where that is not either; none: of none.
    ignore : (k, 3): x, y, radius of what is neither car nor background.
    valid : (h, w) bool, none: everywhere.
    background : (h, w) uint8, none: not known.
    complete : whether every car is marked, so that all else is background; else what looks like a car may be one.
    """

    image: GreyImage
    cars: FloatArray
    ignore: FloatArray = field(default_factory=_no_circles)
    valid: Mask | None = None
    background: GreyImage | None = None
    complete: bool = True
    tilts: FloatArray | None = None


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


def within(sample: LabelledImage, region: Mask) -> LabelledImage:
    """The picture with nothing known outside a region (h, w)."""
    valid, inside = region if sample.valid is None else region & sample.valid, lies_in(region, sample.cars)
    tilts = None if sample.tilts is None else sample.tilts[inside]
    return replace(sample, valid=valid, cars=sample.cars[inside], tilts=tilts)


def lies_in(region: Mask, xy: FloatArray) -> Mask:
    """Whether places (n, 2...) lie in a region (h, w)."""
    x, y = (np.clip(np.rint(xy[:, k]), 0, region.shape[1 - k] - 1).astype(np.int64) for k in (0, 1))
    return np.asarray(region[y, x])


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


def distance(xy: FloatArray, cars: FloatArray) -> FloatArray:
    """From places (n, 2...) to the nearest car."""
    if not len(cars):
        return np.full(len(xy), np.inf)
    return np.asarray(KDTree(cars[:, :2]).query(xy[:, :2])[0])
