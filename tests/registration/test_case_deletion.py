"""Case deletion and the models it fits, on contaminated points whose truth is known."""

import numpy as np
import pytest

from velfield.errors import Failure
from velfield.registration.fitting import (
    fit_by_case_deletion,
    fit_polyprojective,
    second_order_monomials,
)
from velfield.registration.transforms import HomographyTransform, PolyprojectiveTransform, fit_normalisation

MATRIX = np.array([[1.02, 0.12, 30.0], [-0.11, 0.99, 50.0], [1e-5, -8e-6, 1.0]])
SIZE = np.array([1279.0, 959.0])


def contaminated(fraction: float, seed: int, *, noise_px: float = 0.4) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, their images with noise, and which of them are outliers of 10 to 60 px."""
    rng = np.random.default_rng(seed)
    source = rng.uniform([0, 0], SIZE, (600, 2))
    target = HomographyTransform(MATRIX)(source) + rng.normal(0, noise_px, (600, 2))
    wrong = rng.random(600) < fraction
    direction = rng.uniform(0, 2 * np.pi, 600)
    target += wrong[:, None] * rng.uniform(10, 60, (600, 1)) * np.stack([np.cos(direction), np.sin(direction)], axis=1)
    return source, target, wrong


def error_px(transform: PolyprojectiveTransform) -> float:
    xy = np.random.default_rng(99).uniform([0, 0], SIZE, (2000, 2))
    return float(np.linalg.norm(transform(xy) - HomographyTransform(MATRIX)(xy), axis=1).mean())


@pytest.mark.parametrize("fraction", [0.0, 0.1, 0.3])
def test_outliers_are_deleted_and_the_truth_is_found(fraction: float) -> None:
    source, target, wrong = contaminated(fraction, 1)
    fit = fit_by_case_deletion(source, target, model="homography", max_mean_error_px=0.6)
    assert not (fit.inliers & wrong).any()
    assert (fit.inliers & ~wrong).sum() > 0.8 * (~wrong).sum()
    assert error_px(fit.transform) < 0.1
    assert np.linalg.norm(fit.transform(source[fit.inliers]) - target[fit.inliers], axis=1).mean() <= 0.6


def test_without_deletion_outliers_bias_the_fit() -> None:
    source, target, _ = contaminated(0.3, 1)
    plain = fit_polyprojective(source, target, model="homography")
    assert not isinstance(plain, Failure)
    assert error_px(plain) > 0.5


def test_each_round_deletes_the_fraction_that_is_asked_for() -> None:
    source, target, _ = contaminated(0.3, 2)
    rounds = {}
    for fraction in (0.02, 0.1):
        fit = fit_by_case_deletion(source, target, model="homography", drop_fraction=fraction, max_mean_error_px=0.6)
        rounds[fraction] = fit.rounds
        left = 600
        for _ in range(fit.rounds):
            left -= max(1, round(fraction * left))
        assert fit.inliers.sum() == left
    assert rounds[0.02] > 3 * rounds[0.1]


def test_no_round_is_needed_where_all_points_agree() -> None:
    source, target, _ = contaminated(0.0, 3, noise_px=0.0)
    fit = fit_by_case_deletion(source, target, max_mean_error_px=0.5)
    assert fit.rounds == 0
    assert fit.inliers.all()


def test_points_without_a_value_are_never_inliers() -> None:
    source, target, _ = contaminated(0.0, 4)
    source[:7], target[7:11] = np.nan, np.inf
    fit = fit_by_case_deletion(source, target, model="homography")
    assert not fit.inliers[:11].any()
    assert fit.inliers[11:].all()


def test_a_limit_that_noise_does_not_meet_ends_in_a_failure_with_counts() -> None:
    source, target, _ = contaminated(0.0, 5)
    fit = fit_by_case_deletion(source, target, model="homography", max_mean_error_px=0.01, min_control_points=100)
    assert isinstance(fit, Failure)
    assert fit.reason.endswith("of 600, 100 needed")


def test_the_polyprojective_holds_second_order_terms_and_the_homography_does_not() -> None:
    source = np.random.default_rng(6).uniform([0, 0], SIZE, (400, 2))
    norm = fit_normalisation(source)
    coefficients = np.zeros((3, 6))
    coefficients[0, 1] = coefficients[1, 2] = coefficients[2, 0] = 1.0
    coefficients[0, 3], coefficients[1, 5] = 0.01, -0.02
    true = PolyprojectiveTransform(coefficients, norm, norm)
    second, first = (fit_polyprojective(source, true(source), model=m) for m in ("polyprojective", "homography"))
    assert not isinstance(second, Failure)
    assert np.abs(second(source) - true(source)).max() < 0.05
    assert np.abs(first(source) - true(source)).max() > 1.0
    assert first.is_homography


def test_points_on_a_line_leave_the_map_harmless_or_fail() -> None:
    x = np.linspace(0, 1000, 60)
    source = np.stack([x, 0.5 * x], axis=1)
    fit = fit_polyprojective(source, source + 3.0)
    assert isinstance(fit, Failure) or np.abs(fit(source) - source - 3.0).max() < 0.01


def test_monomials_are_those_of_normalised_coordinates() -> None:
    m = second_order_monomials(np.array([[14.0, 8.0]]), np.array([10.0, 10.0, 0.5]))
    np.testing.assert_allclose(m, [[1.0, 2.0, -1.0, 4.0, -2.0, 1.0]])
