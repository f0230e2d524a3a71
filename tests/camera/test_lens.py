"""Lens models: there and back, derivative, domain, records."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from velfield.camera.lens import DivisionLens, HarrisLens, Lens, PolynomialLens, lens_from_record, pinhole

SHAPE = (960, 1280)
CENTRE = (652.0, 471.0)

LENSES = [
    HarrisLens(0.3, *CENTRE, 800.0),
    HarrisLens(-0.2, *CENTRE, 800.0),
    DivisionLens(0.4, *CENTRE, 800.0),
    DivisionLens(-0.1, *CENTRE, 800.0),
    PolynomialLens((0.3, 0.1), *CENTRE, 800.0),
    PolynomialLens((0.5, 0.2, 0.4), *CENTRE, 800.0),
    PolynomialLens((-0.1, 0.02), *CENTRE, 800.0),
]


def frame_points(step: int = 37) -> np.ndarray:
    y, x = np.mgrid[0 : SHAPE[0] : step, 0 : SHAPE[1] : step]
    return np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)


@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_distort_undoes_undistort(lens: Lens) -> None:
    xy = frame_points()
    assert np.abs(lens.distort_points(lens.undistort_points(xy)) - xy).max() < 1e-8


@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_tangents_are_the_derivative_of_the_undistortion(lens: Lens) -> None:
    xy, step = frame_points(101), 1e-3
    for direction in np.array([[1.0, 0.0], [0.6, 0.8]]):
        tangents = np.broadcast_to(direction, xy.shape)
        moved = lens.undistort_points(xy + step * direction) - lens.undistort_points(xy - step * direction)
        assert np.abs(lens.undistort_tangents(xy, tangents) - moved / (2 * step)).max() < 1e-6


@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_a_record_gives_the_same_lens(lens: Lens) -> None:
    record = type(lens.to_record()).model_validate_json(lens.to_record().model_dump_json())
    assert lens_from_record(record) == lens


@given(a=st.floats(-0.9, 0.9), x=st.floats(0, 1279), y=st.floats(0, 959))
def test_harris_is_closed_both_ways_wherever_it_is_defined(a: float, x: float, y: float) -> None:
    lens, xy = HarrisLens(a, 639.5, 479.5, 800.0), np.array([[x, y]])
    undistorted = lens.undistort_points(xy)
    assert np.isnan(undistorted).all() or np.abs(lens.distort_points(undistorted) - xy).max() < 1e-6


@given(
    st.lists(st.floats(-0.4, 0.8), min_size=1, max_size=3),
    st.floats(0, 1279),
    st.floats(0, 959),
)
def test_a_polynomial_is_undone_within_its_fold(coefficients: list[float], x: float, y: float) -> None:
    lens, xy = PolynomialLens(tuple(coefficients), 639.5, 479.5, 800.0), np.array([[x, y]])
    radius = float(np.hypot(x - 639.5, y - 479.5)) / 800.0
    if radius < 0.95 * lens.fold_radius():
        assert np.abs(lens.distort_points(lens.undistort_points(xy)) - xy).max() < 1e-5


def test_the_centre_stays_and_its_scale_is_one() -> None:
    for lens in LENSES:
        near = np.array([CENTRE, (CENTRE[0] + 0.01, CENTRE[1])])
        assert np.abs(lens.undistort_points(near) - near).max() < 1e-6


def test_no_value_outside_the_domain() -> None:
    far = np.array([[1e5, 1e5]])
    assert np.isnan(HarrisLens(0.5, *CENTRE, 800.0).undistort_points(far)).all()
    assert np.isnan(HarrisLens(-0.5, *CENTRE, 800.0).distort_points(far)).all()
    assert np.isnan(DivisionLens(0.5, *CENTRE, 800.0).undistort_points(far)).all()
    assert np.isnan(DivisionLens(-0.5, *CENTRE, 800.0).distort_points(far)).all()
    folding = PolynomialLens((-0.3,), *CENTRE, 800.0)
    assert np.isfinite(folding.fold_radius())
    assert np.isnan(folding.undistort_points(far)).all()
    assert np.isnan(folding.distort_points(far)).all()


def test_the_pinhole_changes_nothing() -> None:
    lens, xy = pinhole(SHAPE), frame_points()
    assert lens.is_identity
    assert np.array_equal(lens.undistort_points(xy), xy)
    assert np.array_equal(lens.distort_points(xy), xy)


@pytest.mark.parametrize("a", [0.3, -0.3, 0.0])
def test_harris_is_the_plain_formula_to_the_bit(a: float) -> None:
    xy = np.random.default_rng(2).uniform(-2000, 3000, (500, 2))
    xy[0] = np.nan
    lens = HarrisLens(a, 640.3, 470.1, 800.0)
    offsets = xy - [640.3, 470.1]
    square = 1 - a * ((offsets[:, :1] ** 2 + offsets[:, 1:] ** 2) / 800.0**2)
    plain = offsets / np.sqrt(np.where(square > 0, square, np.nan)) + [640.3, 470.1]
    np.testing.assert_array_equal(lens.undistort_points(xy), plain)
    assert lens.undistort_points(xy[:1].reshape(1, 1, 2)).shape == (1, 1, 2)


def test_division_and_polynomial_are_the_plain_formulas_to_the_bit() -> None:
    xy = np.random.default_rng(3).uniform(-2000, 3000, (500, 2))
    xy[0] = np.nan
    offsets = (xy - [640.3, 470.1]) / 800.0
    radius2 = offsets[:, :1] ** 2 + offsets[:, 1:] ** 2
    for k in (0.2, -0.2):
        divisor = 1 - k * radius2
        inside = (divisor > 0) & (k * radius2 > -1)
        plain = offsets * (1 / np.where(inside, divisor, np.nan)) * 800.0 + [640.3, 470.1]
        np.testing.assert_array_equal(DivisionLens(k, 640.3, 470.1, 800.0).undistort_points(xy), plain)
    for coefficients in ((0.1, 0.03), (-0.1, 0.02), ()):
        lens = PolynomialLens(coefficients, 640.3, 470.1, 800.0)
        scale = np.polynomial.polynomial.polyval(radius2, [1.0, *coefficients])
        plain = offsets * np.where(radius2 < lens.fold_radius() ** 2, scale, np.nan) * 800.0 + [640.3, 470.1]
        np.testing.assert_array_equal(lens.undistort_points(xy), plain)
