"""Geometric transforms: homography, second-order polyprojective, and the complete map of a frame, raw to base pixels.

Paper: registration. Points are (n, 2) float64 as (x, y); pixel (0, 0) is the centre of the top-left pixel.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from schemas.arrays import FloatArray
from schemas.flight import RegistrationConfig
from velfield.camera.lens import Lens
from velfield.registration import kernels

_INVERSE_STEPS = 25
_TOLERANCE_PX = 1e-5
_MAX_ERROR_PX = 1e-3
"""Inverses of which the residual is not below the first are corrected; those not below the second in the end fail."""
_DIFFERENCE_PX = 0.25
"""Step of the numerical derivative: small against the row spline's knot spacing, large against rounding errors."""
_OUTSIDE_FRACTION = 0.1
_OUTSIDE_PX = 64.0
"""An inverse that lies farther outside the frame than both this and the fraction of its longer side is rejected."""


def as_points(xy: object) -> FloatArray:
    """Points as a contiguous (n, 2) float64 array."""
    return np.ascontiguousarray(np.asarray(xy, dtype=np.float64).reshape(-1, 2))


@dataclass(frozen=True, eq=False)
class HomographyTransform:
    """Homography ``matrix`` (3, 3) on homogeneous (x, y, 1), 8 parameters; NaN beyond the horizon."""

    matrix: FloatArray

    def __call__(self, xy: FloatArray) -> FloatArray:
        """Map points (n, 2)."""
        x, y, w = self.matrix[:, :2] @ as_points(xy).T + self.matrix[:, 2:]
        w = np.where(w * np.sign(self.matrix[2, 2]) > 1e-12, w, np.nan)
        return np.stack([x / w, y / w], axis=1)

    def inverse(self, xy: FloatArray) -> FloatArray:
        """Map points (n, 2) back, in closed form."""
        return self._inverted(xy)

    @cached_property
    def _inverted(self) -> "HomographyTransform":
        inverted = np.linalg.inv(self.matrix)
        return HomographyTransform(inverted / inverted[2, 2])


@dataclass(frozen=True, eq=False)
class PolyprojectiveTransform:
    """Second-order rational function with a common denominator, 17 free parameters.

    Paper: the polyprojective model. ``x' = a.m / c.m``, ``y' = b.m / c.m`` with ``m = (1, x, y, x^2, xy, y^2)``.
    """

    coefficients: FloatArray
    """(3, 6), rows a, b, c; c starts with 1. They act on normalised coordinates."""
    source: FloatArray
    target: FloatArray
    """(3,) each: (cx, cy, s); the normalised coordinate is (x - cx) * s."""

    @classmethod
    def from_homography(cls, matrix: FloatArray, source: FloatArray, target: FloatArray) -> "PolyprojectiveTransform":
        """The polyprojective form of a homography ``matrix`` (3, 3), in the given normalisations."""
        inner = normalisation_matrix(target) @ matrix @ np.linalg.inv(normalisation_matrix(source))
        inner = inner / inner[2, 2]
        coefficients = np.zeros((3, 6))
        coefficients[:, 0], coefficients[:, 1], coefficients[:, 2] = inner[:, 2], inner[:, 0], inner[:, 1]
        return cls(coefficients, source, target)

    @classmethod
    def of_frame(cls, matrix: FloatArray, lens: Lens, width: int, height: int) -> "PolyprojectiveTransform":
        """`from_homography` of undistorted px of a frame, in normalisations by its corners."""
        corners = as_points(lens.undistort_points(frame_corners(width, height)))
        norms = fit_normalisation(corners), fit_normalisation(HomographyTransform(matrix)(corners))
        return cls.from_homography(matrix, *norms)

    @property
    def is_homography(self) -> bool:
        """Whether all second-order terms are zero."""
        return not bool(self.coefficients[:, 3:].any())

    def homography(self) -> FloatArray:
        """The homography (3, 3) of the first-order terms; equal to the transform if `is_homography`."""
        c = self.coefficients
        inner = np.stack([c[:, 1], c[:, 2], c[:, 0]], axis=1)
        matrix = np.linalg.inv(normalisation_matrix(self.target)) @ inner @ normalisation_matrix(self.source)
        return np.asarray(matrix / matrix[2, 2])

    def __call__(self, xy: FloatArray) -> FloatArray:
        """Map points (n, 2); NaN rows where the denominator is not positive."""
        return np.asarray(kernels.rational(as_points(xy), self.coefficients, self.source, self.target))

    def jacobian(self, xy: FloatArray) -> FloatArray:
        """Jacobian (n, 2, 2) at points (n, 2)."""
        return _differentiate(self, xy)

    def inverse(self, xy: FloatArray) -> FloatArray:
        """Map points (n, 2) back by Newton's method from the homography's inverse; NaN rows where it fails."""
        return _invert(xy, self._homography.inverse(xy), self)

    @cached_property
    def _homography(self) -> HomographyTransform:
        return HomographyTransform(self.homography())


