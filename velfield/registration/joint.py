"""The joint robust fit: polyprojective and row spline together, weights in place of deletion, smoothness by evidence.

Case deletion throws the rows that wobble away before the spline can explain them. Here every control point keeps a
weight that falls with its residual (Geman-McClure, the scale from the median), and is asked again after every step.

How stiff the row spline is, is chosen by cross-validation: control points fall into folds by place, the normal
equations are gathered once a fold, and for each stiffness the held-out squares follow from small matrices alone. The
same folds give every point its held-out residual: the frame's certificate.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from velfield.camera.lens import Lens
from velfield.errors import Failure
from velfield.registration import kernels
from velfield.registration.transforms import (
    FrameTransform,
    PolyprojectiveTransform,
    as_points,
    normalisation_of,
)

FOLDS = 5
FOLD_CELL_PX = 48
"""Control points of one cell of this side are held out together: neighbours share their errors."""
_ANNEALING = (8.0, 6.0, 4.0, 3.0, 2.5, 2.5, 2.5)
_WARM_ANNEALING = (5.0, 3.5, 2.5, 2.5)
"""Width of the robust weight in standard deviations, step by step: wide first, so that wobbling rows keep theirs."""
_BENDING_SD = 0.05
"""Expected size of the second-order terms, in half-frames: far above what a lens leaves, it only holds them where no
control points do."""
_ASKED_AFTER = (1, 3)
"""Steps after which the stiffness is asked of the evidence again: fast wobble shows only once slow wobble is fitted."""
_POLISH = 2
_STIFF = (10.0, 1e4)
"""Stiffness of the row's shift and roll before the evidence is asked."""
_HALVINGS = 6
_STIFFNESS = tuple(10.0**k for k in (-2, -1, 0, 1, 2, 4, 6))
"""Candidates for the weight of the spline's squared second differences, over the noise variance."""
_END_SHARE = 0.06
"""The first and last rows, of the height, have no say in the stiffness: a roof that leans in there would bend them."""
_WORTH = 1.002
"""A softer spline must make the held-out squares smaller by this factor at least."""
_ROLL_STIFFNESS = tuple(10.0**k for k in (0, 1, 2, 4, 6))
_RIDGE = 0.01
"""Weight of the spline's own size, px: a row moves by some ten px at most. It holds the ends, where few patches lie."""
_GAUGE = 1e5
"""Weight that keeps out of the spline what the polyprojective expresses too (shift, shear, bend along the rows): the
trade between the two would be free, and the steps along it long."""
_KEPT_WEIGHT = 0.25
"""A control point whose weight is at least this counts as kept: about 1.6 times the robust scale."""
_MIN_SIGMA_PX = 0.01


@dataclass(frozen=True, eq=False)
class ControlPoints:
    """Places in the raw frame and where they are in the base image.

    Attributes
    ----------
    xy_raw, xy_base : (n, 2) px.
    sigma_px : (n,) standard deviation expected of each, only their ratios matter.
    """

    xy_raw: FloatArray
    xy_base: FloatArray
    sigma_px: FloatArray

    def __len__(self) -> int:
        return len(self.xy_raw)

    def joined(self, other: "ControlPoints") -> "ControlPoints":
        """These and the others."""
        return ControlPoints(
            np.concatenate([self.xy_raw, other.xy_raw]),
            np.concatenate([self.xy_base, other.xy_base]),
            np.concatenate([self.sigma_px, other.sigma_px]),
        )

    def where(self, mask: NDArray[np.bool_]) -> "ControlPoints":
        """Those for which the mask (n,) holds."""
        return ControlPoints(self.xy_raw[mask], self.xy_base[mask], self.sigma_px[mask])


