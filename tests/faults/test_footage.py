"""Footage that is not what it should be is told with its reason, and what is right is not."""

import re
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from schemas.arrays import GreyImage
from schemas.flight import FramesConfig
from schemas.job import Inputs, Job
from schemas.simulation import CameraSimulation, TimesSimulation
from tests.media import drifting, ground, write_images, write_video
from velfield.camera.lens import pinhole
from velfield.camera.tilt import tilt_of_frames
from velfield.pipeline.configuration import resolve_config
from velfield.pipeline.local import compute_stages
from velfield.pipeline.plan import make_plan, write_flight_record
from velfield.pipeline.stage import stages_before
from velfield.pipeline.stages.frames import flag_frames
from velfield.pipeline.stages.lens import calibrate_flight
from velfield.pipeline.stages.registration import register_unit
from velfield.run.stores import RegistrationStore
from velfield.sources.images import read_grey_image
from velfield.sources.source import probe
from velfield.sources.video.corruption import BlockArtifactDetector
from velfield.synthetic.cases import small_flight

WARNED = FramesConfig()
FRAMES = list(drifting(6, 160, 128))
REAL = Path(__file__).resolve().parents[3] / "shared" / "data"


def quality_warnings(folder: Path, frames: Sequence[GreyImage], *settings: str) -> list[str]:
    return flag_frames(planned(folder, frames, "quality", *settings)).warnings


def planned(folder: Path, frames: Sequence[GreyImage], stage: str, *settings: str):
    """The plan of a flight of these images, computed up to a stage."""
    write_images(folder / "frames", frames)
    config = resolve_config(settings=["frames.fps=5", "frames.every=1", "registration.max_keypoints=800", *settings])
    plan = make_plan(Job(root=str(folder / "run"), inputs=Inputs(source=str(folder / "frames")), config=config))
    write_flight_record(plan)
    compute_stages(plan, stages_before(stage))
    return plan


# ---------------------------------------------------------------------------------------------------------- the video


def test_an_interlaced_video_is_reported(tmp_path: Path) -> None:
    path = write_video(tmp_path / "i.mp4", FRAMES, options={"x264-params": "tff=1"})
    (line,) = probe(path, frames=WARNED).warnings
    assert line.startswith("the video is interlaced")


def test_a_video_of_high_dynamic_range_is_reported(tmp_path: Path) -> None:
    path = write_video(tmp_path / "h.mp4", FRAMES, options={"x264-params": "transfer=arib-std-b67"})
    (line,) = probe(path, frames=WARNED).warnings
    assert "high dynamic range (HLG)" in line


def test_rotation_metadata_is_reported_and_pixels_stay_as_stored(tmp_path: Path) -> None:
    info = probe(write_video(tmp_path / "r.mp4", FRAMES, rotation_deg=90), frames=WARNED)
    (line,) = info.warnings
    assert "rotated by 90 degrees" in line
    assert (info.width, info.height) == (160, 128)


def test_a_usual_video_and_one_of_variable_rate_cause_no_warning(tmp_path: Path) -> None:
    assert probe(write_video(tmp_path / "p.mp4", FRAMES), frames=WARNED).warnings == ()
    times = [0, 1, 2, 5, 6, 9]
    info = probe(write_video(tmp_path / "v.mp4", FRAMES, times=times), frames=WARNED)
    assert info.warnings == ()
    np.testing.assert_allclose(np.diff(info.times_s), np.diff(times) / 25)


# ---------------------------------------------------------------------------------------------------------- the light


def test_night_is_reported(tmp_path: Path) -> None:
    frames = [np.clip(8 + 0.08 * frame, 0, 255).astype(np.uint8) for frame in drifting(5)]
    (line,) = quality_warnings(tmp_path, frames)
    assert "the flight is dark" in line


def test_fog_is_reported(tmp_path: Path) -> None:
    frames = [np.clip(150 + 0.1 * cv2.GaussianBlur(f, (0, 0), 3), 0, 255).astype(np.uint8) for f in drifting(5)]
    assert any("as in fog" in line for line in quality_warnings(tmp_path, frames))


