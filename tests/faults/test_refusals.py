"""Refusals are one line, and come before any work: options, settings without sense, a base image of another place."""

import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from flows import cli
from flows.commands.run import _announce
from flows.console import Console
from schemas.job import Job
from schemas.simulation import SimulationConfig
from tests.small_flight import job
from velfield.errors import InputError
from velfield.parallel import count_steps
from velfield.pipeline import check_inputs, given_files
from velfield.pipeline.local import compute_stages
from velfield.pipeline.plan import dropped_inputs, make_plan, write_flight_record
from velfield.pipeline.stage import stages_before
from velfield.synthetic.flight import Flight

ROOT = Path(__file__).resolve().parents[2]
_ELSEWHERE = "not an image of this flight's area; give one of the area"


def command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str
) -> tuple[int, list[str]]:
    """Exit status and lines of standard error of a command, in this process."""
    monkeypatch.setattr(sys, "argv", ["velfield", *arguments])
    for name in ("limit_threads", "as_ctrl_c", "_warn_of_settings_in_one_line"):
        monkeypatch.setattr(cli, name, lambda: None)
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return int(str(ended.value.code)), capsys.readouterr().err.splitlines()


@pytest.mark.parametrize(
    ("arguments", "status", "text"),
    [
        (("train", "frames"), 2, "--labels"),
        (("run",), 2, "run: --out is missing"),
        (("export", "x"), 2, "export: --format is missing (one of cog, geoparquet, "),
        (("simulate", "x", "--clip"), 2, "simulate: value for --clip is missing"),
        (("fly",), 2, 'Unknown command "fly"'),
        (("run", "a", "--out", "b", "--workers", "many"), 2, "--workers"),
        (("run", "a", "--out", "b", "--workers", "0"), 1, "--workers 0: must be a positive integer"),
        (
            ("run", "a", "--out", "b", "--gsd-m", "23"),
            1,
            "gsd_m = 23.0: input should be less than or equal to 5 (ground sample distance of the base image, m a",
        ),
        (("verify", "/dev/null"), 1, "/dev/null"),
        (("view", "s3://runs/flight"), 1, "s3://runs/flight: a run on S3 cannot be shown"),
        (("run", "http://host/video.mp4", "--out", "out"), 1, "http"),
        (("run", "a", "--out", "out", "--set", "tracking.max_sped_m_per_s=1"), 1, "did you mean"),
        (("run", "a", "--out", "out", "--every", "often"), 1, "--every often"),
        (("simulate", "out", "--size", "big"), 1, "WIDTHxHEIGHT"),
        (("simulate", "out", "--frames", "0"), 1, "--frames 0: input should be greater than 0 (number of frames)"),
        (("simulate", "out", "--frames", "-5"), 1, "--frames -5: input should be greater than 0"),
        (("simulate", "out", "--size", "640x20"), 1, "--size 640x20: input should be greater than or equal to 64 (he"),
        (("simulate", "out", "--tracks", "0"), 1, "--tracks 0: input should be greater than 0"),
        (("simulate", "out", "--tracks", "2", "--clip", "beside"), 1, "--tracks writes no frames; leave out --clip"),
        (("simulate", "out", "--seed", "-1"), 1, "--seed -1: input should be greater than or equal to 0"),
        (("demo", "--out", "out", "--frames", "0"), 1, "--frames 0: input should be greater than 0"),
        (("demo", "--out", "out", "--size", "10x10"), 1, "--size 10x10: input should be greater than or equal to 64"),
        (
            ("run", "a", "--out", "out", "--start-s", "5", "--stop-s", "3"),
            1,
            "velfield: configuration: frames: stop_s = 3 (--stop-s) must be later than start_s = 5 (--start-s); ",
        ),
    ],
)
def test_a_command_that_cannot_be_is_one_line(
    arguments: tuple[str, ...],
    status: int,
    text: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    found, lines = command(monkeypatch, capsys, *arguments)
    assert (found, len(lines)) == (status, 1), lines
    assert lines[0].startswith("velfield: ")
    assert text in lines[0]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (
            PermissionError(13, "Permission denied", "/x"),
            "/x: Permission denied; expected a place that is there, has room, and can be read and written",
        ),
        (OSError(30, "Read-only file system"), "[Errno 30] Read-only file system"),
    ],
)
def test_a_disk_that_refuses_is_one_line(
    error: OSError, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(cli, "app", refuse)
    status, lines = command(monkeypatch, capsys, "schema")
    assert (status, lines) == (1, [f"velfield: {said}"])


_KEYS = {"AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "b", "AWS_MAX_ATTEMPTS": "1"}


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (_KEYS, "Could not connect"),
        (
            {"AWS_EC2_METADATA_DISABLED": "true"},
            "no credentials; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_",
        ),
    ],
)
def test_an_object_store_that_cannot_be_reached_is_one_line(given: dict[str, str], text: str, tmp_path: Path) -> None:
    """In a process of its own: the library keeps its connections by their options, and not by the environment."""
    ours = {name: value for name, value in os.environ.items() if not name.startswith("AWS_")}
    environment = {**ours, "AWS_ENDPOINT_URL": "http://127.0.0.1:9", "HOME": str(tmp_path), **given}
    command = [sys.executable, "-m", "flows.cli", "verify", "s3://runs/flight"]
    ended = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120, check=False)
    lines = ended.stderr.splitlines()
    assert (ended.returncode, len(lines)) == (1, 1), lines
    assert lines[0].startswith(f"velfield: S3: {text}")


