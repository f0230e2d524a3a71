"""Joint robust fit of polyprojective and row spline by iteratively reweighted least squares (IRLS).

The default of a frame's registration (``model="row_spline"``); the paper's fit, case deletion, is in
`velfield.registration.fitting`. Case deletion drops the rows that a rolling shutter displaces before the spline can
model them. Here every control point keeps a Geman-McClure weight of its residual, re-estimated after every Gauss-Newton
step, with the scale from the median residual and the weight function narrowed step by step (annealing).

The spline's smoothness penalty ("stiffness") is selected by spatial cross-validation: the normal equations are
accumulated per fold, so the cross-validated squares of every candidate follow from small matrices alone. The same folds
give every control point its cross-validated residual, to first order: the frame's quality measure.

`scipy.optimize.least_squares` with this loss and a given stiffness is no more accurate (3000 points, 161 parameters:
0.104 in place of 0.101 px) and takes 1.3 in place of 0.1 s per fit, of which a frame needs three or four.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TypeAlias

import numpy as np

from schemas.arrays import FloatArray, IntArray, Mask
from velfield.camera.lens import Lens
from velfield.errors import Failure
from velfield.registration import fit_kernels, kernels
from velfield.registration.control_points import (
    FOLDS,
    MIN_SIGMA_PX,
    ControlPoints,
    assign_folds,
    finite_median,
    geman_mcclure,
    is_inlier,
)
from velfield.registration.transforms import (
    FrameTransform,
    PolyprojectiveTransform,
    as_points,
    fit_normalisation,
    frame_corners,
)

_ANNEALING = (8.0, 6.0, 4.0, 3.0, 2.5, 2.5, 2.5)
_WARM_ANNEALING = (5.0, 3.5, 2.5, 2.5)
_ROUGH_ANNEALING = (5.0, 3.5, 2.5)
"""Width of the weight function in robust standard deviations, step by step: wide first, so that displaced rows keep
their weight. The second is for a refit, the third for a fit that another starts from."""
_BENDING_SD = 0.05
"""Prior standard deviation of the second-order terms, in half-frames: far above what a lens leaves, it matters only
where there are no control points."""
_PRIOR = np.isin(np.arange(17), [3, 4, 5, 9, 10, 11, 14, 15, 16]) / _BENDING_SD**2
"""Penalty (17,) of the rational function's parameters: of the second-order ones alone."""
_SELECT_STIFFNESS_AFTER = (1, 3)
"""Steps after which the stiffness is selected again: fast row motion appears only once the slow one is fitted. In a
fit that starts from an earlier one not again where the first selection changes nothing; always once in such a fit cost
0.02 px of the 95th percentile."""
_FINAL_STEPS = 2
_INITIAL_STIFFNESS = (10.0, 1e4)
"""Stiffness of row shift and roll before the first selection."""
_HALVINGS = 6
_SHIFT_STIFFNESSES = tuple(10.0**k for k in (-2, -1, 0, 1, 2, 4, 6))
"""Candidate weights of the spline's squared second differences, relative to the noise variance."""
_END_FRACTION = 0.06
"""Fraction of the height at either end that does not enter the selection: parallax of a roof there would bend them."""
_MAX_CV_RATIO = 1.002
"""The stiffest candidate is selected whose cross-validated squares are within this ratio of the minimum."""
_ROLL_STIFFNESSES = tuple(10.0**k for k in (0, 1, 2, 4, 6))
_RIDGE = 0.01
"""Ridge on the spline coefficients, px: rows move by some ten px at most. It constrains the ends, with few patches."""
_GAUGE = 1e5
"""Penalty on the spline's components that the polyprojective expresses too (shift, shear, bend along the rows): their
sum alone is determined (gauge freedom)."""


