"""A given base image to which frames register directly, whatever the verification of a single frame says."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from schemas.camera import CameraRecord
from schemas.job import Inputs, Job
from tests.scenes import city, frame_grid, photograph, rms_after_homography, similarity
from velfield.camera.lens import HarrisLens, PolynomialLens, pinhole
from velfield.errors import Failure, InputError
from velfield.pipeline.configuration import resolve_config
from velfield.pipeline.local import compute_stages
from velfield.pipeline.plan import Plan, make_plan
from velfield.pipeline.stage import STAGE, stages_before
from velfield.pipeline.stages.base_image import build_base
from velfield.pipeline.stages.georeference import georeference_run
from velfield.pipeline.stages.registration import register_unit
from velfield.pipeline.units import prepare_stage
from velfield.registration.intersensor.register import register_intersensor
from velfield.run.frame_transforms import read_grid, read_lens

SHAPE = (360, 480)
CENTRE = np.array([239.5, 179.5])


def displace_rows(grey: np.ndarray) -> np.ndarray:
    """Rows displaced by 4 px, 6 cycles per frame: half a cycle is the height of the verification patches."""
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]].astype(np.float32)
    wave = (4.0 * np.sin(2 * np.pi * 6.0 * y / SHAPE[0])).astype(np.float32)
    return cv2.remap(grey, x + wave, y + 0.7 * np.roll(wave, 30, axis=0), cv2.INTER_CUBIC)


@pytest.fixture(scope="module")
def base() -> np.ndarray:
    return city(3, 640)


def plan_on(
    base: np.ndarray, frames: list[np.ndarray], folder: Path, gsd_m: float | None = None, calibrate: str = "never"
) -> Plan:
    """The plan of a flight of these frames, with the stages frames and lens done."""
    (folder / "frames").mkdir()
    for number, frame in enumerate(frames):
        cv2.imwrite(str(folder / "frames" / f"{number}.png"), frame)
    cv2.imwrite(str(folder / "base.png"), base)
    inputs = Inputs(source=str(folder / "frames"), base=str(folder / "base.png"))
    config = resolve_config(overrides={"frames.fps": 5, "lens.calibrate": calibrate, "gsd_m": gsd_m})
    plan = make_plan(Job(root=str(folder / "run"), inputs=inputs, config=config))
    compute_stages(plan, stages_before("base"))
    return plan


def views(base: np.ndarray) -> list[np.ndarray]:
    """Three frames of the middle of the base image, rotated by about 5 degrees."""
    maps = [similarity(1.0, 4.0 + k, CENTRE, np.array([310.0 + 5 * k, 320.0])) for k in range(3)]
    return [photograph(base, to_base, pinhole(SHAPE), SHAPE, k) for k, to_base in enumerate(maps)]


def test_the_note_gives_scale_and_rotation(base: np.ndarray, tmp_path: Path) -> None:
    plan = plan_on(base, views(base), tmp_path, gsd_m=0.2)
    outcome = build_base(plan)
    assert "frames registered directly to the base image: scale 1.00, rotation 5° cw" in outcome.notes[0]
    assert not outcome.warnings
    assert outcome.counts["covered"] == 1.0
    assert outcome.counts["intersensor_error_px"] < 0.5


def test_another_scale_is_related_to_gsd_m(base: np.ndarray, tmp_path: Path) -> None:
    small = cv2.resize(base, None, fx=0.7, fy=0.7, interpolation=cv2.INTER_AREA)
    plan = plan_on(small, views(base), tmp_path, gsd_m=0.2)
    outcome = build_base(plan)
    assert not outcome.warnings
    prepare_stage(plan, STAGE["registration"])
    register_unit(plan, range(3))
    notes = [line for line in georeference_run(plan).notes if line.startswith("--gsd-m 0.2 is")]
    assert notes == [
        "--gsd-m 0.2 is the ground sample distance of the base image, that of the frames is 0.14 m",
    ]


def test_a_base_image_of_low_resolution_is_rejected_with_the_size_needed(base: np.ndarray, tmp_path: Path) -> None:
    small = cv2.resize(base, None, fx=0.35, fy=0.35, interpolation=cv2.INTER_AREA)
    plan = plan_on(small, views(base), tmp_path)
    with pytest.raises(
        InputError, match=r"found 0\.35 base pixels per frame pixel, expected 0\.5 to 2; .* (639|640|641) x"
    ):
        build_base(plan)


def test_a_base_image_of_a_part_of_the_flight_warns_with_its_coverage(base: np.ndarray, tmp_path: Path) -> None:
    part = np.ascontiguousarray(base[:, :420])
    plan = plan_on(part, views(base), tmp_path)
    warnings = build_base(plan).warnings
    # Frames are 480 px wide about column 315: from column 75 on, so 345 of 480 columns are covered.
    (percent,) = (int(word[:-1]) for line in warnings for word in line.split() if word.endswith("%"))
    assert 66 <= percent <= 78


def test_frames_with_a_rolling_shutter_register_directly(base: np.ndarray, tmp_path: Path) -> None:
    frames = [displace_rows(frame) for frame in views(base)]
    plan = plan_on(base, frames, tmp_path)
    build_base(plan)
    assert read_grid(plan.layout).registered_to == "given"
    assert isinstance(register_intersensor(frames[1], base, plan.config.base, lens=pinhole(SHAPE)), Failure)


@pytest.mark.parametrize(
    ("true", "taken", "before_px", "after_px"),
    [
        # of two terms of which the plumb lines gave one: off by a pixel in the corners
        (PolynomialLens((0.02, 0.05), 322.0, 236.0, 400.0), HarrisLens(0.13, 319.5, 239.5, 400.0), 0.5, 0.25),
        # such an image was refused as one of another area: nothing agreed outside the middle
        (PolynomialLens((0.0636, 0.1198), 319.0, 235.0, 400.0), HarrisLens(0.346, 322.5, 248.0, 400.0), 1.5, 0.3),
    ],
    ids=["one term of two", "far off in the corners"],
)
def test_the_frames_matches_with_the_given_image_correct_the_lens(
    tmp_path: Path, true: PolynomialLens, taken: HarrisLens, before_px: float, after_px: float
) -> None:
    shape, middle, ground = (480, 640), np.array([319.5, 239.5]), city(5, 900, blocks=300)
    poses = [similarity(1.0, 2.0 * k, middle, np.array([450.0 + 4 * k, 450.0])) for k in range(4)]
    frames = [photograph(ground, pose, true, shape, k) for k, pose in enumerate(poses)]
    plan = plan_on(ground, frames, tmp_path, calibrate="auto")
    record = CameraRecord.model_validate_json(plan.layout.camera.read_bytes())
    plan.layout.camera.write_text(record.model_copy(update={"lens": taken.to_record()}).model_dump_json())
    outcome = build_base(plan)
    assert any(note.startswith("lens by the base image: k = ") for note in outcome.notes), outcome.notes
    assert plan.layout.map_lens in outcome.outputs
    points = frame_grid(shape)
    before = rms_after_homography(taken.undistort_points(points), true.undistort_points(points))
    after = rms_after_homography(read_lens(plan.layout).undistort_points(points), true.undistort_points(points))
    assert before > before_px
    assert after < after_px


def test_a_lens_that_is_right_stays(base: np.ndarray, tmp_path: Path) -> None:
    plan = plan_on(base, views(base), tmp_path, calibrate="auto")
    outcome = build_base(plan)
    assert not any("lens" in note for note in outcome.notes)
    assert not plan.layout.map_lens.exists()
