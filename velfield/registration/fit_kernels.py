"""Numba kernels of the joint fit of a map: its normal equations, by folds, and their solution.

The parameters are the 17 of the rational function, a border of the matrix, and the row spline's coefficients, knot by
knot, its bands.
"""

from typing import Any

import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from schemas.arrays import FloatArray
from velfield.compiled import compiled, kernel
from velfield.vectors import LONG, Vectors

LANES = 8
"""Values of one vector: systems that are solved at once, or values of one row."""
_POINTS = 16
"""Points that are linearised at a time: what is stored value by value can be read as vectors only a while later."""


@kernel
def evaluate(undistorted, first, basis, observed, theta, knots, norms, centre) -> tuple[FloatArray, FloatArray]:  # type: ignore[no-untyped-def]
    """Points (n, 2) without row motion and their residuals (n, 2) by the parameters ``theta``, as `remove_row_motion`
    and `rational` in one; arguments as in `normal_equations`. NaN where the denominator is not positive."""
    corrected, residuals = np.empty((undistorted.shape[0], 2)), np.empty((undistorted.shape[0], 2))
    shift_x, shift_y, roll = 17, 17 + knots, 17 + 2 * knots
    for i in range(undistorted.shape[0]):
        u, v = undistorted[i, 0], undistorted[i, 1]
        if knots > 0:
            dx, dy, turn = 0.0, 0.0, 0.0
            for k in range(4):
                column, b = first[i] + k, basis[i, k]
                dx += b * theta[shift_x + column]
                dy += b * theta[shift_y + column]
                turn += b * theta[roll + column]
            turn /= norms[3]
            dx, dy = dx - turn * (v - centre[1]), dy + turn * (u - centre[0])
            u, v = u + dx, v + dy
        corrected[i, 0], corrected[i, 1] = u, v
        x, y = (u - norms[0]) * norms[2], (v - norms[1]) * norms[2]
        xx, xy, yy = x * x, x * y, y * y
        w = 1.0 + theta[12] * x + theta[13] * y + theta[14] * xx + theta[15] * xy + theta[16] * yy
        if w > 1e-9:
            p = theta[0] + theta[1] * x + theta[2] * y + theta[3] * xx + theta[4] * xy + theta[5] * yy
            q = theta[6] + theta[7] * x + theta[8] * y + theta[9] * xx + theta[10] * xy + theta[11] * yy
            residuals[i, 0] = observed[i, 0] - (p / w / norms[6] + norms[4])
            residuals[i, 1] = observed[i, 1] - (q / w / norms[6] + norms[5])
        else:
            residuals[i, 0], residuals[i, 1] = np.nan, np.nan
    return corrected, residuals


@intrinsic
def _add_products(_context, out, at, factor, row, start, blocks):  # type: ignore[no-untyped-def]
    """Add ``factor`` times ``blocks`` x 8 values of ``row`` from ``start`` on to those of ``out`` from ``at`` on."""

    def generate(context: Any, build: Any, signature: Any, arguments: Any) -> Any:
        v = Vectors(context, build, signature, arguments, LANES)
        out, at, factor, row, start, blocks = v.arguments
        factor = v.spread(factor)
        with cgutils.for_range(build, blocks) as loop:
            offset = build.mul(loop.index, LONG(LANES))
            v.add(build.fmul(factor, v.load(row, start, offset)), out, at, offset)
        return context.get_dummy_value()

    return types.void(out, at, factor, row, start, blocks), generate


@intrinsic
def _subtract_products(_context, out, at, factors, place, inverse, row, start, count):  # type: ignore[no-untyped-def]
    """Subtract ``factors[place] * inverse`` times ``count`` vectors of ``row`` from ``start`` on from those of ``out``
    from ``at`` on: all places count vectors of 8 values."""

    def generate(context: Any, build: Any, signature: Any, arguments: Any) -> Any:
        v = Vectors(context, build, signature, arguments, LANES)
        out, at, factors, place, inverse, row, start, count = v.arguments
        at, place, start = (build.mul(number, LONG(LANES)) for number in (at, place, start))
        factor = build.fmul(v.load(factors, place), v.load(inverse))
        with cgutils.for_range(build, count) as loop:
            offset = build.mul(loop.index, LONG(LANES))
            value = build.fmul(factor, v.load(row, start, offset))
            v.store(build.fsub(v.load(out, at, offset), value), out, at, offset)
        return context.get_dummy_value()

    return types.void(out, at, factors, place, inverse, row, start, count), generate


