"""Refusals are one line, and come before any work: options, settings without sense, a base image of another place."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from flows import cli
from flows.console import Console, training_progress
from tests.small_flight import job
from velfield.errors import InputError
from velfield.parallel import count_steps
from velfield.pipeline import check_inputs
from velfield.pipeline.configuration import resolve_config
from velfield.pipeline.plan import dropped_inputs, make_plan, write_flight_record
from velfield.pipeline.result import StageResult
from velfield.pipeline.stages import detector as detector_stage

ROOT = Path(__file__).resolve().parents[2]


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
        (("run",), 2, "run: found no --out"),
        (("simulate", "x", "--clip"), 2, "simulate: found no value for --clip"),
        (("fly",), 2, 'Unknown command "fly"'),
        (("run", "a", "--out", "b", "--workers", "many"), 2, "--workers"),
        (("run", "a", "--out", "b", "--workers", "0"), 1, "--workers 0: expected a whole number from 1 on"),
        (("run", "a", "--out", "b", "--gsd-m", "23"), 1, "gsd_m = 23"),
        (("verify", "/dev/null"), 1, "/dev/null"),
        (("view", "s3://runs/flight"), 1, "s3://runs/flight: found a run on S3"),
    ],
)
def test_a_command_that_cannot_be_is_one_line(
    arguments: tuple[str, ...],
    status: int,
    text: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    found, lines = command(monkeypatch, capsys, *arguments)
    assert (found, len(lines)) == (status, 1), lines
    assert lines[0].startswith("velfield: ")
    assert text in lines[0]


@pytest.mark.parametrize(
    "error", [PermissionError(13, "Permission denied", "/x"), OSError(30, "Read-only file system")]
)
def test_a_disk_that_refuses_is_one_line(
    error: OSError, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(cli, "app", refuse)
    status, lines = command(monkeypatch, capsys, "schema")
    assert (status, lines) == (1, [f"velfield: {error}"])


def test_an_object_store_that_does_not_answer_is_one_line() -> None:
    """In a process of its own: the library keeps its connections by their options, and not by the environment."""
    nowhere = {"AWS_ENDPOINT_URL": "http://127.0.0.1:9", "AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "b"}
    command = [sys.executable, "-m", "flows.cli", "verify", "s3://runs/flight"]
    environment = {**os.environ, **nowhere, "AWS_MAX_ATTEMPTS": "1"}
    ended = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120, check=False)
    lines = ended.stderr.splitlines()
    assert (ended.returncode, len(lines)) == (1, 1), lines
    assert lines[0].startswith("velfield: S3: Could not connect")


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


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        (["frames.start_s=3", "frames.stop_s=1"], "found stop_s = 1, expected it after start_s = 3"),
        (["tracking.stationary_speed_m_per_s=50"], "no vehicle could move"),
        (["tracking.max_turn_rad=30"], "max_turn_rad"),  # degrees
        (["field.bin_width_m_per_s=0.01"], "7200 bins an axis"),
        (["field.bin_width_m_per_s=80"], "bins an axis"),
        (["field.tile_size_px=1"], "tile_size_px"),
        (["gsd_m=0.0000001"], "gsd_m"),
        (["work.unit_frames=0"], "unit_frames"),
    ],
)
def test_settings_without_sense_are_refused(settings: list[str], text: str) -> None:
    with pytest.raises(InputError) as caught:
        resolve_config(settings=settings)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_wrong_base_image_is_refused_before_a_frame_is_stored(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of flights that take long: a short one's base stage comes soon enough."""
    base = cv2.imread(str(flight / "base.png"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(tmp_path / "mirrored.png"), base[:, ::-1])
    cv2.imwrite(str(tmp_path / "turned.png"), base[::-1, ::-1])
    checked: list[object] = []
    monkeypatch.setattr(check_inputs, "_LONG_PX", 1)
    check_inputs.check_base_area(make_plan(job(flight, tmp_path / "run")))
    check_inputs.check_base_area(make_plan(job(flight, tmp_path / "run", base=str(tmp_path / "turned.png"))))
    wrong = make_plan(job(flight, tmp_path / "run", base=str(tmp_path / "mirrored.png")))
    with pytest.raises(InputError, match=r"--base .*mirrored\.png: found a mirrored image"):
        check_inputs.validate_inputs(wrong)
    monkeypatch.setattr(check_inputs, "check_base_area", checked.append)
    monkeypatch.setattr(check_inputs, "_LONG_PX", 10**9)
    check_inputs.validate_inputs(wrong)
    assert checked == []


def test_an_input_that_is_no_longer_given_is_said(flight: Path, tmp_path: Path) -> None:
    first = make_plan(job(flight, tmp_path / "run"))
    assert dropped_inputs(first) == []
    write_flight_record(first)
    assert dropped_inputs(first) == []
    inputs = first.job.inputs.model_copy(update={"base": None})
    (line,) = dropped_inputs(replace(first, job=first.job.model_copy(update={"inputs": inputs})))
    assert line.startswith(f"--base {first.job.inputs.base} was given to the run before in ")
    assert "the base image is built from the flight" in line


def test_few_vehicles_that_move_are_warned_of(monkeypatch: pytest.MonkeyPatch) -> None:
    few = SimpleNamespace(usable=True, count=30, warnings=("trained on only 9 moving vehicles",))
    method = SimpleNamespace(train_from_motion=lambda *_: None)
    stubs = {
        "_scale_of_gsd": 1.0,
        "_motion_frames": [],
        "motion_background": None,
        "labels_from_motion": few,
        "detector_class": method,
        "UnlabelledFlight": None,
        "_finish": StageResult(),
    }
    for name, value in stubs.items():
        monkeypatch.setattr(detector_stage, name, lambda *_, value=value, **__: value)
    plan = SimpleNamespace(config=resolve_config())
    assert detector_stage._from_motion(plan).warnings == list(few.warnings)  # type: ignore[arg-type]


_TRAINS = """if True:
    import time
    from flows.stopping import STOPPED, leave, stop_on_signals
    from velfield.parallel import parallel_map
    stop_on_signals(resumes=False, grace_s=0.0)
    try:
        print("trains", flush=True)  # within the try: the signal may come at once
        parallel_map(lambda _: time.sleep(60), range(2))
    except KeyboardInterrupt:
        leave(STOPPED)
"""


def test_a_training_hears_sigterm_at_once() -> None:
    """Its threads are under way, and are not waited for."""
    with subprocess.Popen(
        [sys.executable, "-c", _TRAINS],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        started = time.monotonic()
        process.send_signal(signal.SIGTERM)
        _, text = process.communicate(timeout=60)
    assert process.returncode == 130
    assert time.monotonic() - started < 20
    assert text.strip() == "velfield: stopped"


def test_a_training_shows_its_steps(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("flows.console._LINE_EVERY_S", 0.0)
    with training_progress():
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
    from velfield.detection import boosting
    from velfield.parallel import subscribe_steps

    received: list[tuple[int, int]] = []
    rng = np.random.default_rng(0)
    bins = rng.integers(0, 8, (20, 60)).astype(np.uint8)
    edges = np.sort(rng.normal(size=(20, boosting.N_BINS - 1)).astype(np.float32), axis=1)
    with subscribe_steps(lambda done, announced: received.append((done, announced))):
        boosting.boost(bins, edges, np.arange(60) < 20, rounds=3, car_fraction=0.15, rng=rng)
    assert received == [(0, 3), (1, 0), (1, 0), (1, 0)]
