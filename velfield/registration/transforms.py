"""Geometric maps of registration: homography, second-order polyprojective, and the whole raw-to-base map of a frame.

Paper: registration. Points are (n, 2) float64 as (x, y); pixel (0, 0) is the centre of the top-left pixel.
"""

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from schemas.flight import RegistrationConfig
from velfield.camera.lens import Lens
from velfield.registration import kernels

_INVERSE_STEPS = 25
_INVERSE_TOLERANCE_PX = 1e-5
_DIFFERENCE_PX = 0.25
"""Step of the numerical derivative of the whole map: small against a row spline's knots, large against rounding."""
_OUTSIDE_SHARE = 0.1
_OUTSIDE_PX = 64.0
"""An inverse that lands farther outside the frame than this, or this share of its larger side, is no inverse."""


class Transform(Protocol):
    """A map of the plane; points (n, 2)."""

    def __call__(self, xy: FloatArray) -> FloatArray:
        """Where the points go."""
        ...

    def inverse(self, xy: FloatArray) -> FloatArray:
        """Where they come from; NaN rows where from nowhere."""
        ...


def as_points(xy: object) -> FloatArray:
    """Points as a contiguous (n, 2) float64 array."""
    return np.ascontiguousarray(np.asarray(xy, dtype=np.float64).reshape(-1, 2))


@dataclass(frozen=True, eq=False)
class HomographyTransform:
    """Eight parameters: ``matrix`` (3, 3) on homogeneous (x, y, 1); NaN behind the horizon."""

    matrix: FloatArray

    def __call__(self, xy: FloatArray) -> FloatArray:
        """Points (n, 2) mapped."""
        points = as_points(xy)
        mapped = points @ self.matrix[:, :2].T + self.matrix[:, 2]
        with np.errstate(invalid="ignore", divide="ignore"):
            w = np.where(mapped[:, 2] * np.sign(self.matrix[2, 2]) > 1e-12, mapped[:, 2], np.nan)
            return np.asarray(mapped[:, :2] / w[:, None])

    def inverse(self, xy: FloatArray) -> FloatArray:
        """Points (n, 2) mapped back, exactly."""
        inverted = np.linalg.inv(self.matrix)
        return HomographyTransform(inverted / inverted[2, 2])(xy)


@dataclass(frozen=True, eq=False)
class PolyprojectiveTransform:
    """Second-order rational function with one denominator, 17 free parameters.

    Paper: the polyprojective model. ``x' = a.m / c.m``, ``y' = b.m / c.m`` with ``m = (1, x, y, x^2, xy, y^2)``.

    Parameters
    ----------
    coefficients
        (3, 6): rows a, b, c; c starts with 1. They act on normalised coordinates.
    source, target
        (3,) each: (cx, cy, s); the normalised coordinate is (x - cx) * s.
    """

    coefficients: FloatArray
    source: FloatArray
    target: FloatArray

    @classmethod
    def from_homography(cls, matrix: FloatArray, source: FloatArray, target: FloatArray) -> "PolyprojectiveTransform":
        """The same map as a homography ``matrix`` (3, 3), in the given normalisations."""
        inner = normaliser(target) @ matrix @ np.linalg.inv(normaliser(source))
        inner = inner / inner[2, 2]
        coefficients = np.zeros((3, 6))
        coefficients[:, 0], coefficients[:, 1], coefficients[:, 2] = inner[:, 2], inner[:, 0], inner[:, 1]
        return cls(coefficients, source, target)

    @property
    def is_homography(self) -> bool:
        """Whether all second-order terms are zero."""
        return not bool(self.coefficients[:, 3:].any())

    def homography(self) -> FloatArray:
        """The homography (3, 3) of the terms of first order; the map itself where there are no others."""
        c = self.coefficients
        inner = np.stack([c[:, 1], c[:, 2], c[:, 0]], axis=1)
        matrix = np.linalg.inv(normaliser(self.target)) @ inner @ normaliser(self.source)
        return np.asarray(matrix / matrix[2, 2])

    def __call__(self, xy: FloatArray) -> FloatArray:
        """Points (n, 2) mapped; NaN rows where the denominator is not positive."""
        return np.asarray(kernels.rational(as_points(xy), self.coefficients, self.source, self.target))

    def jacobian(self, xy: FloatArray) -> FloatArray:
        """Derivative (n, 2, 2) at points (n, 2)."""
        return np.asarray(kernels.rational_jacobian(as_points(xy), self.coefficients, self.source, self.target))

    def inverse(self, xy: FloatArray) -> FloatArray:
        """Points (n, 2) mapped back by Newton's method from the homography's inverse; NaN rows where it fails."""
        wanted = as_points(xy)
        guess = HomographyTransform(self.homography()).inverse(wanted)
        for _ in range(_INVERSE_STEPS):
            miss = wanted - self(guess)
            if np.nanmax(np.abs(miss), initial=0.0) < _INVERSE_TOLERANCE_PX:
                break
            guess = guess + _solved(self.jacobian(guess), miss)
        missed = ~(np.abs(wanted - self(guess)).max(axis=1, initial=0.0) < 1e-3)
        guess[missed] = np.nan
        return guess


