"""Least squares fits of homography and polyprojective, and the paper's robust form: case deletion.

Paper: registration. Each round fits all points that are left, then drops the worst ``drop_fraction`` of them, until the
mean error is small. The paper minimises by Downhill Simplex (`fit_by_simplex`, the reference that tests compare with);
the same minimum is reached some 300 times faster by a linear fit and damped Gauss-Newton steps (`fit_polyprojective`).
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from schemas.arrays import FloatArray
from velfield.errors import Failure
from velfield.registration.transforms import PolyprojectiveTransform, as_points, normalisation_of

Model = Literal["polyprojective", "homography"]

FREE = {"homography": 8, "polyprojective": 17}
"""Free parameters of each model."""

_MARQUARDT_STEPS = 30
_LEAST_GAIN = 1e-4  # of the cost: a step that gains less is the last
_MAX_ROUNDS = 400


@dataclass(frozen=True, eq=False)
class CaseDeletion:
    """Result of `case_deletion`.

    Attributes
    ----------
    transform : the fitted map.
    kept : (n,) bool, the control points that were left.
    mean_error_px : their mean error.
    rounds : rounds of deletion.
    """

    transform: PolyprojectiveTransform
    kept: NDArray[np.bool_]
    mean_error_px: float
    rounds: int


def monomials(xy: FloatArray, norm: FloatArray) -> FloatArray:
    """(n, 6): 1, x, y, x^2, xy, y^2 of the normalised coordinates of points (n, 2)."""
    x, y = (xy[:, 0] - norm[0]) * norm[2], (xy[:, 1] - norm[1]) * norm[2]
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def _columns(model: Model) -> NDArray[np.int64]:
    """Which of the seventeen parameters (a, b: 6 each; c without its leading 1: 5) the model frees."""
    if model == "polyprojective":
        return np.arange(17)
    return np.array([0, 1, 2, 6, 7, 8, 12, 13])


def _packed(coefficients: FloatArray) -> FloatArray:
    return np.concatenate([coefficients[0], coefficients[1], coefficients[2, 1:]])


def _unpacked(parameters: FloatArray) -> FloatArray:
    return np.stack([parameters[:6], parameters[6:12], np.concatenate([[1.0], parameters[12:]])])


def _design(m: FloatArray, target: FloatArray, denominator: FloatArray) -> FloatArray:
    """(2n, 17) derivative of the mapped points (first all x, then all y) by the parameters."""
    zero = np.zeros_like(m)
    over = m / denominator[:, None]
    x = np.concatenate([over, zero, -target[:, :1] * over[:, 1:]], axis=1)
    y = np.concatenate([zero, over, -target[:, 1:] * over[:, 1:]], axis=1)
    return np.concatenate([x, y])


def fit_polyprojective(
    source: FloatArray,
    target: FloatArray,
    *,
    model: Model = "polyprojective",
    weights: FloatArray | None = None,
) -> PolyprojectiveTransform | Failure:
    """Weighted least squares of |target - map(source)|: linear homography, then damped Gauss-Newton.

    Parameters
    ----------
    source, target
        Points (n, 2), px.
    model
        ``homography`` leaves the second-order terms zero.
    weights
        (n,) non-negative; none: all one.

    Returns
    -------
    The map, or a failure: too few points, or points that leave it undetermined.
    """
    source, target = as_points(source), as_points(target)
    needed = FREE[model] // 2 + 1
    count = len(source) if weights is None else int(np.count_nonzero(weights))
    if count < needed:
        return Failure(f"{count} control points, a {model} needs {needed}")
    source_norm, target_norm = normalisation_of(source), normalisation_of(target)
    m = monomials(source, source_norm)
    wanted = (target - target_norm[:2]) * target_norm[2]
    root = np.ones(len(source)) if weights is None else np.sqrt(weights)
    parameters = _linear_homography(m, wanted, root)
    settled = _descend(parameters, m, wanted, root, _columns(model))
    if settled is None:
        return Failure(f"the {model} folds over the control points")
    if not np.isfinite(settled).all():
        return Failure(f"the {model} is not determined by {count} control points")
    return PolyprojectiveTransform(_unpacked(settled), source_norm, target_norm)


def _linear_homography(m: FloatArray, wanted: FloatArray, root: FloatArray) -> FloatArray:
    """The seventeen parameters of the homography of least algebraic error: where `_descend` starts."""
    columns = _columns("homography")
    root2 = np.concatenate([root, root])
    design = _design(m, wanted, np.ones(len(m)))[:, columns] * root2[:, None]
    parameters = np.zeros(17)
    parameters[columns] = _least_squares(design, wanted.T.ravel() * root2)
    return parameters


def _descend(
    parameters: FloatArray, m: FloatArray, wanted: FloatArray, root: FloatArray, columns: NDArray[np.int64]
) -> FloatArray | None:
    """Gauss-Newton with Marquardt's damping from a homography; None where that homography folds already.

    A homography times any linear function, over the same function, is a polyprojective too: about a homography two
    directions of the parameters are free, and an undamped step along them, or a linear fit of all seventeen, lets noise
    alone drive the denominator through zero. Damped, they stay where they cost nothing.
    """
    root2 = np.concatenate([root, root])
    state = _misses(parameters, m, wanted, root2)
    if state is None:
        return None
    miss, mapped, denominator = state
    damping, cost = 1e-3, float(miss @ miss)
    for _ in range(_MARQUARDT_STEPS):
        design = _design(m, mapped, denominator)[:, columns] * root2[:, None]
        normal, gradient = design.T @ design, design.T @ miss
        spread = np.trace(normal) / len(normal)
        while damping < 1e3:
            trial = parameters.copy()
            trial[columns] += np.linalg.solve(normal + damping * spread * np.eye(len(normal)), gradient)
            state = _misses(trial, m, wanted, root2)
            if state is not None and float(state[0] @ state[0]) <= cost:
                break
            damping *= 10.0
        if state is None or damping >= 1e3:
            break
        gained = cost - float(state[0] @ state[0])
        parameters, (miss, mapped, denominator) = trial, state
        cost, damping = cost - gained, max(0.1 * damping, 1e-12)
        if gained <= _LEAST_GAIN * cost + 1e-24 * len(m):
            break
    return parameters


def _misses(
    parameters: FloatArray, m: FloatArray, wanted: FloatArray, root2: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Weighted misses (2n,), mapped points (n, 2), denominators (n,); None where a denominator is not positive."""
    c = _unpacked(parameters)
    denominator = m @ c[2]
    if not denominator.min() > 1e-6:
        return None
    mapped = (m @ c[:2].T) / denominator[:, None]
    return (wanted - mapped).T.ravel() * root2, mapped, denominator


