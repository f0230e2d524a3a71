"""Displacement mesh: a regularised piecewise bilinear correction of a frame's parametric map.

Paper: registration, 200 x 200 cells. The mesh models what the polyprojective cannot: smooth relief of the ground and
deviations of the lens from its model. Its nodes are the cell centres. A first-difference penalty couples neighbouring
nodes; cross-validation selects its weight, and drops the mesh if that does not lower the cross-validated residual.

A node is coupled to its eight neighbours only, so the normal equations are banded: they are stored as the lower bands
of LAPACK's ``pbsv``, and a fit costs nodes * columns^2 in place of nodes^3.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from schemas.arrays import FloatArray
from velfield.registration.joint import FOLDS, ControlPoints, JointFit, assign_folds, robust_weights
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
    nodes, shares = bilinear_weights(xy_raw, my, mx, cell_size_px)
    fold = assign_folds(xy_raw)
    normal, right = accumulate_bands(nodes, shares, weights, residuals, fold, FOLDS, my * mx, mx + 2)
    normal_all, right_all = normal.sum(axis=0), right.sum(axis=0)
    # A fold is left out of both fits: the mesh of the others must explain the cross-validated residual.
    smoothness = smoothness_bands(my, mx)
    squares_without = float((weights[:, None] * cv_residuals**2).sum())
    best, best_squares, best_cv = None, squares_without * (1 - _MIN_GAIN), cv_residuals
    for stiffness in _STIFFNESSES:
        meshes = np.stack(
            [_solve(normal_all - normal[f] + stiffness * smoothness, right_all - right[f]) for f in range(FOLDS)]
        )
        mesh_cv = cv_residuals - interpolate_mesh(nodes, shares, meshes, fold)
        squares = float((weights[:, None] * mesh_cv**2).sum())
        if squares < best_squares:
            best, best_squares, best_cv = stiffness, squares, mesh_cv
    if best is None:
        return MeshFit(None, residuals, cv_residuals)
    mesh = _solve(normal_all + best * smoothness, right_all)
    left = residuals - interpolate_mesh(nodes, shares, mesh[None], np.zeros_like(fold))
    return MeshFit(np.ascontiguousarray(mesh.reshape(my, mx, 2)), left, best_cv)


def _solve(bands: FloatArray, right: FloatArray) -> FloatArray:
    return np.asarray(solveh_banded(bands, right, lower=True, check_finite=False))


@njit(cache=True, nogil=True)
def bilinear_weights(xy_raw, my, mx, cell):  # type: ignore[no-untyped-def]
    """Nodes (n, 4) about raw points and their bilinear weights (n, 4), as those of `kernels.mesh_displacement`."""
    nodes = np.empty((len(xy_raw), 4), np.int64)
    shares = np.empty((len(xy_raw), 4))
    for i in range(len(xy_raw)):
        gx = min(max((xy_raw[i, 0] + 0.5) / cell - 0.5, 0.0), mx - 1.0)
        gy = min(max((xy_raw[i, 1] + 0.5) / cell - 0.5, 0.0), my - 1.0)
        j, k = min(int(gx), max(mx - 2, 0)), min(int(gy), max(my - 2, 0))
        fx, fy = gx - j, gy - k
        for q in range(4):
            dy, dx = q // 2, q % 2
            nodes[i, q] = min(k + dy, my - 1) * mx + min(j + dx, mx - 1)
            shares[i, q] = (fx if dx else 1 - fx) * (fy if dy else 1 - fy)
    return nodes, shares


@njit(cache=True, nogil=True)
def accumulate_bands(nodes, shares, weights, residuals, fold, folds, count, bands):  # type: ignore[no-untyped-def]
    """Normal equations of each fold: lower bands (folds, bands, count) and right-hand sides (folds, count, 2)."""
    normal, right = np.zeros((folds, bands, count)), np.zeros((folds, count, 2))
    for i in range(len(nodes)):
        f = fold[i]
        for p in range(4):
            row, share = nodes[i, p], weights[i] * shares[i, p]
            right[f, row, 0] += share * residuals[i, 0]
            right[f, row, 1] += share * residuals[i, 1]
            for q in range(4):
                column = nodes[i, q]
                if row >= column:
                    normal[f, row - column, column] += share * shares[i, q]
    return normal, right


@njit(cache=True, nogil=True)
def interpolate_mesh(nodes, shares, meshes, which):  # type: ignore[no-untyped-def]
    """Displacements (n, 2) at points, each from the mesh ``which`` (n,) of meshes (k, count, 2)."""
    out = np.zeros((len(nodes), 2))
    for i in range(len(nodes)):
        for q in range(4):
            node = meshes[which[i], nodes[i, q]]
            out[i, 0] += shares[i, q] * node[0]
            out[i, 1] += shares[i, q] * node[1]
    return out


def smoothness_bands(my: int, mx: int) -> FloatArray:
    """Lower bands (mx + 2, nodes) of the squared differences between neighbouring nodes, plus a small ridge."""
    bands = np.zeros((mx + 2, my * mx))
    bands[0] = 0.05
    diagonal = np.zeros(my * mx, np.int64)
    node: NDArray[np.int64] = np.arange(my * mx).reshape(my, mx)
    for later, earlier in ((node[:, 1:], node[:, :-1]), (node[1:], node[:-1])):
        i, j = later.ravel(), earlier.ravel()
        np.add.at(bands, (diagonal[i], i), 1.0)
        np.add.at(bands, (diagonal[j], j), 1.0)
        np.add.at(bands, (i - j, j), -1.0)
    return bands