def test_a_cut_to_another_place_is_reported(tmp_path: Path) -> None:
    frames = [*drifting(8, seed=1), *drifting(8, seed=5)]
    (line,) = quality_warnings(tmp_path, frames)
    assert "the picture changes completely at frame 8 (1.600 s)" in line


@pytest.mark.parametrize(("seed", "fps"), [(21, 25.0), (22, 25.0), (23, 5.0)])
def test_a_small_clip_of_a_vibrating_camera_has_no_block_artefacts(seed: int, fps: float) -> None:
    """At 25 frames a second rows move by 2 px against each other: 6 of 40 sound frames were flagged."""
    flight = small_flight(frames=24, width=640, height=480, seed=seed, times=TimesSimulation(fps=fps))
    detector = BlockArtifactDetector()
    assert not any(detector.feed(flight.frame(k)) for k in range(24))


# ----------------------------------------------------------------------------------------------------------- the rate


def photographed(folder: Path, seconds: float, count: int = 5) -> Path:
    """Images with the times that a camera writes, to whole seconds."""
    folder.mkdir()
    for k, grey in enumerate(drifting(count, 160, 120)):
        exif = Image.Exif()
        taken = datetime(2026, 5, 4, 8, 30, tzinfo=UTC) + timedelta(seconds=seconds * k)
        exif.get_ifd(ExifTags.IFD.Exif)[0x9003] = taken.strftime("%Y:%m:%d %H:%M:%S")
        Image.fromarray(grey).save(folder / f"{k}.jpg", exif=exif)
    return folder


def test_a_rate_that_contradicts_the_images_own_times_is_reported(tmp_path: Path) -> None:
    (line,) = probe(photographed(tmp_path / "f", 2.0), frames=FramesConfig(fps=5)).warnings
    assert "5 images would take 0.8 s at that rate, and took 8.0 s" in line
    assert "speeds would be 10 times the true ones; give --fps 0.5" in line


def test_a_rate_that_agrees_and_images_without_times_cause_no_warning(tmp_path: Path) -> None:
    assert probe(photographed(tmp_path / "f", 2.0), frames=FramesConfig(fps=0.5)).warnings == ()
    assert probe(photographed(tmp_path / "burst", 0.2), frames=FramesConfig(fps=5)).warnings == ()
    write_images(tmp_path / "plain", list(drifting(5, 160, 120)))
    assert probe(tmp_path / "plain", frames=FramesConfig(fps=5)).warnings == ()


def test_a_static_camera_and_a_drifting_one_cause_no_warning(tmp_path: Path) -> None:
    rng, scene = np.random.default_rng(0), ground(160, 120)
    still = [np.clip(scene + rng.normal(0, 2, scene.shape), 0, 255).astype(np.uint8) for _ in range(8)]
    assert quality_warnings(tmp_path / "still", still) == []
    assert quality_warnings(tmp_path / "drifting", list(drifting(8))) == []


# ------------------------------------------------------------------------------------------ zoom, obliqueness


def test_a_zoom_in_mid_flight_is_reported(tmp_path: Path) -> None:
    scene = ground(640, 480, seed=3)
    frames = []
    for k, zoom in enumerate([1.0] * 5 + [1.4] * 2):
        matrix = np.array([[zoom, 0, 160 - 320 * zoom + k], [0, zoom, 120 - 240 * zoom]])
        frames.append(cv2.warpAffine(scene, matrix, (320, 240), flags=cv2.INTER_AREA, borderMode=cv2.BORDER_REFLECT))
    plan = planned(tmp_path, frames, "registration", "lens.calibrate=never")
    compute_stages(plan, ("registration",))
    assert RegistrationStore(plan.layout.registration).statuses()[5:] == ["ok", "ok"]
    (line,) = register_unit(plan, range(7)).warnings
    assert "frames 5 to 6 show the ground at up to 1.4" in line