@compiled(error_model="numpy")
def _differentiate(  # type: ignore[no-untyped-def]
    undistorted, corrected, observed, begin, count, coefficients, norms, centre, rows, motion, inside
) -> None:
    """Derivatives of ``count`` mapped points from ``begin`` on by the 17 parameters of the rational function, ``rows``
    (2, 17 and more each), with the residual behind them, and by shift x, shift y and roll, ``motion`` (2, 3 each);
    and whether each is ``inside`` the map's domain."""
    (a0, a1, a2, a3, a4, a5), (b0, b1, b2, b3, b4, b5), (c0, c1, c2, c3, c4, c5) = coefficients
    source_x, source_y, source_scale, unit, target_x, target_y, target_scale = norms
    for n in range(count):
        i = begin + n
        x, y = (corrected[i, 0] - source_x) * source_scale, (corrected[i, 1] - source_y) * source_scale
        xx, xy, yy = x * x, x * y, y * y
        w = c0 + c1 * x + c2 * y + c3 * xx + c4 * xy + c5 * yy
        inside[n] = w > 1e-9
        px = (a0 + a1 * x + a2 * y + a3 * xx + a4 * xy + a5 * yy) / w
        py = (b0 + b1 * x + b2 * y + b3 * xx + b4 * xy + b5 * yy) / w
        over = 1.0 / (w * target_scale)
        monomials = over, x * over, y * over, xx * over, xy * over, yy * over
        for k in range(6):
            rows[n, 0, k] = monomials[k]
            rows[n, 1, 6 + k] = monomials[k]
        for k in range(5):
            rows[n, 0, 12 + k] = -px * monomials[k + 1]
            rows[n, 1, 12 + k] = -py * monomials[k + 1]
        rows[n, 0, 17] = observed[i, 0] - (px / target_scale + target_x)
        rows[n, 1, 17] = observed[i, 1] - (py / target_scale + target_y)
        s = source_scale * over
        wx, wy = c1 + 2 * c3 * x + c4 * y, c2 + c4 * x + 2 * c5 * y
        jxx, jxy = (a1 + 2 * a3 * x + a4 * y - px * wx) * s, (a2 + a4 * x + 2 * a5 * y - px * wy) * s
        jyx, jyy = (b1 + 2 * b3 * x + b4 * y - py * wx) * s, (b2 + b4 * x + 2 * b5 * y - py * wy) * s
        far_x, far_y = (undistorted[i, 0] - centre[0]) / unit, (undistorted[i, 1] - centre[1]) / unit
        motion[n, 0, 0], motion[n, 0, 1], motion[n, 0, 2] = jxx, jxy, jxy * far_x - jxx * far_y
        motion[n, 1, 0], motion[n, 1, 1], motion[n, 1, 2] = jyx, jyy, jyy * far_x - jyx * far_y


@kernel
def _multiply(basis, weight, begin, count, rows, motion, both, near, products) -> None:  # type: ignore[no-untyped-def]
    """Prepare what `_add_points` adds of the points that `_differentiate` has: the derivatives by a (as those by b),
    by c in x and in y, ``both`` (24); the products of one knot's coefficients with the twelve, ``near`` (3, 32), and
    with the 17 and the residual, ``products`` (3, 24); all zero behind their values."""
    for n in range(count):
        i, w = begin + n, weight[begin + n]
        for k in range(6):
            both[n, k], both[n, 6 + k], both[n, 12 + k] = rows[n, 0, k], rows[n, 0, 12 + k], rows[n, 1, 12 + k]
        for c in range(3):
            for d in range(3):
                value = w * (motion[n, 0, c] * motion[n, 0, d] + motion[n, 1, c] * motion[n, 1, d])
                for k in range(4):
                    near[n, c, 3 * k + d] = basis[i, k] * value
    products[:] = 0.0
    for n in range(count):
        for c in range(3):
            for axis in range(2):
                factor = weight[begin + n] * motion[n, axis, c]
                _add_products(products, (3 * n + c) * 24, factor, rows, (2 * n + axis) * 24, 3)


