"""Plumb-line calibration: the lens is found from straight lines, and left alone where lines say nothing."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from schemas.camera import CameraRecord
from schemas.flight import LensConfig
from tests.scenes import city, frame_grid, photograph, rms_after_homography, similarity
from velfield.camera.lens import HarrisLens, lens_from_record, pinhole
from velfield.camera.plumbline import calibrate
from velfield.errors import InputError

SHAPE = (480, 640)
QUICK = LensConfig(max_edge_points=10_000)


def lens_of(a: float) -> HarrisLens:
    return HarrisLens(a, 324.0, 236.0, 400.0)


def flight(a: float, frames: int = 10, seed: int = 1) -> list[np.ndarray]:
    ground, rng = city(seed), np.random.default_rng(seed)
    middle = np.array([319.5, 239.5])
    views = [similarity(1.0, rng.uniform(-6, 6), middle, rng.uniform(450, 750, 2)) for _ in range(frames)]
    return [photograph(ground, view, lens_of(a), SHAPE, seed + number) for number, view in enumerate(views)]


@pytest.fixture(scope="module")
def barrel() -> list[np.ndarray]:
    return flight(0.2)


@pytest.mark.parametrize("a", [0.08, 0.3])
def test_ten_frames_give_the_lens_to_half_a_pixel(a: float) -> None:
    result = calibrate(flight(a), QUICK)
    assert result.accepted, result.reason
    points = frame_grid(SHAPE, 20)
    found, true = lens_from_record(result.lens).undistort_points(points), lens_of(a).undistort_points(points)
    assert rms_after_homography(found, true) <= 0.5


def test_the_result_says_how_sure_it_is_and_is_the_same_again(barrel: list[np.ndarray]) -> None:
    result = calibrate(barrel, QUICK)
    assert 0 < result.a_sd < 0.02
    assert result.residual_px < result.residual_without_px
    assert [row.model for row in result.candidates] == ["none", "harris", "division", "polynomial-2", "polynomial-3"]
    assert CameraRecord.model_validate_json(result.model_dump_json()) == result
    assert calibrate(barrel, QUICK) == result


def test_a_pinhole_stays_a_pinhole() -> None:
    result = calibrate(flight(0.0), QUICK)
    assert not result.accepted
    assert lens_from_record(result.lens) == pinhole(SHAPE)
    assert "pinhole model kept" in result.reason


def test_blobs_have_no_lines_and_leave_the_lens_alone() -> None:
    rng = np.random.default_rng(0)
    frames = [
        cv2.normalize(cv2.GaussianBlur(rng.normal(0, 1, SHAPE), (0, 0), 6), None, 0, 255, cv2.NORM_MINMAX)
        for _ in range(4)
    ]
    result = calibrate([frame.astype(np.uint8) for frame in frames], QUICK)
    assert not result.accepted
    assert lens_from_record(result.lens).is_identity


def test_black_frames_say_how_many_lines_were_found() -> None:
    result = calibrate([np.zeros(SHAPE, dtype=np.uint8)] * 2, QUICK)
    assert not result.accepted
    assert "0 straight edges in 2 frames" in result.reason


def test_kerbs_that_bend_alike_are_no_lens() -> None:
    frames = []
    for seed in range(6):
        rng, picture = np.random.default_rng(seed), np.full(SHAPE, 110, dtype=np.uint8)
        for _ in range(40):
            middle, radius = rng.uniform(0, 640, 2), int(rng.integers(500, 1500))
            centre = (int(middle[0]), int(middle[1] + rng.choice([-1, 1]) * radius))
            cv2.circle(picture, centre, radius, int(rng.integers(20, 240)), 3, cv2.LINE_AA)
        frames.append(picture)
    assert not calibrate(frames, QUICK).accepted


def test_frames_of_two_sizes_are_refused() -> None:
    with pytest.raises(InputError, match=r"frame 1 has shape \(4, 4\), frame 0 \(480, 640\)"):
        calibrate([np.zeros(SHAPE, dtype=np.uint8), np.zeros((4, 4), dtype=np.uint8)], QUICK)
    with pytest.raises(InputError, match="no frame"):
        calibrate([], QUICK)


@pytest.mark.footage
def test_gopro_chessboards_agree_with_the_reference_calibration(footage: Callable[[str], Path]) -> None:
    folder = footage("plumbline_gopro")
    pictures = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted(folder.rglob("GOPR*.jpg"))]
    pictures = [picture for picture in pictures if picture.shape == (960, 1280)][::3]
    result = calibrate(pictures, LensConfig())
    assert result.accepted, result.reason
    reference = json.loads((folder / "reference_calibration.json").read_text())
    matrix, distortion = np.array(reference["K"]), np.array(reference["D_k1k2p1p2k3"])
    points = frame_grid((960, 1280), 24)
    points = points[np.hypot(*(points - (639.5, 479.5)).T) < 590]
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    true = cv2.undistortPoints(points[:, None], matrix, distortion, None, None, None, criteria)[:, 0]
    true = true * matrix[0, 0] + matrix[:2, 2]
    assert rms_after_homography(lens_from_record(result.lens).undistort_points(points), true) <= 1.0


@pytest.mark.footage
def test_a_drone_camera_that_corrects_itself_is_left_alone(footage: Callable[[str], Path]) -> None:
    paths = sorted(footage("kit_ais").joinpath("MOS74_crossroad").glob("*.png"))[::2]
    assert not calibrate([cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths], LensConfig()).accepted


@pytest.mark.footage
def test_the_bent_kerbs_of_a_crossroads_are_no_lens(footage: Callable[[str], Path]) -> None:
    """The entropy falls to the end of what is searched, and 36 of 50 lines came out straighter: by chance."""
    folder = footage("kit_ais") / "MOS74_crossroad"
    pictures = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted(folder.glob("*.png"))]
    result = calibrate(pictures, LensConfig())
    assert not result.accepted
    assert "no minimum" in result.reason