def turned(tilts_deg: Sequence[float]) -> list[GreyImage]:
    """Frames of one place that look so many degrees away from the vertical."""
    scene, focal, middle = ground(900, 700, seed=3), 400.0, np.array([160.0, 120.0])
    frames = []
    for k, tilt_deg in enumerate(tilts_deg):
        tilt = np.radians(tilt_deg)
        down = np.array([[1, 0, 450 + k], [0, 1, 350], [0, 0, 1.0]]) @ np.diag([1, 1, 1 / focal])
        turn = np.array([[1, 0, 0], [0, np.cos(tilt), np.sin(tilt)], [0, -np.sin(tilt), np.cos(tilt)]])
        to_middle = np.array([[1, 0, 0], [0, 1, -focal * np.tan(tilt)], [0, 0, 1.0]])
        to_ground = to_middle @ down @ turn @ np.array([[1, 0, -middle[0]], [0, 1, -middle[1]], [0, 0, focal]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        frames.append(cv2.warpPerspective(scene, to_ground, (320, 240), flags=flags, borderMode=cv2.BORDER_REFLECT))
    return frames


def test_a_turn_towards_the_horizon_in_mid_flight_is_reported(tmp_path: Path) -> None:
    """The last two of seven frames look 30 degrees away from the vertical, at the same place."""
    plan = planned(tmp_path, turned([0, 2, 0, 3, 1, 28, 30]), "registration", "lens.calibrate=never")
    compute_stages(plan, ("registration",))
    assert RegistrationStore(plan.layout.registration).statuses() == ["ok"] * 7
    (line,) = [line for line in register_unit(plan, range(7)).warnings if "degrees" in line]
    found = re.search(r"at up to (\d+) degrees from the base image's view", line)
    assert 22 <= int(found[1]) <= 33


def test_frames_of_a_turn_by_60_degrees_are_lost_with_the_reason(tmp_path: Path) -> None:
    """The sharpest frame is one of them; the base image is of those that most frames overlap with."""
    plan = planned(tmp_path, turned([0, 2, 0, 3, 1, 60, 60]), "registration", "lens.calibrate=never")
    compute_stages(plan, ("registration",))
    statuses = RegistrationStore(plan.layout.registration).statuses()
    assert statuses[:5] == ["ok"] * 5
    assert all(status.startswith("failed:") for status in statuses[5:])


def oblique(tilt_deg: float, seed: int = 21) -> GreyImage:
    camera = CameraSimulation(mean_tilt_deg=tilt_deg)
    return small_flight(frames=1, width=800, height=600, seed=seed, camera=camera).frame(0)


def test_an_oblique_view_is_reported(tmp_path: Path) -> None:
    frame = oblique(40.0)
    found = tilt_of_frames([frame], pinhole(frame.shape))
    assert found.is_oblique
    assert found.degrees == pytest.approx(40, abs=6)
    plan = planned(tmp_path, [frame, np.roll(frame, 2, axis=1), np.roll(frame, 4, axis=1)], "lens", "lens.refine=never")
    (line,) = calibrate_flight(plan).warnings
    assert "the camera looks at the ground obliquely" in line
    assert "--base" in line


def test_a_view_from_above_is_not() -> None:
    frame = oblique(0.0)
    found = tilt_of_frames([frame], pinhole(frame.shape))
    assert not found.is_oblique
    assert found.degrees < 10


@pytest.mark.skipif(not REAL.is_dir(), reason="the real footage is not here")
@pytest.mark.parametrize(
    ("name", "is_oblique"),
    [(f"songdo/{frame}.jpg", False) for frame in ("00003", "00972", "03936")] + [("minsk/DJI_0762-00003.jpg", True)],
)
def test_real_views_from_above_are_not_and_an_oblique_one_is(name: str, is_oblique: bool) -> None:
    frame = read_grey_image(REAL / name, 10**9)
    found = tilt_of_frames([frame], pinhole(frame.shape))
    assert (found is not None and found.is_oblique) == is_oblique
