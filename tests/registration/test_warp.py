"""Warps, told from pictures whose value is their own coordinate."""

import cv2
import numpy as np
import pytest

from tests.scenes import frame_map
from velfield.camera.lens import HarrisLens, pinhole
from velfield.detection.frame import ComparableFrame
from velfield.registration import warp
from velfield.registration.background import NOT_COVERED, median_of_stack
from velfield.registration.resampling.cells import CELL_PX
from velfield.registration.transforms import FrameTransform, PolyprojectiveTransform
from velfield.registration.warp import Rectification, footprint, warp_to_base

WIDTH, HEIGHT = 240, 180


def moved(matrix: np.ndarray, *, a: float = 0.0) -> FrameTransform:
    return frame_map(matrix, (HEIGHT, WIDTH), HarrisLens(a, 119.5, 89.5, 150.0) if a else None)


def wobbling(amplitude_px: float) -> FrameTransform:
    """Transform of a frame of 640x480 whose rows move in x, in four cycles."""
    rows = np.zeros((3, 48))
    rows[0] = amplitude_px * np.sin(np.linspace(0, 2 * np.pi * 4, 48))
    return FrameTransform(
        width=640,
        height=480,
        lens=pinhole((480, 640)),
        polyprojective=PolyprojectiveTransform.from_homography(np.eye(3), *[np.array([320.0, 240.0, 1 / 400])] * 2),
        row_coefficients=rows,
    )


def coordinate_picture(axis: int) -> np.ndarray:
    line = np.arange(WIDTH if axis == 0 else HEIGHT, dtype=np.uint8)
    return np.tile(line, (HEIGHT, 1)) if axis == 0 else np.tile(line[:, None], (1, WIDTH))


def test_identity_leaves_the_frame_as_it_is() -> None:
    frame = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH), dtype=np.uint8)
    image, mask = warp_to_base(frame, moved(np.eye(3)), window=(0, 0, WIDTH, HEIGHT))
    assert mask.all()
    np.testing.assert_array_equal(image, frame)


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("window", [(0, 0, WIDTH, HEIGHT), (31, 17, 101, 77), (-40, -30, 90, 80)])
def test_every_working_pixel_holds_its_own_raw_coordinate(scale: float, window: tuple[int, int, int, int]) -> None:
    angle = 0.1
    matrix = np.array([[np.cos(angle), -np.sin(angle), 12.0], [np.sin(angle), np.cos(angle), -5.0], [1e-5, 0, 1.0]])
    transform = moved(matrix, a=0.15)
    for axis in range(2):
        image, mask = warp_to_base(coordinate_picture(axis), transform, window=window, scale=scale)
        assert image.shape == (round(window[3] * scale), round(window[2] * scale))
        i, j = np.mgrid[: image.shape[0], : image.shape[1]]
        base = np.stack([window[0] + (j + 0.5) / scale - 0.5, window[1] + (i + 0.5) / scale - 0.5], axis=-1)
        raw = transform.to_raw(base.reshape(-1, 2)).reshape(*image.shape, 2)[..., axis]
        # a reduced picture is averaged over areas: its border is half a large pixel inside
        inner = cv2.erode(mask.astype(np.uint8), np.ones((7, 7)), borderValue=0) > 0
        assert inner.any()
        error = image[inner] - raw[inner]
        # grey levels are whole numbers: rounded once, and once more where areas are averaged first
        assert np.abs(error).max() < (0.6 if scale >= 1 else 1.1)
        assert abs(float(error.mean())) < 0.3
        assert not image[~mask].any()


@pytest.mark.parametrize(("amplitude_px", "cell_px"), [(0.3, 16), (6.0, 8)])
def test_cells_are_small_where_the_rows_wobble_fast(amplitude_px: float, cell_px: int) -> None:
    """Four cycles over 480 rows: what bilinear interpolation leaves stays below a fifth of a pixel either way."""
    moved = wobbling(amplitude_px)
    step, coarse = warp._interpolable_map(moved, window=(0, 0, 640, 480), scale=1.0, shape=(480, 640))
    assert step == cell_px
    dense = cv2.resize(coarse.astype(np.float32), None, fx=step, fy=step, interpolation=cv2.INTER_LINEAR)
    y, x = np.mgrid[60:420:7, 60:580:7]
    exact = moved.to_raw(np.stack([x.ravel(), y.ravel()], axis=1).astype(float)).reshape(*x.shape, 2)
    assert np.abs(dense[step : step + 480, step : step + 640][y, x] - exact).max() < 0.2