def test_the_first_line_says_the_preset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`velfield demo` chooses `fast`, whose results are not those of the default."""
    jobs: list[Job] = []
    monkeypatch.setattr("flows.commands.simulate.write_simulation", lambda *_, **__: None)
    monkeypatch.setattr("flows.commands.run.process", lambda job, **_: jobs.append(job) or 1)
    command(monkeypatch, capsys, "demo", "--out", str(tmp_path))
    _announce(jobs[0], Console())
    assert capsys.readouterr().err.endswith("DJI_0001.MP4 into " + str(tmp_path / "run") + ", preset fast\n")


@pytest.mark.parametrize("option", ["base", "labels"])
def test_a_plan_reads_the_inputs_too(
    option: str, flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "hello.txt").write_text("hello\n")
    given = ("--timestamps", str(flight / "timestamps.csv"), f"--{option}", str(tmp_path / "hello.txt"), "--plan")
    status, lines = command(monkeypatch, capsys, "run", str(flight / "frames"), "--out", str(tmp_path / "r"), *given)
    assert (status, len(lines)) == (1, 1)
    assert lines[0].startswith(f"velfield: --{option}: ")
    assert not (tmp_path / "r").exists()


@pytest.fixture(scope="module")
def bases(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The flight's base image turned; one of another town, a corner of it, as the middle of each has the same
    crossing."""
    base = cv2.imread(str(flight / "base.png"), cv2.IMREAD_GRAYSCALE)
    images = {
        "turned": base[::-1, ::-1],
        "town": Flight(SimulationConfig(seed=5, frames=1, width=1600, height=1200)).base_image[:600, :760],
    }
    folder = tmp_path_factory.mktemp("bases")
    for name, image in images.items():
        cv2.imwrite(str(folder / f"{name}.png"), image)
    return {name: folder / f"{name}.png" for name in images}


