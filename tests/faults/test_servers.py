"""Servers: on which addresses they listen, what they refuse, and that runs of killed processes are not "Running"."""

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import psutil
import pytest

from tests.small_flight import job, process
from tests.viewer.test_viewer_server import served
from velfield.errors import InputError
from velfield.report.figures import png_bytes
from velfield.report.viewer_page import page_is_built
from velfield.run.layout import RunLayout, to_path
from velfield.viewer.annotations import frames_to_annotate
from velfield.viewer.annotator import annotate_app
from velfield.viewer.server import runs_app, serve_in_thread


def listening(*processes: psutil.Process) -> set[tuple[int, str, int]]:
    """Process, address and port of each listening socket."""
    return {
        (process.pid, found.laddr.ip, found.laddr.port)
        for process in processes
        for found in process.net_connections(kind="tcp")
        if found.status == psutil.CONN_LISTEN
    }


def test_pages_of_runs_are_served_to_this_machine_alone(tmp_path: Path) -> None:
    before = listening(psutil.Process())
    with serve_in_thread(runs_app(tmp_path), 0) as address:
        opened = listening(psutil.Process()) - before
    assert {(ip, port) for _, ip, port in opened} == {("127.0.0.1", int(address.rpartition(":")[2]))}


@contextmanager
def velfield_process(*arguments: str) -> Iterator[psutil.Process]:
    """A command of velfield's in a process of its own, ended afterwards."""
    command = [sys.executable, "-m", "flows.cli", *arguments]
    checkout = {"PYTHONPATH": str(Path(__file__).parents[2])}
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=os.environ | checkout
    ) as process:
        try:
            yield psutil.Process(process.pid)
        finally:
            process.terminate()
            process.wait(60)


def sockets_seen(process: psutil.Process, *, until: Callable[[], bool], fewest: int = 1) -> set[str]:
    """Addresses on which a process and all that it starts listened, looked at until there are some and all is done."""
    seen: set[tuple[int, str, int]] = set()
    deadline = time.monotonic() + 90
    while (len(seen) < fewest or not until()) and time.monotonic() < deadline:
        with suppress(psutil.NoSuchProcess):
            seen |= listening(process, *process.children(recursive=True))
        time.sleep(0.2)
    assert len(seen) >= fewest
    assert until()
    return {address for _, address, _ in seen}


def test_a_run_listens_on_this_machine_alone(flight: Path, tmp_path: Path) -> None:
    """As a process: scheduler, workers and dashboard of `--workers`."""
    began = tmp_path / "run" / "commits" / "frames"
    given = [str(flight / "frames"), "--timestamps", str(flight / "timestamps.csv"), "--out", str(tmp_path / "run")]
    settings = ["--preset", "fast", "--gsd-m", "0.23", "--base", str(flight / "base.png"), "--workers", "1"]
    with velfield_process("run", *given, *settings) as process:
        assert sockets_seen(process, until=began.exists, fewest=4) == {"127.0.0.1"}


@pytest.mark.skipif(not page_is_built(), reason="the page is not built: `make page`")
@pytest.mark.parametrize("command", ["view", "annotate", "georeference"])
def test_each_page_as_a_process_listens_on_this_machine_alone(command: str, copy: Path) -> None:
    with velfield_process(command, str(copy), "--no-open") as process:
        assert sockets_seen(process, until=lambda: True) == {"127.0.0.1"}


