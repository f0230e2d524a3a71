"""Fits of registration: the paper's case deletion, its simplex as the reference, and the joint robust fit."""

import numpy as np
import pytest
from scipy.optimize import minimize

from velfield.camera.lens import HarrisLens
from velfield.errors import Failure
from velfield.registration.control_points import ControlPoints, rms
from velfield.registration.fitting import fit_polyprojective
from velfield.registration.joint import JointFit, fit_jointly, robust_weights
from velfield.registration.mesh import fit_mesh, fit_robust_mesh
from velfield.registration.transforms import HomographyTransform, PolyprojectiveTransform, fit_normalisation

WIDTH, HEIGHT = 1280, 960
LENS = HarrisLens(0.2, 645.0, 474.0, 800.0)
MATRIX = np.array([[1.02, 0.12, 30.0], [-0.11, 0.99, 50.0], [1e-5, -8e-6, 1.0]])


def places(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.uniform(0, 1, (count, 2)) * [WIDTH - 1, HEIGHT - 1]


def shaken(raw: np.ndarray, *, amplitude_px: float, cycles: float) -> np.ndarray:
    """Lens, rows that move by ``amplitude_px`` in both coordinates, then the homography."""
    angle = 2 * np.pi * cycles * raw[:, 1] / HEIGHT
    motion = amplitude_px * np.stack([np.sin(angle + 0.3), np.sin(angle + 1.3)], axis=1)
    return HomographyTransform(MATRIX)(LENS.undistort_points(raw) - motion)


def control_points(
    rng: np.random.Generator, *, count: int, noise_px: float, wrong: float, **motion: float
) -> ControlPoints:
    raw = places(rng, count)
    base = shaken(raw, **motion) + rng.normal(0, noise_px, (count, 2))
    bad = rng.random(count) < wrong
    base[bad] += rng.uniform(-25, 25, (int(bad.sum()), 2))
    return ControlPoints(raw, base, np.full(count, 0.5))


def fit(points: ControlPoints, *, knots: int = 48, **options: object):
    corners = np.array([[0.0, 0.0], [WIDTH - 1, HEIGHT - 1]])
    start = PolyprojectiveTransform.from_homography(
        MATRIX, fit_normalisation(corners), fit_normalisation(points.xy_base)
    )
    return fit_jointly(points, start=start, lens=LENS, width=WIDTH, height=HEIGHT, knots=knots, **options)


def mean_error(transform, **motion: float) -> float:
    raw = places(np.random.default_rng(99), 4000)
    return float(np.linalg.norm(transform.to_base(raw) - shaken(raw, **motion), axis=1).mean())


@pytest.mark.parametrize("model", ["homography", "polyprojective"])
def test_exact_points_are_fitted_exactly(model: str) -> None:
    source = places(np.random.default_rng(0), 60)
    target = HomographyTransform(MATRIX)(source)
    found = fit_polyprojective(source, target, model=model)
    np.testing.assert_allclose(found(source), target, atol=1e-6)


def test_gauss_newton_reaches_what_the_paper_reaches_by_downhill_simplex() -> None:
    rng = np.random.default_rng(1)
    source = places(rng, 80)
    target = HomographyTransform(MATRIX)(source) + rng.normal(0, 0.5, (80, 2))
    fast = fit_polyprojective(source, target, model="homography")
    start = fast.coefficients * (1 + 1e-3)

    def squares(coefficients: np.ndarray) -> float:
        found = PolyprojectiveTransform(coefficients, fast.source, fast.target)
        return float(((found(source) - target) ** 2).sum())

    def of_free(free: np.ndarray) -> float:
        coefficients = start.copy()
        coefficients[:2, :3], coefficients[2, 1:3] = free[:6].reshape(2, 3), free[6:]
        return squares(coefficients)

    best = np.concatenate([start[:2, :3].ravel(), start[2, 1:3]])
    for _ in range(8):  # a simplex may collapse in a narrow valley: restart it
        best = minimize(of_free, best, method="Nelder-Mead", options={"maxiter": 20_000, "adaptive": True}).x
    assert squares(fast.coefficients) <= of_free(best) * (1 + 1e-6)
    assert of_free(best) == pytest.approx(squares(fast.coefficients), rel=0.02)


def test_too_few_points_are_a_failure_with_counts() -> None:
    assert fit_polyprojective(np.zeros((3, 2)), np.zeros((3, 2))).reason == "3 control points, a polyprojective needs 9"


@pytest.mark.parametrize(("cycles", "limit_px"), [(6.0, 0.13), (12.0, 0.25)])
def test_wobbling_rows_are_followed_among_a_third_of_wrong_matches(cycles: float, limit_px: float) -> None:
    points = control_points(
        np.random.default_rng(4), count=3000, noise_px=0.5, wrong=0.3, amplitude_px=4.0, cycles=cycles
    )
    found = fit(points)
    assert mean_error(found.transform, amplitude_px=4.0, cycles=cycles) < limit_px


def test_a_rough_fit_keeps_its_stiffness_and_is_near_enough_to_start_another() -> None:
    motion = {"amplitude_px": 3.0, "cycles": 3.0}
    points = control_points(np.random.default_rng(12), count=500, noise_px=0.2, wrong=0.05, **motion)
    whole = fit(points)
    rough = fit(points, start_stiffness=whole.stiffness, rough=True)
    assert rough.stiffness == whole.stiffness
    assert mean_error(rough.transform, **motion) < mean_error(whole.transform, **motion) + 0.05
    assert rough.cv_residuals is rough.residuals
    assert fit(points, rough=True).stiffness == whole.stiffness  # without a stiffness to keep it is a whole fit


def test_case_deletion_cannot_follow_wobbling_rows() -> None:
    points = control_points(np.random.default_rng(5), count=3000, noise_px=0.5, wrong=0.1, amplitude_px=4.0, cycles=6.0)
    found = fit(points, knots=0)
    assert mean_error(found.transform, amplitude_px=4.0, cycles=6.0) > 3.0


def test_a_still_camera_pays_nothing_for_the_spline() -> None:
    points = control_points(np.random.default_rng(6), count=3000, noise_px=0.5, wrong=0.1, amplitude_px=0.0, cycles=0.0)
    with_spline, without = fit(points), fit(points, knots=0)
    still = {"amplitude_px": 0.0, "cycles": 0.0}
    assert mean_error(with_spline.transform, **still) < mean_error(without.transform, **still) + 0.01


@pytest.mark.parametrize("seed", range(6))
def test_roofs_that_lean_in_the_first_rows_do_not_bend_them(seed: int) -> None:
    """Twenty points in the first rows, most of them on roofs that lean alike; the other rows hardly move."""
    motion = {"amplitude_px": 1.5, "cycles": 2.0}
    rng = np.random.default_rng(seed)
    points = control_points(rng, count=700, noise_px=0.3, wrong=0.2, **motion)
    ground = points.select(points.xy_raw[:, 1] > 45)
    raw = rng.uniform(0, 1, (20, 2)) * [WIDTH - 1, 45]
    base = shaken(raw, **motion) + rng.normal(0, 0.3, raw.shape)
    base[:12] += [-5.0, 4.0]
    found = fit(ground.concatenate(ControlPoints(raw, base, np.full(20, 0.5))))
    first = np.stack([np.linspace(100, WIDTH - 100, 30), np.full(30, 15.0)], axis=1)
    assert np.linalg.norm(found.transform.to_base(first) - shaken(first, **motion), axis=1).mean() < 1.0


def test_held_out_residual_is_that_of_a_fit_without_the_fold() -> None:
    points = control_points(np.random.default_rng(7), count=600, noise_px=0.5, wrong=0.0, amplitude_px=0.0, cycles=0.0)
    found = fit(points, knots=0)
    fitted_px, heldout_px = (rms(part[found.inliers]) for part in (found.residuals, found.cv_residuals))
    assert fitted_px < heldout_px < 1.1 * fitted_px
    # noise of 0.5 px a coordinate; weights fall with the residual, so that the kept ones lie a little nearer
    assert 0.55 < heldout_px < 0.75


def test_moving_things_do_not_pull_the_fit() -> None:
    rng = np.random.default_rng(8)
    points = control_points(rng, count=2000, noise_px=0.2, wrong=0.0, amplitude_px=0.0, cycles=0.0)
    moving = (points.xy_raw[:, 0] > 400) & (points.xy_raw[:, 0] < 700)
    moved = ControlPoints(points.xy_raw, points.xy_base + np.where(moving[:, None], [6.0, 0.0], 0.0), points.sigma_px)
    found = fit(moved)
    assert mean_error(found.transform, amplitude_px=0.0, cycles=0.0) < 0.1
    assert not found.inliers[moving].any()


def test_mesh_takes_up_slow_relief_and_nothing_else() -> None:
    rng = np.random.default_rng(9)
    raw = places(rng, 2000)
    noise = rng.normal(0, 0.3, raw.shape)
    relief = 1.5 * np.stack([np.sin(raw[:, 0] / 250), np.cos(raw[:, 1] / 250)], axis=1)
    size = {"width": WIDTH, "height": HEIGHT, "cell_size_px": 200}
    found = fit_mesh(raw, noise + relief, noise + relief, np.ones(len(raw)), **size)
    assert found.mesh is not None
    assert (found.cv_residuals**2).mean() < 0.15 * ((noise + relief) ** 2).mean()
    assert fit_mesh(raw, noise, noise, np.ones(len(raw)), **size).mesh is None


def test_the_mesh_follows_a_hill_whose_points_disagree_with_the_smooth_map_and_no_roofs() -> None:
    """On the hill the smooth map's weights are next to nothing; roofs stand among the ground's points everywhere."""
    rng = np.random.default_rng(12)
    raw, sigma = places(rng, 3000), 0.1

    def hill(xy: np.ndarray) -> np.ndarray:
        return np.exp(-(((xy - [800, 500]) / 180) ** 2).sum(axis=1))[:, None] * [1.5, -0.5]

    roofs = (rng.random(len(raw)) < 0.25)[:, None] * [0.0, 2.0]
    residuals = hill(raw) + roofs + rng.normal(0, sigma, raw.shape)
    points = ControlPoints(raw, raw, np.full(len(raw), sigma))
    weights = robust_weights(residuals, points.sigma_px, 1.0)
    transform = fit(control_points(rng, count=400, noise_px=0.1, wrong=0.0, amplitude_px=0.0, cycles=0.0)).transform
    smooth = JointFit(transform, weights, residuals, residuals, 1.0, (1.0, 1.0))
    on_hill = np.hypot(*(raw - [800, 500]).T) < 150
    assert weights[on_hill].mean() < 0.05
    size = {"width": WIDTH, "height": HEIGHT, "cell_size_px": 120}

    def off(iterations: int) -> float:
        found, kept = fit_robust_mesh(points, smooth, iterations=iterations, **size)
        left = found.residuals - roofs  # the mesh against the hill, but for the noise of each point
        assert (iterations == 1) == (kept[on_hill].mean() < 0.1)
        return float(np.abs(np.median(left[on_hill], axis=0)).max())

    assert off(3) < 0.15 < 0.4 * off(1)


@pytest.mark.parametrize("knots", [0, 48])
@pytest.mark.parametrize("reach", [(500.0, 300.0), (600.0, 0.0), (0.0, 0.0)])
def test_points_on_a_line_or_in_one_place_are_a_failure_that_says_so(reach: tuple[float, float], knots: int) -> None:
    raw = np.array([LENS.centre_x_px, LENS.centre_y_px]) + np.linspace(-1, 1, 60)[:, None] * reach
    base = shaken(raw, amplitude_px=0.0, cycles=0.0) + np.array([3.0, -2.0])
    found = fit(ControlPoints(raw, base, np.full(60, 0.5)), knots=knots)
    assert isinstance(found, Failure)
    assert found.reason == "60 control points do not determine the map: they lie on a line or in one place"


def test_points_of_one_fold_are_a_failure_as_nothing_is_left_to_test_the_fit_with() -> None:
    raw = np.random.default_rng(0).uniform(0, 47, (60, 2)) + 480
    base = shaken(raw, amplitude_px=0.0, cycles=0.0)
    found = fit(ControlPoints(raw, base, np.full(60, 0.5)), knots=0)
    assert isinstance(found, Failure)
    assert found.reason == "60 control points do not determine the map without a fifth of them"