@dataclass(frozen=True, eq=False)
class JointFit:
    """Result of `fit_jointly`."""

    transform: FrameTransform
    """The frame's map, without a mesh."""
    weights: FloatArray
    """(n,) robust weight of each control point, in [0, 1]."""
    residuals: FloatArray
    """(n, 2) base px, observed minus mapped."""
    cv_residuals: FloatArray
    """(n, 2) the same with the point's fold left out of the fit (cross-validated)."""
    scale: float
    """Robust standard deviation of the residuals per coordinate, over the control points' ``sigma_px``."""
    stiffness: tuple[float, float]
    """Selected for the row shift and for the roll."""

    @property
    def inliers(self) -> Mask:
        """(n,) control points of sufficient weight."""
        return is_inlier(self.weights)


_Equations: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]
"""Bands, border and corner of the normal equations of each fold, see `fit_kernels.normal_equations`."""


@dataclass(frozen=True, eq=False)
class _Problem:
    """The constants of one fit."""

    undistorted: FloatArray
    xy_base: FloatArray
    sigma: FloatArray
    first: IntArray
    basis: FloatArray
    fold: IntArray
    knots: int
    free: Mask
    norms: FloatArray
    centre: FloatArray
    height: int
    inner: Mask
    gauge: FloatArray

    def coefficients(self, theta: FloatArray) -> FloatArray:
        return np.stack([theta[:6], theta[6:12], np.concatenate([[1.0], theta[12:17]])])

    def row_coefficients(self, theta: FloatArray) -> FloatArray:
        rows = theta[17:].reshape(3, self.knots).copy()
        rows[2] /= self.norms[3]
        return rows

    def evaluate(self, theta: FloatArray) -> "_State":
        """The map by these parameters, at all control points."""
        corrected, residuals = fit_kernels.evaluate(
            self.undistorted, self.first, self.basis, self.xy_base, theta, self.knots, self.norms, self.centre
        )
        return _State(theta, corrected, residuals)

    def equations(self, state: "_State", weight: FloatArray, fold: IntArray, folds: int) -> _Equations:
        return fit_kernels.normal_equations(
            self.undistorted,
            state.corrected,
            self.first,
            self.basis,
            self.xy_base,
            weight,
            fold,
            folds,
            self.knots,
            self.coefficients(state.theta),
            self.norms,
            self.centre,
        )

    def steps(
        self, equations: _Equations, theta: FloatArray, stiffness: tuple[float, float], *, leave_out: bool
    ) -> FloatArray:
        """Gauss-Newton step (1, p) of the penalised squares, or those (folds, p) that leave out a fold each; zero for
        fixed parameters."""
        return fit_kernels.solve_steps(
            *equations,
            _stiffness_bands(self.knots, *stiffness),
            self.gauge,
            _GAUGE,
            _PRIOR,
            self.free,
            theta,
            leave_out,
        )


@dataclass(frozen=True, eq=False)
class _State:
    """The map by parameters ``theta`` (p,): points (n, 2) without row motion, undistorted px; residuals (n, 2)."""

    theta: FloatArray
    corrected: FloatArray
    residuals: FloatArray


def fit_jointly(
    points: ControlPoints,
    *,
    start: PolyprojectiveTransform,
    lens: Lens,
    width: int,
    height: int,
    knots: int,
    homography: bool = False,
    start_rows: FloatArray | None = None,
    start_scale_px: float = 3.0,
    start_stiffness: tuple[float, float] | None = None,
    rough: bool = False,
) -> JointFit | Failure:
    """Fit polyprojective (or homography) and row spline jointly to control points, by annealed IRLS.

    Parameters
    ----------
    points
        Control points; up to about half may be outliers.
    start, start_rows
        Undistorted px to base px, accurate to a few times ``start_scale_px``, and (3, knots) row coefficients.
    knots
        Coefficients of the row spline per component; 0: none.
    homography
        Keep the second-order terms zero.
    start_scale_px
        Upper limit of the robust scale: residuals up to some eight times this have weight at first.
    start_stiffness
        Stiffness of an earlier fit of the same frame: fewer steps and candidates are needed.
    rough
        Fit in a few steps, with that stiffness and without cross-validation: to start another fit from.

    Returns
    -------
    The fit, or a failure if it does not converge.
    """
    problem = _build_problem(points, lens=lens, width=width, height=height, knots=knots, homography=homography)
    state = problem.evaluate(_initial_parameters(problem, start, start_rows))
    rough = rough and start_stiffness is not None
    fitted = _irls_annealed(problem, state, start_scale_px, start_stiffness, rough=rough)
    if isinstance(fitted, Failure):
        return fitted
    state, weights, scale, stiffness = fitted
    return _to_result(problem, state, weights, scale, stiffness, lens=lens, width=width, rough=rough)


