"""Radial lens models: raw pixels to the pixels of an ideal pinhole camera, and back.

Paper: camera calibration. The scale is 1 at the centre of distortion; undistorted pixels extend beyond the frame for
barrel distortion. A model is an immutable value with a closed-form undistortion; its inverse is closed (Harris,
division) or computed by Newton's method to 1e-9 px (polynomial), NaN where there is none.

Other packages use the protocol `Lens` and do not depend on the model.
"""

from dataclasses import asdict, dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple, Protocol

import numpy as np

from schemas.arrays import FloatArray, Points
from schemas.camera import DivisionLensRecord, HarrisLensRecord, LensRecord, PolynomialLensRecord
from velfield.compiled import kernel

_NEWTON_STEPS = 60
_NEWTON_TOLERANCE = 1e-13


class RadialModel(NamedTuple):
    """An undistortion: offsets from the centre are multiplied by a power of a polynomial in the squared radius."""

    centre_x_px: float
    centre_y_px: float
    half_diagonal_px: float
    polynomial: FloatArray
    """Lowest power first, the radius in half-diagonals."""
    power: float
    """1, -1 or, of two terms only, -1/2."""
    limit_r2: float
    """Squared radius from which on there is no value."""


class Lens(Protocol):
    """A map between raw and undistorted pixels; points are (n, 2) float64 as (x, y)."""

    @property
    def is_identity(self) -> bool:
        """Whether raw and undistorted pixels are the same."""
        ...

    def undistort_points(self, xy_raw: Points) -> Points:
        """Raw pixels (n, 2) to undistorted pixels (n, 2); NaN rows outside the model's domain."""
        ...

    def distort_points(self, xy: Points) -> Points:
        """Undistorted pixels (n, 2) to raw pixels (n, 2); NaN rows where there is no inverse."""
        ...

    def undistort_tangents(self, xy_raw: Points, tangents: Points) -> Points:
        """Directions (n, 2) at raw pixels (n, 2), multiplied by the Jacobian of the undistortion."""
        ...

    def to_record(self) -> LensRecord:
        """The record that ``camera.json`` holds."""
        ...


def _squares(offsets: FloatArray) -> FloatArray:
    """Squared lengths (..., 1) of vectors (..., 2): numpy's sum over so short an axis takes five times as long."""
    x, y = offsets[..., :1], offsets[..., 1:]
    return np.asarray(x * x + y * y)


@kernel
def _divide_by_root(points: FloatArray, a: float, centre_x: float, centre_y: float, unit2: float) -> FloatArray:
    """Points (n, 2) at r from a centre moved to r / sqrt(1 + a r^2 / unit2); NaN where there is no root."""
    out = np.empty((points.shape[0], 2))
    for i in range(points.shape[0]):
        x, y = points[i, 0] - centre_x, points[i, 1] - centre_y
        square = 1.0 + a * ((x * x + y * y) / unit2)
        root = np.sqrt(square) if square > 0 else np.nan
        out[i, 0], out[i, 1] = x / root + centre_x, y / root + centre_y
    return out


@kernel
def _scale_by_polynomial(points: FloatArray, lens: RadialModel) -> FloatArray:
    """Points (n, 2) at r from a centre moved to r p(r^2), or r / p(r^2); NaN where p is not positive or r too large."""
    out, terms, unit = np.empty((points.shape[0], 2)), len(lens.polynomial), lens.half_diagonal_px
    for i in range(points.shape[0]):
        x, y = (points[i, 0] - lens.centre_x_px) / unit, (points[i, 1] - lens.centre_y_px) / unit
        radius2 = x * x + y * y
        value = lens.polynomial[terms - 1]
        for k in range(terms - 2, -1, -1):
            value = lens.polynomial[k] + value * radius2
        scale = np.nan
        if value > 0 and radius2 < lens.limit_r2:
            scale = 1.0 / value if lens.power < 0 else value
        out[i, 0], out[i, 1] = x * scale * unit + lens.centre_x_px, y * scale * unit + lens.centre_y_px
    return out


def _move_radially(xy: Points, lens: RadialModel) -> Points:
    """Pixels (..., 2) by a `RadialModel`; NaN outside its domain."""
    points = np.ascontiguousarray(xy, dtype=np.float64)
    rows = points.reshape(-1, 2)
    if lens.power == -0.5:  # its loop becomes vectors
        unit2 = lens.half_diagonal_px**2
        moved = _divide_by_root(rows, lens.polynomial[1], lens.centre_x_px, lens.centre_y_px, unit2)
    else:
        moved = _scale_by_polynomial(rows, lens)
    return np.asarray(moved.reshape(points.shape))


