"""Orientations from the image, and crops rotated to them."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from velfield.detection.crops import oriented_patches, patches_of_chips, upright_chips
from velfield.detection.orientation import (
    axial_difference,
    contradict_axes,
    fill_missing_orientation,
    outline_axes,
)
from velfield.detection.samples import LabelledImage
from velfield.pipeline.stages.labels import check_label_axes

ANGLES = st.floats(-10, 10, allow_nan=False)


def bar(angle: float, side: int = 64) -> np.ndarray:
    """A bright bar through the middle, blurred at its edges."""
    y, x = np.mgrid[:side, :side] - (side - 1) / 2
    u, v = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    inside = 1 / (1 + np.exp(2 * (np.abs(u) - 8))) / (1 + np.exp(2 * (np.abs(v) - 4)))
    return (60 + 150 * inside).astype(np.uint8)


def car(degrees: float, length: float = 16, width: float = 7) -> np.ndarray:
    """A bright car with dark windscreens, in the middle of 64 x 64 px."""
    image, angle = np.full((64, 64), 100, np.uint8), np.radians(degrees)
    c, s = np.cos(angle), np.sin(angle)
    screen = (length / 8, width - 1.5)
    for along, size, grey in ((0.0, (length, width), 170), (-0.22 * length, screen, 60), (0.22 * length, screen, 60)):
        corners = cv2.boxPoints(((32 + along * c, 32 + along * s), size, degrees))
        cv2.fillConvexPoly(image, np.rint(corners * 16).astype(np.int32), (grey,), cv2.LINE_AA, 4)
    return cv2.GaussianBlur(image, (0, 0), 0.8)


@given(ANGLES, ANGLES)
def test_axial_difference_is_a_distance_of_axes(a: float, b: float) -> None:
    one, two = np.array([a]), np.array([b])
    difference = axial_difference(one, two)[0]
    assert 0 <= difference <= np.pi / 2 + 1e-12
    assert difference == pytest.approx(axial_difference(two, one)[0], abs=1e-9)
    assert axial_difference(one + np.pi, two)[0] == pytest.approx(difference, abs=1e-9)
    # The angle between undirected lines, by their direction vectors.
    assert difference == pytest.approx(np.arccos(min(abs(np.cos(a - b)), 1.0)), abs=1e-6)


@pytest.mark.parametrize("degrees", [0.0, 20.0, 45.0, 90.0, 130.0])
@pytest.mark.parametrize("has_box", [False, True])
def test_windscreens_do_not_mislead_the_outline(degrees: float, *, has_box: bool) -> None:
    """The edges across a car are sharper than its sides, and as long."""
    label, angle = np.array([[32.0, 32.0, np.nan, np.nan, np.nan]]), np.radians(degrees)
    box_angle = np.array([np.arcsin(abs(np.sin(angle)))]) if has_box else None
    filled = fill_missing_orientation(car(degrees), label, box_angle)[0, 2]
    assert np.degrees(axial_difference(filled, angle)) < (4 if has_box else 8)


@pytest.mark.parametrize("degrees", [10.0, 80.0, 115.0])
@pytest.mark.parametrize(("length", "width"), [(18.0, 8.0), (24.0, 10.0)])
def test_a_labelled_size_is_used(degrees: float, length: float, width: float) -> None:
    label = np.array([[32.0, 32.0, np.nan, length, width]])
    filled = fill_missing_orientation(car(degrees, length, width), label)[0, 2]
    assert np.degrees(axial_difference(filled, np.radians(degrees))) < 8


def test_a_box_leaves_the_sign_to_the_image() -> None:
    """The same upright box, 30 degrees either way."""
    label, box_angle = np.array([[32.0, 32.0, np.nan, 16.0, 7.0]]), np.array([np.radians(30)])
    for degrees in (30.0, 150.0):
        filled = fill_missing_orientation(car(degrees), label, box_angle)[0, 2]
        assert np.degrees(axial_difference(filled, np.radians(degrees))) < 4


def test_given_orientations_stay_to_the_bit() -> None:
    labels = np.array([[32.0, 32.0, 1.234, 16.0, 7.0], [20.0, 20.0, np.nan, np.nan, np.nan]])
    filled = fill_missing_orientation(car(30.0), labels)
    assert filled[0].tolist() == labels[0].tolist()
    assert np.isfinite(filled[1, 2])
    assert np.isnan(labels[1, 2])  # the caller's array is left alone
    assert fill_missing_orientation(car(30.0), filled)[:, 2].tolist() == filled[:, 2].tolist()


@pytest.mark.parametrize("angle", [0.3, 1.2, 2.5])
def test_oriented_patches_of_rotated_bars_are_alike(angle: float) -> None:
    upright = oriented_patches(bar(0.0), np.array([[31.5, 31.5]]), np.array([0.0]))[0].astype(int)
    rotated = oriented_patches(bar(angle), np.array([[31.5, 31.5]]), np.array([angle]))[0].astype(int)
    assert np.abs(upright - rotated).mean() < 4


def test_chips_are_cropped_about_the_rounded_position() -> None:
    image = np.arange(64 * 64, dtype=np.uint32).reshape(64, 64).astype(np.uint8)
    chip = upright_chips(image, np.array([[30.4, 20.6]]))[0]
    assert chip[16, 16] == image[21, 30]
    np.testing.assert_array_equal(chip, image[5:37, 14:46])


def test_chips_at_the_edge_repeat_the_last_pixels() -> None:
    image = np.random.default_rng(0).integers(0, 255, (40, 50), dtype=np.uint8)
    chip = upright_chips(image, np.array([[0.0, 0.0]]))[0]
    np.testing.assert_array_equal(chip[16:, 16:], image[:16, :16])
    assert (chip[:16, :16] == image[0, 0]).all()


def test_crops_are_those_of_whole_grids() -> None:
    rng = np.random.default_rng(7)
    image = rng.integers(0, 256, (90, 120)).astype(np.uint8)
    xy, axes = rng.uniform(-3, 1, (40, 2)) % [120, 90], rng.uniform(0, np.pi, 40)
    across, along = np.meshgrid(np.arange(10) - 4.5, np.arange(32) - 15.5)
    cosine, sine = np.cos(axes)[:, None, None], np.sin(axes)[:, None, None]
    x = xy[:, 0, None, None] + along * cosine - across * sine
    y = xy[:, 1, None, None] + along * sine + across * cosine
    grids = (values.reshape(40, -1).astype(np.float32) for values in (x, y))
    plain = cv2.remap(image, *grids, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    found = oriented_patches(image, xy, axes, width=10, length=32)
    np.testing.assert_array_equal(found, plain.reshape(40, 32, 10))
    padded = np.pad(image, 32, mode="edge")
    for chip, (left, top) in zip(upright_chips(image, xy), np.rint(xy).astype(int) + 16, strict=True):
        np.testing.assert_array_equal(chip, padded[top : top + 32, left : left + 32])


def test_patches_are_cut_out_of_the_chips_as_out_of_the_image() -> None:
    rng = np.random.default_rng(8)
    image = rng.integers(0, 256, (90, 120)).astype(np.uint8)
    xy, axes = rng.uniform(16, 74, (1500, 2)), rng.uniform(0, np.pi, 1500)
    found = patches_of_chips(upright_chips(image, xy), xy - np.rint(xy), axes)
    assert np.abs(found.astype(int) - oriented_patches(image, xy, axes)).max() <= 8  # positions of 32 bits, rounded


def test_no_positions_give_no_crops() -> None:
    image = np.zeros((40, 50), np.uint8)
    assert oriented_patches(image, np.empty((0, 2)), np.empty(0)).shape == (0, 16, 8)
    assert upright_chips(image, np.empty((0, 2))).shape == (0, 32, 32)


def test_axes_of_labels_that_are_not_those_of_the_cars_are_reported() -> None:
    rng = np.random.default_rng(5)
    image = np.full((400, 400), 90, np.uint8)
    centres = np.array([(x, y) for x in range(40, 400, 40) for y in range(40, 400, 40)], np.float64)
    axes = rng.uniform(0, np.pi, len(centres))
    for (x, y), axis in zip(centres, axes, strict=True):
        corners = cv2.boxPoints(((x, y), (16, 7), np.degrees(axis)))
        cv2.fillPoly(image, [corners.round().astype(np.int32)], 200)
    cars = np.column_stack([centres, axes, np.full((len(axes), 2), (16.0, 7.0))])
    found = outline_axes(image, cars)
    assert not contradict_axes(found, axes)
    (mirrored,) = contradict_axes(found, -axes)
    assert "if angles are counted the other way round" in mirrored
    assert "check the angles" in contradict_axes(found, np.zeros(len(axes)))[0]
    assert not contradict_axes(found[:5], np.zeros(5))


def test_axes_are_compared_over_all_labelled_images() -> None:
    images, cars = [car(40.0) for _ in range(10)], np.array([[32.0, 32.0, np.radians(40.0), 16.0, 7.0]])
    for turn, is_right in ((0.0, True), (np.pi / 2, False)):
        labelled = cars + np.array([0, 0, turn, 0, 0])
        samples = [LabelledImage(image, labelled, np.empty((0, 3)), np.full(1, np.nan)) for image in images]
        assert (not check_label_axes(samples)) == is_right
    unknown = LabelledImage(images[0], cars * np.array([1, 1, np.nan, 1, 1]), np.empty((0, 3)), np.full(1, 0.5))
    assert not check_label_axes([unknown] * 10)
