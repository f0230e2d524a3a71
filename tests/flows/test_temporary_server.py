"""Prefect's temporary server starts beside its user, answers, keeps the run, and ends with the process."""

import os
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

_FLOW = """if True:
    import sys
    from flows.launch import spare_proxies
    spare_proxies()
    from flows.temporary_server import start_server
    server = start_server()
    from prefect import flow, task
    from prefect.settings import get_current_settings
    @task
    def add(one, other):
        return one + other
    @flow
    def sums():
        return add.submit(1, 2).result()
    with server.in_use():
        print(get_current_settings().api.url, sums(), server._process.poll())
    assert get_current_settings().api.url == sys.argv[1] or not sys.argv[1]
"""


def _run(folder: Path, **environment: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [sys.executable, "-c", _FLOW, environment.get("PREFECT_API_URL", "")],
        env={
            **os.environ,
            "PREFECT_HOME": str(folder),
            "PREFECT_SERVER_DATABASE_CONNECTION_URL": f"sqlite+aiosqlite:///{folder}/prefect.db",
            "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS": "180",
            "DO_NOT_TRACK": "1",
            **environment,
        },
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


@pytest.mark.parametrize("proxies", [{}, {"http_proxy": "http://127.0.0.1:9", "no_proxy": "", "NO_PROXY": ""}])
def test_a_flow_runs_on_the_server_that_started_beside_it(tmp_path: Path, proxies: dict[str, str]) -> None:
    done = _run(tmp_path, **proxies)
    assert done.returncode == 0, done.stderr
    url, result, status = done.stdout.split()
    assert url.startswith("http://127.0.0.1:")
    assert (result, status) == ("3", "None")
    assert "Starting temporary server" not in done.stderr  # Prefect needed none of its own
    assert "View at" not in done.stderr  # there is no UI to view it in
    assert "Error logging to API" not in done.stderr
    with sqlite3.connect(tmp_path / "prefect.db") as database:
        states = database.execute("SELECT state_type FROM flow_run UNION ALL SELECT state_type FROM task_run")
        assert [state for (state,) in states] == ["COMPLETED"] * 2
        assert database.execute("SELECT count(*) FROM log").fetchone()[0] > 0


@pytest.mark.parametrize(
    "setting",
    [{"PREFECT_API_URL": "http://127.0.0.1:9/api"}, {"PREFECT_SERVER_EPHEMERAL_ENABLED": "false"}],
    ids=["another server", "none allowed"],
)
def test_none_starts_where_prefects_settings_say_so(tmp_path: Path, setting: dict[str, str]) -> None:
    done = _run(tmp_path, **setting)
    assert done.returncode != 0
    assert not (tmp_path / "prefect.db").exists()
