"""A Prefect server with its UI, and its deployments: flights that arrive, base images that arrive, a nightly run.

One folder, three parts: ``incoming/`` (flights), ``base-images/`` and ``runs/``. The server is a child of this process,
and so is every flow run: whatever ends this process in order ends them.
"""

import asyncio
import contextlib
import os
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from base64 import b64encode
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flows.console import print_with_time
from flows.launch import PAGES, PAGES_OF
from flows.prefect_server import may_have_settings
from flows.stopping import Stopped, end_children, stop_on_signals
from velfield.errors import InputError, count_text
from velfield.pipeline.watch import FolderWatcher, is_flight, is_telemetry

if TYPE_CHECKING:
    from prefect.deployments.runner import RunnerDeployment

FLIGHT_ARRIVED = "velfield.flight.arrived"
BASE_IMAGE_ARRIVED = "velfield.base-image.arrived"
NIGHTLY = "0 3 * * *"
_DATABASE = "PREFECT_API_DATABASE_CONNECTION_URL"
_CHOOSING_A_DATABASE = ("PREFECT_HOME", _DATABASE, "PREFECT_SERVER_DATABASE_CONNECTION_URL")
_POLL_INTERVAL_S = 1.0
_START_S = 180.0
_STOP_S = 10.0


@dataclass(frozen=True)
class ServeConfig:
    """Configuration of `velfield serve`."""

    folder: Path
    host: str = "127.0.0.1"
    port: int = 4200
    database: str | None = None
    """SQLAlchemy address of a Postgres database, ``postgresql+asyncpg://...``; none: SQLite in the folder, so that the
    UI lists this folder's runs alone, or what settings of Prefect that the user has say."""
    auth: str | None = None
    """``user:password`` that the API and the UI ask for."""
    nightly: str = NIGHTLY
    """Cron expression."""
    settle_s: float = 10.0
    """A file that has not changed for so long is complete."""
    limit: int = 1
    """Flow runs at a time."""
    cluster: str = ""
    """Cluster file, as for `velfield run --cluster`."""

    @property
    def url(self) -> str:
        """The UI's address, from this machine."""
        here = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self.host, self.host)
        return f"http://{f'[{here}]' if ':' in here else here}:{self.port}"

    @property
    def incoming(self) -> Path:
        return self.folder / "incoming"

    @property
    def base_images(self) -> Path:
        return self.folder / "base-images"

    @property
    def runs(self) -> Path:
        return self.folder / "runs"


def check(config: ServeConfig) -> None:
    """Refuse a configuration that is not safe or cannot work.

    Raises
    ------
    InputError
        Another address than this machine's own without ``--auth``, or a port that is taken.
    """
    if config.host not in ("127.0.0.1", "localhost", "::1") and not config.auth:
        raise InputError(
            f"--host {config.host}: other machines could run flows here; add --auth USER:PASSWORD, or use 127.0.0.1"
        )
    if config.auth is not None and not all(config.auth.partition(":")):
        raise InputError("--auth: expected USER:PASSWORD")
    with socket.socket(socket.AF_INET6 if ":" in config.host else socket.AF_INET) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((config.host, config.port))
        except OSError as error:
            raise InputError(
                f"--port {config.port} of {config.host} is not available ({error}); give another"
            ) from None


def settings(config: ServeConfig) -> dict[str, str]:
    """Prefect's settings for the server, the deployments and their flow runs."""
    given = {
        "PREFECT_API_URL": f"{config.url}/api",
        # Relative: the same under every name and address by which a browser reaches this server.
        "PREFECT_UI_API_URL": "/api",
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        # Its second UI asks amplitude.com when it is opened, whatever the setting above says (Prefect 3.8).
        "PREFECT_SERVER_UI_V2_ENABLED": "false",
        "PREFECT_SERVER_CORS_ALLOWED_ORIGINS": config.url,
        "PREFECT_RUNNER_POLL_FREQUENCY": "2",
        "PREFECT_CLIENT_CSRF_SUPPORT_ENABLED": "true",
    }
    if config.database:
        given[_DATABASE] = config.database
    elif not any(name in os.environ for name in _CHOOSING_A_DATABASE) and not may_have_settings():
        given[_DATABASE] = f"sqlite+aiosqlite:///{config.folder / 'prefect.db'}"
    if config.auth:
        given |= {"PREFECT_SERVER_API_AUTH_STRING": config.auth, "PREFECT_API_AUTH_STRING": config.auth}
    return given


def deployments(config: ServeConfig) -> list["RunnerDeployment"]:
    """The three deployments; ``prefect.yaml`` has the same."""
    from prefect.events import DeploymentEventTrigger
    from prefect.types.entrypoint import EntrypointType

    def make(flow: Any, name: str, description: str, parameters: dict[str, str], **when: Any) -> Any:
        where_from: Any = {"entrypoint_type": EntrypointType.MODULE_PATH, "parameters": parameters}
        return flow.to_deployment(name=name, description=description, **where_from, **when)

    def on(name: str, event: str, **parameters: str) -> dict[str, Any]:
        return {"triggers": [DeploymentEventTrigger(name=name, expect={event}, parameters=parameters)]}

    from flows.deployed import process_dropped, reprocess_runs

    where = {"runs": str(config.runs), "cluster": config.cluster}
    images = {"base_images": str(config.base_images), "base": "", "run": ""}
    flight, image = "{{ event.payload.source }}", {"base": "{{ event.payload.base }}", "run": "{{ event.payload.run }}"}
    return [
        make(
            process_dropped,
            "watched-folder",
            "A flight was dropped into the watched folder.",
            {"source": "", **where},
            **on("flight arrived", FLIGHT_ARRIVED, source=flight, **where),
        ),
        make(
            reprocess_runs,
            "base-image-arrived",
            "A new base image: every run, or the one that the event names, gets a result on it.",
            {**images, **where},
            **on("base image arrived", BASE_IMAGE_ARRIVED, **{**images, **where, **image}),
        ),
        make(
            reprocess_runs,
            "nightly",
            "The newest base image under every run that has no result on it yet.",
            {**images, **where},
            cron=config.nightly,
        ),
    ]