def _differentiate(forward: Callable[[FloatArray], FloatArray], xy: FloatArray) -> FloatArray:
    """Jacobian (n, 2, 2) of a map at points (n, 2), by central differences."""
    points, steps = as_points(xy), _DIFFERENCE_PX * np.eye(2)
    columns = [(forward(points + step) - forward(points - step)) / (2 * _DIFFERENCE_PX) for step in steps]
    return np.stack(columns, axis=2)


def _invert(xy: FloatArray, guess: FloatArray, forward: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Inverse of a map at points (n, 2) by Newton's method from ``guess``, each until it is accurate; NaN where that
    fails."""
    points, found, error = as_points(xy), guess.copy(), np.full(len(guess), np.nan)
    todo = np.flatnonzero(np.isfinite(found).all(axis=1))
    for step in range(_INVERSE_STEPS + 1):
        here = found[todo]
        mapped = forward(here)
        residual = points[todo] - mapped
        error[todo] = np.maximum(*np.abs(residual.T))
        far = np.flatnonzero(error[todo] > _TOLERANCE_PX)
        if not len(far) or step == _INVERSE_STEPS:
            break
        if len(far) < len(todo):
            todo, here, mapped, residual = todo[far], here[far], mapped[far], residual[far]
        (a, c), (b, d) = ((forward(here + step) - mapped).T / _DIFFERENCE_PX for step in _DIFFERENCE_PX * np.eye(2))
        x, y = residual.T
        with np.errstate(divide="ignore", invalid="ignore"):
            found[todo] = here + np.stack([d * x - b * y, a * y - c * x], axis=1) / (a * d - b * c)[:, None]
    found[~(error < _MAX_ERROR_PX)] = np.nan
    return found


def normalisation_matrix(norm: FloatArray) -> FloatArray:
    """Matrix (3, 3) of the normalisation (cx, cy, s)."""
    cx, cy, s = norm
    return np.array([[s, 0.0, -cx * s], [0.0, s, -cy * s], [0.0, 0.0, 1.0]])


def frame_corners(width: int, height: int) -> FloatArray:
    """Corners (4, 2) of a frame, px."""
    return np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], dtype=np.float64)


def fit_normalisation(xy: FloatArray) -> FloatArray:
    """(cx, cy, s) that centres points (n, 2) and scales the largest coordinate to 1."""
    finite = xy[np.isfinite(xy).all(axis=1)]
    centre = 0.5 * (finite.min(axis=0) + finite.max(axis=0))
    reach = float(np.abs(finite - centre).max())
    return np.array([centre[0], centre[1], 1.0 / max(reach, 1e-9)])


def mesh_shape(width: int, height: int, cell_size_px: int) -> tuple[int, int]:
    """Rows and columns of the displacement mesh over a frame.

    Examples
    --------
    >>> mesh_shape(1280, 960, 200)
    (5, 7)
    """
    return -(-height // cell_size_px), -(-width // cell_size_px)


def vector_length(width: int, height: int, config: RegistrationConfig) -> int:
    """Length of `FrameTransform.to_vector` for a frame size and configuration."""
    my, mx = mesh_shape(width, height, config.cell_size_px)
    return 18 + 6 + 3 * count_row_knots(config) + 2 * my * mx


def count_row_knots(config: RegistrationConfig) -> int:
    """Row-spline coefficients per component; 0 unless the model is ``row_spline``."""
    return config.row_spline_knots if config.model == "row_spline" else 0


@dataclass(frozen=True, eq=False)
class FrameTransform:
    """The complete map of one frame, raw pixels to base pixels.

    raw -> lens undistortion -> rolling-shutter correction (row spline) -> polyprojective -> plus displacement mesh ->
    base.
    """

    width: int
    height: int
    """Size of the raw frame, px."""
    lens: Lens
    """The camera's."""
    polyprojective: PolyprojectiveTransform
    """Undistorted px to base px; a homography has zero second-order terms."""
    row_coefficients: FloatArray = field(default_factory=lambda: np.zeros((3, 0)))
    """(3, knots), uniform cubic B-spline over the raw rows of the shift in x and y (undistorted px) and the roll about
    the frame's centre (rad); knots may be 0."""
    mesh: FloatArray | None = None
    """(my, mx, 2) displacement at the cell centres of the raw frame, base px; None is zero displacement."""
    cell_size_px: int = 200
    """Side of a mesh cell, raw px."""

    @property
    def centre(self) -> FloatArray:
        """Centre of the roll, px."""
        return np.array([(self.width - 1) / 2, (self.height - 1) / 2])

    def remove_row_motion(self, xy_raw: FloatArray) -> FloatArray:
        """Raw pixels (n, 2) to undistorted pixels (n, 2), corrected for rolling shutter."""
        raw = as_points(xy_raw)
        undistorted = as_points(self.lens.undistort_points(raw))
        rows = np.ascontiguousarray(raw[:, 1])
        return np.asarray(kernels.remove_row_motion(undistorted, rows, self.row_coefficients, self.height, self.centre))

    def to_base(self, xy_raw: FloatArray) -> FloatArray:
        """Raw pixels (n, 2) to base pixels (n, 2); NaN rows outside the domain of the lens or the polyprojective."""
        mapped = self.polyprojective(self.remove_row_motion(xy_raw))
        if self.mesh is None:
            return mapped
        return np.asarray(mapped + kernels.mesh_displacement(as_points(xy_raw), self.mesh, self.cell_size_px))

    def to_raw(self, xy_base: FloatArray) -> FloatArray:
        """Base pixels (n, 2) to raw pixels (n, 2), by Newton's method to well below 1e-3 px.

        NaN rows where there is no inverse, or where it lies outside the frame by more than a tenth of its size and
        more than 64 px.
        """
        raw = _invert(xy_base, self.to_raw_roughly(xy_base), self.to_base)
        margin = max(_OUTSIDE_PX, _OUTSIDE_FRACTION * max(self.width, self.height))
        x, y = raw.T
        raw[~((np.minimum(x, y) >= -margin) & (x <= self.width + margin) & (y <= self.height + margin))] = np.nan
        return raw

    def to_raw_in_frame(self, xy_base: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As `to_raw`, with the inverse Jacobian (n, 2, 2) there: what is needed to start a search from."""
        raw = self.to_raw(xy_base)
        (a, b), (c, d) = np.moveaxis(self.jacobian(raw), 0, -1)
        return raw, np.moveaxis(np.array([[d, -b], [-c, a]]) / (a * d - b * c), -1, 0)

    def to_raw_roughly(self, xy_base: FloatArray) -> FloatArray:
        """The inverse without row motion and mesh, so wrong by these; NaN rows where there is none."""
        return as_points(self.lens.distort_points(self.polyprojective.inverse(as_points(xy_base))))

    def jacobian(self, xy_raw: FloatArray) -> FloatArray:
        """Jacobian (n, 2, 2) of `to_base` at raw pixels (n, 2)."""
        return _differentiate(self.to_base, xy_raw)

    def scale_and_rotation(self) -> tuple[float, float]:
        """Scale, base px per frame px, and rotation from +x to +y, rad, of the nearest similarity at the centre."""
        jacobian = self.jacobian(self.centre[None])[0]
        cosine, sine = jacobian[0, 0] + jacobian[1, 1], jacobian[1, 0] - jacobian[0, 1]
        return float(0.5 * np.hypot(cosine, sine)), float(np.arctan2(sine, cosine))

    def to_vector(self, config: RegistrationConfig) -> FloatArray:
        """The parameters as one flat float64 vector of `vector_length`; the lens is in ``camera.json``."""
        my, mx = mesh_shape(self.width, self.height, config.cell_size_px)
        rows = np.zeros((3, count_row_knots(config))) if self.row_coefficients.shape[1] < 4 else self.row_coefficients
        mesh = np.zeros((my, mx, 2)) if self.mesh is None else self.mesh
        p = self.polyprojective
        parts = [p.coefficients, p.source, p.target, rows, mesh]
        vector = np.concatenate([np.ravel(part) for part in parts])
        expected = vector_length(self.width, self.height, config)
        if len(vector) != expected:
            message = (
                f"the transform has {len(vector)} parameters, expected {expected}: fitted with another configuration"
            )
            raise ValueError(message)
        return vector

    @classmethod
    def from_vector(
        cls, vector: FloatArray, *, width: int, height: int, lens: Lens, config: RegistrationConfig
    ) -> "FrameTransform":
        """The inverse of `to_vector`, for the same configuration, frame size and lens."""
        my, mx = mesh_shape(width, height, config.cell_size_px)
        knots = count_row_knots(config)
        sizes = np.cumsum([18, 3, 3, 3 * knots])
        coefficients, source, target, rows, mesh = np.split(np.array(vector, dtype=np.float64), sizes)
        polyprojective = PolyprojectiveTransform(coefficients.reshape(3, 6), source, target)
        mesh = mesh.reshape(my, mx, 2)
        return cls(
            width=width,
            height=height,
            lens=lens,
            polyprojective=polyprojective,
            row_coefficients=rows.reshape(3, knots),
            mesh=mesh if mesh.any() else None,
            cell_size_px=config.cell_size_px,
        )


@dataclass(frozen=True, eq=False)
class MeshedTransform:
    """A polyprojective plus a displacement mesh, from one base image to another.

    ``mesh`` (my, mx, 2) has the displacement at the centres of cells of ``cell_size_px`` of the first image, px of the
    second.
    """

    polyprojective: PolyprojectiveTransform
    mesh: FloatArray
    cell_size_px: int

    def __call__(self, xy: FloatArray) -> FloatArray:
        """Map points (n, 2)."""
        points = as_points(xy)
        return np.asarray(self.polyprojective(points) + kernels.mesh_displacement(points, self.mesh, self.cell_size_px))

    def jacobian(self, xy: FloatArray) -> FloatArray:
        """Jacobian (n, 2, 2) at points (n, 2)."""
        return _differentiate(self, xy)

    def inverse(self, xy: FloatArray) -> FloatArray:
        """Map points (n, 2) back; NaN rows where there is no inverse."""
        return _invert(xy, self.polyprojective.inverse(xy), self)


PlaneTransform = PolyprojectiveTransform | MeshedTransform
"""From one base image to another."""


@dataclass(frozen=True, eq=False)
class ComposedTransform:
    """A frame's map followed by a transform of the base plane."""

    first: "FrameTransform | ComposedTransform"
    second: PlaneTransform

    @property
    def width(self) -> int:
        """Width of the raw frame, px."""
        return self.first.width

    @property
    def height(self) -> int:
        """Height of the raw frame, px."""
        return self.first.height

    def to_base(self, xy_raw: FloatArray) -> FloatArray:
        """Raw pixels (n, 2) to base pixels (n, 2)."""
        return self.second(self.first.to_base(xy_raw))

    def to_raw(self, xy_base: FloatArray) -> FloatArray:
        """Base pixels (n, 2) to raw pixels (n, 2); NaN rows where there is no inverse."""
        return self.first.to_raw(self.second.inverse(xy_base))


FrameMap = FrameTransform | ComposedTransform
"""Raw pixels of a frame to base pixels and back."""