def test_a_wrong_base_image_is_refused_before_a_frame_is_stored(
    flight: Path, bases: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Long flights only: the base stage of a short one comes soon enough."""
    checked: list[object] = []
    plans = {name: make_plan(job(flight, tmp_path / "run", base=str(path))) for name, path in bases.items()}
    monkeypatch.setattr("velfield.pipeline.plan.LONG_MPX", 0.0)
    given_files.check_base_area(plans["turned"])
    with pytest.raises(InputError, match=rf"--base .*town\.png: {_ELSEWHERE}") as caught:
        check_inputs.validate_inputs(plans["town"])
    assert "\n" not in str(caught.value)
    monkeypatch.setattr(given_files, "check_base_area", checked.append)
    monkeypatch.setattr("velfield.pipeline.plan.LONG_MPX", 1e9)
    check_inputs.validate_inputs(plans["town"])
    assert checked == []


def test_a_wrong_base_image_of_a_short_flight_is_refused_before_a_frame_is_registered(
    flight: Path, bases: dict[str, Path], tmp_path: Path
) -> None:
    """Its frames are stored by then."""
    plan = make_plan(job(flight, tmp_path / "run", base=str(bases["town"])))
    write_flight_record(plan)
    with pytest.raises(InputError, match=rf"--base .*town\.png: {_ELSEWHERE}") as caught:
        compute_stages(plan, stages_before("registration"))
    assert "\n" not in str(caught.value)
    assert not plan.layout.registration.exists()


def test_an_input_that_is_no_longer_given_is_said(flight: Path, tmp_path: Path) -> None:
    first = make_plan(job(flight, tmp_path / "run"))
    assert dropped_inputs(first) == []
    write_flight_record(first)
    assert dropped_inputs(first) == []
    inputs = first.job.inputs.model_copy(update={"base": None})
    (line,) = dropped_inputs(replace(first, job=first.job.model_copy(update={"inputs": inputs})))
    assert line.startswith(f"--base {first.job.inputs.base} was given to the run before in ")
    assert "the base image is built from the flight" in line


def test_a_training_shows_its_progress_and_hears_ctrl_c_at_once(flight: Path, tmp_path: Path) -> None:
    """`velfield train` as a process: its threads are under way, and are not waited for."""
    given = [str(flight / "frames"), "--labels", str(flight / "labels.csv"), "--gsd-m", "0.23"]
    with subprocess.Popen(
        [sys.executable, "-m", "flows.cli", "train", *given, "--out", str(tmp_path / "detector.json")],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    ) as process:
        assert any(re.match(r"training: [1-9]\d* of \d+ steps", line.strip()) for line in process.stderr)
        started = time.monotonic()
        process.send_signal(signal.SIGINT)
        _, text = process.communicate(timeout=60)
    assert process.returncode == 130
    assert time.monotonic() - started < 20
    assert text.splitlines()[-1] == "velfield: stopped"
    assert list(tmp_path.iterdir()) == []


def test_a_training_shows_its_steps(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("flows.console._LINE_EVERY_S", 0.0)
    with Console().stage("detector", "training", 0):
        count_steps(0, announced=8)
        count_steps(1)
    assert capsys.readouterr().err.splitlines()[-1] == "training: 1 of 8 steps"


def test_a_run_counts_the_steps_of_its_detector() -> None:
    with Console("quiet").stages() as bars:
        progress = bars.add("detector", "detector")
        progress.expect(1)
        count_steps(0, announced=8)
        count_steps(3)
        assert (progress.done, progress.total) == (3, 9)
    count_steps(1)
    assert progress.done == 3


def test_every_training_counts_its_steps() -> None:
    from velfield.paper import boosting
    from velfield.parallel import subscribe_steps

    received: list[tuple[int, int]] = []
    rng = np.random.default_rng(0)
    bins = rng.integers(0, 8, (20, 60)).astype(np.uint8)
    edges = np.sort(rng.normal(size=(20, boosting.N_BINS - 1)).astype(np.float32), axis=1)
    with subscribe_steps(lambda done, announced, stage: received.append((done, announced))):
        boosting.boost(bins, edges, np.arange(60) < 20, rounds=3, car_fraction=0.15, rng=rng)
    assert received == [(0, 3), (1, 0), (1, 0), (1, 0)]
