"""``velfield bench speed``: a line for every stage, and figures that follow from the network's layers."""

import re

import pytest

from flows.commands.bench_speed import speed, stages_by_frame
from schemas.flight import PRESETS
from velfield.bench.detection import network_gflop
from velfield.pipeline.stage import STAGE


def test_the_networks_arithmetic_is_that_of_its_layers() -> None:
    """By hand: channels in and out, taps, and the pixels of the layer's output."""
    pixels = 2560 * 1920
    half, quarter, eighth = pixels / 4, pixels / 16, pixels / 64
    stem, down1 = half * 16 * 16, quarter * 16 * 16 * 32
    lowest = eighth * (128 * 48 + 4 * 9 * 48 * 48 + 48 * 128)
    rest = quarter * (2 * 9 * 32 * 32 + 32 * 12)
    assert network_gflop(2560, 1920) == pytest.approx(2e-9 * (stem + down1 + lowest + rest))


def test_the_stages_by_frame_are_those_of_the_flights_rate() -> None:
    assert {"frames", "registration", "detections"} <= set(stages_by_frame()) < set(STAGE)
    assert not {"lens", "base", "detector", "maps"} & set(stages_by_frame())


def test_every_stage_is_timed(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PRESETS["fast"]["detection"], "fine_tune_steps", 2)
    assert speed(frames=4, size="640x480", preset="fast") == 0
    told = capsys.readouterr().out
    for name in STAGE:
        line = next(line for line in told.splitlines() if line.startswith(f"{name} "))
        assert ("ms a frame" in line) == (name in stages_by_frame())
    assert float(re.findall(r"set-up apart: ([\d.]+)", told)[0]) > 0
    for what, peer in (("registration", "stabilo"), ("tracklets", "trackpy")):
        (line,) = [line for line in told.splitlines() if peer in line]
        assert re.match(rf"{what}: [\d.]+ s of processor; {peer}.*: [\d.]+ s; [\d.e+-]+ times$", line) or (
            "pip install" in line
        )
    assert (
        0 < float(re.findall(r"(\d+) GFLOP/s of a peak", told)[0]) < float(re.findall(r"peak of (\d+)", told)[0]) * 1.2
    )