@dataclass(frozen=True, eq=False)
class JointFit:
    """Result of `joint_fit`.

    Attributes
    ----------
    transform : the frame's map, without a mesh.
    weights : (n,) robust weight of each control point, in [0, 1].
    residuals : (n, 2) base px, wanted minus mapped.
    heldout : (n, 2) the same with the point's own fold left out of the fit; NaN where it was not asked for.
    scale : robust standard deviation of the residuals in one coordinate, over the control points' own.
    stiffness : chosen for the row's shift and for its roll.
    """

    transform: FrameTransform
    weights: FloatArray
    residuals: FloatArray
    heldout: FloatArray
    scale: float
    stiffness: tuple[float, float]

    @property
    def kept(self) -> NDArray[np.bool_]:
        """(n,) the control points that the fit rests on."""
        return kept_of(self.weights)

    @property
    def residual_px(self) -> float:
        """RMS distance of the kept control points."""
        return _rms(self.residuals[self.kept])

    @property
    def heldout_px(self) -> float:
        """RMS held-out distance of the kept control points."""
        return _rms(self.heldout[self.kept])


def _rms(vectors: FloatArray) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean())) if len(vectors) else float("nan")


@dataclass(frozen=True, eq=False)
class _Problem:
    """All that does not change while the fit runs."""

    undistorted: FloatArray
    rows: FloatArray
    wanted: FloatArray
    sigma: FloatArray
    first: NDArray[np.int64]
    basis: FloatArray
    fold: NDArray[np.int64]
    knots: int
    free: NDArray[np.int64]
    norms: FloatArray
    centre: FloatArray
    height: int
    roughness: FloatArray = field(repr=False)
    shared: FloatArray = field(repr=False)

    def coefficients(self, theta: FloatArray) -> FloatArray:
        return np.stack([theta[:6], theta[6:12], np.concatenate([[1.0], theta[12:17]])])

    def row_coefficients(self, theta: FloatArray) -> FloatArray:
        rows = theta[17:].reshape(3, self.knots).copy()
        rows[2] /= self.norms[3]
        return rows

    def moved(self, theta: FloatArray) -> FloatArray:
        rows = self.row_coefficients(theta)
        return np.asarray(kernels.row_moved(self.undistorted, self.rows, rows, self.height, self.centre))

    def residuals(self, theta: FloatArray) -> FloatArray:
        source, target = self.norms[:3], self.norms[4:]
        mapped = kernels.rational(self.moved(theta), self.coefficients(theta), source, target)
        return np.asarray(self.wanted - mapped)

    def penalty(self, stiffness: float, roll_stiffness: float) -> FloatArray:
        """Matrix (p, p) of the spline's squared second differences and the ridge."""
        matrix = np.zeros((17 + 3 * self.knots, 17 + 3 * self.knots))
        k = self.knots
        for part, weight in enumerate((stiffness, stiffness, roll_stiffness)):
            block = slice(17 + part * k, 17 + (part + 1) * k)
            matrix[block, block] = weight * self.roughness + _RIDGE * np.eye(k) + _GAUGE * self.shared[part]
        bending = [3, 4, 5, 9, 10, 11, 14, 15, 16]
        matrix[bending, bending] = 1.0 / _BENDING_SD**2
        return matrix

    def equations(self, theta: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        return kernels.normal_equations(  # type: ignore[no-any-return]
            self.undistorted,
            self.moved(theta),
            self.first,
            self.basis,
            self.wanted,
            weight,
            self.fold,
            FOLDS,
            self.knots,
            self.coefficients(theta),
            self.norms,
            self.centre,
        )

    def step(self, normal: FloatArray, right: FloatArray, penalty: FloatArray, theta: FloatArray) -> FloatArray:
        """Gauss-Newton step (p,) of the penalised squares; zero for the parameters that are not free."""
        matrix = (normal + penalty)[np.ix_(self.free, self.free)]
        wanted = (right - np.einsum("ij,j", penalty, theta))[self.free]
        out = np.zeros(len(theta))
        out[self.free] = kernels.solve_positive(matrix, wanted[:, None])[:, 0]
        return out


def joint_fit(
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
) -> JointFit | Failure:
    """Fit polyprojective (or homography) and row spline to control points, jointly and robustly.

    Parameters
    ----------
    points
        Control points; wrong ones among them, by half or so, do no harm.
    start
        Undistorted px to base px, right to within a few times ``start_scale_px``.
    knots
        Coefficients of the row spline a component; 0: none.
    homography
        Keep the second-order terms zero.
    start_rows
        (3, knots) row coefficients to start from.
    start_scale_px
        Upper limit of the first robust scale: residuals up to some eight times this are first believed.
    start_stiffness
        Of an earlier fit of the same frame: the start is near, and fewer steps are taken.

    Returns
    -------
    The fit, or a failure where the points do not determine it.
    """
    problem = _posed(points, start=start, lens=lens, width=width, height=height, knots=knots, homography=homography)
    theta = _starting(problem, start, start_rows)
    theta, weights, scale, stiffness = _annealed(problem, theta, start_scale_px, start_stiffness)
    return _fitted(problem, theta, weights, scale, stiffness, lens=lens, width=width)


def _posed(
    points: ControlPoints,
    *,
    start: PolyprojectiveTransform,
    lens: Lens,
    width: int,
    height: int,
    knots: int,
    homography: bool,
) -> _Problem:
    raw = as_points(points.xy_raw)
    undistorted = as_points(lens.undistort_points(raw))
    rows = np.ascontiguousarray(raw[:, 1])
    if knots >= 4:
        first, basis = kernels.spline_basis(rows, height, knots)
    else:
        knots, first, basis = 0, np.zeros(len(raw), np.int64), np.zeros((len(raw), 4))
    difference = np.diff(np.eye(knots), n=2, axis=0) if knots else np.zeros((0, 0))
    free = np.array([0, 1, 2, 6, 7, 8, 12, 13]) if homography else np.arange(17)
    corners = np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], dtype=np.float64)
    source = normalisation_of(as_points(lens.undistort_points(corners)))
    target = normalisation_of(as_points(points.xy_base))
    return _Problem(
        undistorted=undistorted,
        rows=rows,
        wanted=as_points(points.xy_base),
        sigma=np.asarray(points.sigma_px, dtype=np.float64),
        first=first,
        basis=basis,
        fold=folds_of(raw),
        knots=knots,
        free=np.concatenate([free, np.arange(17, 17 + 3 * knots)]),
        norms=np.concatenate([source, [0.5 * np.hypot(width, height)], target]),
        centre=np.array([(width - 1) / 2, (height - 1) / 2]),
        height=height,
        roughness=difference.T @ difference,
        shared=_shared_terms(knots, homography=homography),
    )


