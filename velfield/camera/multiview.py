"""Multi-view estimate of the lens: from matched points of frame pairs, by a small bundle adjustment.

A flat scene maps from frame to frame by a homography of undistorted pixels,

    raw pixel of i -> undistort -> homography -> shift by relief -> distort -> raw pixel of j

and no homography can absorb the lens where the pair sees the same ground at different distances from the image centre.
Residuals are in raw pixels of j (in undistorted pixels a lens that shrinks the image would win). The homography of each
pair is eliminated by the Schur complement; the parameters that all pairs share are estimated by Gauss-Newton steps with
Geman-McClure weights: vehicles and roofs are outliers. Shared are the amount of distortion, its centre, and two effects
that resemble distortion and do not average out over the points:

- Row motion (rolling shutter) deforms a frame in all its pairs: a cosine series in the row, for each frame.
- Relief: under a camera that translates a little, curved ground moves in the image like a radial distortion (to first
  order a bowl and a barrel are the same). Gaussian basis functions of the ground's height are estimated along, with a
  prior of flat ground. A hovering camera cannot separate the two, and the variance of its estimate says so.

The variance combines the jackknife over frames, each left out with all its pairs, and what relief and centre may hide.

`scipy.optimize.least_squares` cannot use this block structure: 20 pairs with 500 parameters take 0.1 s here; there they
had not converged after 3 s, with sparse differences or without.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from schemas.arrays import FloatArray, IntArray, Mask
from velfield.camera.frame_pairs import FramePairs, ScaledLens
from velfield.camera.straighten import geman_mcclure_weights

RELIEF_SD = 0.005
"""Prior standard deviation of the ground's height above its plane at an image corner, over the flying height."""
ROW_SD_PX = 1.0
"""Prior standard deviation of each cosine of the row motion."""
EFFECTIVE_SAMPLE_FRACTION = 0.1
"""Independent points over points, against these priors: residuals of neighbours are correlated."""

SYSTEMATIC_FRACTION = 0.05
"""Fraction of the residual that all points may have in common, in the worst case in the pattern of a distortion."""

_MAX_STEPS = 10
_CONVERGED_STEP = 1e-4
_MAX_STEP = 0.1
_MIN_SCALE_PX = 0.1
_ROW_WAVES = 14  # cosines of the row: half a cycle, one, one and a half, ...
_RELIEF_SPACING = 0.8  # half-diagonals: width and spacing of the relief's basis functions
_MAX_RELIEF_FUNCTIONS = 49
_RELIEF_SD = 1.27 * RELIEF_SD  # of their coefficients, so that the sum has RELIEF_SD at a corner
_DIFFERENCE = 1e-4
_START_THRESHOLD_PX = 6.0
_MIN_DETERMINANT = 1e-6  # of a homography, and its last element: below, it folds the image
_INVALID_RESIDUAL_PX = 1e3
_START_AMOUNTS = (-0.1, 0.0, 0.1, 0.25)
_START_STEPS = 3
_RELIEF_ITERATIONS, _RELIEF_STEPS = 4, 2
_HOMOGRAPHY_STEPS = 3


@dataclass(frozen=True)
class MultiViewFit:
    """A fit of the lens to frame pairs."""

    amount: float
    amount_sd: float
    """Of the distortion, in units of Harris' a."""
    fit_px: float
    """Residual (median over points, mean over pairs) with all parameters fitted; raw px."""
    before_px: float
    after_px: float
    """Residual of a frame's pairs after homographies alone: with the previous lens, and with the one estimated without
    that frame (cross-validated)."""


@dataclass(frozen=True)
class _State:
    """Current estimate: the shared parameters, and the homography (pairs, 3, 3) of normalised pixels of each pair."""

    shared: FloatArray
    matrices: FloatArray

    def move(self, step: FloatArray | float, change: FloatArray) -> "_State":
        """After a step of the shared parameters and a change (pairs, 8) of the homographies' free elements."""
        last = np.zeros((len(change), 1))
        return _State(self.shared + step, self.matrices + np.concatenate([change, last], axis=1).reshape(-1, 3, 3))


