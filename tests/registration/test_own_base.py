"""The flight's own base image: its grid, the reference frame's row motion, the mosaic."""

import numpy as np
import pytest

from tests.scenes import city, frame_map
from velfield.camera.lens import HarrisLens, pinhole
from velfield.registration import own_base
from velfield.registration.control_points import ControlPoints
from velfield.registration.transforms import FrameTransform

SHAPE = HEIGHT, WIDTH = 120, 160
GRID = own_base._Grid(WIDTH, HEIGHT, pinhole(SHAPE), (0, 0))


def shift(x: float, y: float) -> FrameTransform:
    """The map of a frame that sees the base image from (x, y) on."""
    return frame_map(np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]]), SHAPE)


def wave(rows: np.ndarray, cycles: float = 2.0) -> np.ndarray:
    """Row motion (n, 2), px."""
    angle = 2 * np.pi * cycles * rows / HEIGHT
    return np.stack([1.5 * np.sin(angle), 0.8 * np.cos(angle)], axis=1)


def test_the_grid_is_the_reference_frame_undistorted_and_shifted() -> None:
    lens = HarrisLens(0.2, 80.0, 61.0, 100.0)
    grid = own_base._Grid(WIDTH, HEIGHT, lens, (-12, -9))
    raw = np.random.default_rng(0).uniform([0, 0], [WIDTH - 1, HEIGHT - 1], (50, 2))
    base = lens.undistort_points(raw) + np.array([12.0, 9.0])
    np.testing.assert_allclose(grid.transform.to_base(raw), base, atol=1e-8)
    np.testing.assert_allclose(grid.rows(base), raw[:, 1], atol=1e-8)


def test_the_row_motion_of_the_reference_is_the_mean_of_all_frames() -> None:
    """Each frame shows the base image's wave, at the row of the base image, and a wave of its own."""
    rng, registered = np.random.default_rng(1), {}
    for frame in range(24):
        transform = shift(*rng.uniform(-10, 10, 2))
        raw = rng.uniform([0, 0], [WIDTH - 1, HEIGHT - 1], (400, 2))
        own = rng.normal() * wave(raw[:, 1] + rng.uniform(0, HEIGHT), cycles=3.0)
        plain = transform.to_base(raw)
        base = plain + wave(plain[:, 1]) + own + rng.normal(0, 0.1, raw.shape)
        registered[frame] = (transform, ControlPoints(raw, base, np.ones(len(raw))))
    coefficients = own_base._estimate_row_motion(registered, GRID)
    rows = np.arange(5.0, HEIGHT - 5.0)
    found = own_base._row_motion(coefficients, GRID, np.stack([rows, rows], axis=1))
    expected = wave(rows)
    off = found - expected
    assert np.sqrt((off - off.mean(axis=0)) ** 2).mean() < 0.35  # 1.2 RMS without; the frames' own waves average out
    assert np.corrcoef(found[:, 0], expected[:, 0])[0, 1] > 0.95


def test_a_row_corrected_map_is_undone_by_its_inverse() -> None:
    rows = np.linspace(0, HEIGHT - 1, own_base._MOTION_KNOTS)
    corrected = own_base._RowCorrectedMap(shift(7.0, -4.0), GRID, wave(rows).T)
    raw = np.random.default_rng(2).uniform([0, 0], [WIDTH - 1, HEIGHT - 1], (80, 2))
    base = corrected.to_base(raw)
    assert np.abs(base - shift(7.0, -4.0).to_base(raw)).max() > 1.0
    np.testing.assert_allclose(corrected.to_raw(base), raw, atol=1e-3)


def test_without_row_motion_the_map_is_the_frame_s_own() -> None:
    corrected = own_base._RowCorrectedMap(shift(7.0, -4.0), GRID, np.zeros((2, own_base._MOTION_KNOTS)))
    raw = np.array([[10.0, 20.0], [100.0, 90.0]])
    np.testing.assert_array_equal(corrected.to_base(raw), shift(7.0, -4.0).to_base(raw))


@pytest.fixture(scope="module")
def mosaic() -> tuple[np.ndarray, tuple[tuple[int, int], np.ndarray, np.ndarray]]:
    """Five frames of a city, each with a vehicle of its own, cut out at whole pixels."""
    ground = city(51, 240, blocks=60)
    corners = {0: (30, 40), 1: (34, 46), 2: (25, 35), 3: (41, 40), 4: (30, 31)}
    frames, registered = {}, {}
    for frame, (x, y) in corners.items():
        grey = ground[y : y + HEIGHT, x : x + WIDTH].copy()
        grey[50:56, 20 * frame + 20 : 20 * frame + 32] = 255
        frames[frame] = grey
        points = ControlPoints(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
        registered[frame] = (shift(x - 30.0, y - 40.0), points)
    return ground, own_base._build_mosaic(frames.__getitem__, registered, GRID, np.zeros((2, own_base._MOTION_KNOTS)))


def test_the_mosaic_is_the_ground_without_vehicles(
    mosaic: tuple[np.ndarray, tuple[tuple[int, int], np.ndarray, np.ndarray]],
) -> None:
    ground, ((x0, y0), image, valid) = mosaic
    seen = ground[40 + y0 : 40 + y0 + image.shape[0], 30 + x0 : 30 + x0 + image.shape[1]]
    assert valid.mean() > 0.75
    difference = np.abs(image[valid].astype(int) - seen[valid])
    assert np.percentile(difference, 99) <= 1


def test_the_mosaic_covers_all_frames_and_knows_where_few_overlap(
    mosaic: tuple[np.ndarray, tuple[tuple[int, int], np.ndarray, np.ndarray]],
) -> None:
    _, ((x0, y0), image, valid) = mosaic
    assert (x0, y0) == (-5, -9)
    assert np.abs(np.subtract(image.shape, (HEIGHT + 9 + 6, WIDTH + 5 + 11))).max() <= 1  # a corner at 125.0 + 1e-14
    assert not valid[0].any()  # one frame alone reaches there
    assert valid[9:120, 16:150].all()
