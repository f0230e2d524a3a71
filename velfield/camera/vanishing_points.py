"""Refinement of the lens by vanishing points: parallel lines of the ground must meet in one point of the frame.

Kerbs, lanes and roofs of a quarter have few directions. Undistorted, the images of lines that are parallel on flat
ground meet in a vanishing point; a lens rotates them relative to each other, depending on their position in the image.
A line of 60 px under a lens of a = 0.01 is bent by a few thousandths of a pixel, which cannot be measured, but rotated
by 0.1 degrees relative to its neighbours. Each family of lines is weighted by its own scatter about its vanishing
point, so that irregular street grids count little.

This extends the paper, whose entropy of line directions uses the same cue.
"""

from dataclasses import dataclass, replace

import numpy as np

from schemas.arrays import FloatArray, IntArray
from velfield.camera.lines import LineSet, chord_lengths, fit_lines, line_residuals
from velfield.camera.straighten import PlumbLineFit, geman_mcclure_weights, weighted_rms

MAX_ANGLE_RAD = 0.026
"""Largest angle between a line of a family and the direction to its vanishing point, 1.5 degrees."""
MIN_FAMILY_LINES = 10
"""Smallest number of lines of a family: fewer pass near one point by chance."""
EFFECTIVE_SAMPLE_FRACTION = 0.1
"""Independent lines over lines, for the covariance: both sides of a street deviate together, and frames show the same
streets. On 50 simulated flights the errors are two of these standard deviations, RMS, as by straightness alone."""
MIN_RELATIVE_SD = 0.003
"""If the plumb line knows the distortion to this fraction, as with calibration boards, no parallels are exact enough to
improve it: GoPro images of a board were 0.25 px worse for it."""

_TRIED_PAIRS = 3000
_MAX_LENGTH_PX = 200.0  # a longer line's direction is not more accurate
_MIN_SCATTER_RAD = 5e-4
_ITERATIONS = 6
_DIFFERENCE = 1e-5


@dataclass(frozen=True)
class _Family:
    """Indices of its lines (n,) and its vanishing point, a homogeneous unit vector (3,) in half-diagonals."""

    lines: IntArray
    point: FloatArray

    def angles(self, undistorted: "_UndistortedLines", point: FloatArray | None = None) -> FloatArray:
        """Angle, rad, between each line (n,) and the direction to the vanishing point, or to a trial point."""
        return _angles(undistorted, self.lines, self.point if point is None else point)


@dataclass(frozen=True)
class _UndistortedLines:
    """Midpoints (lines, 2), in half-diagonals about the image centre, and unit directions (lines, 2)."""

    midpoint: FloatArray
    direction: FloatArray


@dataclass(frozen=True)
class _FamilyEquations:
    """Normal equations of a family with its vanishing point eliminated (Schur complement).

    ``normal`` (p, p) and ``right`` (p,) of the lens's parameters; ``own`` (2,) and ``coupling`` (2, p) give the step of
    the point along ``basis`` (2, 3) by back substitution.
    """

    family: _Family
    normal: FloatArray
    right: FloatArray
    own: FloatArray
    coupling: FloatArray
    basis: FloatArray

    def update(self, step: FloatArray) -> _Family:
        """The family with its vanishing point after a step (p,) of the parameters."""
        point = self.family.point + (self.own - self.coupling @ step) @ self.basis
        return replace(self.family, point=point / np.linalg.norm(point))


def refine_by_vanishing_points(fit: PlumbLineFit, lines: LineSet) -> PlumbLineFit:
    """Combine a plumb-line fit, as a Gaussian prior, with the vanishing points of families of parallel lines.

    The fit is unchanged if no frame has a family, if the plumb line is more accurate than parallels can be, or if the
    model's domain would end within the image.
    """
    if float(np.sqrt(fit.covariance[0, 0])) < MIN_RELATIVE_SD * abs(float(fit.parameters[0])):
        return fit
    families = _find_families(lines, _undistort_lines(lines, fit, fit.parameters))
    if not families:
        return fit
    prior = np.linalg.inv(fit.covariance)
    parameters, information = fit.parameters, np.zeros_like(prior)
    shifts = np.vstack([np.zeros(parameters.size), _DIFFERENCE * np.eye(parameters.size)])
    for _ in range(_ITERATIONS):
        current, *shifted = (_undistort_lines(lines, fit, parameters + shift) for shift in shifts)
        equations = [_linearise(family, current, shifted) for family in families]
        information = np.sum([part.normal for part in equations], axis=0)
        right = prior @ (fit.parameters - parameters) + sum(part.right for part in equations)
        step = np.linalg.solve(prior + information, right)
        if not np.all(np.isfinite(fit.family.lens(parameters + step).undistort_points(lines.xy))):
            return fit  # the model's domain would end within the image
        parameters = parameters + step
        families = [part.update(step) for part in equations]
    residuals = line_residuals(lines, fit.family.lens(parameters))
    return replace(
        fit,
        parameters=parameters,
        covariance=np.asarray(np.linalg.inv(prior + EFFECTIVE_SAMPLE_FRACTION * information), np.float64),
        residual_px=weighted_rms(residuals, fit.weights[lines.line]),
    )