@dataclass(frozen=True)
class _Problem:
    """The constants of a fit: for each pair the translation of its image centre, ``baseline`` (pairs, 2), and the
    relief's basis functions at its points (pairs, n, functions)."""

    pairs: FramePairs
    family: ScaledLens
    relief_basis: FloatArray
    baseline: FloatArray
    relief_sd: float = _RELIEF_SD

    def select(self, pairs: Mask) -> "_Problem":
        return _Problem(
            self.pairs.select(pairs), self.family, self.relief_basis[pairs], self.baseline[pairs], self.relief_sd
        )

    @cached_property
    def frame_count(self) -> int:
        return int(self.pairs.frames.max()) + 1

    @cached_property
    def row_basis(self) -> tuple[FloatArray, FloatArray]:
        """Cosines (pairs, n, waves) at the rows of i and of j."""
        height = self.pairs.frame_shape[0]
        cycle = np.pi * (1.0 + np.arange(_ROW_WAVES)) / height
        return tuple(np.cos((xy[..., 1:] + 0.5) * cycle) for xy in (self.pairs.xy_i, self.pairs.xy_j))  # type: ignore[return-value]

    @cached_property
    def prior_precision(self) -> FloatArray:
        """Prior precision (shared,); about none of the amount."""
        centre = np.full(2, self.family.centre_sd**-2)
        relief = np.full(self.relief_basis.shape[2], self.relief_sd**-2)
        rows = np.full(self.frame_count * _ROW_WAVES * 2, ROW_SD_PX**-2)
        return np.concatenate([[1e-9], centre, relief, rows])

    @cached_property
    def indices(self) -> IntArray:
        """Indices (pairs, m) of each pair's shared parameters: lens, relief, row motion of i, row motion of j."""
        first = 3 + self.relief_basis.shape[2]
        waves = np.arange(2 * _ROW_WAVES)
        rows = [first + 2 * _ROW_WAVES * self.pairs.frames[:, k, None] + waves for k in (0, 1)]
        common = np.broadcast_to(np.arange(first), (len(rows[0]), first))
        return np.concatenate([common, *rows], axis=1)

    def split(self, shared: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The relief's coefficients (functions,) and those of the row motion (frames, waves, 2), px."""
        count = self.relief_basis.shape[2]
        return shared[3 : 3 + count], shared[3 + count :].reshape(self.frame_count, _ROW_WAVES, 2)

    def map_to_j(self, state: _State) -> FloatArray:
        """Points of i mapped to j, normalised undistorted, (pairs, n, 2)."""
        heights, rows = self.split(state.shared)
        corrected = self.pairs.xy_i - self.row_basis[0] @ rows[self.pairs.frames[:, 0]]
        lens = self.family.lens(state.shared)
        undistorted = lens.undistort_points(corrected.reshape(-1, 2)).reshape(corrected.shape)
        relief = (self.relief_basis @ heights)[..., None] * self.baseline[:, None]
        return _apply_homographies(state.matrices, self.family.normalise(undistorted)) + relief

    def to_raw(self, shared: FloatArray, mapped: FloatArray) -> FloatArray:
        """Normalised undistorted points (pairs, n, 2) of j to raw px."""
        undistorted = self.family.denormalise(mapped).reshape(-1, 2)
        raw = self.family.lens(shared).distort_points(undistorted).reshape(mapped.shape)
        return np.asarray(raw + self.row_basis[1] @ self.split(shared)[1][self.pairs.frames[:, 1]])

    def residuals(self, state: _State) -> FloatArray:
        """(pairs, n, 2) raw px of j; NaN outside the lens's domain."""
        return np.asarray(self.pairs.xy_j - self.to_raw(state.shared, self.map_to_j(state)))


def _apply_homographies(matrices: FloatArray, xy: FloatArray) -> FloatArray:
    """Points (pairs, n, 2) mapped by (pairs, 3, 3)."""
    mapped = xy @ matrices[:, :, :2].transpose(0, 2, 1) + matrices[:, None, :, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(mapped[..., :2] / mapped[..., 2:])


def _zero_invalid(values: FloatArray) -> FloatArray:
    """Zero for values outside a lens's domain or beyond a horizon: they carry no information."""
    return np.where(np.isfinite(values), values, 0.0)


def _distances(residuals: FloatArray, valid: Mask) -> FloatArray:
    """(pairs, n) px; NaN where padded, very large where a point has no image."""
    distance = np.hypot(residuals[..., 0], residuals[..., 1])
    return np.where(valid, np.where(np.isfinite(distance), distance, _INVALID_RESIDUAL_PX), np.nan)


def _medians(residuals: FloatArray, valid: Mask) -> FloatArray:
    """Median residual of each pair (pairs,), px."""
    return np.asarray(np.nanmedian(_distances(residuals, valid), axis=1))


def _weights(residuals: FloatArray, valid: Mask) -> FloatArray:
    """Geman-McClure weights (pairs, n) over each pair's own variance, px^-2."""
    scale = np.maximum(_medians(residuals, valid)[:, None] / 1.1774, _MIN_SCALE_PX)
    return _zero_invalid(geman_mcclure_weights(_distances(residuals, valid), scale) / scale**2)


@dataclass(frozen=True)
class _ReducedEquations:
    """Normal equations with the homographies eliminated (Schur complement).

    For each pair: the normal matrix (pairs, m, m) and right-hand side (pairs, m) of its shared parameters, at
    ``indices`` (pairs, m) among all; ``own`` (pairs, 8) and ``coupling`` (pairs, 8, m) give the homographies by back
    substitution.
    """

    indices: IntArray
    normal: FloatArray
    right: FloatArray
    own: FloatArray
    coupling: FloatArray

    def assemble(self, problem: _Problem, pairs: Mask | None = None) -> tuple[FloatArray, FloatArray]:
        """Normal matrix (s, s), with the prior, and right-hand side (s,), of all pairs or those of a mask."""
        selected = slice(None) if pairs is None else pairs
        indices = self.indices[selected]
        normal, right = np.diag(problem.prior_precision), np.zeros(len(problem.prior_precision))
        np.add.at(normal, (indices[:, :, None], indices[:, None, :]), EFFECTIVE_SAMPLE_FRACTION * self.normal[selected])
        np.add.at(right, indices, EFFECTIVE_SAMPLE_FRACTION * self.right[selected])
        return normal, right

    def step(self, problem: _Problem, shared: FloatArray, pairs: Mask | None = None) -> FloatArray:
        """Gauss-Newton step (s,) of the shared parameters from all pairs or those of a mask."""
        normal, right = self.assemble(problem, pairs)
        return np.asarray(np.linalg.solve(normal, right - problem.prior_precision * shared))


def _linearise(problem: _Problem, state: _State) -> _ReducedEquations:
    residuals = problem.residuals(state)
    root = np.sqrt(_weights(residuals, problem.pairs.valid))[..., None, None]
    pairs = len(residuals)
    distortion = _distortion_jacobian(problem, state)
    own, shared = (
        _homography_jacobian(problem, state, distortion),
        _shared_jacobian(problem, state, residuals, distortion),
    )
    own, shared = (_zero_invalid(root * part).reshape(pairs, -1, part.shape[-1]) for part in (own, shared))
    weighted = _zero_invalid(root[..., 0] * residuals).reshape(pairs, -1, 1)
    normal = own.transpose(0, 2, 1) @ own
    normal += 1e-9 * (1.0 + np.trace(normal, axis1=1, axis2=2)[:, None, None]) * np.eye(8)
    both = np.concatenate([shared, weighted], axis=2)
    crossed = own.transpose(0, 2, 1) @ both
    solved = np.linalg.solve(normal, crossed)
    reduced = shared.transpose(0, 2, 1) @ both - crossed[:, :, :-1].transpose(0, 2, 1) @ solved
    return _ReducedEquations(
        problem.indices, reduced[:, :, :-1], reduced[:, :, -1], solved[:, :, -1], solved[:, :, :-1]
    )


def _homography_jacobian(problem: _Problem, state: _State, distortion: FloatArray) -> FloatArray:
    """(pairs, n, 2, 8): raw px with respect to the eight free elements of each pair's homography."""
    lens = problem.family.lens(state.shared)
    xy = problem.family.normalise(lens.undistort_points(problem.pairs.xy_i.reshape(-1, 2))).reshape(
        *problem.relief_basis.shape[:2], 2
    )
    ones = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=2)
    mapped = _apply_homographies(state.matrices, xy)
    over = ones / (ones @ state.matrices[:, 2, :, None])
    zero = np.zeros_like(over)
    x = np.concatenate([over, zero, -mapped[..., :1] * over[..., :2]], axis=2)
    y = np.concatenate([zero, over, -mapped[..., 1:] * over[..., :2]], axis=2)
    return np.asarray(distortion @ np.stack([x, y], axis=2))


def _distortion_jacobian(problem: _Problem, state: _State) -> FloatArray:
    """(pairs, n, 2, 2): raw px with respect to normalised px, of the distortion at each mapped point."""
    mapped = problem.map_to_j(state)
    columns = []
    for step in (np.array([_DIFFERENCE, 0.0]), np.array([0.0, _DIFFERENCE])):
        ahead, behind = problem.to_raw(state.shared, mapped + step), problem.to_raw(state.shared, mapped - step)
        columns.append((ahead - behind) / (2.0 * _DIFFERENCE))
    return np.stack(columns, axis=-1)


def _shared_jacobian(problem: _Problem, state: _State, residuals: FloatArray, distortion: FloatArray) -> FloatArray:
    """(pairs, n, 2, m): raw px with respect to a pair's shared parameters, see ``_Problem.indices``."""
    columns = []
    for k in range(3):
        shifted = state.shared.copy()
        shifted[k] += _DIFFERENCE
        columns.append((residuals - problem.residuals(replace(state, shared=shifted)))[..., None] / _DIFFERENCE)
    relief = distortion @ problem.baseline[:, None, :, None]
    # The row motion of a point of i moves that of j by the pair's rotation and scale, nearly the same everywhere.
    similarity = -state.matrices[:, None, :2, None, :2]
    of_i = similarity * problem.row_basis[0][:, :, None, :, None]
    of_j = np.eye(2)[:, None, :] * problem.row_basis[1][:, :, None, :, None]
    rows = [part.reshape(*residuals.shape, 2 * _ROW_WAVES) for part in (of_i, of_j)]
    return np.concatenate([*columns, relief * problem.relief_basis[:, :, None, :], *rows], axis=3)


def _estimate_homographies(pairs: FramePairs, family: ScaledLens, amount: float) -> FloatArray:
    """(pairs, 3, 3), normalised px, by MAGSAC under the lens of an amount; the identity where degenerate."""
    lens = family.lens(np.array([amount, 0.0, 0.0]))
    threshold = _START_THRESHOLD_PX / family.unit.half_diagonal_px
    matrices = []
    for xy_i, xy_j, valid in zip(pairs.xy_i, pairs.xy_j, pairs.valid, strict=True):
        source, target = (family.normalise(lens.undistort_points(xy[valid])) for xy in (xy_i, xy_j))
        matrix, _ = cv2.findHomography(source, target, cv2.USAC_MAGSAC, threshold, maxIters=2000, confidence=0.999)
        regular = (
            matrix is not None
            and abs(matrix[2, 2]) > _MIN_DETERMINANT
            and abs(np.linalg.det(matrix)) > _MIN_DETERMINANT
        )
        matrices.append(matrix / matrix[2, 2] if regular else np.eye(3))
    return np.array(matrices, dtype=np.float64)


def _build_problem(pairs: FramePairs, family: ScaledLens, matrices: FloatArray) -> _Problem:
    ground = _apply_homographies(_chain_homographies(pairs, matrices), family.normalise(pairs.xy_i))
    inside = ground[pairs.valid & np.isfinite(ground).all(axis=2)]
    low, high = np.percentile(inside, 1, axis=0), np.percentile(inside, 99, axis=0)
    spacing = _RELIEF_SPACING
    while np.prod(np.ceil((high - low) / spacing) + 1) > _MAX_RELIEF_FUNCTIONS:  # a long flight: wider functions
        spacing *= 1.1
    along = [_gaussian_basis(ground[..., k], float(low[k]), float(high[k]), spacing) for k in (0, 1)]
    basis = (along[0][..., :, None] * along[1][..., None, :]).reshape(*ground.shape[:2], -1)
    baseline = _apply_homographies(matrices, np.zeros((len(matrices), 1, 2)))[:, 0]
    return _Problem(pairs, family, _zero_invalid(basis), baseline)


def _gaussian_basis(positions: FloatArray, low: float, high: float, spacing: float) -> FloatArray:
    """(..., functions): Gaussians along one axis, evenly spaced over the range and a little beyond."""
    count = int(np.ceil((high - low) / spacing)) + 1
    nodes = 0.5 * (low + high) + spacing * (np.arange(count) - 0.5 * (count - 1))
    return np.asarray(np.exp(-0.5 * ((positions[..., None] - nodes) / spacing) ** 2))


def _chain_homographies(pairs: FramePairs, matrices: FloatArray) -> FloatArray:
    """(pairs, 3, 3) from each frame i to the frame of most pairs, along pairs of most points; NaN: not connected."""
    frames, size = pairs.frames, pairs.valid.sum(axis=1)
    to_root: dict[int, FloatArray] = {int(np.argmax(np.bincount(frames.ravel()))): np.eye(3)}
    while edges := [p for p, (i, j) in enumerate(frames.tolist()) if (i in to_root) != (j in to_root)]:
        best = max(edges, key=lambda p: (size[p], -p))
        i, j = frames[best].tolist()
        if j in to_root:
            to_root[i] = to_root[j] @ matrices[best]
        else:
            to_root[j] = to_root[i] @ np.linalg.inv(matrices[best])
    return np.array([to_root.get(i, np.full((3, 3), np.nan)) for i in frames[:, 0].tolist()])


def fit_multiview(pairs: FramePairs, family: ScaledLens, *, start: float | None, before: float) -> MultiViewFit:
    """Estimate the amount of distortion from frame pairs, with outliers among their points.

    ``start`` is the initial amount, None the best of a grid; the estimate is compared with the amount ``before``.
    """
    problem, state = min(
        (_fit_from_start(pairs, family, amount) for amount in (_START_AMOUNTS if start is None else (start,))),
        key=lambda fit: _mean_log_residual(fit[0].residuals(fit[1]), pairs.valid),
    )
    problem, state = _fit_relief_variance(problem, _iterate(problem, state, _MAX_STEPS))
    equations = _linearise(problem, state)
    residuals = problem.residuals(state)
    frames = np.unique(pairs.frames)
    without = [~(pairs.frames == frame).any(axis=1) for frame in frames]
    jackknife = np.array([state.shared + equations.step(problem, state.shared, kept) for kept in without])
    jackknife_variance = (len(frames) - 1) * float(np.var(jackknife[:, 0]))
    fit_px = float(_medians(residuals, pairs.valid).mean())
    weight = float(_weights(residuals, pairs.valid).sum())
    before_px, after_px = _cross_validate(problem, state, jackknife[:, :3], without, before)
    amount_sd = float(np.sqrt(jackknife_variance + _systematic_variance(problem, equations, weight, fit_px)))
    figures = (float(state.shared[0]), amount_sd, fit_px, before_px, after_px)
    return MultiViewFit(*(_round_for_determinism(value) for value in figures))


def _round_for_determinism(value: float) -> float:
    """Round to six digits: the last ones depend on the number of threads of the linear algebra library."""
    return float(f"{value:.6g}")


def _systematic_variance(problem: _Problem, equations: _ReducedEquations, weight: float, fit_px: float) -> float:
    """Variance of the amount that the jackknife over frames cannot show: prior-dominated relief, common residuals."""
    covariance_row = np.linalg.inv(equations.assemble(problem)[0])[0]
    from_priors = float(np.sum(covariance_row[1:] ** 2 * problem.prior_precision[1:]))
    # RMS residual caused by an amount of 1 with all else refitted
    sensitivity_px = np.sqrt(1.0 / (covariance_row[0] * EFFECTIVE_SAMPLE_FRACTION * weight))
    return from_priors + (SYSTEMATIC_FRACTION * fit_px / float(sensitivity_px)) ** 2


def _cross_validate(
    problem: _Problem, state: _State, lenses: FloatArray, without: Sequence[Mask], before: float
) -> tuple[float, float]:
    """Mean residual, px, of each frame's pairs with the lens before, and with the one (frames, 3) fitted without it."""
    figures = []
    for lens, kept in zip(lenses, without, strict=True):
        part, matrices = problem.select(~kept), state.matrices[~kept]
        figures.append(
            [_refit_homographies(part, row, matrices).mean() for row in (np.array([before, 0.0, 0.0]), lens)]
        )
    before_px, after_px = np.mean(figures, axis=0)
    return float(before_px), float(after_px)


def _fit_from_start(pairs: FramePairs, family: ScaledLens, amount: float) -> tuple[_Problem, _State]:
    """A few steps from one initial amount."""
    matrices = _estimate_homographies(pairs, family, amount)
    problem = _build_problem(pairs, family, matrices)
    shared = np.zeros(len(problem.prior_precision))
    shared[0] = amount
    return problem, _iterate(problem, _State(shared, matrices), _START_STEPS)


def _iterate(problem: _Problem, state: _State, steps: int) -> _State:
    """Gauss-Newton steps until the amount converges."""
    for _ in range(steps):
        equations = _linearise(problem, state)
        step = equations.step(problem, state.shared)
        step *= min(1.0, _MAX_STEP / max(abs(float(step[0])), 1e-12))
        change = equations.own - (equations.coupling @ step[equations.indices][..., None])[..., 0]
        state = state.move(step, change)
        if abs(float(step[0])) < _CONVERGED_STEP:
            break
    return state


def _fit_relief_variance(problem: _Problem, state: _State) -> tuple[_Problem, _State]:
    """Estimate the prior variance of the relief by expectation-maximisation; at least that of flat ground."""
    relief = slice(3, 3 + problem.relief_basis.shape[2])
    for _ in range(_RELIEF_ITERATIONS):
        normal = _linearise(problem, state).assemble(problem)[0]
        variance = np.mean(state.shared[relief] ** 2 + np.diag(np.linalg.inv(normal))[relief])
        problem = replace(problem, relief_sd=max(_RELIEF_SD, float(np.sqrt(variance))))
        if problem.relief_sd == _RELIEF_SD:
            break
        state = _iterate(problem, state, _RELIEF_STEPS)
    return problem, state


def _mean_log_residual(residuals: FloatArray, valid: Mask) -> float:
    """Mean over pairs of the logarithm of the median residual: no pair's outliers dominate."""
    return float(np.mean(np.log(np.maximum(_medians(residuals, valid), _MIN_SCALE_PX))))


def _refit_homographies(problem: _Problem, lens: FloatArray, matrices: FloatArray) -> FloatArray:
    """Median residual of each pair, raw px, with a fixed lens, a refitted homography and nothing else."""
    shared = np.zeros(len(problem.prior_precision))
    shared[:3] = lens
    state = _State(shared, matrices)
    for _ in range(_HOMOGRAPHY_STEPS):
        residuals = problem.residuals(state)
        weight = _weights(residuals, problem.pairs.valid)
        own = _zero_invalid(_homography_jacobian(problem, state, _distortion_jacobian(problem, state)))
        own = own.reshape(len(residuals), -1, 8)
        weighted = own * np.repeat(weight, 2, axis=1)[..., None]
        normal = weighted.transpose(0, 2, 1) @ own
        change = np.linalg.solve(
            normal + 1e-9 * (1.0 + np.trace(normal, axis1=1, axis2=2)[:, None, None]) * np.eye(8),
            weighted.transpose(0, 2, 1) @ _zero_invalid(residuals).reshape(len(residuals), -1, 1),
        )
        state = state.move(0.0, change[..., 0])
    return _medians(problem.residuals(state), problem.pairs.valid)