def _shared_terms(knots: int, *, homography: bool) -> FloatArray:
    """Projections (3, knots, knots) on what shift x, shift y and roll share with the model: low powers of the row."""
    powers = (2, 2, 1) if homography else (3, 3, 2)
    out = np.zeros((3, knots, knots))
    for part, count in enumerate(powers if knots else ()):
        basis, _ = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, knots), count, increasing=True))
        out[part] = basis @ basis.T
    return out


def folds_of(xy_raw: FloatArray) -> NDArray[np.int64]:
    """Fold (n,) of each point, by its cell: the same for a place whatever else is there."""
    cell = np.floor(np.asarray(xy_raw) / FOLD_CELL_PX).astype(np.int64)
    return np.asarray((cell[:, 0] * 2 + cell[:, 1]) % FOLDS)


def _starting(problem: _Problem, start: PolyprojectiveTransform, rows: FloatArray | None) -> FloatArray:
    """The start in the problem's own normalisation, exact for its values on a grid."""
    theta = np.zeros(17 + 3 * problem.knots)
    source, target = problem.norms[:3], problem.norms[4:]
    if start.is_homography:
        moved = PolyprojectiveTransform.from_homography(start.homography(), source, target)
    else:
        moved = _renormalised(start, source, target)
    theta[:12], theta[12:17] = moved.coefficients[:2].ravel(), moved.coefficients[2, 1:]
    if rows is not None and rows.shape[1] == problem.knots:
        theta[17:] = (rows * np.array([[1.0], [1.0], [problem.norms[3]]])).ravel()
    return theta


