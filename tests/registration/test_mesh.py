"""The displacement mesh: its basis, its penalty, and when there is one."""

import numpy as np
import pytest

from velfield.registration import kernels, mesh
from velfield.registration.control_points import FOLDS, assign_folds
from velfield.registration.mesh import fit_mesh

WIDTH, HEIGHT, CELL = 640, 480, 80
SIZE = {"width": WIDTH, "height": HEIGHT, "cell_size_px": CELL}


def points(seed: int, count: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform([0, 0], [WIDTH - 1, HEIGHT - 1], (count, 2))


def ramp(xy: np.ndarray) -> np.ndarray:
    """A displacement that is linear in the position: the mesh holds it exactly between its nodes."""
    return np.stack([0.004 * xy[:, 0] - 1.0, 0.5 - 0.003 * xy[:, 1]], axis=1)


def test_the_weights_interpolate_as_the_kernel_does() -> None:
    xy, nodes = points(0, 300), np.random.default_rng(1).normal(size=(6, 8, 2))
    of, shares = mesh.bilinear_weights(xy, 6, 8, CELL)
    np.testing.assert_allclose(shares.sum(axis=1), 1.0)
    found = mesh.interpolate_mesh(of, shares, nodes.reshape(1, -1, 2), np.zeros(300, np.int64))
    np.testing.assert_allclose(found, kernels.mesh_displacement(xy, nodes, CELL), atol=1e-12)


def dense(bands: np.ndarray) -> np.ndarray:
    """A symmetric matrix from its bands."""
    out = np.zeros((bands.shape[0],) * 2)
    for k, band in enumerate(bands.T):
        out += np.diag(band[: len(out) - k], -k) + (np.diag(band[: len(out) - k], k) if k else 0)
    return out


def test_the_penalty_is_the_sum_of_squared_differences_of_neighbours() -> None:
    nodes = np.random.default_rng(2).normal(size=(4, 5))
    expected = (np.diff(nodes, axis=0) ** 2).sum() + (np.diff(nodes, axis=1) ** 2).sum() + 0.05 * (nodes**2).sum()
    assert nodes.ravel() @ dense(mesh.smoothness_bands(4, 5)) @ nodes.ravel() == pytest.approx(expected)


@pytest.mark.parametrize("seed", range(3))
def test_the_bands_hold_the_normal_equations_of_each_fold(seed: int) -> None:
    """Against the plain reference: the matrix of all weights, its dense product, numpy's own solution."""
    rng, xy = np.random.default_rng(seed), points(seed, 400)
    weights, residuals, fold = rng.uniform(0, 2, 400), rng.normal(size=(400, 2)), assign_folds(xy)
    of, shares = mesh.bilinear_weights(xy, 6, 8, CELL)
    bands, right = mesh.accumulate_bands(of, shares, weights, residuals, fold, FOLDS, 48, 10)
    basis = np.zeros((400, 48))
    np.add.at(basis, (np.arange(400)[:, None], of), shares)
    for k in range(FOLDS):
        part = basis[fold == k]
        np.testing.assert_allclose(dense(bands[k]), part.T @ (part * weights[fold == k, None]), atol=1e-12)
        np.testing.assert_allclose(right[k], part.T @ (weights[:, None] * residuals)[fold == k], atol=1e-12)
    meshes = mesh.solve_without_folds(bands, right, mesh.smoothness_bands(6, 8), 3.0)
    for k in range(FOLDS + 1):
        used = np.arange(FOLDS) != k
        matrix = dense(bands[used].sum(axis=0) + 3.0 * mesh.smoothness_bands(6, 8))
        np.testing.assert_allclose(meshes[k], np.linalg.solve(matrix, right[used].sum(axis=0)), atol=1e-11)


def test_a_smooth_displacement_is_recovered_where_there_are_points() -> None:
    xy = points(3, 1500)
    residuals = ramp(xy) + np.random.default_rng(4).normal(0, 0.1, xy.shape)
    found = fit_mesh(xy, residuals, residuals, np.ones(len(xy)), **SIZE)
    assert found.mesh.shape == (6, 8, 2)
    inner = points(5, 200) * 0.8 + 0.1 * np.array([WIDTH, HEIGHT])
    error = kernels.mesh_displacement(inner, found.mesh, CELL) - ramp(inner)
    assert np.abs(error).mean() < 0.05
    np.testing.assert_allclose(found.residuals, residuals - kernels.mesh_displacement(xy, found.mesh, CELL), atol=1e-9)


def test_noise_alone_and_too_few_points_have_no_mesh() -> None:
    xy = points(6, 1500)
    noise = np.random.default_rng(7).normal(0, 1.0, xy.shape)
    assert fit_mesh(xy, noise, noise, np.ones(len(xy)), **SIZE).mesh is None
    few = points(8, 2 * 6 * 8 - 1)
    found = fit_mesh(few, ramp(few), ramp(few), np.ones(len(few)), **SIZE)
    assert found.mesh is None
    np.testing.assert_array_equal(found.residuals, ramp(few))


def test_a_frame_of_one_cell_has_no_mesh() -> None:
    xy = points(9, 400)
    assert fit_mesh(xy, ramp(xy), ramp(xy), np.ones(len(xy)), width=640, height=480, cell_size_px=640).mesh is None


def test_points_of_no_weight_do_not_shape_the_mesh() -> None:
    xy = points(10, 1500)
    wrong = np.arange(len(xy)) % 3 == 0
    residuals = ramp(xy) + np.where(wrong[:, None], 50.0, 0.0)
    found = fit_mesh(xy, residuals, residuals, np.where(wrong, 0.0, 1.0), **SIZE)
    assert found.mesh is not None
    assert np.abs(found.residuals[~wrong]).mean() < 0.05


def test_the_cross_validated_residual_is_larger_than_that_of_the_fit() -> None:
    xy = points(11, 800)
    residuals = ramp(xy) + np.random.default_rng(12).normal(0, 0.3, xy.shape)
    found = fit_mesh(xy, residuals, residuals, np.ones(len(xy)), **SIZE)
    assert found.mesh is not None
    assert (found.residuals**2).mean() < (found.cv_residuals**2).mean() < (residuals**2).mean()


def test_neighbours_share_a_fold_whatever_else_is_there() -> None:
    xy = points(13, 500)
    fold = assign_folds(xy)
    assert set(fold) == set(range(5))
    np.testing.assert_array_equal(assign_folds(xy[::-1]), fold[::-1])
    cell = np.floor(xy / 48).astype(int)
    for one in np.unique(cell, axis=0)[:40]:
        assert len(set(fold[(cell == one).all(axis=1)])) == 1
