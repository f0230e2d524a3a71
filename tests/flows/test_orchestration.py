"""Flows on threads of this process, and as Prefect shows them: the same results, retries and errors."""

import logging
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from flows import orchestration, prefect_server
from flows.orchestration import Orchestration, Threads
from flows.prefect_server import choose_orchestration
from flows.runners import WorkersKilledError
from schemas.summary import RunSummary, StageSummary
from velfield.errors import InputError


@pytest.fixture(params=["threads", "prefect"])
def by(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Orchestration:
    monkeypatch.setattr(orchestration, "RETRY_S", 0.0)
    if request.param == "threads":
        return Threads()
    request.getfixturevalue("server")
    from flows import prefect_flows

    monkeypatch.setattr(prefect_flows, "RETRY_S", 0.0)
    chosen = choose_orchestration()
    assert isinstance(chosen, prefect_flows.PrefectFlows)
    return chosen


@pytest.mark.parametrize(
    ("error", "attempts"),
    [
        (OSError("blinked"), 3),
        (InputError("stays bad"), 1),
        (OSError(28, "No space left on device"), 1),
        (WorkersKilledError("all of them"), 2),
    ],
)
def test_what_may_pass_is_tried_again_and_its_error_is_kept(by: Orchestration, error: Exception, attempts: int) -> None:
    calls: list[int] = []

    def fail() -> None:
        calls.append(1)
        raise error

    def flow() -> BaseException | None:
        return by.submit(fail, name="fails", run_name="fails 0", retries=2).exception(60)

    found = by.run(flow, name="flow", folder="/flow {x}", threads=2, parameters={"a": 1})
    assert (type(found), str(found)) == (type(error), str(error))
    assert len(calls) == attempts


def test_tasks_read_those_before(by: Orchestration) -> None:
    def flow() -> int:
        first = by.submit(lambda: 1, name="one", run_name="one")
        assert first.result(60) == 1
        return by.submit(lambda: 2, name="two", run_name="two", after=[first]).result(60)

    assert by.run(flow, name="flow", folder="/flow", threads=1, parameters=None) == 2


def test_a_run_that_lost_frames_is_shown_as_incomplete(server: None) -> None:

    from flows.prefect_flows import end_state

    stage = StageSummary(name="registration", units=2, done_before=0, lost=("1",), seconds=1.0, text="")
    summary = RunSummary(root="RUN", stages=(stage,), frames_lost=("frame 1 (0.2 s): not processed",))
    shown = end_state(summary)
    assert (shown.name, shown.is_completed()) == ("Incomplete", True)
    assert str(shown.message).startswith("incomplete: frames lost: 1, units lost: 1")
    by = choose_orchestration()
    assert by.run(lambda: summary, name="flow", folder="/flow", threads=1, parameters=None) is summary
    whole = RunSummary(root="RUN", stages=())
    assert end_state(whole) is whole


def test_an_error_of_the_flow_is_raised(by: Orchestration) -> None:
    def refuse() -> None:
        raise InputError("no such file")

    with pytest.raises(InputError, match="no such file"):
        by.run(refuse, name="flow", folder="/flow", threads=1, parameters=None)


@contextmanager
def errors_logged() -> Iterator[list[logging.LogRecord]]:
    """Records of errors that the logs of flow runs and task runs receive."""
    found: list[logging.LogRecord] = []

    class Keep(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            found.append(record)

    handler = Keep(logging.ERROR)
    loggers = [logging.getLogger(name) for name in ("prefect.flow_runs", "prefect.task_runs")]
    for logger in loggers:
        logger.addHandler(handler)
    yield found
    for logger in loggers:
        logger.removeHandler(handler)


def test_bad_input_is_one_line_of_the_log_and_the_state_of_the_run(server: None, tmp_path: Path) -> None:
    from prefect.client.orchestration import get_client

    by = choose_orchestration()

    def refuse() -> None:
        raise InputError(f"no such file as {tmp_path}")

    with errors_logged() as logged, pytest.raises(InputError, match="no such file"):
        by.run(refuse, name="flow", folder=str(tmp_path), threads=1, parameters=None)
    assert [(record.getMessage(), record.exc_info) for record in logged] == [(f"no such file as {tmp_path}", None)]
    with get_client(sync_client=True) as client:
        (run,) = [one for one in client.read_flow_runs() if one.parameters.get("run_folder") == str(tmp_path)]
    assert (run.state.name, run.state.message) == ("Failed", f"no such file as {tmp_path}")
    assert run.name == tmp_path.name
    assert set(run.tags) == {"flow", tmp_path.name}


def test_bad_input_of_a_unit_is_one_line_of_its_log(server: None) -> None:
    by = choose_orchestration()

    def refuse() -> None:
        raise InputError("no such file")

    def flow() -> None:
        by.submit(refuse, name="refuses", run_name="refuses").result(60)

    with errors_logged() as logged, pytest.raises(InputError, match="no such file"):
        by.run(flow, name="flow", folder="/flow", threads=1, parameters=None)
    assert [record.exc_info for record in logged] == [None, None]  # the unit's, and the run's
    assert all("no such file" in record.getMessage() for record in logged)


def test_other_errors_keep_their_traceback(server: None) -> None:
    by = choose_orchestration()

    def fail() -> None:
        raise ValueError("a bug")

    with errors_logged() as logged, pytest.raises(ValueError, match="a bug"):
        by.run(fail, name="flow", folder="/flow", threads=1, parameters=None)
    assert [record.exc_info[0] for record in logged if record.exc_info is not None] == [ValueError]


@pytest.mark.parametrize(
    ("file", "text", "asked"),
    [
        (None, "", False),
        ("pyproject.toml", "[tool.ruff]", False),
        ("pyproject.toml", "[tool.prefect]", True),
        ("prefect.toml", "", True),
        (".env", "PREFECT_API_URL=", True),
        ("home/profiles.toml", "", True),
    ],
)
def test_prefect_is_asked_only_where_its_settings_may_name_a_server(
    tmp_path: Path, file: str | None, text: str, asked: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "home").mkdir()
    if file is not None:
        (tmp_path / file).write_text(text)
    for name in prefect_server._NAMING_A_SERVER:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.delitem(sys.modules, "prefect", raising=False)
    monkeypatch.setenv("PREFECT_HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    assert prefect_server.may_have_settings() == asked


def test_prefect_is_not_imported_where_nothing_may_name_a_server(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in prefect_server._NAMING_A_SERVER:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PREFECT_HOME", str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).resolve().parents[2]))
    code = "import sys, flows.process_flight, flows.reprocess, flows.prefect_server as o; "
    code += "print(type(o.choose_orchestration()).__name__, 'prefect' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert done.stdout.split() == ["Threads", "False"]


def test_artifacts_of_runs_whose_folders_have_one_name_are_not_versions_of_one(
    server: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    from flows import artifacts

    keys = []
    for folder in ("/a/Run 1", "/b/Run 1", "/b/Run 1"):
        flow_run = SimpleNamespace(name="Run 1", parameters={"run_folder": folder})
        monkeypatch.setattr(artifacts, "flow_run", flow_run)
        keys.append(artifacts._key("summary"))
    assert keys[0] != keys[1] == keys[2]
    assert all(re.fullmatch("run-1-[0-9a-f]{6}-summary", key) for key in keys)