def test_shrinking_averages_in_place_of_skipping() -> None:
    frame = np.zeros((HEIGHT, WIDTH), np.uint8)
    frame[::2] = 200
    image, mask = warp_to_base(frame, moved(np.eye(3)), window=(0, 0, WIDTH, HEIGHT), scale=0.25)
    assert mask.all()
    assert np.abs(image.astype(int) - 100).max() <= 2


def test_continued_a_frame_ends_without_an_edge() -> None:
    """A detector would take the border to nothing for a car's side."""
    angle = 0.2
    matrix = np.array([[np.cos(angle), -np.sin(angle), 20.0], [np.sin(angle), np.cos(angle), 10.0], [0, 0, 1.0]])
    window = (-20, -20, WIDTH + 40, HEIGHT + 40)
    image, mask = warp_to_base(
        np.full((HEIGHT, WIDTH), 170, np.uint8), moved(matrix), window=window, replicate_border=True
    )
    assert not mask.all()
    assert (image == 170).all()


def test_footprint_holds_the_frame() -> None:
    shift = np.array([[1.0, 0.0, 7.0], [0.0, 1.0, -3.0], [0.0, 0.0, 1.0]])
    assert footprint(moved(shift), (HEIGHT, WIDTH)) == pytest.approx((7, -3, WIDTH + 6, HEIGHT - 4))


def test_the_median_has_no_traffic_on_it() -> None:
    ground = np.random.default_rng(1).integers(60, 120, (50, 80), dtype=np.uint8)
    stack = np.tile(ground, (11, 1, 1))
    for k in range(11):
        stack[k, 20:28, 7 * k : 7 * k + 12] = 250
    np.testing.assert_array_equal(median_of_stack(stack, np.full(ground.shape, 11)), ground)


@pytest.mark.parametrize("frames", [1, 2, 3, 6, 25, 40, 64])
def test_the_median_is_that_of_the_frames_that_cover_a_pixel(frames: int) -> None:
    rng = np.random.default_rng(frames)
    stack = rng.integers(0, 256, (frames, 3, 700), dtype=np.uint8)
    covered = rng.random(stack.shape) < 0.6
    covered[:, 0, 0] = False
    stack[~covered] = NOT_COVERED
    found = median_of_stack(stack, covered.sum(axis=0))
    plain = np.ma.median(np.ma.array(stack, mask=~covered), axis=0).filled(0)
    np.testing.assert_array_equal(found, np.floor(plain + 0.5))


@pytest.mark.parametrize(("scale", "amplitude_px"), [(1.0, 0.3), (0.9, 6.0), (0.4, 0.3)])
def test_resampled_by_cells_a_frame_is_as_when_resampled_whole(scale: float, amplitude_px: float) -> None:
    frame = cv2.GaussianBlur(np.random.default_rng(3).integers(0, 255, (480, 640), dtype=np.uint8), (0, 0), 2)
    transform, window = wobbling(amplitude_px), (-20, -30, 700, 500)
    whole, mask = warp_to_base(
        frame, transform, window=window, scale=scale, interpolation=cv2.INTER_CUBIC, replicate_border=True
    )
    by_cells = Rectification(frame, transform, window=window, scale=scale)
    cells = np.random.default_rng(4).random([-(-size // CELL_PX) for size in whole.shape]) < 0.5
    by_cells.resample(cells)
    asked = np.kron(cells, np.ones((CELL_PX, CELL_PX), bool))[: whole.shape[0], : whole.shape[1]]
    assert not by_cells.image[~asked].any()
    halves = np.kron(~cells, np.array([[True, False], [False, False]]))
    by_cells.resample(halves[: -(-2 * whole.shape[0] // CELL_PX), : -(-2 * whole.shape[1] // CELL_PX)], CELL_PX // 2)
    assert cv2.absdiff(by_cells.image, whole).max() <= 4
    assert np.abs(by_cells.image.astype(int) - whole).mean() < 0.2
    assert (by_cells.valid != mask).mean() < 1e-3
    half = ComparableFrame(whole, mask)
    assert by_cells.half_image.shape == half.half_image.shape
    assert np.abs(by_cells.half_image.astype(int) - half.half_image).mean() < 2
    assert (by_cells.half_valid != half.half_valid).mean() < 0.01


def test_a_map_inverted_on_a_grid_is_the_inverse() -> None:
    transform = wobbling(6.0)
    base = np.stack(np.meshgrid(np.arange(-40.0, 680, 16), np.arange(-40.0, 520, 16)), axis=2)
    exact = transform.to_raw(base.reshape(-1, 2)).reshape(base.shape)
    assert np.nanmax(np.abs(warp.invert_on_grid(transform, base) - exact)) < 0.005