def _build_problem(
    points: ControlPoints, *, lens: Lens, width: int, height: int, knots: int, homography: bool
) -> _Problem:
    raw = as_points(points.xy_raw)
    undistorted = as_points(lens.undistort_points(raw))
    rows = np.ascontiguousarray(raw[:, 1])
    if knots >= 4:
        first, basis = kernels.spline_basis(rows, height, knots)
    else:
        knots, first, basis = 0, np.zeros(len(raw), np.int64), np.zeros((len(raw), 4))
    source = fit_normalisation(as_points(lens.undistort_points(frame_corners(width, height))))
    target = fit_normalisation(as_points(points.xy_base))
    return _Problem(
        undistorted=undistorted,
        xy_base=as_points(points.xy_base),
        sigma=np.asarray(points.sigma_px, dtype=np.float64),
        first=first,
        basis=basis,
        fold=assign_folds(raw),
        knots=knots,
        free=_PRIOR == 0.0 if homography else np.ones(17, bool),
        norms=np.concatenate([source, [0.5 * np.hypot(width, height)], target]),
        centre=np.array([(width - 1) / 2, (height - 1) / 2]),
        height=height,
        inner=np.asarray(np.abs(rows / (height - 1) - 0.5) < 0.5 - _END_FRACTION),
        gauge=_gauge_directions(knots, homography=homography),
    )


@cache
def _stiffness_bands(knots: int, shift: float, roll: float) -> FloatArray:
    """Penalty (3 knots, 3) of each row coefficient with itself and with those of the next two knots: the squared second
    differences, and the ridge."""
    difference = np.diff(np.eye(knots), n=2, axis=0) if knots else np.zeros((0, 0))
    roughness, out = difference.T @ difference, np.zeros((knots, 3, 3))
    for offset in range(3 if knots else 0):
        out[: knots - offset, :, offset] = np.outer(np.diagonal(roughness, offset), (shift, shift, roll))
    out[:, :, 0] += _RIDGE
    return out.reshape(3 * knots, 3)


@cache
def _gauge_directions(knots: int, *, homography: bool) -> FloatArray:
    """Directions (3 knots, g), of length one, of the row coefficients that the model expresses too: the low powers of
    the row in shift x, shift y and roll."""
    powers = (2, 2, 1) if homography else (3, 3, 2)
    out = np.zeros((knots, 3, sum(powers) if knots else 0))
    for part, count in enumerate(powers if knots else ()):
        basis, _ = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, knots), count, increasing=True))
        out[:, part, sum(powers[:part]) : sum(powers[: part + 1])] = basis
    return out.reshape(3 * knots, -1) if knots else np.zeros((0, 0))


def _initial_parameters(problem: _Problem, start: PolyprojectiveTransform, rows: FloatArray | None) -> FloatArray:
    """The parameter vector of the start, in the problem's normalisation."""
    theta = np.zeros(17 + 3 * problem.knots)
    source, target = problem.norms[:3], problem.norms[4:]
    if start.is_homography:
        corrected = PolyprojectiveTransform.from_homography(start.homography(), source, target)
    else:
        corrected = _renormalise(start, source, target)
    theta[:12], theta[12:17] = corrected.coefficients[:2].ravel(), corrected.coefficients[2, 1:]
    if rows is not None and rows.shape[1] == problem.knots:
        theta[17:] = (rows * np.array([[1.0], [1.0], [problem.norms[3]]])).ravel()
    return theta


