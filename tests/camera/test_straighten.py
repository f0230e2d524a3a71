"""Robust least squares of the plumb line on lines whose lens is known."""

import numpy as np
import pytest

from velfield.camera.lens import HarrisLens, PolynomialLens
from velfield.camera.lines import LineSet, line_residuals
from velfield.camera.straighten import (
    LensFamily,
    cv_rms,
    fit_lens,
    geman_mcclure_weights,
    line_weights,
    weighted_rms,
)

MIDDLE, HALF = (319.5, 239.5), 400.0
TRUE = HarrisLens(0.2, 321.5, 238.5, HALF)
HARRIS = LensFamily("harris", 1, MIDDLE, HALF)
TRUTH = np.array([0.2, 2.0 / HALF, -1.0 / HALF])


def lines(seed: int, *, count: int = 120, noise_px: float = 0.15, curved: float = 0.0) -> LineSet:
    """Lines of 120 px, some of them bent by a parabola of some pixels: kerbs."""
    rng, parts, tangents = np.random.default_rng(seed), [], []
    for k in range(count):
        angle, through = rng.uniform(0, np.pi), rng.uniform([40, 40], [600, 440])
        along = np.array([np.cos(angle), np.sin(angle)])
        normal = np.array([-along[1], along[0]])
        t = np.linspace(-60, 60, 16)[:, None]
        bow = (k < curved * count) * rng.uniform(2.0, 6.0) * ((t / 60) ** 2 - 1 / 3)
        xy = TRUE.distort_points(through + t * along + bow * normal) + rng.normal(0, noise_px, (16, 2))
        parts.append(xy)
        tangents.append(np.broadcast_to((xy[-1] - xy[0]) / np.linalg.norm(xy[-1] - xy[0]), xy.shape))
    number = np.repeat(np.arange(count), 16)
    return LineSet(np.concatenate(parts), np.concatenate(tangents), number, np.zeros(count, int))


