"""Numba kernels of the raw-to-base map: rational function, row spline, displacement mesh.

The map of one point, in order, is

    undistorted u, raw row y  ->  v = u + shift(y) + roll(y) x (u - c)  ->  P(v)  ->  + mesh(raw x, raw y)

with P the rational function in normalised coordinates.
"""

import math

import numpy as np

from schemas.arrays import FloatArray, IntArray
from velfield.compiled import compiled, kernel


@compiled(error_model="numpy")
def rational(points: FloatArray, coefficients: FloatArray, source: FloatArray, target: FloatArray) -> FloatArray:
    """Second-order rational function of points (n, 2); NaN where the denominator is not positive.

    ``coefficients`` (3, 6) over the monomials 1, x, y, x^2, xy, y^2 of normalised coordinates (x - cx) * s, with
    ``source`` and ``target`` each (cx, cy, s).
    """
    out = np.empty((points.shape[0], 2))
    (a0, a1, a2, a3, a4, a5), (b0, b1, b2, b3, b4, b5), (c0, c1, c2, c3, c4, c5) = coefficients
    (source_x, source_y, source_scale), (target_x, target_y, target_scale) = source, target
    for i in range(points.shape[0]):
        x, y = (points[i, 0] - source_x) * source_scale, (points[i, 1] - source_y) * source_scale
        xx, xy, yy = x * x, x * y, y * y
        w = c0 + c1 * x + c2 * y + c3 * xx + c4 * xy + c5 * yy
        w = w if w > 1e-9 else np.nan
        out[i, 0] = (a0 + a1 * x + a2 * y + a3 * xx + a4 * xy + a5 * yy) / w / target_scale + target_x
        out[i, 1] = (b0 + b1 * x + b2 * y + b3 * xx + b4 * xy + b5 * yy) / w / target_scale + target_y
    return out


@kernel
def spline_basis(rows: FloatArray, height: int, knots: int) -> tuple[IntArray, FloatArray]:
    """Uniform cubic B-spline basis at rows (n,): index of the first of four coefficients (n,), their weights (n, 4).

    Rows outside the frame are clamped to its border.
    """
    first = np.empty(rows.shape[0], np.int64)
    weights = np.empty((rows.shape[0], 4))
    spans = knots - 3
    for i in range(rows.shape[0]):
        t = (rows[i] + 0.5) / height * spans
        t = min(max(t, 0.0), float(spans)) if t == t else 0.0
        k = min(int(t), spans - 1)
        f = t - k
        g = 1.0 - f
        first[i] = k
        weights[i, 0] = g * g * g / 6.0
        weights[i, 1] = (3.0 * f * f * f - 6.0 * f * f + 4.0) / 6.0
        weights[i, 2] = (3.0 * g * g * g - 6.0 * g * g + 4.0) / 6.0
        weights[i, 3] = f * f * f / 6.0
    return first, weights


@compiled(error_model="numpy")
def remove_row_motion(
    undistorted: FloatArray, rows: FloatArray, coefficients: FloatArray, height: int, centre: FloatArray
) -> FloatArray:
    """Undistorted points (n, 2) corrected for rolling shutter; ``coefficients`` (3, knots): x, y px, roll rad."""
    out = undistorted.copy()
    if coefficients.shape[1] < 4:
        return out
    first, weights = spline_basis(rows, height, coefficients.shape[1])
    for i in range(len(out)):
        dx, dy, turn = 0.0, 0.0, 0.0
        for m in range(4):
            weight, k = weights[i, m], first[i] + m
            dx += weight * coefficients[0, k]
            dy += weight * coefficients[1, k]
            turn += weight * coefficients[2, k]
        out[i, 0] += dx - turn * (undistorted[i, 1] - centre[1])
        out[i, 1] += dy + turn * (undistorted[i, 0] - centre[0])
    return out


@kernel
def mesh_displacement(points: FloatArray, mesh: FloatArray, cell: int) -> FloatArray:
    """Displacement (n, 2) at raw points by bilinear interpolation of a mesh (my, mx, 2) with nodes at cell centres."""
    out = np.zeros((points.shape[0], 2))
    my, mx = mesh.shape[0], mesh.shape[1]
    for i in range(points.shape[0]):
        if not (math.isfinite(points[i, 0]) and math.isfinite(points[i, 1])):
            continue
        gx = min(max((points[i, 0] + 0.5) / cell - 0.5, 0.0), mx - 1.0)
        gy = min(max((points[i, 1] + 0.5) / cell - 0.5, 0.0), my - 1.0)
        j = min(int(gx), max(mx - 2, 0))
        k = min(int(gy), max(my - 2, 0))
        fx, fy = gx - j, gy - k
        j1, k1 = min(j + 1, mx - 1), min(k + 1, my - 1)
        for c in range(2):
            top = mesh[k, j, c] + fx * (mesh[k, j1, c] - mesh[k, j, c])
            bottom = mesh[k1, j, c] + fx * (mesh[k1, j1, c] - mesh[k1, j, c])
            out[i, c] = top + fy * (bottom - top)
    return out
