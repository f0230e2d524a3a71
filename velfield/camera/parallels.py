"""What parallels of the ground say of a lens, by their directions where straightness has their bows alone.

Kerbs, lanes and roofs of a quarter run along few directions. Lines that are parallel on flat ground meet, undistorted,
in one vanishing point of their frame; a lens turns them against each other by their place in the picture. A line of 60
px under a lens of a = 0.01 bows by some thousandths of a pixel, which nobody sees, but stands at 0.1 degrees to its
neighbours. How parallel a family is comes out of its own scatter, so that crooked quarters say little.

This goes beyond the paper, whose entropy of the lines' directions has the same root.
"""

from dataclasses import dataclass, replace

import numpy as np

from schemas.arrays import FloatArray, IntArray
from velfield.camera.lines import LineSet, chords, fitted_lines, line_residuals
from velfield.camera.straighten import StraightFit, robust_weights, usual_residual

NEAR_RAD = 0.026
"""Largest angle between a line and the way to its vanishing point, 1.5 degrees."""
FEWEST = 10
"""Lines of a family: fewer meet near a point by chance."""
HEARD = 0.1
"""Share of what parallels say that counts in the deviations: both sides of a street are crooked together, and frames
show the same streets. On 50 simulated flights errors are two of these deviations, RMS, as with straightness alone."""
LEAST_DOUBT = 0.003
"""Where straightness is surer of the distortion than this share of it, as with boards held before a camera, nothing is
parallel enough to say more: GoPro pictures of a board were 0.25 px the worse for it."""

_TRIED_PAIRS = 3000
_LONG_PX = 200.0  # a longer line's direction is no better known
_LEAST_SCATTER_RAD = 5e-4
_ROUNDS = 6
_NUDGE = 1e-5


@dataclass(frozen=True)
class _Family:
    """Numbers of its lines (n,) and its vanishing point, a unit 3-vector of half-diagonals about the middle."""

    lines: IntArray
    point: FloatArray

    def off(self, placed: "_Placed", point: FloatArray | None = None) -> FloatArray:
        """Angle, rad, of each line (n,) to the way to the family's point, or to one tried in its place."""
        return _angles(placed, self.lines, self.point if point is None else point)


@dataclass(frozen=True)
class _Placed:
    """Undistorted lines: middles (lines, 2), in half-diagonals about the picture's middle, and unit directions."""

    middle: FloatArray
    direction: FloatArray


@dataclass(frozen=True)
class _Part:
    """A family's say, linearised, its vanishing point solved for: information (p, p) and pull (p,) of the lens's
    parameters; ``own`` (2,) and ``coupling`` (2, p) move the point along ``basis`` (2, 3) after a step of theirs."""

    family: _Family
    information: FloatArray
    pull: FloatArray
    own: FloatArray
    coupling: FloatArray
    basis: FloatArray

    def moved(self, step: FloatArray) -> _Family:
        """The family, its point where it belongs after a step (p,) of the parameters."""
        point = self.family.point + (self.own - self.coupling @ step) @ self.basis
        return replace(self.family, point=point / np.linalg.norm(point))


def refine_by_parallels(fit: StraightFit, lines: LineSet, seed: int = 0) -> StraightFit:
    """The fit with what families of parallels say of its parameters joined to what straightness said.

    Parameters
    ----------
    fit
        A lens by straightness; its covariance is how far it is trusted.
    lines
        The lines it was fitted to.
    seed
        Seed of the pairs of lines tried as vanishing points.

    Returns
    -------
    StraightFit
        The same fit where no frame has a family, where straightness is surer than parallels can be, and where the
        model ends within the picture.
    """
    if float(np.sqrt(fit.covariance[0, 0])) < LEAST_DOUBT * abs(float(fit.parameters[0])):
        return fit
    families = _families(lines, _placed(lines, fit, fit.parameters), seed)
    if not families:
        return fit
    known = np.linalg.inv(fit.covariance)
    parameters, said = fit.parameters, np.zeros_like(known)
    for _ in range(_ROUNDS):
        parts = _parts(lines, fit, parameters, families)
        said = np.sum([part.information for part in parts], axis=0)
        pull = known @ (fit.parameters - parameters) + sum(part.pull for part in parts)
        step = np.linalg.solve(known + said, pull)
        if not np.all(np.isfinite(fit.family.lens(parameters + step).undistort_points(lines.xy))):
            return fit  # its domain ends within the picture: no model to be refined
        parameters = parameters + step
        families = [part.moved(step) for part in parts]
    residuals = line_residuals(lines, fit.family.lens(parameters))
    return replace(
        fit,
        parameters=parameters,
        covariance=np.asarray(np.linalg.inv(known + HEARD * said), np.float64),
        residual_px=usual_residual(residuals, fit.weights[lines.line]),
    )