def _undistort_lines(lines: LineSet, fit: PlumbLineFit, parameters: FloatArray) -> _UndistortedLines:
    xy = fit.family.lens(parameters).undistort_points(lines.xy)
    midpoint, direction = fit_lines(xy, lines.line, lines.count)
    return _UndistortedLines((midpoint - fit.family.middle) / fit.family.half_diagonal_px, direction)


def _angles(undistorted: _UndistortedLines, lines: IntArray, points: FloatArray) -> FloatArray:
    """Angle (..., n), rad in (-pi/2, pi/2], of lines (n,) to the direction to each of the points (..., 3)."""
    direction = undistorted.direction[lines]
    to_point = points[..., None, :2] - points[..., None, 2:] * undistorted.midpoint[lines]
    along = np.sum(to_point * direction, axis=-1)
    across = to_point[..., 1] * direction[:, 0] - to_point[..., 0] * direction[:, 1]
    # Lines have no sign: reverse directions that point away.
    return np.asarray(np.arctan2(np.where(along < 0, -across, across), np.abs(along)))


def _find_families(lines: LineSet, undistorted: _UndistortedLines) -> list[_Family]:
    """Sequential RANSAC for vanishing points, per frame: intersections of random pairs of lines, scored by length."""
    weight = np.minimum(chord_lengths(lines), _MAX_LENGTH_PX)
    random = np.random.default_rng(0)
    families = []
    for frame in np.unique(lines.frame):
        free = np.flatnonzero(lines.frame == frame)
        while free.size >= MIN_FAMILY_LINES:
            points = _intersections(undistorted, random.choice(free, (2, _TRIED_PAIRS)))
            angles = np.abs(_angles(undistorted, free, points))
            best = int(np.argmax(np.maximum(1.0 - angles / MAX_ANGLE_RAD, 0.0) @ weight[free]))
            near = angles[best] < MAX_ANGLE_RAD
            if near.sum() < MIN_FAMILY_LINES:
                break
            families.append(_Family(free[near], points[best]))
            free = free[angles[best] > 2.0 * MAX_ANGLE_RAD]  # lines between one and two limits belong to no family
    return families


def _intersections(undistorted: _UndistortedLines, pairs: IntArray) -> FloatArray:
    """Intersections of pairs of lines (2, n): homogeneous unit vectors (m, 3)."""
    (mx, my), (dx, dy) = undistorted.midpoint.T, undistorted.direction.T
    homogeneous = np.stack([dy, -dx, dx * my - dy * mx], axis=1)
    points = np.cross(homogeneous[pairs[0]], homogeneous[pairs[1]])
    size = np.linalg.norm(points, axis=1)
    distinct = size > 1e-9  # a line intersects itself everywhere
    return np.asarray(points[distinct] / size[distinct, None])


def _linearise(family: _Family, current: _UndistortedLines, shifted: list[_UndistortedLines]) -> _FamilyEquations:
    angles = family.angles(current)
    scale = max(1.4826 * float(np.median(np.abs(angles))), _MIN_SCATTER_RAD)
    weight = geman_mcclure_weights(angles, scale) / scale**2
    basis = np.linalg.svd(family.point[None])[2][1:]
    shared = np.stack([(family.angles(lines) - angles) / _DIFFERENCE for lines in shifted], axis=1)
    own = np.stack(
        [(family.angles(current, family.point + _DIFFERENCE * row) - angles) / _DIFFERENCE for row in basis], axis=1
    )
    normal = (own * weight[:, None]).T @ own + 1e-9 * np.eye(2)
    solved = np.linalg.solve(normal, (own * weight[:, None]).T @ np.column_stack([shared, angles]))
    reduced = (shared - own @ solved[:, :-1]) * weight[:, None]
    own_step, coupling = np.asarray(-solved[:, -1], np.float64), np.asarray(solved[:, :-1], np.float64)
    return _FamilyEquations(family, reduced.T @ shared, -reduced.T @ angles, own_step, coupling, basis)
