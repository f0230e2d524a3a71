"""Maps of registration: each against plain numpy, its inverse, and its place in a vector."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.flight import RegistrationConfig
from velfield.camera.lens import DivisionLens, HarrisLens, PolynomialLens
from velfield.registration.transforms import (
    ComposedTransform,
    FrameTransform,
    HomographyTransform,
    PolyprojectiveTransform,
    count_row_knots,
    fit_normalisation,
    mesh_shape,
    normalisation_matrix,
    vector_length,
)

WIDTH, HEIGHT = 640, 480
CONFIG = RegistrationConfig(row_spline_knots=20)
LENSES = (
    HarrisLens(0.2, 323.0, 236.0, 400.0),
    DivisionLens(0.1, 323.0, 236.0, 400.0),
    PolynomialLens((0.1, 0.02), 323.0, 236.0, 400.0),
)


def grid(columns: int = 17, rows: int = 13, *, inset: float = 0.0) -> np.ndarray:
    x, y = np.linspace(inset, WIDTH - 1 - inset, columns), np.linspace(inset, HEIGHT - 1 - inset, rows)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def homography(rng: np.random.Generator) -> np.ndarray:
    angle, scale = rng.uniform(-np.pi, np.pi), rng.uniform(0.5, 2.0)
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    tilt = rng.uniform(-1e-4, 1e-4, 2)
    return np.array([[c, -s, rng.uniform(-500, 500)], [s, c, rng.uniform(-500, 500)], [tilt[0], tilt[1], 1.0]])


def bent(rng: np.random.Generator) -> PolyprojectiveTransform:
    """A polyprojective that is a homography and some bending of a few pixels."""
    matrix = homography(rng)
    source = fit_normalisation(grid())
    target = fit_normalisation(HomographyTransform(matrix)(grid()))
    plain = PolyprojectiveTransform.from_homography(matrix, source, target)
    bend = np.zeros((3, 6))
    bend[:, 3:] = rng.uniform(-0.01, 0.01, (3, 3))
    return PolyprojectiveTransform(plain.coefficients + bend, source, target)


def frame_transform(rng: np.random.Generator, *, mesh: bool = True) -> FrameTransform:
    """Everything at once: lens, bending, rows that move by some pixels and roll, a mesh."""
    rows = rng.normal(0, 1.0, (3, CONFIG.row_spline_knots)) * np.array([[2.0], [2.0], [2e-3]])
    shape = mesh_shape(WIDTH, HEIGHT, CONFIG.cell_size_px)
    return FrameTransform(
        width=WIDTH,
        height=HEIGHT,
        lens=HarrisLens(0.2, 323.0, 236.0, 400.0),
        polyprojective=bent(rng),
        row_coefficients=rows,
        mesh=rng.normal(0, 1.0, (*shape, 2)) if mesh else None,
        cell_size_px=CONFIG.cell_size_px,
    )


def test_rational_is_the_plain_formula() -> None:
    p = bent(np.random.default_rng(0))
    xy = grid()
    x, y = ((xy - p.source[:2]) * p.source[2]).T
    m = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    a, b, c = (m @ row for row in p.coefficients)
    plain = np.stack([a / c, b / c], axis=1) / p.target[2] + p.target[:2]
    np.testing.assert_allclose(p(xy), plain, atol=1e-9)


def test_jacobian_is_the_difference_quotient() -> None:
    p = bent(np.random.default_rng(1))
    step = 1e-4
    for axis in range(2):
        d = np.eye(2)[axis] * step
        np.testing.assert_allclose(
            p.jacobian(grid())[:, :, axis], (p(grid() + d) - p(grid() - d)) / (2 * step), atol=1e-5
        )


def test_polyprojective_without_bending_is_the_homography() -> None:
    matrix = homography(np.random.default_rng(2))
    p = PolyprojectiveTransform.from_homography(matrix, fit_normalisation(grid()), np.array([3.0, 4.0, 0.01]))
    assert p.is_homography
    np.testing.assert_allclose(p(grid()), HomographyTransform(matrix)(grid()), atol=1e-8)
    np.testing.assert_allclose(p.homography(), matrix, atol=1e-10)


@settings(max_examples=25)
@given(st.integers(0, 10_000))
def test_polyprojective_inverse_undoes_it(seed: int) -> None:
    p = bent(np.random.default_rng(seed))
    np.testing.assert_allclose(p.inverse(p(grid())), grid(), atol=1e-3)


@settings(max_examples=25)
@given(st.integers(0, 10_000))
def test_to_raw_undoes_to_base_below_a_thousandth_of_a_pixel(seed: int) -> None:
    t = replace(frame_transform(np.random.default_rng(seed)), lens=LENSES[seed % len(LENSES)])
    raw = grid(31, 23)
    back = t.to_raw(t.to_base(raw))
    assert np.isfinite(back).all()
    assert np.abs(t.to_base(back) - t.to_base(raw)).max() < 1e-3


@pytest.mark.parametrize("seed", range(3))
def test_to_raw_in_frame_starts_a_search_where_to_raw_ends(seed: int) -> None:
    transform, raw = frame_transform(np.random.default_rng(seed)), grid()
    base = transform.to_base(raw)
    found, slopes = transform.to_raw_in_frame(base)
    assert np.hypot(*(found - transform.to_raw(base)).T).max() < 0.05
    np.testing.assert_allclose(
        slopes @ transform.jacobian(raw), np.broadcast_to(np.eye(2), (len(raw), 2, 2)), atol=0.02
    )
    far = transform.to_base(np.array([[-300.0, 100.0]]))
    assert all(np.isnan(part).all() for part in transform.to_raw_in_frame(far))


def test_to_raw_is_nan_far_outside_the_frame() -> None:
    t = frame_transform(np.random.default_rng(3))
    far = t.to_base(np.array([[320.0, 240.0]])) + np.array([1e5, 1e5])
    assert np.isnan(t.to_raw(far)).all()
    assert np.isnan(t.to_base(np.array([[np.nan, 1.0]]))).all()


@pytest.mark.parametrize("model", ["row_spline", "polyprojective", "homography"])
def test_vector_brings_the_transform_back(model: str) -> None:
    config = RegistrationConfig.model_validate({"model": model, "row_spline_knots": 20})
    t = frame_transform(np.random.default_rng(5))
    if model != "row_spline":
        t = replace(t, row_coefficients=np.zeros((3, 0)))
    vector = t.to_vector(config)
    assert vector.shape == (vector_length(WIDTH, HEIGHT, config),)
    back = FrameTransform.from_vector(vector, width=WIDTH, height=HEIGHT, lens=t.lens, config=config)
    np.testing.assert_array_equal(back.to_base(grid()), t.to_base(grid()))


def test_composition_is_one_map_after_the_other() -> None:
    rng = np.random.default_rng(6)
    t, p = frame_transform(rng), bent(rng)
    both = ComposedTransform(t, p)
    raw = grid(inset=20)
    there = both.to_base(raw)
    np.testing.assert_allclose(there, p(t.to_base(raw)))
    good = np.isfinite(there).all(axis=1)
    back = both.to_raw(there[good])
    found = np.isfinite(back).all(axis=1)
    assert np.abs(both.to_base(back[found]) - there[good][found]).max() < 1e-2


@settings(max_examples=25)
@given(st.integers(0, 10_000))
def test_a_homography_and_its_inverse_cancel(seed: int) -> None:
    h = HomographyTransform(homography(np.random.default_rng(seed)))
    np.testing.assert_allclose(h.inverse(h(grid())), grid(), atol=1e-6)
    np.testing.assert_allclose(h(h.inverse(h(grid()))), h(grid()), atol=1e-6)


def test_a_homography_is_the_plain_formula() -> None:
    matrix = homography(np.random.default_rng(9))
    x, y, w = matrix @ np.column_stack([grid(), np.ones(len(grid()))]).T
    np.testing.assert_allclose(HomographyTransform(matrix)(grid()), np.stack([x / w, y / w], axis=1), atol=1e-9)


def test_a_homography_has_no_value_beyond_its_horizon() -> None:
    h = HomographyTransform(np.array([[1.0, 0, 0], [0, 1.0, 0], [-0.01, 0, 1.0]]))  # the horizon is x = 100
    assert np.isfinite(h(np.array([[99.0, 5.0], [101.0, 5.0]]))).all(axis=1).tolist() == [True, False]


@settings(max_examples=25)
@given(st.integers(0, 10_000))
def test_normalised_points_lie_in_the_unit_square_and_touch_it(seed: int) -> None:
    xy = np.random.default_rng(seed).uniform(-1e4, 1e4, (20, 2))
    cx, cy, s = fit_normalisation(xy)
    normalised = HomographyTransform(normalisation_matrix(np.array([cx, cy, s])))(xy)
    assert np.abs(normalised).max() == pytest.approx(1.0)
    np.testing.assert_allclose(normalised, (xy - [cx, cy]) * s, atol=1e-9)


def test_normalisation_ignores_points_without_a_value() -> None:
    xy = np.array([[0.0, 0.0], [10.0, 4.0], [np.nan, 1e9], [np.inf, 3.0]])
    np.testing.assert_allclose(fit_normalisation(xy), [5.0, 2.0, 0.2])
    assert fit_normalisation(np.ones((3, 2)))[2] == pytest.approx(1e9)  # one point: no extent to scale


@pytest.mark.parametrize(("scale", "degrees"), [(1.0, 0.0), (0.6, 137.0), (1.4, -80.0)])
def test_scale_and_rotation_are_those_of_the_similarity(scale: float, degrees: float) -> None:
    angle = np.radians(degrees)
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    norm = fit_normalisation(grid())
    matrix = np.array([[c, -s, 30.0], [s, c, -10.0], [0.0, 0.0, 1.0]])
    p = PolyprojectiveTransform.from_homography(matrix, norm, norm)
    t = FrameTransform(width=WIDTH, height=HEIGHT, lens=HarrisLens(0.2, 319.5, 239.5, 400.0), polyprojective=p)
    found = t.scale_and_rotation()
    assert found[0] == pytest.approx(scale, rel=1e-3)
    assert np.degrees(found[1]) == pytest.approx(degrees, abs=0.01)


def test_jacobian_of_the_whole_map_is_its_difference_quotient() -> None:
    t, raw, step = frame_transform(np.random.default_rng(8)), grid(inset=30), 1e-3
    for axis in range(2):
        d = np.eye(2)[axis] * step
        quotient = (t.to_base(raw + d) - t.to_base(raw - d)) / (2 * step)
        # central differences of 0.25 px, over the kinks of the mesh and the spline's curvature
        assert np.abs(t.jacobian(raw)[:, :, axis] - quotient).mean() < 1e-3


def test_a_vector_of_another_configuration_is_refused() -> None:
    t = frame_transform(np.random.default_rng(9))
    other = RegistrationConfig(row_spline_knots=24)
    with pytest.raises(ValueError, match=f"expected {vector_length(WIDTH, HEIGHT, other)}"):
        t.to_vector(other)


def test_only_the_row_spline_model_has_knots() -> None:
    models = ("row_spline", "polyprojective", "homography")
    knots = [count_row_knots(RegistrationConfig.model_validate({"model": model})) for model in models]
    assert knots[0] == RegistrationConfig().row_spline_knots > 0
    assert knots[1:] == [0, 0]