def error_px(fit_lens_: HarrisLens | PolynomialLens) -> float:
    """Difference in bending: distance from the truth of undistorted points, up to translation and scale."""
    y, x = np.mgrid[40:440:40, 40:600:40]
    points = np.column_stack([x.ravel(), y.ravel()]).astype(float)
    found, true = fit_lens_.undistort_points(points), TRUE.undistort_points(points)
    design = np.column_stack([found, np.ones(len(found))])
    return float(np.sqrt(((design @ np.linalg.lstsq(design, true, rcond=None)[0] - true) ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_lens_is_recovered_within_its_uncertainty(seed: int) -> None:
    fit = fit_lens(lines(seed), HARRIS, np.array([0.1, 0.0, 0.0]))
    deviation = np.sqrt(np.diag(fit.covariance))
    assert abs(fit.parameters[0] - 0.2) < 4 * deviation[0] < 0.03
    assert np.abs(fit.parameters[1:] - TRUTH[1:]).max() < 0.01  # half-diagonals; the prior draws it to the middle
    assert error_px(fit.lens) < 0.4
    assert fit.residual_px == pytest.approx(0.15, rel=0.15)


def test_curved_kerbs_lose_their_weight_and_leave_the_lens_alone() -> None:
    clean, kerbs = (fit_lens(lines(4, curved=share), HARRIS, np.array([0.1, 0.0, 0.0])) for share in (0.0, 0.25))
    assert kerbs.weights[:30].mean() < 0.1
    assert kerbs.weights[30:].mean() > 0.6
    assert abs(kerbs.parameters[0] - 0.2) < 0.03
    assert kerbs.covariance[0, 0] > clean.covariance[0, 0]


@pytest.mark.parametrize("start", [0.0, 0.05, 0.4])
def test_the_start_does_not_matter(start: float) -> None:
    same = lines(5)
    reference = fit_lens(same, HARRIS, TRUTH)
    fit = fit_lens(same, HARRIS, np.array([start, 0.0, 0.0]))
    assert fit.parameters[0] == pytest.approx(reference.parameters[0], abs=1e-3)


def test_a_start_outside_the_domain_is_shrunk_into_it() -> None:
    fit = fit_lens(lines(6), HARRIS, np.array([5.0, 0.0, 0.0]))
    assert np.isfinite(line_residuals(lines(6), fit.lens)).all()
    assert fit.parameters[0] == pytest.approx(0.2, abs=0.02)


def test_few_lines_keep_the_centre_near_the_middle() -> None:
    few = lines(7, count=6, noise_px=0.3)
    centres = np.abs(fit_lens(few, HARRIS, np.array([0.1, 0.0, 0.0])).parameters[1:])
    assert centres.max() < 0.05


def test_the_uncertainty_is_that_of_repeated_experiments() -> None:
    fits = [fit_lens(lines(100 + k, count=60), HARRIS, np.array([0.15, 0.0, 0.0])) for k in range(20)]
    scatter = np.std([fit.parameters[0] for fit in fits])
    predicted = np.mean([np.sqrt(fit.covariance[0, 0]) for fit in fits])
    assert 0.5 < scatter / predicted < 2.0


def test_a_polynomial_of_two_terms_follows_harris() -> None:
    fit = fit_lens(lines(8), LensFamily("polynomial", 2, MIDDLE, HALF), np.array([0.1, 0.015, 0.0, 0.0]))
    assert isinstance(fit.lens, PolynomialLens)
    assert error_px(fit.lens) < 0.4


def test_families_make_the_lens_of_their_parameters() -> None:
    assert HARRIS.lens(TRUTH) == TRUE
    division = LensFamily("division", 1, MIDDLE, HALF).lens(np.array([0.1, 0.0, 0.01]))
    assert (division.centre_x_px, division.centre_y_px) == (319.5, pytest.approx(243.5))
    polynomial = LensFamily("polynomial", 2, MIDDLE, HALF).lens(np.array([0.1, 0.2, 0.0, 0.0]))
    assert isinstance(polynomial, PolynomialLens)
    assert polynomial.coefficients == (0.1, 0.2)


def test_geman_mcclure_weights_fall_with_the_residual() -> None:
    weights = geman_mcclure_weights(np.array([0.0, 2.5, 25.0]), 1.0)
    np.testing.assert_allclose(weights, [1.0, 0.25, (1 / 101) ** 2])
    np.testing.assert_allclose(geman_mcclure_weights(np.array([5.0]), np.array([2.0])), [0.25])


def test_the_scale_of_line_weights_is_the_median_by_points() -> None:
    rms, sizes = np.array([0.1, 0.2, 5.0]), np.array([10.0, 100.0, 10.0])
    expected = geman_mcclure_weights(rms, 0.2)
    np.testing.assert_allclose(line_weights(rms, sizes), expected)
    perfect = line_weights(np.zeros(3), sizes)  # a floor of 0.05 px keeps the scale positive
    np.testing.assert_array_equal(perfect, 1.0)


def test_weighted_rms() -> None:
    assert weighted_rms(np.array([3.0, 4.0, 100.0]), np.array([1.0, 1.0, 0.0])) == pytest.approx(np.sqrt(12.5))


def test_cross_validation_prefers_the_lens_to_none_and_no_needless_terms() -> None:
    data = lines(9, noise_px=0.05)
    none = (LensFamily("harris", 0, MIDDLE, HALF), np.zeros(3))
    harris, polynomial = ((HARRIS, TRUTH), (LensFamily("polynomial", 3, MIDDLE, HALF), np.array([0.1, 0, 0, 0, 0])))
    rms = cv_rms(data, [none, harris, polynomial], folds=4)
    assert rms.shape == (3, 120)
    typical = np.sqrt((rms**2).mean(axis=1))
    assert typical[1] < 0.6 * typical[0]
    assert typical[2] > 0.97 * typical[1]
    np.testing.assert_array_equal(cv_rms(data, [none], folds=4)[0], rms[0])
