"""Training patches: target maps, masks, and augmentation under which labels move with the image."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.arrays import FloatArray, GreyImage
from velfield.detection.cnn.dataset import (
    BATCH_SIZE,
    HEATMAP_SIGMA_PX,
    PATCH_PX,
    PatchDataset,
    _random_similarity,
    _source_window,
    encode_targets,
)
from velfield.detection.cnn.network import STRIDE
from velfield.detection.cnn.trainer import Batch
from velfield.detection.orientation import axial_difference
from velfield.detection.samples import LabelledImage

SIDE = PATCH_PX // STRIDE
POSITIONS = np.arange(SIDE) * STRIDE + (STRIDE - 1) / 2
"""Of the heatmap's rows and columns in the patch."""
INSIDE = st.floats(6, PATCH_PX - 7)
ANGLES = st.floats(0, np.pi)


def sample(image: GreyImage, cars: FloatArray | None = None, **known: object) -> LabelledImage:
    rows = np.empty((0, 5)) if cars is None else cars
    return LabelledImage(image=image, cars=rows, **known)


def patches(*groups: LabelledImage, weights: tuple[float, ...] = (1.0,), seed: int = 0, step: int = 0) -> Batch:
    return PatchDataset([[group] for group in groups], weights, seed)(step)


def bars(seed: int = 0) -> LabelledImage:
    """White bars of 18 x 6 px on black, on a grid and at random angles, each labelled as a car."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:400, :400]
    image, cars = np.zeros((400, 400), np.uint8), []
    for centre_x in range(40, 400, 40):
        for centre_y in range(40, 400, 40):
            angle = rng.uniform(0, np.pi)
            along = (x - centre_x) * np.cos(angle) + (y - centre_y) * np.sin(angle)
            across = (y - centre_y) * np.cos(angle) - (x - centre_x) * np.sin(angle)
            image[(np.abs(along) <= 9) & (np.abs(across) <= 3)] = 255
            cars.append((centre_x, centre_y, angle, 18, 6))
    return sample(image, np.array(cars, float))


@settings(max_examples=50)
@given(INSIDE, INSIDE, ANGLES)
def test_a_car_is_decoded_from_its_target_maps(x: float, y: float, angle: float) -> None:
    heatmap, orientation, weight = encode_targets(np.array([[x, y]]), np.array([angle]))
    row, column = np.unravel_index(heatmap.argmax(), heatmap.shape)
    assert np.hypot(POSITIONS[column] - x, POSITIONS[row] - y) <= np.hypot(1, 1) + 1e-6
    # log of a Gaussian is a parabola: three samples give its centre
    log = np.log(np.maximum(heatmap.astype(float), 1e-30))
    centre = [
        at + STRIDE * (after - before) / (2 * (2 * log[row, column] - before - after))
        for at, before, after in (
            (POSITIONS[column], log[row, column - 1], log[row, column + 1]),
            (POSITIONS[row], log[row - 1, column], log[row + 1, column]),
        )
    ]
    np.testing.assert_allclose(centre, (x, y), atol=0.01)
    decoded = 0.5 * np.arctan2(orientation[row, column, 1:], orientation[row, column, :1])
    assert axial_difference(decoded, np.array([angle]))[0] < 1e-5
    np.testing.assert_allclose(weight, heatmap**2, rtol=1e-6)


def test_the_heatmap_is_a_gaussian() -> None:
    heatmap, _, _ = encode_targets(np.array([[40.5, 50.5]]), np.zeros(1))
    squared = (POSITIONS[None] - 40.5) ** 2 + (POSITIONS[:, None] - 50.5) ** 2
    np.testing.assert_allclose(heatmap, np.exp(-squared / (2 * HEATMAP_SIGMA_PX**2)), atol=1e-6)
    assert heatmap[25, 20] == 1


@settings(max_examples=30)
@given(st.permutations(range(5)))
def test_where_cars_overlap_the_nearest_one_counts(order: list[int]) -> None:
    centres = np.array([[20.0, 20], [27, 20], [20, 31], [60, 60], [63, 64]])
    angles = np.linspace(0.1, 2.9, 5)
    heatmap, orientation, _ = encode_targets(centres[order], angles[order])
    alone = [encode_targets(centres[k : k + 1], angles[k : k + 1]) for k in range(5)]
    np.testing.assert_array_equal(heatmap, np.max([part[0] for part in alone], axis=0))
    nearest = np.argmax([part[0] for part in alone], axis=0)
    expected = np.stack([np.cos(2 * angles), np.sin(2 * angles)], 1)[nearest]
    np.testing.assert_allclose(orientation[heatmap > 1e-3], expected[heatmap > 1e-3], atol=1e-6)


@pytest.mark.parametrize(("x", "shows"), [(-7.9, True), (-8.1, False), (103.9, True), (104.1, False)])
def test_cars_just_outside_a_patch_still_show(x: float, shows: bool) -> None:
    heatmap, _, _ = encode_targets(np.array([[x, 48.0]]), np.zeros(1))
    assert heatmap.any() == shows


def test_target_heatmaps_move_with_the_image() -> None:
    """Where the heatmap has a peak, the patch is white; between the bars it is black, whatever the augmentation."""
    made = patches(bars())
    contrasts = []
    for image, heatmap in zip(made.images, made.heatmap, strict=True):
        centre, between = image[::STRIDE, ::STRIDE][heatmap > 0.9], image[::STRIDE, ::STRIDE][heatmap < 1e-6]
        contrasts.append(centre.min() > np.median(between) + 0.1 if len(centre) else True)
    assert np.mean(contrasts) > 0.9  # a shadow's edge may darken a bar
    assert sum((heatmap > 0.9).any() for heatmap in made.heatmap) > 12


def test_target_orientations_rotate_and_mirror_with_the_image() -> None:
    """The principal axis of each whole bar of a patch is its target orientation."""
    made = patches(bars())
    errors = []
    y, x = np.mgrid[-13:14, -13:14]
    disc = np.hypot(x, y) < 13.5
    for image, heatmap, orientation in zip(made.images, made.heatmap, made.orientation, strict=True):
        for row, column in np.argwhere(heatmap > 0.93):
            top, left = STRIDE * row, STRIDE * column
            if min(top, left) < 14 or max(top, left) > PATCH_PX - 15:
                continue
            crop = image[top - 13 : top + 14, left - 13 : left + 14]
            weight = np.clip(crop - np.median(crop) - 0.15, 0, None) * disc
            dx, dy = x - np.average(x, weights=weight), y - np.average(y, weights=weight)
            cxx, cyy, cxy = (np.average(part, weights=weight) for part in (dx * dx, dy * dy, dx * dy))
            target = 0.5 * np.arctan2(orientation[row, column, 1], orientation[row, column, 0])
            axis = 0.5 * np.arctan2(2 * cxy, cxx - cyy)
            errors.append(axial_difference(np.array([axis]), np.array([target]))[0])
    assert len(errors) > 20
    assert np.median(errors) < np.radians(3)
    assert np.mean(np.array(errors) < np.radians(15)) > 0.9


def test_ignored_circles_and_what_is_not_valid_are_masked() -> None:
    """Both are painted white: where a patch is white its mask is 0, and where its mask is 1 it is black."""
    y, x = np.mgrid[:400, :400]
    circle, invalid = np.hypot(x - 200, y - 200) < 110, (x < 170) | (y > 270)
    ignored = sample(np.where(circle, 255, 0).astype(np.uint8), ignore=np.array([[200.0, 200, 110]]))
    unknown = sample(np.where(invalid, 255, 0).astype(np.uint8), valid=~invalid)
    for labelled in (ignored, unknown):
        made = patches(labelled)
        both = np.ptp(made.images, axis=(1, 2)) > 0.3
        grey, known = made.images[both, ::STRIDE, ::STRIDE], made.mask[both] == 1
        white = grey > (grey.min(axis=(1, 2), keepdims=True) + grey.max(axis=(1, 2), keepdims=True)) / 2
        assert both.sum() > 3
        assert known[white].mean() < 0.02
        assert white[known].mean() < 0.02
        assert 0.1 < known.mean() < 0.8


def test_a_labelled_car_counts_within_an_ignored_circle() -> None:
    image = np.full((200, 200), 90, np.uint8)
    cars = np.array([[100.0, 100, 0.3, 16, 7]])
    made = patches(sample(image, cars, ignore=np.array([[100.0, 100, 60]])))
    assert made.mask[made.heatmap > 0.11].all()
    assert not made.mask[(made.heatmap > 0) & (made.heatmap < 0.09) & (made.heatmap > 1e-3)].any()
    assert not made.orientation_weight[made.mask == 0].any()


def test_shapes_types_and_ranges_of_a_batch() -> None:
    made = patches(bars())
    assert made.images.shape == (BATCH_SIZE, PATCH_PX, PATCH_PX)
    assert made.heatmap.shape == made.mask.shape == made.orientation_weight.shape == (BATCH_SIZE, SIDE, SIDE)
    assert made.orientation.shape == (BATCH_SIZE, SIDE, SIDE, 2)
    for name, values in vars(made).items():
        assert values.dtype == np.float32, name
        assert np.isfinite(values).all(), name
    assert made.images.min() >= 0
    assert made.images.max() <= 1
    assert set(np.unique(made.mask)) <= {0.0, 1.0}
    norm = np.hypot(made.orientation[..., 0], made.orientation[..., 1])
    np.testing.assert_allclose(norm[made.heatmap > 1e-3], 1, atol=1e-6)


def test_images_smaller_than_a_patch_are_mirrored_at_their_borders() -> None:
    made = patches(sample(np.tile(np.arange(40, dtype=np.uint8) * 6, (30, 1))))
    assert (made.images.std(axis=(1, 2)) > 0).all()
    assert made.mask.mean() < 0.5  # beyond the image nothing is known
    assert (made.mask.sum(axis=(1, 2)) > 0).all()


@pytest.mark.parametrize("shape", [(400, 500), (150, 220), (70, 90)])
def test_a_window_of_the_image_shows_what_the_whole_image_does(shape: tuple[int, int]) -> None:
    """At its borders too, where patches see the mirror image."""
    rng = np.random.default_rng(7)
    sample = LabelledImage(rng.integers(0, 256, shape).astype(np.uint8), np.empty((0, 5)))
    for _ in range(100):
        matrix = _random_similarity(rng.uniform(0, sample.image.shape[::-1]), rng, 0.2)
        rows, columns, of_window = _source_window(matrix, shape)
        found, expected = (
            cv2.warpAffine(image.astype(np.float32), to_patch, (PATCH_PX, PATCH_PX), borderMode=cv2.BORDER_REFLECT_101)
            for image, to_patch in ((sample.image[rows, columns], of_window), (sample.image, matrix))
        )
        np.testing.assert_allclose(found, expected, atol=0.05)


def test_photometry_varies_from_patch_to_patch() -> None:
    grey = patches(sample(np.full((200, 200), 128, np.uint8)), seed=3).images.mean(axis=(1, 2))
    assert grey.std() > 0.05
    assert grey.min() < 0.5 < grey.max()


def test_groups_are_sampled_by_weight_whatever_their_number_of_images() -> None:
    black, white = (sample(np.full((200, 200), grey, np.uint8)) for grey in (0, 255))

    def white_fraction(weights: tuple[float, float]) -> float:
        dataset = PatchDataset([[black] * 5, [white]], weights, seed=0)
        return float(np.mean([dataset(step).images.mean(axis=(1, 2)) > 0.45 for step in range(8)]))

    assert white_fraction((1.0, 0.0)) == 0
    assert white_fraction((0.0, 2.0)) == 1
    assert white_fraction((1.0, 3.0)) == pytest.approx(0.75, abs=0.1)


def test_batches_follow_from_their_number_and_the_seed() -> None:
    labelled = bars()
    one, other = (PatchDataset([[labelled]], [1.0], 4) for _ in range(2))
    in_order = [one(step).images for step in range(3)]
    backwards = [other(step).images for step in (2, 1, 0)]
    for first, second in zip(in_order, backwards[::-1], strict=True):
        np.testing.assert_array_equal(first, second)
    assert not np.array_equal(in_order[0], in_order[1])
    assert not np.array_equal(in_order[0], PatchDataset([[labelled]], [1.0], 5)(0).images)


def test_unlabelled_orientations_are_filled_in_from_the_image() -> None:
    labelled = bars()
    unknown = labelled.cars.copy()
    unknown[:, 2] = np.nan
    made, expected = patches(sample(labelled.image, unknown)), patches(labelled)
    cell = expected.heatmap > 0.5
    angles = (0.5 * np.arctan2(part.orientation[cell][:, 1], part.orientation[cell][:, 0]) for part in (made, expected))
    assert np.quantile(axial_difference(*angles), 0.9) < np.radians(6)


def test_the_gaussian_of_a_bus_is_longer_along_its_axis_alone() -> None:
    bus, _, _ = encode_targets(np.array([[48.5, 48.5]]), np.array([np.pi / 2]), np.array([48.0]))
    car, _, _ = encode_targets(np.array([[48.5, 48.5]]), np.array([np.pi / 2]), np.array([16.0]))
    np.testing.assert_allclose(bus[24], car[24], atol=1e-6)
    assert (bus[22, 24], bus[26, 24]) == pytest.approx((car[24, 22] ** (1 / 3),) * 2, rel=1e-4)
