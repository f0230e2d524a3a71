"""Progress lines of a run whose output is a file, so that no bar is drawn."""

import json

import pytest

from flows import console
from flows.console import Console


def test_a_log_gets_a_line_of_a_long_stage_now_and_then(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(console, "_LOG_EVERY_S", 0.0)
    with Console().stage("detector", "detector", 3) as progress:
        progress.at_least(2)
        progress.at_least(3)  # its own line follows
    assert capsys.readouterr().err.splitlines() == ["detector: 2 of 3 steps"]


def test_a_short_stage_leaves_no_line(capsys: pytest.CaptureFixture[str]) -> None:
    with Console().stage("lens", "lens", 3) as progress:
        progress.at_least(2)
    assert capsys.readouterr().err == ""


def test_a_program_gets_it_as_an_event_and_quiet_means_quiet(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(console, "_LOG_EVERY_S", 0.0)
    for verbosity in ("json", "quiet"):
        with Console(verbosity).stage("frames", "frames", 9) as progress:  # type: ignore[arg-type]
            progress.at_least(4)
    (line,) = capsys.readouterr().err.splitlines()
    told = json.loads(line)
    assert (told["event"], told["text"]) == ("progress", "frames: 4 of 9 steps")