def _renormalised(start: PolyprojectiveTransform, source: FloatArray, target: FloatArray) -> PolyprojectiveTransform:
    """The same rational function over other normalised coordinates."""
    ratio = start.source[2] / source[2]
    ox, oy = (source[0] - start.source[0]) * start.source[2], (source[1] - start.source[1]) * start.source[2]
    # old x = ratio * x + ox: each old monomial in the new ones
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


def _robust(residuals: FloatArray, sigma: FloatArray, width: float, limit: float) -> tuple[FloatArray, float]:
    """Geman-McClure weights (n,) and the scale of the residuals over sigma, from their median."""
    size = np.linalg.norm(residuals, axis=1) / sigma
    finite = size[np.isfinite(size)]
    scale = min(float(np.median(finite)) / 1.1774 if finite.size else limit, limit)
    scale = max(scale, _MIN_SIGMA_PX)
    return _geman_mcclure(size / (width * scale)), scale


def _geman_mcclure(size: FloatArray) -> FloatArray:
    with np.errstate(invalid="ignore"):
        weights = 1.0 / (1.0 + size**2) ** 2
    return np.where(np.isfinite(weights), weights, 0.0)


def kept_of(weights: FloatArray) -> NDArray[np.bool_]:
    """(n,) which control points a fit with these robust weights rests on."""
    return np.asarray(weights >= _KEPT_WEIGHT)


def weights_of(residuals: FloatArray, sigma: FloatArray, scale: float) -> FloatArray:
    """Robust weights (n,) of residuals (n, 2), as the joint fit ends with them.

    Parameters
    ----------
    sigma
        (n,) of the control points.
    scale
        `JointFit.scale`.
    """
    return _geman_mcclure(np.linalg.norm(residuals, axis=1) / (sigma * scale * _ANNEALING[-1]))


def _annealed(
    problem: _Problem, theta: FloatArray, start_scale_px: float, start_stiffness: tuple[float, float] | None
) -> tuple[FloatArray, FloatArray, float, tuple[float, float]]:
    """Parameters, weights, scale and stiffness once the weights have closed in on the control points that agree."""
    stiffness = start_stiffness or _STIFF
    widths = _ANNEALING if start_stiffness is None else _WARM_ANNEALING
    limit = start_scale_px / float(np.median(problem.sigma))
    weights, scale = _robust(problem.residuals(theta), problem.sigma, widths[0], limit)
    for turn, wide in enumerate(widths):
        theta = _stepped(problem, theta, weights, scale, stiffness)
        weights, scale = _robust(problem.residuals(theta), problem.sigma, wide, limit)
        if turn in _ASKED_AFTER:
            stiffness = _stiffness_by_evidence(problem, theta, weights, scale, start_stiffness)
    for _ in range(_POLISH):
        theta = _stepped(problem, theta, weights, scale, stiffness)
        weights, scale = _robust(problem.residuals(theta), problem.sigma, widths[-1], limit)
    return theta, weights, scale, stiffness


def _fitted(
    problem: _Problem,
    theta: FloatArray,
    weights: FloatArray,
    scale: float,
    stiffness: tuple[float, float],
    *,
    lens: Lens,
    width: int,
) -> JointFit | Failure:
    """The result, with each point's residual when its fold is left out (to first order)."""
    _, steps = _held_out(problem, problem.equations(theta, _precision(problem, weights, scale)), theta, stiffness)
    residuals = problem.residuals(theta)
    if not np.isfinite(theta).all() or float(weights.sum()) < len(problem.free) / 4:
        return Failure(f"the fit to {len(weights)} control points did not settle")
    change = kernels.predicted_change(
        problem.undistorted,
        problem.moved(theta),
        problem.first,
        problem.basis,
        steps,
        problem.fold,
        problem.knots,
        problem.coefficients(theta),
        problem.norms,
        problem.centre,
    )
    transform = FrameTransform(
        width=width,
        height=problem.height,
        lens=lens,
        polyprojective=PolyprojectiveTransform(problem.coefficients(theta), problem.norms[:3], problem.norms[4:]),
        row_coefficients=problem.row_coefficients(theta),
    )
    return JointFit(transform, weights, residuals, residuals - change, scale, stiffness)