@contextlib.contextmanager
def server(config: ServeConfig) -> Iterator[None]:
    """A running Prefect server within the context."""
    command = [sys.executable, "-m", "uvicorn", "--factory", "prefect.server.api.server:create_app"]
    command += ["--host", config.host, "--port", str(config.port), "--log-level", "warning"]
    # A session of its own: Ctrl-C reaches this process alone, which then ends the others in order.
    process = subprocess.Popen(command, env=dict(os.environ), start_new_session=True)
    try:
        _wait_until_up(config, process)
        yield
    finally:
        _end(process)


def _wait_until_up(config: ServeConfig, process: subprocess.Popen[bytes]) -> None:
    request = urllib.request.Request(f"{config.url}/api/health")
    if config.auth:
        request.add_header("Authorization", f"Basic {b64encode(config.auth.encode()).decode()}")
    deadline = time.monotonic() + _START_S
    while time.monotonic() < deadline:
        if process.poll() is not None:
            raise InputError(f"the Prefect server ended at once (status {process.returncode}); see its output above")
        with contextlib.suppress(urllib.error.URLError, OSError), urllib.request.urlopen(request, timeout=5):
            return
        time.sleep(0.2)
    raise InputError(f"the Prefect server at {config.url} did not come up in {_START_S:.0f} s")


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


@contextlib.contextmanager
def pages(config: ServeConfig) -> Iterator[None]:
    """Serve the pages of the runs at the port after the UI's, to this machine only; artifacts link to them."""
    from velfield.viewer.server import runs_app, serve_in_thread

    with serve_in_thread(runs_app(config.runs), config.port + 1) as address:
        os.environ.update({PAGES: address, PAGES_OF: str(config.runs)})
        print(f"pages       {address}", flush=True)
        yield


@contextlib.contextmanager
def watching(config: ServeConfig) -> Iterator[None]:
    """Poll the folders within the context, and emit an event for each arrival."""
    from prefect.events import emit_event

    def flight(path: Path) -> None:
        if is_telemetry(path):
            print_with_time(f"{path.name} has arrived: telemetry, read with the video of its name")
            return
        if not is_flight(path):  # thumbnails and proxies that a drone writes beside a video
            print_with_time(f"{path.name} has arrived: neither a video nor a folder, not processed")
            return
        print_with_time(f"{path.name} has arrived: processing")
        _resource = {"prefect.resource.id": f"velfield.flight.{path.name}"}
        emit_event(FLIGHT_ARRIVED, resource=_resource, payload={"source": str(path.resolve())})

    def base_image(path: Path) -> None:
        print_with_time(f"base image {path.name} has arrived: reprocessing all runs")
        _resource = {"prefect.resource.id": f"velfield.base-image.{path.name}"}
        emit_event(BASE_IMAGE_ARRIVED, resource=_resource, payload={"base": path.name, "run": ""})

    flights = FolderWatcher(config.incoming, config.settle_s, flight, include_existing=False)
    images = FolderWatcher(config.base_images, config.settle_s, base_image, include_existing=False)
    ended = threading.Event()

    def poll() -> None:
        while not ended.wait(_POLL_INTERVAL_S):
            for watch in (flights, images):
                watch.poll(time.monotonic())

    thread = threading.Thread(target=poll, name="watched folders", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(_STOP_S)


def run_deployments(config: ServeConfig) -> None:
    """Start the flow runs of the deployments as they come, until interrupted."""
    from prefect.runner import Runner

    class Interruptible(Runner):
        """Prefect's own answer to SIGTERM calls a coroutine without awaiting it (3.8.8), so that nothing is stopped."""

        def handle_sigterm(self, *_: Any, **__: Any) -> None:
            raise Stopped

    runner = Interruptible(pause_on_shutdown=False, limit=config.limit)
    for deployment in deployments(config):
        runner.add_deployment(deployment)
    asyncio.run(runner.start())


def serve_folder(config: ServeConfig) -> None:
    """Serve until interrupted; ends all child processes."""
    check(config)
    for folder in (config.incoming, config.base_images, config.runs):
        folder.mkdir(parents=True, exist_ok=True)
    # Server and flow runs import from their working folder despite PYTHONSAFEPATH: it must be one of ours.
    os.chdir(config.folder)
    os.environ.update(settings(config))
    # Late, where the interrupt was lost: it may be raised where Python can only print it, as while it frees an object.
    stop_on_signals(resumes=False, grace_s=3 * _STOP_S)
    print("the Prefect server starts, within a minute", file=sys.stderr, flush=True)
    try:
        with server(config):
            from flows.stale import mark_abandoned

            if killed := mark_abandoned():
                print_with_time(f"marked as crashed, as their processes were killed: {count_text(killed, 'run')}")
            everywhere = f", port {config.port} of all its addresses" if config.host in ("0.0.0.0", "::") else ""
            print(f"Prefect UI  {config.url}{everywhere}", flush=True)
            for name, path in (
                ("flights", config.incoming),
                ("base images", config.base_images),
                ("runs", config.runs),
            ):
                print(f"{name:<12}{path}", flush=True)
            with watching(config), pages(config):
                run_deployments(config)
    finally:
        end_children(_STOP_S)