def normaliser(norm: FloatArray) -> FloatArray:
    """The matrix (3, 3) of the normalisation (cx, cy, s)."""
    cx, cy, s = norm
    return np.array([[s, 0.0, -cx * s], [0.0, s, -cy * s], [0.0, 0.0, 1.0]])


def normalisation_of(xy: FloatArray) -> FloatArray:
    """(cx, cy, s) that brings points (n, 2) about zero with a largest offset of one."""
    finite = xy[np.isfinite(xy).all(axis=1)]
    centre = 0.5 * (finite.min(axis=0) + finite.max(axis=0))
    reach = float(np.abs(finite - centre).max())
    return np.array([centre[0], centre[1], 1.0 / max(reach, 1e-9)])


def _solved(jacobian: FloatArray, miss: FloatArray) -> FloatArray:
    """Two-by-two systems solved by hand: numpy's solve raises when a single one is singular."""
    a, b, c, d = jacobian[:, 0, 0], jacobian[:, 0, 1], jacobian[:, 1, 0], jacobian[:, 1, 1]
    with np.errstate(invalid="ignore", divide="ignore"):
        determinant = a * d - b * c
        x = (d * miss[:, 0] - b * miss[:, 1]) / determinant
        y = (a * miss[:, 1] - c * miss[:, 0]) / determinant
    return np.stack([x, y], axis=1)


