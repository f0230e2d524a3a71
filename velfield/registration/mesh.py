"""Displacement mesh: a regularised piecewise bilinear correction of a frame's parametric map.

Paper: registration, 200 x 200 cells. The mesh models what the polyprojective cannot: smooth relief of the ground and
deviations of the lens from its model. Its nodes are the cell centres. A first-difference penalty couples neighbouring
nodes; cross-validation selects its weight, and drops the mesh if that does not lower the cross-validated residual.
"""

from dataclasses import dataclass

import numpy as np

from schemas.arrays import FloatArray
from velfield.registration.joint import FOLDS, ControlPoints, JointFit, assign_folds, robust_weights
from velfield.registration.kernels import solve_cholesky
from velfield.registration.transforms import mesh_shape

_STIFFNESSES = tuple(10.0**k for k in (-1, 0, 1, 2, 3))
"""Candidate weights of the squared differences between neighbouring nodes, in control points."""
_MIN_GAIN = 0.01
"""Smallest relative decrease of the cross-validated squares for which a mesh is used."""
_MIN_POINTS_PER_CELL = 2.0
MESH_ITERATIONS = 3
"""Reweighted fits: each uses the robust weights of the residuals of the one before."""


@dataclass(frozen=True, eq=False)
class MeshFit:
    """Mesh (my, mx, 2), base px, or None; ``residuals`` and ``cv_residuals`` (n, 2) after it."""

    mesh: FloatArray | None
    residuals: FloatArray
    cv_residuals: FloatArray


def fit_robust_mesh(
    points: ControlPoints,
    fit: JointFit,
    *,
    width: int,
    height: int,
    cell_size_px: int,
    iterations: int = MESH_ITERATIONS,
) -> tuple[MeshFit, FloatArray]:
    """Fit a mesh to the residuals of a joint fit by iteratively reweighted least squares; also the weights (n,).

    Control points on relief are outliers of the parametric map and would have no weight in the mesh that is meant to
    model it. Relative to the mesh of the previous iteration they are inliers; those on roofs among them are not.
    """
    mesh_fit, weights = MeshFit(None, fit.residuals, fit.cv_residuals), fit.weights
    for iteration in range(iterations):
        if iteration:
            weights = robust_weights(mesh_fit.residuals, points.sigma_px, fit.scale)
        precision = weights / points.sigma_px**2
        mesh_fit = fit_mesh(
            points.xy_raw,
            fit.residuals,
            fit.cv_residuals,
            precision * (weights.sum() / max(float(precision.sum()), 1e-12)),  # the penalty counts in control points
            width=width,
            height=height,
            cell_size_px=cell_size_px,
        )
        if mesh_fit.mesh is None:
            return mesh_fit, fit.weights
    return mesh_fit, weights


def fit_mesh(
    xy_raw: FloatArray,
    residuals: FloatArray,
    cv_residuals: FloatArray,
    weights: FloatArray,
    *,
    width: int,
    height: int,
    cell_size_px: int,
) -> MeshFit:
    """Fit a mesh to residuals by penalised least squares; cross-validation selects the penalty, or no mesh.

    Parameters
    ----------
    xy_raw, residuals
        Control points (n, 2), raw px, and their residuals (n, 2) after the parametric map, base px.
    cv_residuals
        (n, 2) cross-validated residuals of the parametric map.
    weights
        (n,) of the control points: robust weight over variance.
    width, height
        Raw frame, px.
    """
    my, mx = mesh_shape(width, height, cell_size_px)
    if len(xy_raw) < _MIN_POINTS_PER_CELL * my * mx or my * mx < 4:
        return MeshFit(None, residuals, cv_residuals)
    basis = _bilinear_basis(xy_raw, my, mx, cell_size_px)
    fold = assign_folds(xy_raw)
    weighted = basis * weights[:, None]
    normal = np.stack([weighted[fold == f].T @ basis[fold == f] for f in range(FOLDS)])
    right = np.stack([weighted[fold == f].T @ residuals[fold == f] for f in range(FOLDS)])
    # A fold is left out of both fits: the mesh of the others must explain the cross-validated residual.
    smoothness = _smoothness_matrix(my, mx)
    squares_without = float((weights[:, None] * cv_residuals**2).sum())
    best, best_squares, best_cv = None, squares_without * (1 - _MIN_GAIN), cv_residuals
    for stiffness in _STIFFNESSES:
        mesh_cv = cv_residuals.copy()
        for f in range(FOLDS):
            mesh = solve_cholesky(normal.sum(axis=0) - normal[f] + stiffness * smoothness, right.sum(axis=0) - right[f])
            mesh_cv[fold == f] -= basis[fold == f] @ mesh
        squares = float((weights[:, None] * mesh_cv**2).sum())
        if squares < best_squares:
            best, best_squares, best_cv = stiffness, squares, mesh_cv
    if best is None:
        return MeshFit(None, residuals, cv_residuals)
    mesh = solve_cholesky(normal.sum(axis=0) + best * smoothness, right.sum(axis=0))
    return MeshFit(np.ascontiguousarray(mesh.reshape(my, mx, 2)), residuals - basis @ mesh, best_cv)


def _bilinear_basis(xy_raw: FloatArray, my: int, mx: int, cell: int) -> FloatArray:
    """Bilinear weights (n, my * mx) of the nodes at raw points, equal to those of `kernels.mesh_displacement`."""
    gx = np.clip((xy_raw[:, 0] + 0.5) / cell - 0.5, 0.0, mx - 1.0)
    gy = np.clip((xy_raw[:, 1] + 0.5) / cell - 0.5, 0.0, my - 1.0)
    j, k = np.minimum(gx.astype(np.int64), max(mx - 2, 0)), np.minimum(gy.astype(np.int64), max(my - 2, 0))
    fx, fy = gx - j, gy - k
    out = np.zeros((len(xy_raw), my * mx))
    rows = np.arange(len(xy_raw))
    for dy, wy in ((0, 1 - fy), (1, fy)):
        for dx, wx in ((0, 1 - fx), (1, fx)):
            node = np.minimum(k + dy, my - 1) * mx + np.minimum(j + dx, mx - 1)
            np.add.at(out, (rows, node), wx * wy)
    return out


def _smoothness_matrix(my: int, mx: int) -> FloatArray:
    """Quadratic form of the squared differences between neighbouring nodes, plus a small ridge."""
    node = np.arange(my * mx).reshape(my, mx)
    matrix = 0.05 * np.eye(my * mx)
    for a, b in ((node[:, 1:], node[:, :-1]), (node[1:], node[:-1])):
        i, j = a.ravel(), b.ravel()
        np.add.at(matrix, (i, i), 1.0)
        np.add.at(matrix, (j, j), 1.0)
        np.add.at(matrix, (i, j), -1.0)
        np.add.at(matrix, (j, i), -1.0)
    return matrix