@pytest.mark.skipif(not page_is_built(), reason="the page is not built: `make page`")
def test_annotate_serves_its_frames_and_nothing_else(tmp_path: Path) -> None:
    image = tmp_path / "frames" / "a.png"
    image.parent.mkdir()
    image.write_bytes(png_bytes(np.zeros((32, 48), np.uint8)))
    with served(annotate_app(frames_to_annotate(image, max_frames=1), tmp_path / "labels.csv")) as client:
        for path in ("/frame/1.png", "/frame/-1.png", "/frame/", "/labels.csv", "/../labels.csv", "/%2e%2e/x", "/.git"):
            assert client.status(path) in (404, 405), path
        for method in ("POST", "PUT", "DELETE"):
            assert client.status("/frame/0.png", method) == 405, method
        assert client.status("/", headers={"Host": "elsewhere.example"}) == 400
        for path in ("/", "/frame/0.png"):
            headers = client.ask(path)[2]
            assert headers["content-security-policy"].startswith("default-src 'none'"), path
            assert headers["x-content-type-options"] == "nosniff", path
    assert not (tmp_path / "labels.csv").exists()


def test_a_run_is_known_by_its_folder_from_the_root_on(
    flight: Path, server: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As `--out RUN` gives it, one that was killed was never marked, and one of another place's `RUN` was."""
    from prefect.client.orchestration import get_client
    from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterName

    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="nowhere"):
        process(job(flight, Path("RUN {x}"), timestamps="nowhere"))
    named = FlowRunFilter(name=FlowRunFilterName(any_=["RUN {x}"]))
    with get_client(sync_client=True) as client:
        (run,) = client.read_flow_runs(flow_run_filter=named)
    assert run.parameters["run_folder"] == str(tmp_path / "RUN {x}")


def test_a_run_on_s3_whose_lease_expired_is_crashed_once_another_works_there(server: None, s3: None) -> None:
    from prefect import flow
    from prefect.client.orchestration import get_client
    from prefect.states import Running

    from flows.stale import mark_abandoned, mark_crashed

    @flow
    def nothing() -> None:
        pass

    owner = {"pid": 1, "host": "another.machine"}
    with get_client(sync_client=True) as client:
        runs = {}
        for name, until_s in (("killed", time.time() - 5), ("alive", time.time() + 60)):
            root = to_path(f"s3://flights/servers/{name}")
            RunLayout(root).lock.write_bytes(json.dumps(owner | {"until_s": until_s}).encode())
            folder = {"run_folder": f"s3://flights/servers/{name}"}
            runs[name] = client.create_flow_run(nothing, name=name, parameters=folder, state=Running())
        assert mark_abandoned() == 0  # a server on this machine does not ask S3
        assert mark_crashed("s3://flights/servers/another") == 1
        states = {name: client.read_flow_run(run.id).state_name for name, run in runs.items()}
        assert states == {"killed": "Crashed", "alive": "Running"}
        client.delete_flow_run(runs["alive"].id)


def test_runs_whose_process_was_killed_are_crashed_and_others_are_not(server: None, tmp_path: Path) -> None:
    from prefect import flow
    from prefect.client.orchestration import get_client
    from prefect.states import Running

    from flows.stale import mark_abandoned, mark_crashed
    from velfield.run.lock import machine_id

    @flow
    def nothing() -> None:
        pass

    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        ended.wait()
    pids = {"killed": ended.pid, "alive": os.getpid(), "resumed": os.getpid(), "elsewhere/resumed": os.getpid()}
    with get_client(sync_client=True) as client:
        runs = {}
        for name, pid in pids.items():
            (tmp_path / name).mkdir(parents=True)
            owner = {"pid": pid, "host": socket.gethostname(), "machine": machine_id()}
            (tmp_path / name / ".lock").write_text(json.dumps(owner))
            root = tmp_path / name
            folder = {"run_folder": str(root)}
            runs[name] = client.create_flow_run(nothing, name=root.name, parameters=folder, state=Running())
        assert mark_crashed(str(tmp_path / "resumed")) == 2
        states = {name: client.read_flow_run(run.id).state_name for name, run in runs.items()}
        left = {"alive": "Running", "elsewhere/resumed": "Running"}
        assert states == left | {"killed": "Crashed", "resumed": "Crashed"}
        assert mark_abandoned() == 0
        for name in left:
            client.delete_flow_run(runs[name].id)