def mesh_shape(width: int, height: int, cell_size_px: int) -> tuple[int, int]:
    """Rows and columns of the displacement mesh that covers a frame.

    Examples
    --------
    >>> mesh_shape(1280, 960, 200)
    (5, 7)
    """
    return -(-height // cell_size_px), -(-width // cell_size_px)


def vector_length(width: int, height: int, config: RegistrationConfig) -> int:
    """Length of `FrameTransform.to_vector` for frames of that size under that configuration."""
    my, mx = mesh_shape(width, height, config.cell_size_px)
    return 18 + 6 + 3 * row_knots(config) + 2 * my * mx


def row_knots(config: RegistrationConfig) -> int:
    """Coefficients of the row spline a component; none but for the model ``row_spline``."""
    return config.row_spline_knots if config.model == "row_spline" else 0


def _empty_rows() -> FloatArray:
    return np.zeros((3, 0))


@dataclass(frozen=True, eq=False)
class FrameTransform:
    """The map of one frame, raw pixels to base pixels.

    raw -> undistorted by the lens -> the row's motion taken out (rolling shutter) -> polyprojective -> plus the
    displacement mesh -> base.

    Parameters
    ----------
    width, height
        Size of the raw frame, px.
    lens
        The camera's lens.
    polyprojective
        Undistorted px to base px; a homography has no second-order terms.
    row_coefficients
        (3, knots): uniform cubic B-spline over the raw rows of the shift in x and y (undistorted px) and of the roll
        about the frame's centre (rad); knots may be 0.
    mesh
        (my, mx, 2) displacement at the centres of the raw frame's cells, base px; none is as zero.
    cell_size_px
        Side of a cell, raw px.
    """

    width: int
    height: int
    lens: Lens
    polyprojective: PolyprojectiveTransform
    row_coefficients: FloatArray = field(default_factory=_empty_rows)
    mesh: FloatArray | None = None
    cell_size_px: int = 200

    @property
    def centre(self) -> FloatArray:
        """About which the row's roll turns, px."""
        return np.array([(self.width - 1) / 2, (self.height - 1) / 2])

    def row_moved(self, xy_raw: FloatArray) -> FloatArray:
        """Raw pixels (n, 2) to undistorted pixels (n, 2) with the row's motion taken out."""
        raw = as_points(xy_raw)
        undistorted = as_points(self.lens.undistort_points(raw))
        rows = np.ascontiguousarray(raw[:, 1])
        return np.asarray(kernels.row_moved(undistorted, rows, self.row_coefficients, self.height, self.centre))

    def row_motion(self, rows: FloatArray) -> FloatArray:
        """Motion (n, 3) at raw rows (n,): shift in x and y, undistorted px, and roll, rad."""
        if self.row_coefficients.shape[1] < 4:
            return np.zeros((len(rows), 3))
        first, weights = kernels.spline_basis(
            np.asarray(rows, dtype=np.float64), self.height, self.row_coefficients.shape[1]
        )
        return np.asarray(np.einsum("nk,cnk->nc", weights, self.row_coefficients[:, first[:, None] + np.arange(4)]))

    def to_base(self, xy_raw: FloatArray) -> FloatArray:
        """Raw pixels (n, 2) to base pixels (n, 2); NaN rows where the lens or the map has no value."""
        raw = as_points(xy_raw)
        base = self.polyprojective(self.row_moved(raw))
        if self.mesh is not None:
            base += kernels.mesh_displacement(raw, self.mesh, self.cell_size_px)
        return base

    def to_raw(self, xy_base: FloatArray) -> FloatArray:
        """Base pixels (n, 2) to raw pixels (n, 2), by Newton's method to well below 1e-3 px.

        NaN rows where there is no inverse, or only one that lies outside the frame by more than a tenth of its size or
        64 px, whichever is more.
        """
        wanted = as_points(xy_base)
        raw = as_points(self.lens.distort_points(self.polyprojective.inverse(wanted)))
        todo = np.flatnonzero(np.isfinite(raw).all(axis=1))
        for _ in range(_INVERSE_STEPS):
            miss = wanted[todo] - self.to_base(raw[todo])
            size = np.abs(miss).max(axis=1, initial=0.0)
            todo, miss = todo[size > _INVERSE_TOLERANCE_PX], miss[size > _INVERSE_TOLERANCE_PX]
            if not todo.size:
                break
            raw[todo] += _solved(self.jacobian(raw[todo]), miss)
        missed = ~(np.abs(wanted - self.to_base(raw)).max(axis=1, initial=0.0) < 1e-3)
        raw[missed | self._far_outside(raw)] = np.nan
        return raw

    def _far_outside(self, raw: FloatArray) -> NDArray[np.bool_]:
        margin = max(_OUTSIDE_PX, _OUTSIDE_SHARE * max(self.width, self.height))
        with np.errstate(invalid="ignore"):
            inside = (raw >= -margin) & (raw <= np.array([self.width, self.height]) + margin)
        return np.asarray(~inside.all(axis=1))

    def jacobian(self, xy_raw: FloatArray) -> FloatArray:
        """Derivative (n, 2, 2) of `to_base` at raw pixels (n, 2), by central differences."""
        raw = as_points(xy_raw)
        columns = []
        for axis in range(2):
            step = np.zeros(2)
            step[axis] = _DIFFERENCE_PX
            columns.append((self.to_base(raw + step) - self.to_base(raw - step)) / (2 * _DIFFERENCE_PX))
        return np.stack(columns, axis=2)

    def scale_and_rotation(self) -> tuple[float, float]:
        """Base px a frame px, and turn from +x to +y, rad: of the similarity nearest to the map in the middle."""
        jacobian = self.jacobian(self.centre[None])[0]
        cosine, sine = jacobian[0, 0] + jacobian[1, 1], jacobian[1, 0] - jacobian[0, 1]
        return float(0.5 * np.hypot(cosine, sine)), float(np.arctan2(sine, cosine))

    def followed_by(self, transform: PolyprojectiveTransform) -> "ComposedTransform":
        """This map, then another: from the flight's own base image on to a given one."""
        return ComposedTransform(self, transform)

    def to_vector(self, config: RegistrationConfig) -> FloatArray:
        """The parameters as one flat float64 vector of `vector_length`; the lens stands in ``camera.json``."""
        my, mx = mesh_shape(self.width, self.height, config.cell_size_px)
        rows = np.zeros((3, row_knots(config))) if self.row_coefficients.shape[1] < 4 else self.row_coefficients
        mesh = np.zeros((my, mx, 2)) if self.mesh is None else self.mesh
        p = self.polyprojective
        parts = [p.coefficients, p.source, p.target, rows, mesh]
        vector = np.concatenate([np.ravel(part) for part in parts])
        expected = vector_length(self.width, self.height, config)
        if len(vector) != expected:
            message = f"the transform has {len(vector)} parameters, the configuration {expected}: not fitted under it"
            raise ValueError(message)
        return vector

    @classmethod
    def from_vector(
        cls, vector: FloatArray, *, width: int, height: int, lens: Lens, config: RegistrationConfig
    ) -> "FrameTransform":
        """The transform that `to_vector` wrote, under the same configuration, frame size and lens."""
        my, mx = mesh_shape(width, height, config.cell_size_px)
        knots = row_knots(config)
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

    def with_mesh(self, mesh: FloatArray | None) -> "FrameTransform":
        """The same map with another displacement mesh."""
        return replace(self, mesh=mesh)


@dataclass(frozen=True, eq=False)
class ComposedTransform:
    """A frame's map followed by another map of the plane."""

    first: "FrameTransform | ComposedTransform"
    second: PolyprojectiveTransform

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

    def followed_by(self, transform: PolyprojectiveTransform) -> "ComposedTransform":
        """This map, then another: from one base image on to the next."""
        return ComposedTransform(self, transform)


FrameMap = FrameTransform | ComposedTransform
"""Raw pixels of a frame to base pixels and back."""
