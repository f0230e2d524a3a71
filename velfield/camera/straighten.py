"""The lens that makes lines straight, by robust least squares over the points' distances from their lines.

Gauss-Newton with Marquardt's damping over the lens's few parameters, each line's place solved for inside. A line that
no lens straightens (a kerb that bends) is weighed down as a whole, by its own RMS against the usual one.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from schemas.arrays import FloatArray
from velfield.camera.lens import DivisionLens, HarrisLens, Lens, PolynomialLens
from velfield.camera.lines import LineSet, line_residuals, line_rms

AnyLens = HarrisLens | DivisionLens | PolynomialLens

CENTRE_SD = 0.03
"""How far from the picture's middle, in half-diagonals, a lens's centre usually is: said where lines say little."""
CENTRE_DOUBT = 6.0
"""That knowledge is weighed against what the lines say of the centre, taken to err by so much more than they say: bent
kerbs do not average out. On 20 plane flights and 16 cities, factors of 3 and 12 were worse."""
_ROUNDS = 25
_LEAST_GAIN = 1e-5  # of the cost: a round that gains less is the last
_ROBUST_FACTOR = 2.5
_LEAST_SCALE_PX = 0.05


@dataclass(frozen=True)
class LensFamily:
    """A model with parameters (shape terms..., centre x, centre y), the centre in half-diagonals from the middle."""

    name: str
    terms: int
    middle: tuple[float, float]
    half_diagonal_px: float

    def lens(self, parameters: FloatArray) -> AnyLens:
        """The lens of a parameter vector (terms + 2,)."""
        x = self.middle[0] + float(parameters[-2]) * self.half_diagonal_px
        y = self.middle[1] + float(parameters[-1]) * self.half_diagonal_px
        if self.name == "harris":
            return HarrisLens(float(parameters[0]), x, y, self.half_diagonal_px)
        if self.name == "division":
            return DivisionLens(float(parameters[0]), x, y, self.half_diagonal_px)
        return PolynomialLens(tuple(float(term) for term in parameters[:-2]), x, y, self.half_diagonal_px)


@dataclass(frozen=True)
class StraightFit:
    """A fitted lens: ``parameters`` of its family, their ``covariance``, RMS residual, the lines' ``weights``."""

    family: LensFamily
    parameters: FloatArray
    covariance: FloatArray
    residual_px: float
    weights: FloatArray

    @property
    def lens(self) -> AnyLens:
        """The fitted lens."""
        return self.family.lens(self.parameters)


def line_weights(rms: FloatArray, sizes: FloatArray) -> FloatArray:
    """Weight of each line by its RMS residual, (lines,) in (0, 1]: Geman-McClure about the usual line."""
    order = np.argsort(rms)
    half = np.searchsorted(np.cumsum(sizes[order]), 0.5 * sizes.sum())
    return robust_weights(rms, max(float(rms[order[min(half, rms.size - 1)]]), _LEAST_SCALE_PX))


def robust_weights(residuals: FloatArray, scale: float | FloatArray) -> FloatArray:
    """Geman-McClure weights in (0, 1] of residuals whose usual size is ``scale``, both of any one unit."""
    return np.asarray(1.0 / (1.0 + (residuals / (_ROBUST_FACTOR * scale)) ** 2) ** 2)


def fit_lens(lines: LineSet, family: LensFamily, start: FloatArray) -> StraightFit:
    """Fit a model's parameters to straight lines.

    Parameters
    ----------
    lines
        Points of lines.
    family
        The model.
    start
        Parameters to start from, (terms + 2,).

    Returns
    -------
    StraightFit
        Its covariance is the sandwich estimate with lines as the independent units.
    """
    parameters, damping = _inside_domain(lines, family, start), 1e-3
    sizes = np.bincount(lines.line, minlength=lines.count).astype(np.float64)
    residuals = line_residuals(lines, family.lens(parameters))
    for _ in range(_ROUNDS):
        weights = line_weights(line_rms(lines, residuals), sizes)
        jacobian = _jacobian(lines, family, parameters, residuals)
        point_weight = weights[lines.line]
        information, by_line = _information(lines, jacobian, residuals, point_weight)
        prior = _prior(information, by_line)
        normal = information + np.diag(prior)
        gradient = (jacobian * point_weight[:, None]).T @ residuals + prior * parameters
        cost = _cost(residuals, point_weight, prior, parameters)
        trial = partial(_trial, lines, family, point_weight=point_weight, prior=prior)
        step, gained, damping = _damped_step(trial, parameters, normal, gradient, cost, damping)
        parameters = parameters + step
        residuals = line_residuals(lines, family.lens(parameters))
        if gained < _LEAST_GAIN * cost:
            break
    return _finished(lines, family, parameters, residuals, sizes)