def _renormalise(start: PolyprojectiveTransform, source: FloatArray, target: FloatArray) -> PolyprojectiveTransform:
    """The same rational function in other normalised coordinates."""
    ratio = start.source[2] / source[2]
    ox, oy = (source[0] - start.source[0]) * start.source[2], (source[1] - start.source[1]) * start.source[2]
    # old x = ratio * x + ox: each old monomial as a combination of the new ones
    change = np.array(
        [
            [1, 0, 0, 0, 0, 0],
            [ox, ratio, 0, 0, 0, 0],
            [oy, 0, ratio, 0, 0, 0],
            [ox * ox, 2 * ratio * ox, 0, ratio**2, 0, 0],
            [ox * oy, ratio * oy, ratio * ox, 0, ratio**2, 0],
            [oy * oy, 0, 2 * ratio * oy, 0, 0, ratio**2],
        ]
    )
    c = start.coefficients @ change
    for axis in range(2):
        c[axis] = (c[axis] / start.target[2] + (start.target[axis] - target[axis]) * c[2]) * target[2]
    return PolyprojectiveTransform(c / c[2, 0], source, target)


def _weights_and_scale(
    residuals: FloatArray, sigma: FloatArray, width: float, limit: float
) -> tuple[FloatArray, float]:
    """Geman-McClure weights (n,) and the robust scale (median) of the residuals over sigma."""
    size = np.hypot(*residuals.T) / sigma
    scale = max(min(finite_median(size) / 1.1774, limit), MIN_SIGMA_PX)
    return geman_mcclure(size / (width * scale)), scale


def robust_weights(residuals: FloatArray, sigma: FloatArray, scale: float) -> FloatArray:
    """Robust weights (n,) of residuals (n, 2) over ``sigma`` (n,) and `JointFit.scale`, as in its last step."""
    return geman_mcclure(np.hypot(*residuals.T) / (sigma * scale * _ANNEALING[-1]))


def _irls_annealed(
    problem: _Problem,
    state: _State,
    start_scale_px: float,
    start_stiffness: tuple[float, float] | None,
    *,
    rough: bool,
) -> tuple[_State, FloatArray, float, tuple[float, float]] | Failure:
    """IRLS with a weight function that narrows from step to step: the map, weights, scale and stiffness.

    A failure if the normal equations are not positive definite, or if the last step was not possible."""
    stiffness = start_stiffness or _INITIAL_STIFFNESS
    widths: tuple[float, ...] = _ANNEALING if start_stiffness is None else _WARM_ANNEALING
    widths = _ROUGH_ANNEALING if rough else widths + (widths[-1],) * _FINAL_STEPS
    limit = start_scale_px / float(np.median(problem.sigma))
    weights, scale = _weights_and_scale(state.residuals, problem.sigma, widths[0], limit)
    no_folds, equations, settled, moved = np.zeros_like(problem.fold), None, rough, False
    for iteration, width in enumerate(widths):
        if equations is None:
            equations = problem.equations(state, _inverse_variance(problem, weights, scale), no_folds, 1)
        stepped = _take_step(problem, state, equations, weights, stiffness)
        if isinstance(stepped, Failure):
            return stepped
        moved, state = stepped is not state, stepped
        weights, scale = _weights_and_scale(state.residuals, problem.sigma, width, limit)
        equations = None
        if iteration in _SELECT_STIFFNESS_AFTER and problem.knots and not settled:
            # the rows at the ends take part in the next step only: a fold of their own
            equations = problem.equations(
                state,
                _inverse_variance(problem, weights, scale),
                np.where(problem.inner, problem.fold, FOLDS),
                FOLDS + 1,
            )
            bands, border, corner = (part[:FOLDS] for part in equations)
            selected = _select_stiffness(problem, (bands, border, corner), state.theta, start_stiffness)
            settled = start_stiffness is not None and selected == stiffness
            stiffness = selected
    if not moved:
        return Failure(f"the fit to {len(weights)} control points did not converge: a step folds the map over")
    return state, weights, scale, stiffness if problem.knots else (1.0, 1.0)


