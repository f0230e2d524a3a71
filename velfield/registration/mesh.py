"""The displacement mesh: what a frame's smooth map leaves, cell by cell, where the evidence supports it.

Paper: registration, 200 x 200 cells; finer ones follow the ground better, as their ties are chosen by the evidence.
The mesh carries what the polyprojective cannot: slow relief of the ground, a lens that is not quite the model. Its
nodes are the cells' centres; neighbours are tied to each other, how strongly the held-out control points decide, and
where a mesh does not predict them better than none there is none.
"""

from dataclasses import dataclass

import numpy as np

from schemas.arrays import FloatArray
from velfield.registration.joint import FOLDS, ControlPoints, JointFit, folds_of, weights_of
from velfield.registration.kernels import solve_positive
from velfield.registration.transforms import mesh_shape

_TIES = tuple(10.0**k for k in (-1, 0, 1, 2, 3))
"""Candidates for the weight of squared differences between neighbours, in control points."""
_LEAST_GAIN = 0.01
"""A mesh must take this share off the held-out squares."""
_LEAST_POINTS_A_CELL = 2.0
MESH_TURNS = 3
"""Meshes, each fitted to the control points that agree with the one before."""


@dataclass(frozen=True, eq=False)
class MeshFit:
    """Mesh (my, mx, 2), base px, or none; ``residuals`` and ``heldout`` (n, 2) with it."""

    mesh: FloatArray | None
    residuals: FloatArray
    heldout: FloatArray


def robust_mesh(
    points: ControlPoints, fit: JointFit, *, width: int, height: int, cell_size_px: int, turns: int = MESH_TURNS
) -> tuple[MeshFit, FloatArray]:
    """Mesh of what a joint fit leaves, and the robust weights (n,) of its control points, which count by variance too.

    Where the ground rises or falls its control points all disagree with the smooth map, and would have no say in the
    mesh that is there for them; with the mesh before they agree, and a roof's among them do not.
    """
    found, weights = MeshFit(None, fit.residuals, fit.heldout), fit.weights
    for turn in range(turns):
        if turn:
            weights = weights_of(found.residuals, points.sigma_px, fit.scale)
        precise = weights / points.sigma_px**2
        found = fit_mesh(
            points.xy_raw,
            fit.residuals,
            fit.heldout,
            precise * (weights.sum() / max(float(precise.sum()), 1e-12)),  # ties are weighed against control points
            width=width,
            height=height,
            cell_size_px=cell_size_px,
        )
        if found.mesh is None:
            return found, fit.weights
    return found, weights


def fit_mesh(
    xy_raw: FloatArray,
    residuals: FloatArray,
    heldout: FloatArray,
    weights: FloatArray,
    *,
    width: int,
    height: int,
    cell_size_px: int,
) -> MeshFit:
    """Mesh of residual displacements by penalised least squares, its stiffness and its very being by cross-validation.

    Parameters
    ----------
    xy_raw, residuals
        Control points (n, 2), raw px, and what the smooth map leaves of them (n, 2), base px.
    heldout
        (n, 2) the same residuals with each point's fold left out of the smooth fit.
    weights
        (n,) how much each control point counts: robust weights, over its variance.
    width, height
        Raw frame, px.
    """
    my, mx = mesh_shape(width, height, cell_size_px)
    if len(xy_raw) < _LEAST_POINTS_A_CELL * my * mx or my * mx < 4:
        return MeshFit(None, residuals, heldout)
    basis = _bilinear(xy_raw, my, mx, cell_size_px)
    fold = folds_of(xy_raw)
    weighted = basis * weights[:, None]
    normal = np.stack([weighted[fold == f].T @ basis[fold == f] for f in range(FOLDS)])
    right = np.stack([weighted[fold == f].T @ residuals[fold == f] for f in range(FOLDS)])
    # left out of the smooth fit as well as of the mesh: the mesh of the others must explain the held-out residual
    ties = _ties(my, mx)
    best, best_squares, best_left = None, float((weights[:, None] * heldout**2).sum()) * (1 - _LEAST_GAIN), heldout
    for tie in _TIES:
        left = heldout.copy()
        for f in range(FOLDS):
            mesh = solve_positive(normal.sum(axis=0) - normal[f] + tie * ties, right.sum(axis=0) - right[f])
            left[fold == f] -= basis[fold == f] @ mesh
        squares = float((weights[:, None] * left**2).sum())
        if squares < best_squares:
            best, best_squares, best_left = tie, squares, left
    if best is None:
        return MeshFit(None, residuals, heldout)
    mesh = solve_positive(normal.sum(axis=0) + best * ties, right.sum(axis=0))
    return MeshFit(np.ascontiguousarray(mesh.reshape(my, mx, 2)), residuals - basis @ mesh, best_left)


def _bilinear(xy_raw: FloatArray, my: int, mx: int, cell: int) -> FloatArray:
    """Weights (n, my * mx) of the nodes at raw points, as `kernels.mesh_displacement` has them."""
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


def _ties(my: int, mx: int) -> FloatArray:
    """Matrix of the squared differences between neighbouring nodes, and a little of the nodes themselves."""
    node = np.arange(my * mx).reshape(my, mx)
    matrix = 0.05 * np.eye(my * mx)
    for a, b in ((node[:, 1:], node[:, :-1]), (node[1:], node[:-1])):
        i, j = a.ravel(), b.ravel()
        np.add.at(matrix, (i, i), 1.0)
        np.add.at(matrix, (j, j), 1.0)
        np.add.at(matrix, (i, j), -1.0)
        np.add.at(matrix, (j, i), -1.0)
    return matrix
