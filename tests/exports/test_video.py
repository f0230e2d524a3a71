"""`velfield export --format video`, read back by PyAV."""

import itertools
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from schemas.export import ExportOptions
from velfield import open_run
from velfield.errors import InputError
from velfield.exports.export import export_run
from velfield.exports.pictures import video

WIDTH = 640


@pytest.fixture(scope="module")
def clip(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    steps: list[tuple[int, int]] = []
    path = tmp_path_factory.mktemp("video") / "clip.mp4"
    run = open_run(whole)
    export_run(run, "video", path, ExportOptions(width_px=WIDTH), lambda done, total: steps.append((done, total)))
    registered = run.registration_status.count("ok")
    assert steps == [(k, registered) for k in range(1, registered + 1)]
    assert [found.name for found in path.parent.iterdir()] == [path.name]  # nothing half-written is left
    return path


def test_the_clip_is_h264_and_keeps_the_true_times(clip: Path, whole: Path) -> None:
    run = open_run(whole)
    times = run.times_s[[status == "ok" for status in run.registration_status]]
    with av.open(str(clip)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"  # what every player reads
        shown = [float(frame.pts * frame.time_base) for frame in container.decode(video=0)]
        height = round(run.grid.height_px * WIDTH / run.grid.width_px)
        assert stream.height == height - height % 2
        assert stream.width >= WIDTH
    np.testing.assert_allclose(shown, times - times[0], atol=1e-3)


def test_a_vehicle_is_drawn_where_its_track_is(clip: Path, whole: Path) -> None:
    run = open_run(whole)
    frames = [k for k, status in enumerate(run.registration_status) if status == "ok"]
    chosen = frames[len(frames) // 2]
    with av.open(str(clip)) as container:
        image = list(container.decode(video=0))[frames.index(chosen)].to_ndarray(format="rgb24")
    saturation = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)[..., 1]
    segments = run.segments()
    here = segments[np.abs(segments["start_s"] - run.times_s[chosen]) < 1e-6]
    fast = here[np.hypot(here["vx_px_per_s"], here["vy_px_per_s"]) > 40]
    assert len(fast) >= 3, "the test needs vehicles that drive"
    scale = WIDTH / run.grid.width_px
    at = [(int((y + 0.5) * scale), int((x + 0.5) * scale)) for x, y in zip(fast["x0_px"], fast["y0_px"], strict=True)]
    assert np.mean([saturation[place] > 100 for place in at]) > 0.8


def test_speeds_do_not_cover_one_another(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = open_run(whole)
    scene = video._Scene.of(run, ExportOptions(width_px=900))
    written: list[tuple[str, tuple[int, int], float]] = []
    monkeypatch.setattr(video._Scene, "_write", staticmethod(lambda image, *what: written.append(what)))
    scene.draw(scene.base, np.ones(scene.base.shape, bool), float(np.nanmedian(run.times_s)))
    labels = [(text, at) for text, at, _ in written if ":" not in text]
    assert len(labels) >= 5, "the test needs vehicles that drive"
    assert all(int(text) >= 1 for text, _ in labels)
    boxes = []
    for text, (x, y) in labels:
        (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, video._LABEL_SIZE, 1)
        boxes.append((x, y - height, x + width, y))
    for (x0, y0, x1, y1), (u0, v0, u1, v1) in itertools.combinations(boxes, 2):
        assert x1 <= u0 or u1 <= x0 or y1 <= v0 or v1 <= y0


def test_a_video_that_no_player_reads_is_refused(whole: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--width 9000: found a video of 9000 x \d+ px"):
        export_run(open_run(whole), "video", tmp_path / "clip.mp4", ExportOptions(width_px=9000))
    assert not list(tmp_path.iterdir())


def test_vehicles_are_drawn_as_long_as_they_were_measured(whole: Path) -> None:
    run = open_run(whole)
    lengths_m = run.vehicles().set_index("track_id")["length_m"].dropna()
    tracks = video._Tracks.of(run, 5.0)
    drawn_m = np.unique(np.round(tracks.cars_long * video._LENGTH_M, 3))
    known_m = set(np.round(np.maximum(lengths_m, 2 * video._WIDTH_M), 3)) | {video._LENGTH_M}
    assert len(drawn_m) > 3
    assert all(np.min(np.abs(np.array(sorted(known_m)) - one)) < 2e-3 for one in drawn_m)
    boxes = video._boxes(np.zeros((2, 2)), np.array([0.0, np.pi / 2]), np.array([20.0, 50.0]), 8.0)
    assert np.ptp(boxes, axis=1) == pytest.approx(np.array([[20.0, 8.0], [8.0, 50.0]]))
