"""The lens by a map: from matches of one raw frame with an image whose geometry is right, an orthophoto or map.

Plumb lines choose between models by a few hundredths of a pixel, and a hovering camera's frame pairs see nothing of the
lens. Against a map every match shows the distortion itself, so that it decides where it is there: the polynomial of two
terms, its centre and a homography are fitted to the matches robustly.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import least_squares

from schemas.arrays import FloatArray
from velfield.camera.lens import Lens, PolynomialLens, pinhole

MIN_MATCHES = 100
MIN_GAIN = 0.1
"""Relative decrease of the median residual against the lens before, without which that is kept."""
CENTRE_SD = 0.03
"""Prior standard deviation of the centre about the image's middle, half-diagonals."""
_SCALE_PX = 1.0
_RADII = np.linspace(0.05, 1.0, 40)


@dataclass(frozen=True)
class MapFit:
    """A lens fitted to matches with a map."""

    lens: PolynomialLens
    """Of two terms."""
    change_px: float
    """RMS change of undistorted positions over the frame against the lens before, up to a homography."""
    before_px: float
    after_px: float
    """Median residual under the lens before and under this one, each with its homography, map px."""
    matches: int
    """Number of matches."""

    @property
    def is_better(self) -> bool:
        """Whether the matches decide for it."""
        return self.matches >= MIN_MATCHES and self.after_px < (1.0 - MIN_GAIN) * self.before_px


def fit_lens_to_map(xy_raw: FloatArray, xy_map: FloatArray, lens: Lens, shape: tuple[int, int]) -> MapFit | None:
    """Fit a lens of two terms to matches (n, 2) raw px and (n, 2) map px of a frame of (height, width).

    None where there are too few matches, or the fit folds within the frame.
    """
    if len(xy_raw) < MIN_MATCHES:
        return None
    hole = pinhole(shape)
    before, residual_before = _homography(lens, xy_raw, xy_map)
    middle = np.array([hole.centre_x_px, hole.centre_y_px])
    start = np.concatenate([_profile(lens, middle, hole.half_diagonal_px), [0.0, 0.0], before.ravel()[:8]])
    unit = np.abs(start[4:]) + 1e-9

    def unpack(parameters: FloatArray) -> tuple[PolynomialLens, FloatArray]:
        x, y = middle + parameters[2:4] * hole.half_diagonal_px
        fitted = PolynomialLens((float(parameters[0]), float(parameters[1])), float(x), float(y), hole.half_diagonal_px)
        return fitted, np.append(parameters[4:] * unit, 1.0).reshape(3, 3)

    def residuals(parameters: FloatArray) -> FloatArray:
        fitted, matrix = unpack(parameters)
        left = _apply(matrix, fitted.undistort_points(xy_raw)) - xy_map
        robust = np.where(np.isfinite(left), left, 1e3)
        return np.concatenate([robust.ravel(), parameters[2:4] / CENTRE_SD])

    start[4:] /= unit
    solved = least_squares(
        residuals, start, loss="cauchy", f_scale=_SCALE_PX, x_scale=np.r_[0.01, 0.01, 0.005, 0.005, np.full(8, 1e-3)]
    )
    fitted, matrix = unpack(np.asarray(solved.x))
    after_px = float(np.median(np.hypot(*(_apply(matrix, fitted.undistort_points(xy_raw)) - xy_map).T)))
    grid = _grid(shape)
    new, old = fitted.undistort_points(grid), lens.undistort_points(grid)
    if not np.isfinite(new).all() or fitted.fold_radius() < 1.0:
        return None
    valid = np.isfinite(old).all(axis=1)
    refit, _ = cv2.findHomography(old[valid], new[valid], 0)
    change = np.hypot(*(_apply(np.asarray(refit), old[valid]) - new[valid]).T)
    return MapFit(fitted, float(np.sqrt(np.mean(change**2))), residual_before, after_px, len(xy_raw))


def mean_lens(lenses: Sequence[PolynomialLens]) -> PolynomialLens:
    """The lens of the mean coefficients and centre of lenses of one size and number of terms."""
    x, y = np.mean([(lens.centre_x_px, lens.centre_y_px) for lens in lenses], axis=0)
    coefficients = tuple(float(k) for k in np.mean([lens.coefficients for lens in lenses], axis=0))
    return PolynomialLens(coefficients, float(x), float(y), lenses[0].half_diagonal_px)


def _homography(lens: Lens, xy_raw: FloatArray, xy_map: FloatArray) -> tuple[FloatArray, float]:
    """The homography (3, 3) of undistorted px under a lens, and the median residual."""
    source = lens.undistort_points(xy_raw)
    matrix, _ = cv2.findHomography(source, xy_map, cv2.USAC_MAGSAC, 3.0, maxIters=2000, confidence=0.999)
    matrix = np.eye(3) if matrix is None else np.asarray(matrix, np.float64)
    return matrix, float(np.median(np.hypot(*(_apply(matrix, source) - xy_map).T)))


def _profile(lens: Lens, middle: FloatArray, half_diagonal_px: float) -> FloatArray:
    """The two terms nearest to a lens's radial profile."""
    raw = middle + np.column_stack([_RADII * half_diagonal_px, np.zeros_like(_RADII)])
    shift = (lens.undistort_points(raw)[:, 0] - raw[:, 0]) / half_diagonal_px
    good = np.isfinite(shift)
    powers = np.column_stack([_RADII**3, _RADII**5])[good]
    return np.asarray(np.linalg.lstsq(powers, shift[good], rcond=None)[0])


def _apply(matrix: FloatArray, xy: FloatArray) -> FloatArray:
    mapped = np.column_stack([xy, np.ones(len(xy))]) @ matrix.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def _grid(shape: tuple[int, int]) -> FloatArray:
    y, x = np.meshgrid(np.linspace(0, shape[0] - 1, 13), np.linspace(0, shape[1] - 1, 17), indexing="ij")
    return np.column_stack([x.ravel(), y.ravel()])
