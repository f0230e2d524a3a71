"""Numba kernels of registration against their plain numpy and scipy forms."""

import numpy as np
import pytest
from scipy.interpolate import BSpline, RegularGridInterpolator

from velfield.registration import fit_kernels, kernels

WIDTH, HEIGHT, KNOTS, FOLDS = 640, 480, 12, 3
SOURCE, TARGET = np.array([320.0, 240.0, 1 / 320]), np.array([410.0, 190.0, 1 / 400])
ROLL_UNIT = 400.0
NORMS = np.concatenate([SOURCE, [ROLL_UNIT], TARGET])
CENTRE = np.array([319.5, 239.5])


def coefficients(rng: np.random.Generator) -> np.ndarray:
    """A rational function near the identity, without a pole on the frame."""
    c = rng.uniform(-0.05, 0.05, (3, 6))
    c[0, 1], c[1, 2], c[2, 0] = 1.0, 1.0, 1.0
    return c


def points(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.uniform(0, 1, (count, 2)) * [WIDTH - 1, HEIGHT - 1]


def row_coefficients(theta: np.ndarray) -> np.ndarray:
    rows = theta[17:].reshape(3, KNOTS).copy()
    rows[2] /= ROLL_UNIT
    return rows


def residuals(theta: np.ndarray, undistorted: np.ndarray, rows: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """The joint model, evaluated kernel by kernel: what the normal equations linearise."""
    c = np.stack([theta[:6], theta[6:12], np.concatenate([[1.0], theta[12:17]])])
    corrected = kernels.remove_row_motion(undistorted, rows, row_coefficients(theta), HEIGHT, CENTRE)
    return observed - kernels.rational(corrected, c, SOURCE, TARGET)


@pytest.fixture
def problem() -> dict[str, np.ndarray]:
    """Control points, parameters (17 + 3 knots) and everything the kernels of the joint fit take."""
    rng = np.random.default_rng(0)
    c = coefficients(rng)
    theta = np.concatenate([c[0], c[1], c[2, 1:], rng.normal(0, 1.5, 3 * KNOTS)])
    undistorted, rows = points(rng, 90), rng.uniform(0, HEIGHT - 1, 90)
    first, basis = kernels.spline_basis(rows, HEIGHT, KNOTS)
    observed = observed_near(theta, undistorted, rows, rng)
    fold, weight = rng.integers(0, FOLDS, 90), rng.uniform(0.1, 1.0, 90)
    corrected = kernels.remove_row_motion(undistorted, rows, row_coefficients(theta), HEIGHT, CENTRE)
    return {
        "theta": theta,
        "undistorted": undistorted,
        "rows": rows,
        "first": first,
        "basis": basis,
        "observed": observed,
        "fold": fold,
        "weight": weight,
        "corrected": corrected,
        "coefficients": c,
    }


def observed_near(theta: np.ndarray, undistorted: np.ndarray, rows: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return -residuals(theta, undistorted, rows, np.zeros_like(undistorted)) + rng.normal(0, 2.0, undistorted.shape)


def jacobian(problem: dict[str, np.ndarray]) -> np.ndarray:
    """Derivative (n, 2, p) of the mapped points, by central differences of the plain model."""
    theta, columns = problem["theta"], []
    for k in range(len(theta)):
        step = np.zeros(len(theta))
        step[k] = 1e-6 * max(1.0, abs(theta[k]))
        behind, ahead = (
            residuals(theta + s, problem["undistorted"], problem["rows"], problem["observed"]) for s in (-step, step)
        )
        columns.append((behind - ahead) / (2 * step[k]))
    return np.stack(columns, axis=2)


def equations(problem: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    names = ("undistorted", "corrected", "first", "basis", "observed", "weight", "fold")
    arguments = (problem[name] for name in names)
    return fit_kernels.normal_equations(*arguments, FOLDS, KNOTS, problem["coefficients"], NORMS, CENTRE)


def symmetric(bands: np.ndarray, width: int) -> np.ndarray:
    """A symmetric matrix from its bands."""
    out = np.zeros((len(bands),) * 2)
    for d in range(width):
        out += np.diag(bands[: len(out) - d, d], d) + (np.diag(bands[: len(out) - d, d], -d) if d else 0)
    return out


ORDER = np.concatenate([np.arange(17), 17 + np.arange(3 * KNOTS).reshape(KNOTS, 3).T.ravel()])
"""Where each parameter is among the 17 and the row coefficients knot by knot."""


def normal_equations(problem: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Full matrices (folds, p, p), right-hand sides (folds, p) and sums of squares of each fold."""
    bands, border, corner = equations(problem)
    normal = np.zeros((FOLDS, 17 + 3 * KNOTS, 17 + 3 * KNOTS))
    for fold in range(FOLDS):
        normal[fold, :17, :17], normal[fold, 17:, 17:] = corner[fold, :17, :17], symmetric(bands[fold], 12)
        normal[fold, 17:, :17], normal[fold, :17, 17:] = border[fold, :, :17], border[fold, :, :17].T
    right = np.concatenate([corner[:, :17, 17], border[:, :, 17]], axis=1)
    return normal[:, ORDER[:, None], ORDER], right[:, ORDER], corner[:, 17, 17]


def test_evaluation_in_one_is_that_of_the_kernels_one_by_one(problem: dict[str, np.ndarray]) -> None:
    p = problem
    corrected, found = fit_kernels.evaluate(
        p["undistorted"], p["first"], p["basis"], p["observed"], p["theta"], KNOTS, NORMS, CENTRE
    )
    np.testing.assert_allclose(corrected, p["corrected"], atol=1e-9)
    np.testing.assert_allclose(found, residuals(p["theta"], p["undistorted"], p["rows"], p["observed"]), atol=1e-9)
    still, _ = fit_kernels.evaluate(
        p["undistorted"], p["first"], p["basis"], p["observed"], p["theta"], 0, NORMS, CENTRE
    )
    np.testing.assert_array_equal(still, p["undistorted"])


def test_evaluation_has_no_value_beyond_the_pole(problem: dict[str, np.ndarray]) -> None:
    p, theta = problem, problem["theta"].copy()
    theta[12:17] = [-2.0, 0.0, 0.0, 0.0, 0.0]
    _, found = fit_kernels.evaluate(
        p["undistorted"], p["first"], p["basis"], p["observed"], theta, KNOTS, NORMS, CENTRE
    )
    beyond = (problem["corrected"][:, 0] - SOURCE[0]) * SOURCE[2] >= 0.5
    assert beyond.any()
    np.testing.assert_array_equal(np.isnan(found).all(axis=1), beyond)


def test_normal_equations_are_those_of_the_dense_jacobian(problem: dict[str, np.ndarray]) -> None:
    normal, right, squares = normal_equations(problem)
    j = jacobian(problem)
    e = residuals(problem["theta"], problem["undistorted"], problem["rows"], problem["observed"])
    for fold in range(FOLDS):
        w = np.where(problem["fold"] == fold, problem["weight"], 0.0)
        expected = np.einsum("n,nai,naj->ij", w, j, j)
        np.testing.assert_allclose(normal[fold], expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())
        np.testing.assert_allclose(right[fold], np.einsum("n,nai,na->i", w, j, e), rtol=1e-4, atol=1e-3)
        assert squares[fold] == pytest.approx((w[:, None] * e**2).sum())


def test_points_without_weight_do_not_enter_the_normal_equations(problem: dict[str, np.ndarray]) -> None:
    without = {**problem, "weight": np.where(np.arange(90) < 30, 0.0, problem["weight"])}
    far = {**without, "observed": np.where(np.arange(90)[:, None] < 30, 1e6, problem["observed"])}
    for a, b in zip(normal_equations(without), normal_equations(far), strict=True):
        np.testing.assert_array_equal(a, b)


def test_predicted_change_is_that_of_the_model_to_first_order(problem: dict[str, np.ndarray]) -> None:
    step = 1e-5 * np.random.default_rng(1).normal(size=(FOLDS, len(problem["theta"])))
    names = ("undistorted", "corrected", "first", "basis")
    change = fit_kernels.predict_change(
        *(problem[name] for name in names), step, problem["fold"], KNOTS, problem["coefficients"], NORMS, CENTRE
    )
    for fold in range(FOLDS):
        theta, here = problem["theta"], problem["fold"] == fold
        arguments = problem["undistorted"], problem["rows"], problem["observed"]
        moved = residuals(theta, *arguments) - residuals(theta + step[fold], *arguments)
        np.testing.assert_allclose(change[here], moved[here], rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("homography", [False, True])
def test_a_step_is_that_of_the_full_matrix(problem: dict[str, np.ndarray], homography: bool) -> None:
    """With all priors, of all points and without each fold; a homography has fixed parameters."""
    rng, p, theta = np.random.default_rng(7), 17 + 3 * KNOTS, problem["theta"]
    free = np.isin(np.arange(17), [0, 1, 2, 6, 7, 8, 12, 13]) | (not homography)
    stiffness = rng.uniform([3.0, -1.0, 0.0], [4.0, 1.0, 1.0], (3 * KNOTS, 3))
    gauge, prior, gauge_weight = rng.normal(size=(3 * KNOTS, 4)), rng.uniform(0.0, 3.0, 17), 1e3
    spaced = np.zeros((3 * KNOTS, 7))
    spaced[:, ::3] = stiffness
    penalty = np.zeros((p, p))
    penalty[:17, :17], penalty[17:, 17:] = np.diag(prior), symmetric(spaced, 7) + gauge_weight * gauge @ gauge.T
    penalty = penalty[ORDER[:, None], ORDER]
    normal, right, squares = normal_equations(problem)
    kept = np.concatenate([np.flatnonzero(free), np.arange(17, p)])

    def step(folds: list[int]) -> np.ndarray:
        matrix, out = normal[folds].sum(axis=0) + penalty, np.zeros(p)
        out[kept] = np.linalg.solve(matrix[np.ix_(kept, kept)], (right[folds].sum(axis=0) - penalty @ theta)[kept])
        return out

    arguments = (*equations(problem), stiffness, gauge, gauge_weight, prior, free, theta)
    (found,) = fit_kernels.solve_steps(*arguments, False)
    np.testing.assert_allclose(found, step([*range(FOLDS)]), rtol=1e-6, atol=1e-9)
    steps, expected = fit_kernels.solve_steps(*arguments, True), 0.0
    for fold in range(FOLDS):
        left = step([f for f in range(FOLDS) if f != fold])
        np.testing.assert_allclose(steps[fold], left, rtol=1e-6, atol=1e-9)
        expected += squares[fold] - 2 * left @ right[fold] + left @ normal[fold] @ left  # of the fold left out
    assert fit_kernels.predict_squares(*equations(problem), steps) == pytest.approx(expected, rel=1e-9)


def test_an_indefinite_matrix_has_no_step(problem: dict[str, np.ndarray]) -> None:
    theta, free = problem["theta"], np.ones(17, bool)
    stiffness, gauge = np.full((3 * KNOTS, 3), [1.0, 0.0, 0.0]), np.zeros((3 * KNOTS, 0))
    for row, prior in ((-1e9, 1.0), (1.0, -1e9)):
        stiffness[5, 0] = row
        arguments = (*equations(problem), stiffness, gauge, 1.0, np.full(17, prior), free, theta)
        assert np.isnan(fit_kernels.solve_steps(*arguments, True)).all()


def test_spline_basis_is_the_uniform_cubic_b_spline() -> None:
    rows = np.linspace(0, HEIGHT - 1, 77)
    first, weights = kernels.spline_basis(rows, HEIGHT, KNOTS)
    values = np.random.default_rng(2).normal(size=KNOTS)
    spline = BSpline(np.arange(-3, KNOTS + 1, dtype=float), values, 3)
    expected = spline((rows + 0.5) / HEIGHT * (KNOTS - 3))
    np.testing.assert_allclose((weights * values[first[:, None] + np.arange(4)]).sum(axis=1), expected, atol=1e-12)


def test_rows_outside_the_frame_move_as_its_border() -> None:
    values = np.random.default_rng(3).normal(size=(3, KNOTS))
    at = np.array([[100.0, 50.0]])
    for outside, border in ((-40.0, -0.5), (HEIGHT + 40.0, HEIGHT - 0.5)):
        beyond, edge = (
            kernels.remove_row_motion(at, np.array([row]), values, HEIGHT, CENTRE) for row in (outside, border)
        )
        np.testing.assert_allclose(beyond, edge, atol=1e-12)


def test_mesh_is_the_bilinear_interpolation_of_its_nodes() -> None:
    rng = np.random.default_rng(4)
    mesh, cell = rng.normal(size=(4, 5, 2)), 100
    inside = rng.uniform(50, [449, 349], (200, 2))
    nodes = (np.arange(4) * cell + cell / 2 - 0.5, np.arange(5) * cell + cell / 2 - 0.5)
    expected = RegularGridInterpolator(nodes, mesh)(inside[:, ::-1])
    np.testing.assert_allclose(kernels.mesh_displacement(inside, mesh, cell), expected, atol=1e-12)


def test_mesh_is_constant_beyond_its_outermost_nodes_and_zero_without_a_point() -> None:
    mesh = np.random.default_rng(5).normal(size=(3, 3, 2))
    corners = np.array([[0.0, 0.0], [299.0, 0.0], [0.0, 299.0], [299.0, 299.0]])
    expected = mesh[[0, 0, 2, 2], [0, 2, 0, 2]]
    np.testing.assert_allclose(kernels.mesh_displacement(corners, mesh, 100), expected, rtol=1e-12)
    nowhere = np.array([[np.nan, 1.0], [1.0, np.inf]])
    np.testing.assert_array_equal(kernels.mesh_displacement(nowhere, mesh, 100), 0.0)


def test_rational_has_no_value_beyond_its_pole() -> None:
    c = np.zeros((3, 6))
    c[0, 1], c[1, 2], c[2, 0], c[2, 1] = 1.0, 1.0, 1.0, -1.0  # the denominator 1 - x vanishes at x = 640 px
    xy = np.array([[600.0, 10.0], [639.9, 10.0], [640.1, 10.0], [900.0, 10.0]])
    assert np.isfinite(kernels.rational(xy, c, SOURCE, TARGET)).all(axis=1).tolist() == [True, True, False, False]
