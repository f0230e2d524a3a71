"""The coarse stage of inter-sensor registration: SIFT homography and search, on images whose map is known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.scenes import by_homography, city, photograph, similarity
from velfield.camera.lens import HarrisLens, pinhole
from velfield.registration.intersensor.coarse import (
    MIN_INLIERS,
    downscale,
    estimate_sift_homography,
    scaling_matrix,
    search_similarity,
    sift_keypoints,
    sift_scale,
    similarity_matrix,
)
from velfield.registration.keypoints import is_plausible
from velfield.registration.transforms import HomographyTransform, frame_corners

SHAPE = (240, 320)
CENTRE = np.array([159.5, 119.5])
LENS = HarrisLens(0.1, 160.5, 118.0, 200.0)


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    return city(31, 600, blocks=200)


def view(scale: float, rotation_deg: float) -> np.ndarray:
    """Undistorted frame px to base px."""
    return similarity(scale, rotation_deg, CENTRE, np.array([310.0, 290.0]))


@pytest.mark.parametrize("scale", [0.5, 0.25])
def test_scaling_matrix_maps_pixel_centres_as_area_averaging_does(scale: float) -> None:
    """Coordinate images: each downscaled pixel holds the mean coordinate of the pixels it averages."""
    for axis in range(2):
        grey = np.indices((200, 200))[1 - axis].astype(np.uint8)
        small = downscale(grey, scale)
        there = np.indices(small.shape)[::-1].reshape(2, -1).T.astype(float)
        back = by_homography(np.linalg.inv(scaling_matrix(scale)), there)
        np.testing.assert_allclose(small.ravel(), back[:, axis], atol=0.51)


def test_nothing_is_enlarged() -> None:
    grey = np.zeros((7, 9), np.uint8)
    assert downscale(grey, 1.0) is grey
    assert downscale(grey, 3.0) is grey


def test_small_images_keep_the_size_that_sift_needs() -> None:
    assert sift_scale((1920, 2560), 0.5) == 0.5
    assert sift_scale((500, 1400), 0.25) == pytest.approx(0.5)
    assert sift_scale((100, 100), 0.25) == 1.0


@given(scale=st.floats(0.2, 5.0), angle=st.floats(-3.1, 3.1), x=st.floats(-500, 500), y=st.floats(-500, 500))
def test_a_similarity_maps_its_point_and_keeps_angles(scale: float, angle: float, x: float, y: float) -> None:
    source, target = np.array([x, y]), np.array([12.0, -7.0])
    matrix = similarity_matrix(scale, angle, source, target)
    np.testing.assert_allclose(by_homography(matrix, source[None])[0], target, atol=1e-6)
    linear = matrix[:2, :2]
    np.testing.assert_allclose(linear @ linear.T, scale**2 * np.eye(2), atol=1e-9)
    assert np.linalg.det(linear) > 0
    back = similarity_matrix(1 / scale, -angle, target, source)
    np.testing.assert_allclose(matrix @ back, np.eye(3), atol=1e-6)


@pytest.mark.parametrize(("scale", "rotation_deg"), [(1.0, 0.0), (0.8, 100.0), (1.2, -45.0)])
def test_sift_finds_the_homography_of_any_rotation(ground: np.ndarray, scale: float, rotation_deg: float) -> None:
    to_base = view(scale, rotation_deg)
    image = photograph(ground, to_base, LENS, SHAPE, 1)
    found = estimate_sift_homography(image, sift_keypoints(ground, 0.25), LENS, scale=0.25)
    assert found.matrix is not None
    assert MIN_INLIERS <= found.inliers <= found.matches
    corners = frame_corners(*SHAPE[::-1])
    error = by_homography(found.matrix, corners) - by_homography(to_base, corners)
    assert np.linalg.norm(error, axis=1).max() < 4.0


def test_a_flipped_image_matches_when_mirrored_alone(ground: np.ndarray) -> None:
    flipped = np.ascontiguousarray(photograph(ground, view(1.0, 10.0), pinhole(SHAPE), SHAPE, 1)[:, ::-1])
    lens, of_ground = pinhole(SHAPE), sift_keypoints(ground, 0.25)
    assert estimate_sift_homography(flipped, of_ground, lens, scale=0.25).matrix is None
    assert estimate_sift_homography(flipped, of_ground, lens, scale=0.25, mirrored=True).matrix is not None


def test_too_few_features_or_matches_give_no_matrix_but_their_numbers(ground: np.ndarray) -> None:
    image = photograph(ground, view(1.0, 0.0), pinhole(SHAPE), SHAPE, 1)
    of_ground, of_other = (sift_keypoints(base, 0.25) for base in (ground, city(77, 600, blocks=200)))
    flat = estimate_sift_homography(np.full(SHAPE, 90, np.uint8), of_ground, pinhole(SHAPE), scale=0.25)
    assert (flat.matrix, flat.matches, flat.inliers) == (None, 0, 0)
    other = estimate_sift_homography(image, of_other, pinhole(SHAPE), scale=0.25)
    assert other.matrix is None
    assert other.inliers < MIN_INLIERS


@pytest.mark.parametrize(
    ("matrix", "plausible"),
    [
        (np.eye(3), True),
        (similarity(2.0, 200.0, CENTRE, CENTRE), True),
        (np.diag([-1.0, 1.0, 1.0]), False),  # mirrored
        (np.diag([1.0, 9.0, 1.0]), False),  # stretched
        (np.diag([0.01, 0.01, 1.0]), False),  # shrunk to a point
        (np.array([[1.0, 0, 0], [0, 1.0, 0], [-1 / 150, 0, 1.0]]), False),  # a horizon across the frame
    ],
)
def test_plausible_maps_keep_handedness_and_shape(matrix: np.ndarray, plausible: bool) -> None:
    assert is_plausible(HomographyTransform(matrix), frame_corners(*SHAPE[::-1])) is plausible


def centre_error_px(matrix: np.ndarray, to_base: np.ndarray) -> float:
    return float(np.linalg.norm(by_homography(matrix, CENTRE[None]) - by_homography(to_base, CENTRE[None])))


def test_the_search_finds_rotation_scale_and_position(ground: np.ndarray) -> None:
    to_base = view(0.8, 40.0)
    image = photograph(ground, to_base, LENS, SHAPE, 1)
    found = search_similarity(
        image, ground, LENS, scales=(0.63, 0.79, 1.0), rotations_rad=np.radians(np.arange(0.0, 360.0, 20.0))
    )
    best = found[0]
    assert [c.score for c in found] == sorted((c.score for c in found), reverse=True)
    assert centre_error_px(best.matrix, to_base) < 8.0
    assert np.sqrt(np.linalg.det(best.matrix[:2, :2])) == pytest.approx(0.79)
    assert np.degrees(np.arctan2(best.matrix[1, 0], best.matrix[0, 0])) == pytest.approx(40.0)


def test_candidates_are_relative_to_an_initial_map(ground: np.ndarray) -> None:
    to_base = view(1.0, 30.0)
    image = photograph(ground, to_base, pinhole(SHAPE), SHAPE, 1)
    initial = to_base @ similarity(1.25, 10.0, CENTRE, CENTRE + np.array([9.0, -7.0]))
    found = search_similarity(
        image,
        ground,
        pinhole(SHAPE),
        scales=(0.8, 1.0, 1.25),
        rotations_rad=np.radians([-10.0, 0.0, 10.0]),
        initial=initial,
    )
    assert centre_error_px(found[0].matrix, to_base) < 6.0
    np.testing.assert_allclose(found[0].matrix[:2, :2], to_base[:2, :2], atol=0.02)


def test_a_frame_larger_than_the_base_image_has_no_candidate(ground: np.ndarray) -> None:
    image = photograph(ground, view(1.0, 0.0), pinhole(SHAPE), SHAPE, 1)
    small = np.ascontiguousarray(ground[:100, :100])
    assert search_similarity(image, small, pinhole(SHAPE), scales=(2.0,), rotations_rad=(0.0,)) == []
    flat = np.full(SHAPE, 90, np.uint8)
    assert search_similarity(flat, ground, pinhole(SHAPE), scales=(1.0,), rotations_rad=(0.0,)) == []
