"""Displacement mesh: a regularised piecewise bilinear correction of a frame's parametric map.

Paper: registration, 200 x 200 cells. The mesh models what the polyprojective cannot: smooth relief of the ground and
deviations of the lens from its model. Its nodes are the cell centres. A first-difference penalty couples neighbouring
nodes; cross-validation selects its weight, and drops the mesh if that does not lower the cross-validated residual. The
normal equations are banded: a fit costs nodes * rows^2 in place of nodes^3, and the fits without each fold are solved
as one.

How accurate the whole map is where, `measure_support` says: between its control points a map errs by little more than
its noise; beyond the last of them it is an extrapolation, which is off by pixels in the corners under a lens that the
model does not quite describe, while all figures of the frame are as good as ever.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from schemas.arrays import Float32Array, FloatArray, IntArray
from velfield.compiled import kernel
from velfield.registration import fit_kernels
from velfield.registration.control_points import FOLDS, ControlPoints, assign_folds
from velfield.registration.fit_kernels import LANES
from velfield.registration.joint import JointFit, robust_weights
from velfield.registration.transforms import as_points, mesh_shape

_STIFFNESSES = tuple(10.0**k for k in (-1, 0, 1, 2, 3))
"""Candidate weights of the squared differences between neighbouring nodes, in control points."""
_MIN_GAIN = 0.01
"""Smallest relative decrease of the cross-validated squares for which a mesh is used."""
_MIN_POINTS_PER_CELL = 2.0
MESH_ITERATIONS = 3
"""Reweighted fits: each uses the robust weights of the residuals of the one before."""

CELLS = (24, 32)
"""Rows and columns of the cells over an image."""
REACH = 0.1
"""A map is supported within this distance of its control points, half-diagonals: at random three of 3000 are never
farther than a third of it."""
MIN_REACH_PX = 80.0
"""And at least so far: the control points of small images are no closer to each other."""
NEIGHBOURS = 3
"""Minimum number of control points within that distance: one alone may be a chance match."""
MAX_SD_PX = 1.0
_MAX_SD_RATIO = 1.5
"""A larger standard deviation is no evidence either, unless the control points themselves scatter as much."""
_AVERAGED = 24
"""Control points of which the hold-out residual is averaged about a cell."""
_INDEPENDENT = 6.0
"""Neighbouring residuals that count as one: relief and roofs displace neighbours alike."""
_BRIDGED = 2.0
"""A hole between control points is bridged where they are at most so far in each direction, in reaches."""
_GROWTH = 3.0
"""Standard deviation at the reach, in hold-out residuals."""


@dataclass(frozen=True, eq=False)
class MeshFit:
    """Mesh (my, mx, 2), base px, or None; ``residuals`` and ``cv_residuals`` (n, 2) after it; selected stiffness."""

    mesh: FloatArray | None
    residuals: FloatArray
    cv_residuals: FloatArray
    stiffness: float = float("nan")


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
    stiffnesses = _STIFFNESSES
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
            stiffnesses=stiffnesses,
        )
        if mesh_fit.mesh is None:
            return mesh_fit, fit.weights
        # the second fit's weights are the first that count relief as inliers; those of the third hardly differ
        at = stiffnesses.index(mesh_fit.stiffness)
        stiffnesses = stiffnesses[max(at - 1, 0) : at + 2] if iteration == 0 else (mesh_fit.stiffness,)
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
    fold: IntArray | None = None,
    stiffnesses: Sequence[float] = _STIFFNESSES,
) -> MeshFit:
    """Fit a mesh to residuals by penalised least squares; cross-validation selects the penalty, or no mesh.

    Parameters
    ----------
    xy_raw, residuals, cv_residuals
        Control points (n, 2), raw px; residuals after the parametric map (n, 2), base px, fitted and cross-validated.
    weights
        (n,) of the control points: robust weight over variance.
    fold
        (n,) fold of each control point; None: by cells of 48 px.
    stiffnesses
        Candidate weights of the penalty.
    """
    my, mx = mesh_shape(width, height, cell_size_px)
    if len(xy_raw) < _MIN_POINTS_PER_CELL * my * mx or my * mx < 4:
        return MeshFit(None, residuals, cv_residuals)
    # columns of nodes one after the other: they are the shorter ones, so there are fewer bands
    nodes, shares = bilinear_weights(xy_raw[:, ::-1], mx, my, cell_size_px)
    fold = assign_folds(xy_raw) if fold is None else fold
    equations = accumulate_bands(nodes, shares, weights, residuals, fold, FOLDS, my * mx, my + 2)
    # A fold is left out of both fits: the mesh of the others must explain the cross-validated residual.
    smoothness = smoothness_bands(mx, my)
    squares_without = float(weights @ (cv_residuals**2).sum(axis=1))
    best, best_squares, best_cv, mesh = None, squares_without * (1 - _MIN_GAIN), cv_residuals, None
    for stiffness in stiffnesses:
        meshes = solve_without_folds(*equations, smoothness, stiffness)
        mesh_cv = cv_residuals - interpolate_mesh(nodes, shares, meshes, fold)
        squares = float(weights @ (mesh_cv**2).sum(axis=1))
        if squares < best_squares:
            best, best_squares, best_cv, mesh = stiffness, squares, mesh_cv, meshes[FOLDS]
    if best is None or mesh is None:
        return MeshFit(None, residuals, cv_residuals)
    left = residuals - interpolate_mesh(nodes, shares, mesh[None], np.zeros_like(fold))
    return MeshFit(np.ascontiguousarray(mesh.reshape(mx, my, 2).swapaxes(0, 1)), left, best_cv, best)


@kernel
def solve_without_folds(normal: FloatArray, right: FloatArray, smoothness: FloatArray, stiffness: float) -> FloatArray:
    """Meshes (folds + 1, count, 2) of the fits without each fold, and of that to all: eight systems at once.

    ``normal`` and ``right`` from `accumulate_bands`, of at most seven folds, ``smoothness`` from `smoothness_bands`.
    """
    folds, count, width = normal.shape
    bands, sides = fit_kernels.aligned_zeros(count, width, LANES), fit_kernels.aligned_zeros(count, 2, LANES)
    for i in range(count):
        for d in range(width):
            bands[i, d] = stiffness * smoothness[i, d]
    fit_kernels.add_folds(normal, True, bands, 0)
    fit_kernels.add_folds(right, True, sides, 0)
    nothing = np.zeros((0, 2, LANES))
    fit_kernels.eliminate_bands(bands, sides, nothing)
    found = fit_kernels.substitute_back(bands, sides, nothing)
    meshes = np.empty((folds + 1, count, 2))
    for f in range(folds + 1):
        for i in range(count):
            meshes[f, i, 0], meshes[f, i, 1] = found[i, 0, f], found[i, 1, f]
    return meshes


@kernel
def bilinear_weights(xy_raw: FloatArray, my: int, mx: int, cell: int) -> tuple[IntArray, FloatArray]:
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


@kernel
def accumulate_bands(nodes, shares, weights, residuals, fold, folds, count, bands) -> tuple[FloatArray, FloatArray]:  # type: ignore[no-untyped-def]
    """Normal equations of each fold: bands (folds, count, bands) as those of `fit_kernels.eliminate_bands`, and
    right-hand sides (folds, count, 2)."""
    normal, right = np.zeros((folds, count, bands)), np.zeros((folds, count, 2))
    for i in range(len(nodes)):
        f = fold[i]
        for p in range(4):
            row, share = nodes[i, p], weights[i] * shares[i, p]
            right[f, row, 0] += share * residuals[i, 0]
            right[f, row, 1] += share * residuals[i, 1]
            for q in range(4):
                column = nodes[i, q]
                if row >= column:
                    normal[f, column, row - column] += share * shares[i, q]
    return normal, right


@kernel
def interpolate_mesh(nodes: IntArray, shares: FloatArray, meshes: FloatArray, which: IntArray) -> FloatArray:
    """Displacements (n, 2) at points, each from the mesh ``which`` (n,) of meshes (k, count, 2)."""
    out = np.zeros((len(nodes), 2))
    for i in range(len(nodes)):
        for q in range(4):
            node = meshes[which[i], nodes[i, q]]
            out[i, 0] += shares[i, q] * node[0]
            out[i, 1] += shares[i, q] * node[1]
    return out


@cache
def smoothness_bands(my: int, mx: int) -> FloatArray:
    """Bands (nodes, mx + 2) of the squared differences between neighbouring nodes, plus a small ridge."""
    bands = np.zeros((my * mx, mx + 2))
    bands[:, 0] = 0.05
    node: NDArray[np.int64] = np.arange(my * mx).reshape(my, mx)
    for later, earlier in ((node[:, 1:], node[:, :-1]), (node[1:], node[:-1])):
        i, j = later.ravel(), earlier.ravel()
        bands[:, 0] += np.bincount(i, minlength=my * mx) + np.bincount(j, minlength=my * mx)
        bands[j, i - j] = -1.0
    return bands


@dataclass(frozen=True, eq=False)
class Support:
    """Standard deviation of a map in `CELLS` over an image of ``width`` x ``height`` px, (rows, columns) px; NaN where
    it has no control points."""

    sd_px: Float32Array
    width: int
    height: int

    def at(self, xy: FloatArray) -> FloatArray:
        """(n,) px at points (n, 2) of the image; those beyond its border have the value of the nearest cell."""
        return sample_cells(self.sd_px, xy, self.width, self.height)


def sample_cells(cells: FloatArray | Float32Array, xy: FloatArray, width: int, height: int) -> FloatArray:
    """Values (n,) of cells (rows, columns) over an image at points (n, 2); NaN at points that are not finite."""
    finite = np.asarray(np.isfinite(xy).all(axis=1))
    index = cell_index(np.where(finite[:, None], xy, 0.0), cells.shape, width, height)
    return np.where(finite, cells.ravel()[index].astype(np.float64), np.nan)


def cell_index(xy: FloatArray, cells: tuple[int, ...], width: int, height: int) -> IntArray:
    """Number (n,), row by row, of the cell of (rows, columns) over an image in which, or beside which, points lie."""
    rows, columns = cells
    row = np.clip((xy[:, 1] + 0.5) / height * rows, 0, rows - 1).astype(np.int64)
    column = np.clip((xy[:, 0] + 0.5) / width * columns, 0, columns - 1).astype(np.int64)
    return np.asarray(row * columns + column)


def no_support(width: int, height: int) -> Support:
    """An image of which nothing is known."""
    return Support(np.full(CELLS, np.nan, np.float32), width, height)


def reach(width: int, height: int) -> float:
    """Distance from its control points within which a map over an image is supported, px."""
    return max(REACH * 0.5 * float(np.hypot(width, height)), MIN_REACH_PX)


def measure_support(xy: FloatArray, residuals: FloatArray, *, width: int, height: int) -> Support:
    """Measure a map's accuracy by the hold-out residuals (n, 2) of its control points (n, 2).

    The standard deviation of a cell is that of the mean of the residuals around it, with a term that grows with the
    distance to the nearest control points. Its two constants were set on simulated flights of seeds 1 to 3.
    """
    if len(xy) < NEIGHBOURS:
        return no_support(width, height)
    rows, columns = CELLS
    sd = np.full(rows * columns, np.nan, np.float32)
    x, y = (np.arange(columns) + 0.5) * width / columns - 0.5, (np.arange(rows) + 0.5) * height / rows - 0.5
    centres = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    reach_px = reach(width, height)
    distances, nearest = map(np.asarray, cKDTree(as_points(xy)).query(centres, min(_AVERAGED, len(xy))))
    near = np.asarray(distances <= reach_px)
    count = near.sum(axis=1)
    squares = (residuals**2).sum(axis=1)
    mean = np.where(near, squares[nearest], 0.0).sum(axis=1) / np.maximum(count, 1)
    beyond = np.clip(distances[:, NEIGHBOURS - 1] / reach_px, 0.0, 1.0)
    variance = mean * (_INDEPENDENT / np.maximum(count, _INDEPENDENT) + (_GROWTH * beyond**2) ** 2)
    limit = max(MAX_SD_PX, _MAX_SD_RATIO * float(np.sqrt((residuals**2).sum(axis=1).mean())))
    supported = (count >= NEIGHBOURS) & (variance <= limit**2)
    sd[supported] = np.sqrt(variance[supported])
    cells = int(_BRIDGED * reach_px * rows / height), int(_BRIDGED * reach_px * columns / width)
    return Support(bridge_holes(sd.reshape(CELLS), cells), width, height)


def bridge_holes(sd: Float32Array, cells: tuple[int, int]) -> Float32Array:
    """Give cells (rows, columns) without a value, NaN, the largest of those beside, above and below, if there are four.

    A bare roof amid control points is spanned by the map; only beyond the last of them it is an extrapolation. The
    values may be so many cells away up or down, and to either side.

    Examples
    --------
    >>> bridge_holes(np.array([[1, 1, 1], [2, np.nan, 1], [1, 1, np.nan]], np.float32), (2, 2))
    array([[ 1.,  1.,  1.],
           [ 2.,  2.,  1.],
           [ 1.,  1., nan]], dtype=float32)
    """
    sides = [_last_value(sd, cells[0]), _last_value(sd[::-1], cells[0])[::-1]]
    sides += [_last_value(sd.T, cells[1]).T, _last_value(sd.T[::-1], cells[1])[::-1].T]
    return np.where(np.isnan(sd), np.max(sides, axis=0), sd)


def _last_value(sd: Float32Array, most: int) -> Float32Array:
    """The last value above each cell, at most so many rows away; NaN where there is none."""
    last = np.full_like(sd, np.nan)
    for step in range(most, 0, -1):
        if step < len(sd):
            shifted = sd[:-step]
            last[step:] = np.where(np.isnan(shifted), last[step:], shifted)
    return last