class _Radial:
    """What the models have in common; each is a frozen dataclass."""

    centre_x_px: float
    centre_y_px: float
    """Centre of distortion, raw px; a fixed point."""
    half_diagonal_px: float
    """Unit of the radius, px."""

    @property
    def radial(self) -> RadialModel:
        """The undistortion."""
        raise NotImplementedError

    @property
    def is_identity(self) -> bool:
        """Whether there is no distortion."""
        return not self.radial.polynomial[1:].any()

    def undistort_points(self, xy_raw: Points) -> Points:
        """Raw pixels (n, 2) to undistorted pixels (n, 2); NaN rows outside the model's domain."""
        return _move_radially(xy_raw, self.radial)

    def undistort_tangents(self, xy_raw: Points, tangents: Points) -> Points:
        """Directions (n, 2) at raw pixels (n, 2), multiplied by the Jacobian of the undistortion."""
        model, polynomial = self.radial, np.polynomial.Polynomial(self.radial.polynomial)
        offsets, radius2 = self._offsets(xy_raw)
        value = polynomial(radius2)
        value = np.where((value > 0) & (radius2 < model.limit_r2), value, np.nan)
        derivative_r2 = model.power * value ** (model.power - 1) * polynomial.deriv()(radius2)
        along = np.sum(offsets * tangents, axis=-1, keepdims=True)
        return np.asarray(value**model.power * tangents + 2.0 * derivative_r2 * along * offsets)

    def _offsets(self, xy: Points) -> tuple[Points, Points]:
        """Offsets from the centre (..., 2), half-diagonals, and their squared lengths (..., 1)."""
        offsets = (np.asarray(xy, dtype=np.float64) - (self.centre_x_px, self.centre_y_px)) / self.half_diagonal_px
        return offsets, _squares(offsets)

    def _to_pixels(self, offsets: Points) -> Points:
        return np.asarray(offsets * self.half_diagonal_px + (self.centre_x_px, self.centre_y_px))

    def _build_radial(self, polynomial: tuple[float, ...], power: float, limit_r2: float = np.inf) -> RadialModel:
        # floats and nothing else: kernels are compiled for the types of their arguments
        centre_and_unit = float(self.centre_x_px), float(self.centre_y_px), float(self.half_diagonal_px)
        return RadialModel(*centre_and_unit, np.array(polynomial, np.float64), power, float(limit_r2))


@dataclass(frozen=True)
class HarrisLens(_Radial):
    """Harris' model, r_d = r / sqrt(1 + a r^2), with its closed inverse r = r_d / sqrt(1 - a r_d^2).

    The distortion a is in 1 / half-diagonal^2: positive is barrel, zero a pinhole camera.
    """

    a: float
    centre_x_px: float
    centre_y_px: float
    half_diagonal_px: float

    @cached_property
    def radial(self) -> RadialModel:
        """The undistortion."""
        return self._build_radial((1.0, -self.a), -0.5)

    @cached_property
    def _inverse(self) -> RadialModel:
        """The inverse is the model with the opposite sign."""
        return self._build_radial((1.0, self.a), -0.5)

    def distort_points(self, xy: Points) -> Points:
        """Undistorted pixels (n, 2) to raw pixels (n, 2); NaN rows where pincushion distortion has no inverse."""
        return _move_radially(xy, self._inverse)

    def to_record(self) -> HarrisLensRecord:
        """The record that ``camera.json`` holds."""
        return HarrisLensRecord(**asdict(self))


@dataclass(frozen=True)
class DivisionLens(_Radial):
    """Division model, r = r_d / (1 - k r_d^2), with its closed inverse: one parameter, for wide-angle lenses.

    The distortion k is in 1 / half-diagonal^2: positive is barrel.
    """

    k: float
    centre_x_px: float
    centre_y_px: float
    half_diagonal_px: float

    @cached_property
    def radial(self) -> RadialModel:
        """The undistortion."""
        # Pincushion distortion folds at k r_d^2 = -1; barrel distortion diverges where the divisor is zero.
        return self._build_radial((1.0, -self.k), -1.0, -1.0 / self.k if self.k < 0 else np.inf)

    def distort_points(self, xy: Points) -> Points:
        """Undistorted pixels (n, 2) to raw pixels (n, 2); NaN rows where pincushion distortion has no inverse."""
        offsets, radius2 = self._offsets(xy)
        square = 1.0 + 4.0 * self.k * radius2
        return self._to_pixels(offsets * 2.0 / (1.0 + np.sqrt(np.where(square > 0, square, np.nan))))

    def to_record(self) -> DivisionLensRecord:
        """The record that ``camera.json`` holds."""
        return DivisionLensRecord(**asdict(self))