def _precision(problem: _Problem, weights: FloatArray, scale: float) -> FloatArray:
    return weights / (problem.sigma * scale) ** 2


def _stepped(
    problem: _Problem, theta: FloatArray, weights: FloatArray, scale: float, stiffness: tuple[float, float]
) -> FloatArray:
    """One step, shortened until no control point that counts falls off the map."""
    normal, right, _ = problem.equations(theta, _precision(problem, weights, scale))
    step = problem.step(normal.sum(axis=0), right.sum(axis=0), problem.penalty(*stiffness), theta)
    for _ in range(_HALVINGS):
        if np.isfinite(problem.residuals(theta + step)[weights > 0]).all():
            return theta + step
        step = 0.5 * step
    return theta


def _held_out(
    problem: _Problem,
    equations: tuple[FloatArray, FloatArray, FloatArray],
    theta: FloatArray,
    stiffness: tuple[float, float],
) -> tuple[float, FloatArray]:
    """Held-out squares over all folds, and each fold's step (FOLDS, p) with that fold left out."""
    normal, right, squares = equations
    free = problem.free
    penalty = problem.penalty(*stiffness)[np.ix_(free, free)]
    steps = np.zeros((FOLDS, len(theta)))
    total, steps[:, free] = kernels.left_out(
        np.ascontiguousarray(normal[:, free[:, None], free]), right[:, free], squares, penalty, theta[free]
    )
    return (total if np.isfinite(total) else np.inf), steps


def _stiffness_by_evidence(
    problem: _Problem,
    theta: FloatArray,
    weights: FloatArray,
    scale: float,
    near: tuple[float, float] | None,
) -> tuple[float, float]:
    """The stiffness of the row's shift, then of its roll, with the least held-out squares; ``near`` is earlier's."""
    if problem.knots == 0:
        return (1.0, 1.0)
    inner = np.abs(problem.rows / (problem.height - 1) - 0.5) < 0.5 - _END_SHARE
    equations = problem.equations(theta, _precision(problem, np.where(inner, weights, 0.0), scale))
    shifts = _neighbours(_STIFFNESS, None if near is None else near[0])
    rolls = _neighbours(_ROLL_STIFFNESS, None if near is None else near[1])
    roll = _ROLL_STIFFNESS[-1] if near is None else near[1]
    shift, _ = _stiffest_of_the_best(problem, equations, theta, [(s, roll) for s in shifts])
    return _stiffest_of_the_best(problem, equations, theta, [(shift, s) for s in rolls])


def _neighbours(candidates: tuple[float, ...], value: float | None) -> tuple[float, ...]:
    """The candidates next to a value and itself; all where there is none."""
    if value is None or value not in candidates:
        return candidates
    k = candidates.index(value)
    return candidates[max(0, k - 1) : k + 2]


def _stiffest_of_the_best(
    problem: _Problem,
    equations: tuple[FloatArray, FloatArray, FloatArray],
    theta: FloatArray,
    candidates: list[tuple[float, float]],
) -> tuple[float, float]:
    """The last candidate (they are given soft first) that predicts held-out points about as well as the best."""
    squares = [_held_out(problem, equations, theta, candidate)[0] for candidate in candidates]
    return max(
        candidate for candidate, value in zip(candidates, squares, strict=True) if value <= _WORTH * min(squares)
    )
