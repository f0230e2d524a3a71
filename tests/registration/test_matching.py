"""Key points and their matches, the guided ones against a plain search."""

import numpy as np

from schemas.flight import RegistrationConfig
from velfield.errors import Failure
from velfield.registration.keypoints import (
    Keypoints,
    detect_keypoints,
    estimate_homography_prior,
    match_descriptors,
    match_guided,
)
from velfield.registration.transforms import HomographyTransform

CONFIG = RegistrationConfig(max_keypoints=500)
TURNED = np.array([[0.9, -0.3, 40.0], [0.3, 0.95, -20.0], [1e-5, 2e-5, 1.0]])


def textured(seed: int = 0, shape: tuple[int, int] = (240, 320)) -> np.ndarray:
    """Blocks of random grey: corners everywhere."""
    rng = np.random.default_rng(seed)
    small = rng.integers(0, 255, (shape[0] // 8, shape[1] // 8), dtype=np.uint8)
    return np.kron(small, np.ones((8, 8), np.uint8))


def random_keypoints(rng: np.random.Generator, count: int) -> Keypoints:
    return Keypoints(rng.uniform(0, 400, (count, 2)), rng.integers(0, 90, (count, 128), dtype=np.uint8))


def test_key_points_are_spread_and_no_more_than_asked_for() -> None:
    found = detect_keypoints(textured(), CONFIG)
    assert 300 < len(found) <= 500
    assert found.descriptors.dtype == np.uint8
    assert len(np.unique(np.floor(found.xy[:40] / 80), axis=0)) >= 10


def test_key_points_keep_to_the_mask() -> None:
    mask = np.zeros((240, 320), bool)
    mask[:, :160] = True
    assert detect_keypoints(textured(), CONFIG, mask).xy[:, 0].max() < 162


def test_a_black_frame_has_no_keypoints() -> None:
    assert len(detect_keypoints(np.zeros((240, 320), np.uint8), CONFIG)) == 0


def test_key_points_are_where_the_full_size_picture_has_them() -> None:
    picture = np.zeros((240, 320), np.float64)
    y, x = np.mgrid[:240, :320]
    centres = np.array([[80.0, 60.0], [240.5, 61.0], [81.0, 180.5], [200.0, 150.0]])
    for cx, cy in centres:
        picture += 200 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * 6.0**2))
    found = detect_keypoints(picture.astype(np.uint8), CONFIG)
    for centre in centres:
        assert np.linalg.norm(found.xy - centre, axis=1).min() < 0.15


def test_guided_matches_are_those_of_a_plain_search() -> None:
    rng = np.random.default_rng(1)
    reference = random_keypoints(rng, 300)
    descriptors = np.clip(reference.descriptors.astype(int) + rng.integers(-9, 9, (300, 128)), 0, 255).astype(np.uint8)
    predicted = reference.xy + rng.uniform(-30, 30, (300, 2))
    pairs = match_guided(predicted, descriptors, reference, search_px=50)
    np.testing.assert_array_equal(pairs, plain_guided(predicted, descriptors, reference, half_px=25.0))
    assert (pairs[:, 0] == pairs[:, 1]).mean() > 0.98


def plain_guided(predicted: np.ndarray, descriptors: np.ndarray, reference: Keypoints, *, half_px: float) -> np.ndarray:
    """The rule of guided matching, written down: nearest in the window, by a tenth, and mutually so."""
    distance = np.linalg.norm(descriptors[:, None].astype(float) - reference.descriptors[None].astype(float), axis=2)
    distance[(np.abs(predicted[:, None] - reference.xy[None]) > half_px).any(axis=2)] = np.inf
    pairs = []
    for i, row in enumerate(distance):
        first, second = np.sort(row)[:2]
        j = int(row.argmin())
        if first < 350 and first < 0.9 * second and distance[:, j].argmin() == i:
            pairs.append((i, j))
    return np.array(pairs)


def test_guided_matching_survives_predictions_without_a_value() -> None:
    reference = random_keypoints(np.random.default_rng(2), 50)
    predicted = reference.xy.copy()
    predicted[:10] = np.nan
    pairs = match_guided(predicted, reference.descriptors, reference, search_px=50)
    np.testing.assert_array_equal(pairs[:, 0], np.arange(10, 50))


def test_matching_everywhere_is_mutual() -> None:
    rng = np.random.default_rng(3)
    reference = random_keypoints(rng, 200)
    order = rng.permutation(200)[:120]
    pairs = match_descriptors(reference.descriptors[order], reference.descriptors)
    np.testing.assert_array_equal(order[pairs[:, 0]], pairs[:, 1])
    assert len(pairs) == 120


def test_prior_is_found_among_wrong_matches() -> None:
    rng = np.random.default_rng(4)
    moving = random_keypoints(rng, 400)
    there = HomographyTransform(TURNED)(moving.xy) + rng.normal(0, 0.5, (400, 2))
    there[:160] = rng.uniform(0, 400, (160, 2))
    prior = estimate_homography_prior(moving.xy, moving.descriptors, Keypoints(there, moving.descriptors))
    assert np.abs(prior(moving.xy) - HomographyTransform(TURNED)(moving.xy)).max() < 2.0


def test_mirrored_picture_gives_no_prior() -> None:
    moving = random_keypoints(np.random.default_rng(5), 300)
    mirrored = Keypoints(moving.xy * [-1.0, 1.0] + [400.0, 0.0], moving.descriptors)
    prior = estimate_homography_prior(moving.xy, moving.descriptors, mirrored)
    assert isinstance(prior, Failure)
    assert "inliers of" in prior.reason


def test_strange_picture_gives_no_prior_and_says_how_many_matches() -> None:
    rng = np.random.default_rng(6)
    moving, strange = random_keypoints(rng, 300), random_keypoints(rng, 300)
    prior = estimate_homography_prior(moving.xy, moving.descriptors, strange)
    assert isinstance(prior, Failure)
    assert "16 needed" in prior.reason