@lru_cache(maxsize=64)
def _fold_radius(coefficients: tuple[float, ...]) -> float:
    """Radius at which a polynomial folds, inf if it does not; cached, as points are undistorted very often."""
    scale = np.array((1.0, *coefficients))
    growth = scale * (1.0 + 2.0 * np.arange(len(scale)))
    # The root of a vanishing last term is at infinity and would spoil the accuracy of the others.
    roots = np.polynomial.polynomial.polyroots(np.polynomial.polynomial.polytrim(growth, tol=1e-9))
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
    return float(np.sqrt(real.min())) if real.size else float("inf")


@dataclass(frozen=True)
class PolynomialLens(_Radial):
    """Polynomial model, r = r_d (1 + k_1 r_d^2 + k_2 r_d^4 + ...), for lenses that one parameter cannot describe.

    The radius is in half-diagonals. The inverse is that of the branch about the centre, up to where the model folds.
    """

    coefficients: tuple[float, ...]
    centre_x_px: float
    centre_y_px: float
    half_diagonal_px: float

    @cached_property
    def radial(self) -> RadialModel:
        """The undistortion."""
        return self._build_radial((1.0, *self.coefficients), 1.0, self.fold_radius() ** 2)

    def fold_radius(self) -> float:
        """Raw radius, in half-diagonals, at which the undistorted radius stops growing; infinity if never."""
        return _fold_radius(self.coefficients)

    def distort_points(self, xy: Points) -> Points:
        """Undistorted pixels (n, 2) to raw pixels (n, 2); NaN rows beyond the radius where the model folds."""
        offsets, radius2 = self._offsets(xy)
        radius = np.sqrt(radius2)
        raw_radius = self._raw_radius(radius)
        with np.errstate(invalid="ignore", divide="ignore"):
            scale = np.where(radius > 0, raw_radius / radius, 1.0)
        return self._to_pixels(offsets * scale)

    def _raw_radius(self, radius: Points) -> Points:
        """Solve r_d * scale(r_d^2) = r by Newton's method safeguarded by bisection."""
        scale = self.radial.polynomial
        growth = scale * (1.0 + 2.0 * np.arange(len(scale)))
        polyval = np.polynomial.polynomial.polyval
        low = np.zeros_like(radius)
        # Without a fold the radius grows without bound: 1e3 half-diagonals bracket every root of interest.
        high = np.full_like(radius, min(self.fold_radius(), 1e3))
        raw = np.minimum(radius, high)
        for _ in range(_NEWTON_STEPS):
            excess = raw * polyval(raw * raw, scale) - radius
            low, high = np.where(excess < 0, raw, low), np.where(excess >= 0, raw, high)
            derivative_r2 = polyval(raw * raw, growth)
            step = np.where(derivative_r2 > 0, excess / np.where(derivative_r2 > 0, derivative_r2, 1.0), np.inf)
            newton = raw - step
            inside = (newton >= low) & (newton <= high)
            updated = np.where(inside, newton, 0.5 * (low + high))
            if np.all(np.abs(updated - raw) <= _NEWTON_TOLERANCE * np.maximum(raw, 1.0)):
                raw = updated
                break
            raw = updated
        failed = np.abs(raw * polyval(raw * raw, scale) - radius) > 1e-9 * np.maximum(radius, 1.0)
        return np.where(failed, np.nan, raw)

    def to_record(self) -> PolynomialLensRecord:
        """The record that ``camera.json`` holds."""
        return PolynomialLensRecord(**asdict(self))


def pinhole(frame_shape: tuple[int, int]) -> HarrisLens:
    """The lens without distortion for frames of (height, width): the identity."""
    height, width = frame_shape
    return HarrisLens(
        a=0.0,
        centre_x_px=(width - 1) / 2,
        centre_y_px=(height - 1) / 2,
        half_diagonal_px=0.5 * float(np.hypot(width, height)),
    )


def lens_from_record(record: LensRecord) -> HarrisLens | DivisionLens | PolynomialLens:
    """The lens that a record of ``camera.json`` describes."""
    models: dict[str, type[Any]] = {"harris": HarrisLens, "division": DivisionLens, "polynomial": PolynomialLens}
    lens: HarrisLens | DivisionLens | PolynomialLens = models[record.kind](**record.model_dump(exclude={"kind"}))
    return lens