def _jacobian(lines: LineSet, family: LensFamily, parameters: FloatArray, residuals: FloatArray) -> FloatArray:
    """Forward differences (points, parameters); the lines are fitted anew at each."""
    columns = []
    for k in range(parameters.size):
        shifted = parameters.copy()
        shifted[k] += 1e-5
        columns.append((line_residuals(lines, family.lens(shifted)) - residuals) / 1e-5)
    return np.nan_to_num(np.stack(columns, axis=1))


def _information(
    lines: LineSet, jacobian: FloatArray, residuals: FloatArray, point_weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """What the points say of the parameters, in units of the cost, and the spread of what the lines do, both (p, p)."""
    scores = jacobian * (point_weight * residuals)[:, None]
    by_line = np.stack([np.bincount(lines.line, weights=column, minlength=lines.count) for column in scores.T], axis=1)
    return (jacobian * point_weight[:, None]).T @ jacobian, np.asarray(by_line.T @ by_line, dtype=np.float64)


def _prior(information: FloatArray, by_line: FloatArray) -> FloatArray:
    """Diagonal of the prior on the centre, in units of the cost.

    A point's say is worth its variance as the lines spread, not as points do: those of a line err together.
    """
    diagonal = np.full(len(information), 1e-9)
    bread = np.linalg.inv(information + np.diag(diagonal))
    variance = np.diag(bread @ by_line @ bread)[-2:] / np.diag(bread)[-2:]
    diagonal[-2:] = np.maximum(variance, _LEAST_SCALE_PX**2) * (CENTRE_DOUBT / CENTRE_SD) ** 2
    return diagonal


def _cost(residuals: FloatArray, point_weight: FloatArray, prior: FloatArray, parameters: FloatArray) -> float:
    if not np.all(np.isfinite(residuals)):
        return float("inf")
    return float(np.sum(point_weight * residuals**2) + np.sum(prior * parameters**2))


def _trial(
    lines: LineSet, family: LensFamily, parameters: FloatArray, *, point_weight: FloatArray, prior: FloatArray
) -> float:
    return _cost(line_residuals(lines, family.lens(parameters)), point_weight, prior, parameters)


def _damped_step(
    trial: Callable[[FloatArray], float],
    parameters: FloatArray,
    normal: FloatArray,
    gradient: FloatArray,
    cost: float,
    damping: float,
) -> tuple[FloatArray, float, float]:
    """The first damped step that lowers the cost, by how much it does, and the damping after it."""
    for _ in range(8):
        step = np.asarray(-np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient), dtype=np.float64)
        reached = trial(parameters + step)
        if reached < cost:
            return step, cost - reached, max(damping / 10.0, 1e-9)
        damping *= 10.0
    return np.zeros_like(parameters), 0.0, damping


def _inside_domain(lines: LineSet, family: LensFamily, start: FloatArray) -> FloatArray:
    """The start, drawn towards the pin-hole until every point is inside the lens's domain."""
    parameters = np.array(start, dtype=np.float64)
    while not np.all(np.isfinite(line_residuals(lines, family.lens(parameters)))):
        parameters[: family.terms] *= 0.97
    return parameters


def _finished(
    lines: LineSet, family: LensFamily, parameters: FloatArray, residuals: FloatArray, sizes: FloatArray
) -> StraightFit:
    weights = line_weights(line_rms(lines, residuals), sizes)
    point_weight = weights[lines.line]
    jacobian = _jacobian(lines, family, parameters, residuals)
    information, by_line = _information(lines, jacobian, residuals, point_weight)
    bread = np.linalg.inv(information + np.diag(_prior(information, by_line)))
    return StraightFit(family, parameters, bread @ by_line @ bread, usual_residual(residuals, point_weight), weights)


def usual_residual(residuals: FloatArray, point_weight: FloatArray) -> float:
    """Weighted RMS distance of points (n,) from their lines, raw px."""
    return float(np.sqrt(np.sum(point_weight * residuals**2) / np.sum(point_weight)))


def heldout_rms(
    lines: LineSet, families: Sequence[tuple[LensFamily, FloatArray]], *, folds: int, seed: int
) -> FloatArray:
    """RMS of each line left out of the fit, (models, lines) px: every model sees the same folds."""
    fold = np.random.default_rng(seed).permutation(lines.count) % folds
    rms = np.zeros((len(families), lines.count))
    for part in range(folds):
        kept, left_out = lines.only(fold != part), lines.only(fold == part)
        for number, (family, start) in enumerate(families):
            lens: Lens = fit_lens(kept, family, start).lens if family.terms else family.lens(start)
            rms[number, fold == part] = line_rms(left_out, line_residuals(left_out, lens))
    return rms
