"""Inter-sensor registration: found through tones, turns and scales; another place is refused with its scores."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from schemas.flight import BaseConfig
from tests.scenes import by_homography, city, frame_grid, photograph, similarity
from velfield.camera.lens import HarrisLens, pinhole
from velfield.errors import Failure
from velfield.registration.intersensor.correlation import match_grid
from velfield.registration.intersensor.register import IntersensorResult, register_intersensor

SHAPE = (480, 640)
MIDDLE = np.array([319.5, 239.5])
LENS = HarrisLens(0.15, 324.0, 236.0, 400.0)
CONFIG = BaseConfig()


def other_sensor(ground: np.ndarray, seed: int = 9) -> np.ndarray:
    """The ground in other tones, less sharp, with noise of its own."""
    rng = np.random.default_rng(seed)
    tones = 255.0 * (cv2.GaussianBlur(ground, (0, 0), 1.0) / 255.0) ** 0.6
    return np.clip(tones + rng.normal(0, 3.0, ground.shape), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    return city(4, 900, blocks=220)


@pytest.fixture(scope="module")
def base(ground: np.ndarray) -> np.ndarray:
    return other_sensor(ground)


def view(scale: float, rotation_deg: float) -> np.ndarray:
    return similarity(scale, rotation_deg, MIDDLE, np.array([450.0, 440.0]))


def found(image: np.ndarray, base: np.ndarray) -> IntersensorResult:
    result = register_intersensor(image, base, CONFIG, lens=LENS)
    assert isinstance(result, IntersensorResult), result.reason
    return result


def mean_error_px(result: IntersensorResult, to_base: np.ndarray) -> float:
    raw = frame_grid(SHAPE)
    true = by_homography(to_base, LENS.undistort_points(raw))
    inside = ((true > 0) & (true < 900)).all(axis=1)
    return float(np.linalg.norm(result.transform.to_base(raw[inside]) - true[inside], axis=1).mean())


@pytest.mark.parametrize(("scale", "rotation_deg"), [(1.0, 0.0), (0.6, 137.0), (1.15, -80.0)])
def test_any_turn_and_scale_is_found_to_a_fraction_of_a_pixel(
    ground: np.ndarray, base: np.ndarray, scale: float, rotation_deg: float
) -> None:
    to_base = view(scale, rotation_deg)
    result = found(photograph(ground, to_base, LENS, SHAPE, 1), base)
    assert mean_error_px(result, to_base) < 0.5
    assert result.cv_error_px < 1.0
    assert result.scale == pytest.approx(scale, rel=0.02)
    assert np.degrees(result.rotation_rad) == pytest.approx(rotation_deg, abs=1.0)


def test_scales_of_two_and_a_half(ground: np.ndarray, base: np.ndarray) -> None:
    image = photograph(ground, view(1.0, 20.0), LENS, SHAPE, 1)
    for factor in (0.5, 2.0):
        size = round(900 * factor)
        scaled = cv2.resize(base, (size, size), interpolation=cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC)
        assert found(image, scaled).scale == pytest.approx(factor, rel=0.02)


def test_a_negative_is_found(ground: np.ndarray, base: np.ndarray) -> None:
    to_base = view(1.0, 15.0)
    result = found(photograph(ground, to_base, LENS, SHAPE, 1), np.bitwise_not(base))
    assert mean_error_px(result, to_base) < 0.5


def test_rows_that_wobble_do_not_make_another_place_of_it(ground: np.ndarray, base: np.ndarray) -> None:
    image = photograph(ground, view(1.0, 5.0), LENS, SHAPE, 1)
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]].astype(np.float32)
    wave = (4.0 * np.sin(2 * np.pi * 4.0 * y / SHAPE[0])).astype(np.float32)
    shaken = cv2.remap(image, x + wave, y + 0.7 * np.roll(wave, 30, axis=0), cv2.INTER_LINEAR)
    result = found(shaken, base)
    assert mean_error_px(result, view(1.0, 5.0)) < 2.5
    turned = cv2.rotate(shaken, cv2.ROTATE_180)[:, ::-1].copy()
    assert isinstance(register_intersensor(turned, base, CONFIG, lens=LENS), Failure)


def test_the_error_map_covers_the_ground_seen_and_nothing_else(ground: np.ndarray, base: np.ndarray) -> None:
    result = found(photograph(ground, view(0.6, 0.0), LENS, SHAPE, 1), base)
    spacing = result.error_map_spacing_px
    assert result.error_map.shape == (900 // spacing, 900 // spacing)
    assert np.isfinite(result.error_map[440 // spacing, 450 // spacing])
    assert np.isnan(result.error_map[0, 0])
    assert result.source_raw.shape == result.target.shape == (len(result.cv_errors_px), 2)


def test_another_place_is_refused_in_one_clause_and_its_scores_are_logged(
    base: np.ndarray, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("DEBUG", logger="velfield")
    image = photograph(city(77, 900, blocks=220), view(1.0, 5.0), LENS, SHAPE, 1)
    result = register_intersensor(image, base, CONFIG, lens=LENS)
    assert isinstance(result, Failure)
    assert result.reason == (
        "not an image of this flight's area; give one of the area, seen from above, at 0.5 to 2 times the frames' scale"
    )
    assert "SIFT (intensity): " in caplog.text
    assert "inliers of" in caplog.text
    assert "\n" not in result.reason


def test_a_mirrored_base_image_is_refused_and_called_so(ground: np.ndarray, base: np.ndarray) -> None:
    image = photograph(ground, view(1.0, 5.0), LENS, SHAPE, 1)
    result = register_intersensor(image, np.ascontiguousarray(base[:, ::-1]), CONFIG, lens=LENS)
    assert isinstance(result, Failure)
    assert result.reason.startswith("found a mirrored image (")
    assert result.reason.endswith("flip it")


def test_a_black_frame_and_a_base_image_of_noise_are_refused(ground: np.ndarray, base: np.ndarray) -> None:
    noise = np.random.default_rng(5).integers(0, 256, base.shape).astype(np.uint8)
    image = photograph(ground, view(1.0, 5.0), LENS, SHAPE, 1)
    for pair in ((np.zeros(SHAPE, dtype=np.uint8), base), (image, noise)):
        assert isinstance(register_intersensor(*pair, CONFIG, lens=LENS), Failure)


def test_the_grid_stage_measures_a_known_shift_below_the_pixel(ground: np.ndarray) -> None:
    moved = cv2.warpAffine(ground, np.array([[1.0, 0, 3.3], [0, 1.0, -2.6]]), (900, 900), flags=cv2.INTER_CUBIC)
    mask = np.ones(ground.shape, dtype=bool)
    matches = match_grid(ground, mask, moved, spacing_px=100, patch_px=75, radius_px=8)
    inner = (np.abs(matches.points - 450) < 350).all(axis=1)
    assert np.abs(np.median(matches.displacement[inner], axis=0) - (3.3, -2.6)).max() < 0.1
    assert np.median(matches.score[inner]) > 0.95


@pytest.mark.footage
@pytest.mark.parametrize("negative", [False, True])
def test_west_concord(footage: Callable[[str], Path], negative: bool) -> None:
    folder = footage("westconcord")
    image = cv2.imread(str(folder / "westconcordaerial.png"), cv2.IMREAD_GRAYSCALE)
    base = cv2.imread(str(folder / "westconcordorthophoto.png"), cv2.IMREAD_GRAYSCALE)
    shown = np.bitwise_not(image) if negative else image
    result = register_intersensor(shown, base, CONFIG, lens=pinhole((image.shape[0], image.shape[1])))
    assert isinstance(result, IntersensorResult), result.reason
    assert result.scale == pytest.approx(0.915, abs=0.012)
    assert np.degrees(result.rotation_rad) == pytest.approx(10.3, abs=0.5)
    assert result.cv_error_px < 1.0


def town(seed: int, block_px: int = 110) -> np.ndarray:
    """Equal blocks between streets, with other houses for each seed."""
    rng = np.random.default_rng(seed)
    image = np.full((920, 1160), 130.0, np.float32)
    for x, y, half_width, half_height, grey in rng.uniform((0, 0, 4, 4, 60), (1160, 920, 16, 16, 220), (2500, 5)):
        corners = [(round(x - half_width), round(y - half_height)), (round(x + half_width), round(y + half_height))]
        cv2.rectangle(image, *corners, grey, -1)
    for at, thickness in ((80.0, 12), (200.0, 1)):
        for x in range(20, 1160, block_px):
            cv2.line(image, (x, 0), (x, 920), at, thickness)
        for y in range(30, 920, block_px):
            cv2.line(image, (0, y), (1160, y), at, thickness)
    noisy = cv2.GaussianBlur(image, (0, 0), 1.0) + rng.normal(0, 3, image.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


def test_another_town_of_the_same_blocks_is_refused() -> None:
    """Its streets match in 45 to 50 % of the patches, more than the fourth that a map needs whose place is known."""
    image = town(0)[100:820, 100:1060]
    assert isinstance(register_intersensor(image, town(0), CONFIG, lens=pinhole(image.shape)), IntersensorResult)
    refused = register_intersensor(image, town(1), CONFIG, lens=pinhole(image.shape))
    assert isinstance(refused, Failure)
    assert "not an image of this flight's area" in refused.reason
