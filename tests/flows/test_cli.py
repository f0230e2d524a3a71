"""The command: exit statuses, one clear line for bad input."""

import json
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from flows.cli import app
from schemas.flight import FlightConfig
from tests.media import drifting, write_images
from velfield.pipeline.configuration import resolve_config

ROOT = Path(__file__).resolve().parents[2]


def test_help_lists_the_commands(capsys: pytest.CaptureFixture[str]) -> None:
    app(["--help"], result_action="return_value")
    text = capsys.readouterr().out
    assert [name for name in ("demo", "run", "schema", "simulate") if name not in text] == []


@pytest.mark.parametrize("arguments", [("--help",), ("schema",)])
def test_output_that_nobody_reads_is_no_error(arguments: tuple[str, ...]) -> None:
    """As by ``velfield --help | head -1``: the pipe is closed."""
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "flows.cli", *arguments]
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, check=False, cwd=ROOT)
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    app(["--version"], result_action="return_value")
    assert capsys.readouterr().out.strip() == version("velfield")


def test_bad_input_of_a_process_is_one_clear_line_and_status_1(tmp_path: Path) -> None:
    """Other bad input is tested without a process: `tests.faults.test_refusals`."""
    result = subprocess.run(
        [sys.executable, "-m", "flows.cli", "run", "none.mp4", "--out", "out"],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert result.returncode == 1
    (line,) = result.stderr.strip().splitlines()
    assert line.startswith("velfield: ")
    assert "none.mp4" in line
    assert not (tmp_path / "out" / "commits").exists()


def test_schema_is_the_configuration(capsys: pytest.CaptureFixture[str]) -> None:
    assert app(["schema"], result_action="return_value") == 0
    assert json.loads(capsys.readouterr().out) == FlightConfig.model_json_schema()


def test_the_example_configuration_is_read() -> None:
    assert resolve_config(file=ROOT / "examples" / "flight.yaml") == FlightConfig(gsd_m=0.23)


def test_a_plan_is_shown_and_nothing_is_done(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_images(tmp_path / "frames", list(drifting(40, 128, 96)))
    line = ["run", str(tmp_path / "frames"), "--fps", "5", "--out", str(tmp_path / "run"), "--plan"]
    assert app(line, result_action="return_value", exit_on_error=False) == 0
    text = capsys.readouterr().out
    assert "40 of them to process" in text
    assert "GB needed" in text
    assert not (tmp_path / "run").exists()


def test_no_file_names_a_registry_host() -> None:
    tracked = subprocess.run(["git", "ls-files"], capture_output=True, text=True, check=True, cwd=ROOT).stdout.split()
    hosts = ("pypi." + "org", "pythonhosted." + "org", "registry.npmjs." + "org", "deb.debian." + "org")
    texts = [ROOT / name for name in tracked if (ROOT / name).suffix not in (".jpg", ".png", ".npz")]
    found = [
        path.name
        for path in texts
        if path.is_file() and any(host in path.read_text(errors="replace") for host in hosts)
    ]
    assert found == []
    assert "uv.lock" not in tracked
