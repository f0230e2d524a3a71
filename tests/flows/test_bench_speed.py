"""``velfield bench speed``: a line for every stage, and figures that follow from the network's layers."""

import re
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from flows.commands.benchmarks.speed import speed, stages_by_frame
from schemas.flight import PRESETS, FramesConfig
from tests.benchmarks.long_flight import encode_frames
from velfield.bench.clips import make_clip
from velfield.bench.detection import network_gflop
from velfield.bench.measured_run import run_measured
from velfield.pipeline.stage import STAGE
from velfield.sources.source import iter_frames, probe


def test_the_networks_arithmetic_is_that_of_its_layers() -> None:
    """By hand: channels in and out, taps, and the pixels of the layer's output."""
    pixels = 2560 * 1920
    half, quarter, eighth, sixteenth = pixels / 4, pixels / 16, pixels / 64, pixels / 256
    stem, down1 = half * 16 * 16, quarter * 16 * 16 * 32
    lowest = eighth * (128 * 48 + 4 * 9 * 48 * 48 + 48 * 128)
    lowest += sixteenth * (192 * 96 + 2 * 9 * 96 * 96 + 96 * 192)
    rest = quarter * (2 * 9 * 32 * 32 + 32 * 12)
    assert network_gflop(2560, 1920) == pytest.approx(2e-9 * (stem + down1 + lowest + rest))


def test_the_stages_by_frame_are_those_of_the_flights_rate() -> None:
    assert {"frames", "registration", "detections"} <= set(stages_by_frame()) < set(STAGE)
    assert not {"lens", "base", "detector", "maps"} & set(stages_by_frame())


@pytest.mark.filterwarnings("ignore:The inplace keyword")  # trackpy's
def test_every_stage_is_timed(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PRESETS["fast"]["detection"], "fine_tune_steps", 2)
    assert speed(frames=4, size="640x480", preset="fast", parts=("stages", "network", "peers")) == 0
    told = capsys.readouterr().out
    for name in STAGE:
        line = next(line for line in told.splitlines() if line.startswith(f"{name} "))
        assert ("ms a frame" in line) == (name in stages_by_frame())
    assert float(re.findall(r"set-up apart: ([\d.]+)", told)[0]) > 0
    for what, peer in (
        ("registration", "stabilo"),
        ("tracklets", "trackpy"),
        (r"accumulation, \d+ tiles", "boost-histogram"),
        (r"accumulation, \d+ tiles", "xhistogram"),
    ):
        (line,) = [line for line in told.splitlines() if peer in line] or ["pip install: the peer before it is missing"]
        assert re.match(rf"{what}: [\d.e-]+ s of processor; {peer}.*: [\d.e-]+ s; [\d.e+-]+ times$", line) or (
            "pip install" in line
        )
    rate, peak = re.findall(r"(\d+) GFLOP/s of a peak of (\d+)", told)[0]
    assert 0 < float(rate) < 1.2 * float(peak)


CLIP_FRAMES = 16
"""At 30 a second: three that are used, 0.2 s apart, and no fewer make a tracklet."""


def test_clips_are_timed_with_nothing_given(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    name = "480p H.265"
    monkeypatch.setattr("velfield.bench.clips.CLIPS", {"480p H.264": (640, 480), name: (640, 480)})
    clip = make_clip(name, tmp_path, CLIP_FRAMES)
    monkeypatch.setattr("velfield.bench.clips.CLIPS", {name: (640, 480)})
    assert speed(frames=CLIP_FRAMES, preset="fast", parts=("clips",), work=tmp_path) == 0
    told = capsys.readouterr().out
    assert f"{name}, {CLIP_FRAMES} frames, " in told
    for line in (
        r"^frames +[\d.]+ s, +[\d.]+ s of processor",
        r"libav alone, all frames: [\d.]+ s",
        r"velfield run: [\d.]+ s",
    ):
        assert len(re.findall(line, told, re.MULTILINE)) == 1
    assert probe(clip, frames=FramesConfig(every=1)).frame_count == CLIP_FRAMES


def test_memory_is_that_of_the_driver_and_of_the_largest_worker() -> None:
    hold = "import time; held = bytearray({mb} << 20); held[::4096] = b'x' * len(held[::4096]); time.sleep(1.5)"
    worker = [sys.executable, "-c", hold.format(mb=150), "spawn_main"]
    other = [sys.executable, "-c", hold.format(mb=400)]
    command = f"import subprocess as s; [p.wait() for p in [s.Popen({worker}), s.Popen({other})]]"
    run = run_measured([sys.executable, "-c", command], watch=Path(sys.executable))
    assert run.appeared_s < run.wall_s
    assert run.wall_s > 1.5
    assert run.driver.peak_mb < 100
    assert 150 < run.worker.peak_mb < 250
    assert "worker 0." in run.text()
    with pytest.raises(RuntimeError, match="status 3"):
        run_measured([sys.executable, "-c", "raise SystemExit(3)"])


def test_a_long_flight_of_few_frames_goes_there_and_back(tmp_path: Path) -> None:
    flight = tmp_path / "flight"
    (flight / "frames").mkdir(parents=True)
    for k in range(4):
        cv2.imwrite(str(flight / f"frames/{k:05d}.png"), np.full((64, 96), 40 * (k + 1), np.uint8))
    (flight / "labels.csv").write_text("frame,x_px\n00000.png,1\n00003.png,2\n")
    video, labels = encode_frames(flight, tmp_path / "long", 9)
    info = probe(Path(video), frames=FramesConfig(every=1))
    assert np.diff(info.times_s) == pytest.approx(0.2)
    means = [frame.grey.mean() for frame in iter_frames(Path(video), info, range(info.frame_count))]
    assert means == pytest.approx([40, 80, 120, 160, 120, 80, 40, 80, 120], abs=3)
    assert Path(labels.removeprefix("--labels=")).read_text() == "frame,x_px\n0,1\n"
