"""Progress lines and warnings of a run whose output is a file, so that no bar is drawn."""

import json
import time
from types import SimpleNamespace
from uuid import UUID

import pytest
from prefect import flow
from prefect.client.orchestration import get_client
from prefect.client.schemas.filters import LogFilter, LogFilterFlowRunId
from prefect.context import FlowRunContext

from flows import console
from flows.console import Console


def test_a_log_gets_a_line_of_a_long_stage_now_and_then(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(console, "_LINE_EVERY_S", 0.0)
    now_s = [time.monotonic() + 1.0]
    monkeypatch.setattr("flows.console.time", SimpleNamespace(monotonic=lambda: now_s[0]))
    with Console().stages() as bars:
        progress = bars.add("detections", "detections", "frames")
        progress.expect(400)
        for done in (100, 300, 400):  # an earlier run had done 100 of them; at 400 its own line follows
            progress.at_least(done)
            now_s[0] += 60
    assert capsys.readouterr().err.splitlines() == [
        "detections: 100 of 400 frames",
        "detections: 300 of 400 frames, about 30 s left",
    ]


def test_a_short_stage_leaves_no_line(capsys: pytest.CaptureFixture[str]) -> None:
    with Console().stage("lens", "lens", 3) as progress:
        progress.at_least(2)
    assert capsys.readouterr().err == ""


def test_a_program_gets_it_as_an_event_and_quiet_means_quiet(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(console, "_LINE_EVERY_S", 0.0)
    for verbosity in ("json", "quiet"):
        with Console(verbosity).stage("frames", "frames", 9) as progress:
            progress.at_least(4)
    (line,) = capsys.readouterr().err.splitlines()
    told = json.loads(line)
    assert (told["event"], told["text"]) == ("progress", "frames: 4 of 9 steps")


def test_warnings_of_stages_are_printed_together_at_the_end(capsys: pytest.CaptureFixture[str]) -> None:
    lines = Console()
    lines.warn_at_end("the flight is dark")
    lines.event("stage", "frames  3 of 3 frames read")
    lines.warn_at_end("no scale: give --gsd-m")
    lines.event("stage", "lens  8 terms")
    lines.print_warnings()
    lines.print_warnings()
    assert capsys.readouterr().err.splitlines() == [
        "frames  3 of 3 frames read",
        "lens  8 terms",
        "warning: the flight is dark",
        "warning: no scale: give --gsd-m",
    ]


def test_quiet_keeps_warnings_and_a_program_gets_them_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    quiet = Console("quiet")
    quiet.warn_at_end("the flight is dark")
    quiet.print_warnings()
    assert capsys.readouterr().err == "warning: the flight is dark\n"
    Console("json").warn_at_end("the flight is dark")
    assert json.loads(capsys.readouterr().err)["event"] == "warning"


def test_lines_stand_in_the_logs_of_the_flow_run(server: None) -> None:
    @flow
    def noted() -> UUID:
        console = Console("normal")
        console.event("stage", "the lens is straight")
        console.warn("a frame was lost")
        context = FlowRunContext.get()
        return context.flow_run.id

    run_id = noted()
    expected, found = {(20, "the lens is straight"), (30, "a frame was lost")}, set()
    deadline_s = time.monotonic() + 20
    with get_client(sync_client=True) as client:
        while not expected <= found and time.monotonic() < deadline_s:  # they are sent in batches
            time.sleep(0.2)
            logs = client.read_logs(LogFilter(flow_run_id=LogFilterFlowRunId(any_=[run_id])))
            found = {(log.level, log.message) for log in logs}
    assert expected <= found