@kernel
def _add_points(first, basis, weight, fold, begin, count, inside, both, near, products, bands, border, sums) -> None:  # type: ignore[no-untyped-def]
    """Add points, prepared by `_multiply`, to the ``bands`` (folds, 3 knots, 16) and the ``border`` (folds, 3 knots,
    24) of the row coefficients, and to ``sums`` (folds, 12, 24): of a with a and c, and of c with c."""
    for n in range(count):
        i, w, f = begin + n, weight[begin + n], fold[begin + n]
        if not (w > 0.0 and inside[n]):
            continue
        for k in range(6):
            own, above, below = n * 24, (f * 12 + k) * 24, (f * 12 + 6 + k) * 24
            _add_products(sums, above, w * both[n, k], both, own, 3)
            _add_products(sums, below, w * both[n, 6 + k], both, own + 6, 1)
            _add_products(sums, below, w * both[n, 12 + k], both, own + 12, 1)
        row = f * bands.shape[1] + 3 * first[i]
        for k in range(4 if bands.shape[1] > 0 else 0):
            for c in range(3):
                _add_products(bands, row * 16, basis[i, k], near, (3 * n + c) * 32 + 3 * k + c, 2 if k < 2 else 1)
                _add_products(border, row * 24, basis[i, k], products, (3 * n + c) * 24, 3)
                row += 1


