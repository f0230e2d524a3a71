"""The fine stage of inter-sensor registration: levels, inliers, cross-validation, and failures with their reasons."""

import numpy as np
import pytest

from schemas.flight import BaseConfig
from tests.scenes import by_homography, city, frame_grid, photograph, similarity
from velfield.camera.lens import HarrisLens, pinhole
from velfield.errors import Failure
from velfield.registration.fitting import fit_polyprojective
from velfield.registration.intersensor.coarse import CoarseCandidate
from velfield.registration.intersensor.control import (
    FineFit,
    ImagePair,
    cv_errors,
    is_regular,
    register_coarse_to_fine,
    warp_to_base_grid,
)
from velfield.registration.intersensor.modality import GRADIENT, INTENSITY
from velfield.registration.intersensor.register import MIN_CONSISTENT_PATCHES, VerificationPatches, verify
from velfield.registration.transforms import PolyprojectiveTransform

SHAPE = (300, 400)
CENTRE = np.array([199.5, 149.5])
LENS = HarrisLens(0.1, 201.0, 148.0, 250.0)
TO_BASE = similarity(1.0, 12.0, CENTRE, np.array([330.0, 300.0]))


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    return city(41, 640, blocks=200)


@pytest.fixture(scope="module")
def pair(ground: np.ndarray) -> ImagePair:
    return ImagePair(photograph(ground, TO_BASE, LENS, SHAPE, 1), ground, LENS, BaseConfig())


@pytest.fixture(scope="module")
def fit(pair: ImagePair) -> FineFit:
    """From a start that is 20 px and 3 degrees off."""
    start = similarity(1.0, 3.0, np.array([330.0, 300.0]), np.array([345.0, 287.0])) @ TO_BASE
    found = register_coarse_to_fine(pair, CoarseCandidate(start, "test", INTENSITY, 1.0))
    assert isinstance(found, FineFit), found
    return found


def test_a_start_twenty_pixels_off_is_refined_below_half_a_pixel(fit: FineFit) -> None:
    raw = frame_grid(SHAPE, 25)
    error = fit.transform.to_base(raw) - by_homography(TO_BASE, LENS.undistort_points(raw))
    assert np.linalg.norm(error, axis=1).mean() < 0.3
    assert fit.cv_error_px < 0.5


def test_inliers_are_those_near_the_truth(fit: FineFit) -> None:
    true = by_homography(TO_BASE, LENS.undistort_points(fit.source_raw))
    error = np.linalg.norm(fit.target - true, axis=1)
    assert fit.inliers.sum() > 100
    assert error[fit.inliers].max() < 2.0
    assert np.median(error[fit.inliers]) < 0.3


def test_verification_counts_the_patches_that_agree(pair: ImagePair, fit: FineFit) -> None:
    verification = verify(pair, fit, INTENSITY)
    assert verification.is_verified
    assert verification.is_certain
    assert verification.consistent > 0.9 * verification.count
    assert f"{verification.consistent} of {verification.count} verification patches" in verification.text


def test_verification_refuses_a_map_that_is_ten_pixels_off(pair: ImagePair, fit: FineFit) -> None:
    p = fit.transform.polyprojective
    moved = PolyprojectiveTransform(p.coefficients, p.source, p.target + np.array([8.0, -8.0, 0.0]))
    off = FineFit(pair.transform(moved), fit.model, fit.source_raw, fit.target, fit.inliers, 0.0)
    # control points of the same rows would explain a common shift: leave none
    none = FineFit(off.transform, off.model, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, bool), 0.0)
    for wrong in (off, none):
        assert verify(pair, wrong, GRADIENT).consistent < 0.1 * verify(pair, fit, GRADIENT).consistent
    assert not verify(pair, none, GRADIENT).is_verified


def test_row_correction_recovers_patches_of_displaced_rows(pair: ImagePair, fit: FineFit) -> None:
    """Rows 100 to 200 lie 5 px to the right: patches there agree once the control points' motion is subtracted."""
    image = pair.image.copy()
    image[100:200] = np.roll(image[100:200], 5, axis=1)
    shaken = ImagePair(image, pair.base, pair.lens, pair.config)
    displaced = (fit.source_raw[:, 1] >= 100) & (fit.source_raw[:, 1] < 200)
    source = fit.source_raw + np.where(displaced[:, None], [5.0, 0.0], 0.0)
    seen = FineFit(fit.transform, fit.model, source, fit.target, fit.inliers, 0.0)
    verification = verify(shaken, seen, INTENSITY)
    assert verification.consistent < 0.7 * verification.count
    assert verification.row_corrected > verification.consistent + 0.05 * verification.count