def _least_squares(design: FloatArray, wanted: FloatArray) -> FloatArray:
    """Minimum-norm least squares by the normal equations: the coordinates are normalised, so they are tame."""
    normal = design.T @ design
    normal[np.diag_indices_from(normal)] += 1e-12 * np.trace(normal) / len(normal)
    return np.asarray(np.linalg.solve(normal, design.T @ wanted))


def fit_by_simplex(
    source: FloatArray, target: FloatArray, *, start: PolyprojectiveTransform, model: Model = "polyprojective"
) -> PolyprojectiveTransform:
    """The paper's minimiser, Downhill Simplex, on the same sum of squares, from ``start``; slow, for comparison."""
    columns = _columns(model)
    fixed = _packed(start.coefficients)

    def squares(free: FloatArray) -> float:
        parameters = fixed.copy()
        parameters[columns] = free
        mapped = PolyprojectiveTransform(_unpacked(parameters), start.source, start.target)(source)
        return float(np.nansum((mapped - target) ** 2)) if np.isfinite(mapped).all() else 1e30

    best = fixed[columns]
    for _ in range(8):  # a simplex collapses on a valley's floor: begin again from where it stopped
        found = minimize(
            squares, best, method="Nelder-Mead", options={"maxiter": 20_000, "maxfev": 20_000, "adaptive": True}
        )
        best = found.x
    parameters = fixed.copy()
    parameters[columns] = best
    return PolyprojectiveTransform(_unpacked(parameters), start.source, start.target)


def case_deletion(
    source: FloatArray,
    target: FloatArray,
    *,
    model: Model = "polyprojective",
    drop_fraction: float = 0.05,
    max_mean_error_px: float = 2.0,
    min_control_points: int = 40,
) -> CaseDeletion | Failure:
    """Fit, drop the worst share, fit again, until the mean error is below the limit.

    Paper: registration, 5 % a round until the mean error is below 2 px.

    Parameters
    ----------
    source, target
        Control points (n, 2), px.
    drop_fraction
        Share of the points left that a round drops, at least one.
    max_mean_error_px
        The mean error at which deletion ends.
    min_control_points
        Fewer left than this is a failure.
    """
    source, target = as_points(source), as_points(target)
    kept: NDArray[np.bool_] = np.asarray(np.isfinite(source).all(axis=1) & np.isfinite(target).all(axis=1))
    for rounds in range(_MAX_ROUNDS):
        left = int(kept.sum())
        if left < min_control_points:
            return Failure(f"{left} control points left of {len(source)}, {min_control_points} needed")
        transform = fit_polyprojective(source[kept], target[kept], model=model)
        if isinstance(transform, Failure):
            return transform
        error = np.linalg.norm(transform(source[kept]) - target[kept], axis=1)
        error = np.where(np.isfinite(error), error, np.inf)
        mean = float(error.mean())
        if mean <= max_mean_error_px:
            return CaseDeletion(transform, kept, mean, rounds)
        worst = np.argsort(error)[left - max(1, round(drop_fraction * left)) :]
        kept[np.flatnonzero(kept)[worst]] = False
    return Failure(f"mean error still above {max_mean_error_px} px after {_MAX_ROUNDS} rounds")