@kernel
def normal_equations(  # type: ignore[no-untyped-def]
    undistorted, corrected, first, basis, observed, weight, fold, folds, knots, coefficients, norms, centre
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Gauss-Newton normal equations per fold: bands (folds, 3 knots, 16), border (folds, 3 knots, 24) and corner
    (folds, 18, 18).

    Parameters are the 17 of the rational function (a, b: 6 each, c without its leading 1), then ``knots`` each of the
    row shift in x, in y, and the roll (px at a distance ``norms[3]`` from the centre). ``norms`` = source cx, cy, s,
    roll unit, target cx, cy, s. Residuals are in output px, weighted by ``weight`` (n,).

    A point depends on four knots side by side. With the three coefficients of each knot next to each other, those of
    the rows have a banded matrix: ``bands[f, i, d]`` is that of coefficients i and i + d, for d < 12. ``border`` has
    their products with the 17, ``corner`` those of the 17; column 17 in both is the right-hand side, and the last of
    ``corner`` the sum of squares.
    """
    bands, border = aligned_zeros(folds, 3 * knots, 16), aligned_zeros(folds, 3 * knots, 24)
    sums, corner = aligned_zeros(folds, 12, 24), np.zeros((folds, 18, 18))
    rows, motion, inside = np.zeros((_POINTS, 2, 24)), np.zeros((_POINTS, 2, 3)), np.empty(_POINTS, np.bool_)
    both, near, products = np.zeros((_POINTS, 24)), np.zeros((_POINTS, 3, 32)), np.zeros((_POINTS, 3, 24))
    for begin in range(0, undistorted.shape[0], _POINTS):
        count = min(_POINTS, undistorted.shape[0] - begin)
        _differentiate(
            undistorted, corrected, observed, begin, count, coefficients, norms, centre, rows, motion, inside
        )
        _multiply(basis, weight, begin, count, rows, motion, both, near, products)
        _add_points(first, basis, weight, fold, begin, count, inside, both, near, products, bands, border, sums)
    for f in range(folds):
        _fill_corner(sums[f], corner[f])
    return bands, border, corner


@kernel
def aligned_zeros(count: int, rows: int, columns: int) -> FloatArray:
    """Zeros (count, rows, columns) from a multiple of 64 bytes on: vectors of eight do not cross lines of the cache,
    which takes the fit a quarter longer."""
    size = count * rows * columns
    values = np.zeros(size + LANES)
    start = (-(values.ctypes.data // 8)) % LANES
    return values[start : start + size].reshape((count, rows, columns))


@kernel
def _fill_corner(sums: FloatArray, corner: FloatArray) -> None:
    """The symmetric matrix of a, b, c and the residual from their products as `normal_equations` has them."""
    for k in range(6):
        for j in range(6):
            corner[k, j] = corner[6 + k, 6 + j] = sums[k, j]
            corner[k, 12 + j] = corner[12 + j, k] = sums[k, 6 + j]
            corner[6 + k, 12 + j] = corner[12 + j, 6 + k] = sums[k, 12 + j]
            corner[12 + k, 12 + j] = sums[6 + k, j]


@kernel
def predict_change(undistorted, corrected, first, basis, step, fold, knots, coefficients, norms, centre) -> FloatArray:  # type: ignore[no-untyped-def]
    """First-order change (n, 2) of the mapped points under ``step`` (folds, p), each point by the step of its fold."""
    out = np.zeros((undistorted.shape[0], 2))
    ts = norms[6]
    m = np.empty(6)
    for i in range(undistorted.shape[0]):
        d = step[fold[i]]
        x = (corrected[i, 0] - norms[0]) * norms[2]
        y = (corrected[i, 1] - norms[1]) * norms[2]
        m[0], m[1], m[2], m[3], m[4], m[5] = 1.0, x, y, x * x, x * y, y * y
        c = coefficients
        px, py, w, dp, dq, dw = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(6):
            px += c[0, k] * m[k]
            py += c[1, k] * m[k]
            w += c[2, k] * m[k]
            dp += d[k] * m[k]
            dq += d[6 + k] * m[k]
            if k > 0:
                dw += d[11 + k] * m[k]
        px, py = px / w, py / w
        out[i, 0] = (dp - px * dw) / w / ts
        out[i, 1] = (dq - py * dw) / w / ts
        if knots > 0:
            s = norms[2] / ts / w
            wx = c[2, 1] + 2 * c[2, 3] * x + c[2, 4] * y
            wy = c[2, 2] + c[2, 4] * x + 2 * c[2, 5] * y
            sx, sy, roll = 0.0, 0.0, 0.0
            for k in range(4):
                q = 17 + first[i] + k
                sx += basis[i, k] * d[q]
                sy += basis[i, k] * d[q + knots]
                roll += basis[i, k] * d[q + 2 * knots]
            sx -= roll * (undistorted[i, 1] - centre[1]) / norms[3]
            sy += roll * (undistorted[i, 0] - centre[0]) / norms[3]
            out[i, 0] += (c[0, 1] + 2 * c[0, 3] * x + c[0, 4] * y - px * wx) * s * sx
            out[i, 0] += (c[0, 2] + c[0, 4] * x + 2 * c[0, 5] * y - px * wy) * s * sy
            out[i, 1] += (c[1, 1] + 2 * c[1, 3] * x + c[1, 4] * y - py * wx) * s * sx
            out[i, 1] += (c[1, 2] + c[1, 4] * x + 2 * c[1, 5] * y - py * wy) * s * sy
    return out


@compiled(error_model="numpy")
def eliminate_bands(bands: FloatArray, border: FloatArray, corner: FloatArray) -> None:
    """Eliminate the unknowns of eight symmetric systems at once, value by value: in place, without a root.

    ``bands`` (n, width, 8): ``bands[i, d]`` is the matrix's value of unknowns i and i + d. ``border`` (n, m, 8) has
    products with further unknowns, and behind them right-hand sides, ``corner`` (k, m, 8), k <= m, those of the further
    unknowns, of which the upper triangle is read and written.
    """
    size, width, columns = bands.shape[0], bands.shape[1], border.shape[1]
    inverse = np.empty(LANES)
    for i in range(size):
        for lane in range(LANES):
            inverse[lane] = 1.0 / bands[i, 0, lane]
        at, beside = i * width, i * columns
        for d in range(1, min(width, size - i)):
            _subtract_products(bands, at + d * width, bands, at + d, inverse, bands, at + d, width - d)
            _subtract_products(border, beside + d * columns, bands, at + d, inverse, border, beside, columns)
        for k in range(corner.shape[0]):
            _subtract_products(corner, k * columns + k, border, beside + k, inverse, border, beside + k, columns - k)


@compiled(error_model="numpy")
def substitute_back(bands: FloatArray, border: FloatArray, known: FloatArray) -> FloatArray:
    """Solutions (n, m - k, 8) after `eliminate_bands`, whose arrays it takes, by the further unknowns (k, m - k, 8)."""
    size, width, columns, inner = bands.shape[0], bands.shape[1], border.shape[1], known.shape[0]
    sides, one = columns - inner, np.ones(LANES)
    out = np.empty((size, sides, LANES))
    for i in range(size - 1, -1, -1):
        at, right = i * width, i * columns + inner
        for k in range(inner):
            _subtract_products(border, right, border, i * columns + k, one, known, k * sides, sides)
        for d in range(1, min(width, size - i)):
            _subtract_products(border, right, bands, at + d, one, out, (i + d) * sides, sides)
        for side in range(sides):
            for lane in range(LANES):
                out[i, side, lane] = border[i, inner + side, lane] / bands[i, 0, lane]
    return out


@kernel
def add_folds(parts: FloatArray, leave_out: bool, systems: FloatArray, begin: int) -> None:
    """Add to eight systems (n, m, 8), from column ``begin`` on, the sums over all folds of ``parts`` (folds, n, k or
    more); where each is left out, to the first of them without a fold each. It adds k = m - ``begin`` columns at most.
    """
    folds, size, columns = parts.shape
    for i in range(size):
        for d in range(min(columns, systems.shape[1] - begin)):
            total = 0.0
            for f in range(folds):
                total += parts[f, i, d]
            for lane in range(LANES):
                systems[i, begin + d, lane] += total
            for f in range(folds if leave_out else 0):
                systems[i, begin + d, f] -= parts[f, i, d]


@kernel
def _interleave(theta: FloatArray) -> FloatArray:
    """Row coefficients (3 knots,), those of each knot next to each other, of parameters (17 + 3 knots,)."""
    out = np.empty(len(theta) - 17)
    for k in range(len(out)):
        out[k] = theta[_parameter(k, len(out))]
    return out


@kernel
def _parameter(k: int, count: int) -> int:
    """Number among the parameters of the k-th of so many interleaved row coefficients."""
    return 17 + k % 3 * (count // 3) + k // 3


@kernel
def _add(to: FloatArray, value: float) -> None:
    """Add a value to each of eight systems; numba compiles what assigns an array to a part of another for seconds."""
    for lane in range(LANES):
        to[lane] += value


@kernel
def _make_priors(
    stiffness: FloatArray, gauge: FloatArray, gauge_weight: float, prior: FloatArray, theta: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Priors to which `solve_steps` adds the folds: bands and border of the row coefficients, matrix of the others."""
    size, directions, rows = stiffness.shape[0], gauge.shape[1], _interleave(theta)
    bands, border = aligned_zeros(size, 12, LANES), aligned_zeros(size, directions + 18, LANES)
    corner = aligned_zeros(directions + 18, directions + 18, LANES)
    for i in range(size):
        for d in range(min(3, (size - i + 2) // 3)):
            _add(bands[i, 3 * d], stiffness[i, d])
            _add(border[i, -1], -stiffness[i, d] * rows[i + 3 * d])
            if d > 0:
                _add(border[i + 3 * d, -1], -stiffness[i, d] * rows[i])
        for k in range(directions):
            _add(border[i, k], gauge[i, k])
            _add(corner[k, -1], -gauge[i, k] * rows[i])
    for k in range(directions):
        _add(corner[k, k], -1.0 / gauge_weight)
    for k in range(17):
        _add(corner[directions + k, directions + k], prior[k])
        _add(corner[directions + k, -1], -prior[k] * theta[k])
    return bands, border, corner


@kernel
def solve_steps(bands, border, corner, stiffness, gauge, gauge_weight, prior, free, theta, leave_out) -> FloatArray:  # type: ignore[no-untyped-def]
    """Gauss-Newton step (1, p) of the penalised squares, or the step (folds, p) without each fold; NaN where their
    matrix is not positive definite.

    The gauge's penalty, ``gauge_weight`` times the square of gauge . x, would couple all knots. It enters by one
    multiplier for each of its directions, which are further unknowns as the 17 parameters are: their equations read
    gauge . x = multiplier / gauge_weight.

    The equations are from `normal_equations`, of at most eight folds where each is left out. ``stiffness`` (3 knots, 3)
    is the penalty of each row coefficient with itself and those of the next two knots, ``gauge`` (3 knots, g) has the
    directions, ``prior`` and ``free`` (17,) the penalty of the other parameters, and whether each is free.
    """
    matrix, beside, inner = _make_priors(stiffness, gauge, gauge_weight, prior, theta)
    directions = gauge.shape[1]
    add_folds(bands, leave_out, matrix, 0)
    add_folds(border, leave_out, beside, directions)
    add_folds(corner, leave_out, inner[directions:], directions)
    for k in range(17):
        if not free[k]:  # its step is zero
            at = directions + k
            beside[:, at], inner[at], inner[:, at] = 0.0, 0.0, 0.0
            inner[at, at] = 1.0
    eliminate_bands(matrix, beside, inner[:-1])
    dense, known = _solve_dense(inner)
    rows = substitute_back(matrix, beside, known)
    steps = np.full((len(bands) if leave_out else 1, len(theta)), np.nan)
    for f in range(len(steps)):
        definite = (matrix[:, 0, f] > 0.0).all() and (dense[directions:, 0, f] > 0.0).all()
        if definite and (dense[:directions, 0, f] < 0.0).all():
            for k in range(17):
                steps[f, k] = known[directions + k, 0, f]
            for k in range(len(rows)):
                steps[f, _parameter(k, len(rows))] = rows[k, 0, f]
    return steps


@kernel
def _solve_dense(systems: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Solutions (n, 1, 8) of eight symmetric systems (n and one more, n + 1, 8), of which the upper triangle is read,
    and the bands that they are eliminated by."""
    count = systems.shape[0] - 1
    bands, right = aligned_zeros(count, count, LANES), aligned_zeros(count, 1, LANES)
    for k in range(count):
        for lane in range(LANES):
            for d in range(count - k):
                bands[k, d, lane] = systems[k, k + d, lane]
            right[k, 0, lane] = systems[k, count, lane]
    nothing = np.zeros((0, 1, LANES))
    eliminate_bands(bands, right, nothing)
    return bands, substitute_back(bands, right, nothing)


@kernel
def predict_squares(bands: FloatArray, border: FloatArray, corner: FloatArray, steps: FloatArray) -> float:
    """Sum of squares of all folds, to first order, each after its step (folds, p)."""
    size, total, inner = bands.shape[1], 0.0, np.empty(18)
    for f in range(len(steps)):
        moved = _interleave(steps[f])
        for k in range(17):
            inner[k] = steps[f, k]
        inner[17] = -1.0
        for i in range(size):
            value = bands[f, i, 0] * moved[i]
            for d in range(1, min(12, size - i)):
                value += 2.0 * bands[f, i, d] * moved[i + d]
            for k in range(18):
                value += 2.0 * border[f, i, k] * inner[k]
            total += moved[i] * value
        for k in range(18):
            for j in range(18):
                total += inner[k] * corner[f, k, j] * inner[j]
    return total