@pytest.mark.parametrize(
    ("counts", "verified", "certain"),
    [
        ((100, 25, 0), True, False),
        ((100, 24, 44), False, False),
        ((100, 0, 45), True, False),
        ((100, 0, 50), True, True),
        ((20, MIN_CONSISTENT_PATCHES - 1, 0), False, True),  # too few for any fraction
        ((0, 0, 0), False, True),
    ],
)
def test_thresholds_of_the_verification(counts: tuple[int, int, int], verified: bool, certain: bool) -> None:
    patches = VerificationPatches(*counts)
    assert (patches.is_verified, patches.is_certain) == (verified, certain)


def test_a_frame_beside_the_base_image_is_a_failure(pair: ImagePair) -> None:
    away = similarity(1.0, 0.0, CENTRE, np.array([5000.0, 5000.0]))
    found = register_coarse_to_fine(pair, CoarseCandidate(away, "test", INTENSITY, 1.0))
    assert isinstance(found, Failure)
    assert found.reason == "the frame would lie outside the base image"
    assert warp_to_base_grid(pair, pair.from_homography(away), 1.0) is None


def test_a_frame_shrunk_to_a_patch_is_a_failure_with_its_size(pair: ImagePair) -> None:
    tiny = similarity(0.2, 0.0, CENTRE, np.array([330.0, 300.0]))
    found = register_coarse_to_fine(pair, CoarseCandidate(tiny, "test", INTENSITY, 1.0))
    assert isinstance(found, Failure)
    assert found.reason.startswith("the frame would cover 8")


def test_another_area_is_a_failure_with_the_number_of_matches(pair: ImagePair) -> None:
    other = ImagePair(pair.image, city(77, 640, blocks=200), pair.lens, pair.config)
    found = register_coarse_to_fine(other, CoarseCandidate(TO_BASE, "test", INTENSITY, 1.0))
    if isinstance(found, Failure):
        assert "near one homography" in found.reason or "folds" in found.reason
    else:
        assert not verify(other, found, INTENSITY).is_verified


def test_the_frame_is_warped_to_where_the_base_image_shows_the_same(pair: ImagePair, fit: FineFit) -> None:
    for scale in (0.5, 1.0):
        images = warp_to_base_grid(pair, fit.transform, scale)
        moving, mask, reference, (x0, y0) = images
        assert moving.shape == mask.shape == reference.shape
        assert 0 <= x0 < 330
        assert 0 <= y0 < 300
        assert np.corrcoef(moving[mask], reference[mask])[0, 1] > 0.95


def test_cross_validated_errors_are_those_of_fits_without_the_point() -> None:
    rng = np.random.default_rng(1)
    source = rng.uniform(0, 400, (60, 2))
    target = by_homography(TO_BASE, source) + rng.normal(0, 0.5, (60, 2))
    errors = cv_errors(source, target, "homography")
    for k in (0, 17, 59):
        fold = np.arange(60) * 7 % 5
        others = fold != fold[k]
        refit = fit_polyprojective(source[others], target[others], model="homography")
        assert not isinstance(refit, Failure)
        assert errors[k] == pytest.approx(float(np.linalg.norm(refit(source[k : k + 1]) - target[k])))
    fitted = fit_polyprojective(source, target, model="homography")
    assert not isinstance(fitted, Failure)
    assert errors.mean() > np.linalg.norm(fitted(source) - target, axis=1).mean()


def test_cross_validation_of_too_few_points_is_worse_than_any_error() -> None:
    assert (cv_errors(np.zeros((8, 2)), np.zeros((8, 2)), "polyprojective") > 1e300).all()


def test_second_order_terms_without_need_raise_the_cross_validated_error() -> None:
    """The choice of the model: with a plane and few points, nine more parameters fit noise."""
    rng = np.random.default_rng(2)
    source = rng.uniform(0, 400, (30, 2))
    target = by_homography(TO_BASE, source) + rng.normal(0, 1.0, (30, 2))
    assert cv_errors(source, target, "homography").mean() < cv_errors(source, target, "polyprojective").mean()


def test_regular_maps_neither_fold_nor_diverge(pair: ImagePair) -> None:
    assert is_regular(pair.from_homography(TO_BASE))
    plain = pair.from_homography(TO_BASE).polyprojective
    folded = plain.coefficients.copy()
    folded[0, 3] = 2.0  # x + 2 x^2 turns back within the frame
    assert not is_regular(pair.transform(PolyprojectiveTransform(folded, plain.source, plain.target)))
    tilted = np.array([[1.0, 0, 0], [0, 1.0, 0], [-0.9 / 400, 0, 1.0]])  # stretched tenfold towards one side
    assert not is_regular(ImagePair(pair.image, pair.base, pinhole(SHAPE), pair.config).from_homography(tilted))