def _placed(lines: LineSet, fit: StraightFit, parameters: FloatArray) -> _Placed:
    xy = fit.family.lens(parameters).undistort_points(lines.xy)
    middle, direction = fitted_lines(xy, lines.line, lines.count)
    return _Placed((middle - fit.family.middle) / fit.family.half_diagonal_px, direction)


def _angles(placed: _Placed, chosen: IntArray, points: FloatArray) -> FloatArray:
    """Angle, rad in (-pi/2, pi/2], of chosen lines (n,) to the way to each of the points (..., 3), (..., n)."""
    direction = placed.direction[chosen]
    way = points[..., None, :2] - points[..., None, 2:] * placed.middle[chosen]
    along = np.sum(way * direction, axis=-1)
    across = way[..., 1] * direction[:, 0] - way[..., 0] * direction[:, 1]
    # A line has no sign: a way against its direction is a way along it.
    return np.asarray(np.arctan2(np.where(along < 0, -across, across), np.abs(along)))


def _families(lines: LineSet, placed: _Placed, seed: int) -> list[_Family]:
    """Families of each frame: of random pairs of lines, the one whose meeting point most lines run to, and again."""
    weight = np.minimum(chords(lines), _LONG_PX)
    random = np.random.default_rng(seed)
    found = []
    for frame in np.unique(lines.frame):
        free = np.flatnonzero(lines.frame == frame)
        while free.size >= FEWEST:
            points = _meeting_points(placed, random.choice(free, (2, _TRIED_PAIRS)))
            off = np.abs(_angles(placed, free, points))
            best = int(np.argmax(np.maximum(1.0 - off / NEAR_RAD, 0.0) @ weight[free]))
            near = off[best] < NEAR_RAD
            if near.sum() < FEWEST:
                break
            found.append(_Family(free[near], points[best]))
            free = free[off[best] > 2.0 * NEAR_RAD]  # what is between belongs to neither
    return found


def _meeting_points(placed: _Placed, pairs: IntArray) -> FloatArray:
    """Where the lines of pairs (2, n) meet: unit vectors (m, 3)."""
    (mx, my), (dx, dy) = placed.middle.T, placed.direction.T
    through = np.stack([dy, -dx, dx * my - dy * mx], axis=1)
    points = np.cross(through[pairs[0]], through[pairs[1]])
    size = np.linalg.norm(points, axis=1)
    apart = size > 1e-9  # a line meets itself everywhere
    return np.asarray(points[apart] / size[apart, None])


def _parts(lines: LineSet, fit: StraightFit, parameters: FloatArray, families: list[_Family]) -> list[_Part]:
    here = _placed(lines, fit, parameters)
    nudges = _NUDGE * np.eye(parameters.size)
    nudged = [_placed(lines, fit, parameters + nudge) for nudge in nudges]
    return [_part(family, here, nudged) for family in families]


def _part(family: _Family, here: _Placed, nudged: list[_Placed]) -> _Part:
    off = family.off(here)
    scale = max(1.4826 * float(np.median(np.abs(off))), _LEAST_SCATTER_RAD)
    weight = robust_weights(off, scale) / scale**2
    basis = np.linalg.svd(family.point[None])[2][1:]
    shared = np.stack([(family.off(placed) - off) / _NUDGE for placed in nudged], axis=1)
    own = np.stack([(family.off(here, family.point + _NUDGE * row) - off) / _NUDGE for row in basis], axis=1)
    normal = (own * weight[:, None]).T @ own + 1e-9 * np.eye(2)
    solved = np.linalg.solve(normal, (own * weight[:, None]).T @ np.column_stack([shared, off]))
    left = (shared - own @ solved[:, :-1]) * weight[:, None]
    own_step, coupling = np.asarray(-solved[:, -1], np.float64), np.asarray(solved[:, :-1], np.float64)
    return _Part(family, left.T @ shared, -left.T @ off, own_step, coupling, basis)