def _to_result(
    problem: _Problem,
    state: _State,
    weights: FloatArray,
    scale: float,
    stiffness: tuple[float, float],
    *,
    lens: Lens,
    width: int,
    rough: bool,
) -> JointFit | Failure:
    """The result, with cross-validated residuals to first order: one Gauss-Newton step without each fold."""
    theta, residuals = state.theta, state.residuals
    if not np.isfinite(theta).all() or float(weights.sum()) < (problem.free.sum() + 3 * problem.knots) / 4:
        return Failure(f"the fit to {len(weights)} control points did not converge")
    transform = FrameTransform(
        width=width,
        height=problem.height,
        lens=lens,
        polyprojective=PolyprojectiveTransform(problem.coefficients(theta), problem.norms[:3], problem.norms[4:]),
        row_coefficients=problem.row_coefficients(theta),
    )
    if rough:
        return JointFit(transform, weights, residuals, residuals, scale, stiffness)
    equations = problem.equations(state, _inverse_variance(problem, weights, scale), problem.fold, FOLDS)
    steps = problem.steps(equations, theta, stiffness, leave_out=True)
    if not np.isfinite(steps).all():
        return Failure(f"{len(weights)} control points do not determine the map without a fifth of them")
    change = fit_kernels.predict_change(
        problem.undistorted,
        state.corrected,
        problem.first,
        problem.basis,
        steps,
        problem.fold,
        problem.knots,
        problem.coefficients(theta),
        problem.norms,
        problem.centre,
    )
    return JointFit(transform, weights, residuals, residuals - change, scale, stiffness)


def _inverse_variance(problem: _Problem, weights: FloatArray, scale: float) -> FloatArray:
    return weights / (problem.sigma * scale) ** 2


def _take_step(
    problem: _Problem,
    state: _State,
    equations: _Equations,
    weights: FloatArray,
    stiffness: tuple[float, float],
) -> _State | Failure:
    """One Gauss-Newton step, halved until every control point of positive weight stays in the map's domain.

    Returns the state itself if no halving suffices; a failure if the control points do not determine the map.
    """
    (step,) = problem.steps(equations, state.theta, stiffness, leave_out=False)
    if not np.isfinite(step).all():
        return Failure(f"{len(weights)} control points do not determine the map: they lie on a line or in one place")
    for _ in range(_HALVINGS):
        stepped = problem.evaluate(state.theta + step)
        if np.isfinite(stepped.residuals[weights > 0.0]).all():
            return stepped
        step = 0.5 * step
    return state


def _select_stiffness(
    problem: _Problem,
    equations: _Equations,
    theta: FloatArray,
    earlier: tuple[float, float] | None,
) -> tuple[float, float]:
    """Select the stiffness of the row shift, then of the roll, by cross-validation; near ``earlier`` if given."""
    shifts = _neighbours(_SHIFT_STIFFNESSES, None if earlier is None else earlier[0])
    rolls = _neighbours(_ROLL_STIFFNESSES, None if earlier is None else earlier[1])
    roll = _ROLL_STIFFNESSES[-1] if earlier is None else earlier[1]

    @cache
    def squares(candidate: tuple[float, float]) -> float:
        steps = problem.steps(equations, theta, candidate, leave_out=True)
        total = float(fit_kernels.predict_squares(*equations, steps))
        return total if np.isfinite(total) else np.inf

    shift, _ = _select_stiffest_near_best([(s, roll) for s in shifts], squares)
    return _select_stiffest_near_best([(shift, s) for s in rolls], squares)


def _neighbours(candidates: tuple[float, ...], value: float | None) -> tuple[float, ...]:
    """A value and its neighbours among the candidates; all candidates without a value."""
    if value is None or value not in candidates:
        return candidates
    k = candidates.index(value)
    return candidates[max(0, k - 1) : k + 2]


def _select_stiffest_near_best(
    candidates: list[tuple[float, float]], squares: Callable[[tuple[float, float]], float]
) -> tuple[float, float]:
    """The stiffest candidate (the last: they are ordered) with about the minimum of cross-validated squares."""
    limit = _MAX_CV_RATIO * min(map(squares, candidates))
    return max(candidate for candidate in candidates if squares(candidate) <= limit)
