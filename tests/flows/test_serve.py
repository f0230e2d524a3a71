"""`velfield serve`: a real server and real flow runs, from an event to a finished result; and what it refuses."""

import contextlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from base64 import b64encode
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import psutil
import pytest
import yaml

from flows import deployed
from flows.artifacts import page_address
from flows.console import Console
from flows.deployed import process_dropped, reprocess_runs
from flows.launch import PAGES, PAGES_OF
from flows.runners import RunnerConfig
from flows.serve import ServeConfig, check, deployments, settings, watching
from schemas.job import Job
from schemas.summary import RunSummary
from tests.browser import browser
from tests.faults.test_servers import listening
from velfield.errors import InputError
from velfield.pipeline.plan import OtherFlightError
from velfield.pipeline.stage import STAGES, NewBase
from velfield.pipeline.watch import FolderWatcher, find_image, inputs_of, newest_image, run_folders, run_name
from velfield.run.layout import to_path

ROOT = Path(__file__).resolve().parents[2]
AUTH = "somebody:secret"


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


# -------------------------------------------------------------------------------------------------- what is refused


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "10.0.0.1"])
def test_another_address_is_refused_without_an_auth_string(host: str) -> None:
    with pytest.raises(InputError, match="add --auth USER:PASSWORD"):
        check(ServeConfig(Path("x"), host=host, port=free_port()))


def test_another_address_is_served_with_one() -> None:
    check(ServeConfig(Path("x"), host="0.0.0.0", port=free_port(), auth=AUTH))
    with pytest.raises(InputError, match="expected USER:PASSWORD"):
        check(ServeConfig(Path("x"), auth="secret"))


def test_a_port_that_is_taken_is_refused() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(InputError, match="is not available"):
            check(ServeConfig(Path("x"), port=taken.getsockname()[1]))


def test_no_analytics_and_no_other_origin() -> None:
    given = settings(ServeConfig(Path("x"), port=4321, auth=AUTH, database="postgresql+asyncpg://db/velfield"))
    assert given["PREFECT_SERVER_ANALYTICS_ENABLED"] == "false"
    assert given["PREFECT_SERVER_CORS_ALLOWED_ORIGINS"] == "http://127.0.0.1:4321"
    assert given["PREFECT_API_DATABASE_CONNECTION_URL"].startswith("postgresql")
    assert given["PREFECT_SERVER_API_AUTH_STRING"] == AUTH


@pytest.mark.parametrize(
    ("chosen", "expected"),
    [
        ({}, "sqlite+aiosqlite:////flights/prefect.db"),
        ({"PREFECT_HOME": "/elsewhere"}, None),
        ({"PREFECT_SERVER_DATABASE_CONNECTION_URL": "sqlite+aiosqlite:////elsewhere/runs.db"}, None),
        ({"PREFECT_PROFILE": "mine"}, None),
    ],
)
def test_a_folder_has_a_database_of_its_own_unless_the_user_has_chosen_one(
    chosen: dict[str, str], expected: str | None, tmp_path: Path
) -> None:
    """In a process without Prefect: its settings are read once, when it is imported."""
    ours = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    code = (
        "import sys; from pathlib import Path; from flows.serve import ServeConfig, settings; "
        "print(settings(ServeConfig(Path('/flights'))).get('PREFECT_API_DATABASE_CONNECTION_URL')); "
        "assert 'prefect' not in sys.modules"
    )
    environment = {**ours, "HOME": str(tmp_path), "PYTHONPATH": str(ROOT), **chosen}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == str(expected)


@pytest.mark.parametrize(
    ("host", "url"),
    [("0.0.0.0", "http://127.0.0.1:4321"), ("::", "http://[::1]:4321"), ("10.0.0.1", "http://10.0.0.1:4321")],
)
def test_the_ui_asks_the_address_by_which_the_browser_reached_it(host: str, url: str) -> None:
    """A browser elsewhere cannot ask 0.0.0.0, nor 127.0.0.1; this machine asks itself."""
    given = settings(ServeConfig(Path("x"), host=host, port=4321, auth=AUTH))
    assert given["PREFECT_UI_API_URL"] == "/api"
    assert given["PREFECT_API_URL"] == f"{url}/api"


def test_a_flight_that_fails_says_so_in_the_terminal(
    server: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Else "has arrived" is the last word about it there."""
    with pytest.raises(InputError, match="does not exist"):
        process_dropped(str(tmp_path / "street.mp4"), str(tmp_path / "runs"))
    assert f"street.mp4 failed: {tmp_path / 'street.mp4'} does not exist" in capsys.readouterr().out


def test_the_page_of_a_run_on_s3_has_an_address_while_other_pages_are_served(
    s3: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PAGES_OF, str(tmp_path))
    monkeypatch.setenv(PAGES, "http://127.0.0.1:4280")
    assert page_address(tmp_path / "street/index.html") == "http://127.0.0.1:4280/street/index.html"
    address = "s3://flights/runs/street/index.html"
    assert page_address(to_path(address)) is None


def test_runs_on_s3_are_found_for_a_new_base_image(server: None, s3: None, tmp_path: Path) -> None:
    runs = "s3://flights/runs-of-serve"
    for name in ("flight.json", "index.html"):
        (to_path(runs) / "street" / name).write_bytes(b"")
    (tmp_path / "base.png").write_bytes(b"")
    with pytest.raises(InputError, match="the runs are street"):
        reprocess_runs(runs, str(tmp_path), run="another")


def test_all_addresses_with_a_password(tmp_path: Path) -> None:
    """A real server: without the password nothing but its health, and the UI works under other names of the machine."""
    port = free_port()
    ours = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    environment = {**ours, "HOME": str(tmp_path), "PYTHONPATH": str(ROOT)}
    at = ["--host", "0.0.0.0", "--port", str(port), "--auth", AUTH]
    command = [sys.executable, "-m", "flows.cli", "serve", str(tmp_path / "served"), *at]
    told_to: dict[str, Any] = {"env": environment, "stdout": subprocess.PIPE, "text": True}
    with (tmp_path / "errors").open("w+") as errors, subprocess.Popen(command, stderr=errors, **told_to) as process:
        try:
            told = process.stdout.readline().strip()
            assert told == f"Prefect UI  http://127.0.0.1:{port}, port {port} of all its addresses"
            assert (tmp_path / "served" / "prefect.db").exists()
            url = f"http://localhost:{port}"
            for password, status in ((None, 401), ("somebody:else", 401), (AUTH, 200)):
                request = urllib.request.Request(
                    f"{url}/api/deployments/filter", b"{}", {"Content-Type": "application/json"}
                )
                if password is not None:
                    request.add_header("Authorization", f"Basic {b64encode(password.encode()).decode()}")
                assert _status(request) == status
            for path in ("/admin/version", "/variables/name/system-health"):
                assert _status(urllib.request.Request(f"{url}/api{path}")) == 401, path
            with browser(tmp_path / "profile") as found, found.page() as page:
                page.open(url)
                page.wait("document.querySelector('input') !== null")  # for the password
                asked = [request for request in page.requests if "/api/" in request]
                assert asked
                assert [request for request in asked if not request.startswith(url)] == []
                assert "Can't connect" not in page.value("document.body.innerText")
                others = [one for one in page.requests if not one.startswith((url, "data:", "blob:"))]
                assert others == []  # no other host is told that somebody looks
            process.send_signal(signal.SIGTERM)
            assert process.wait(60) == 0
            assert process.stdout.read().splitlines()[-1] == "stopped; all processes ended"
            errors.seek(0)
            assert "Warning" not in errors.read()
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(60)


def _status(request: urllib.request.Request) -> int:
    try:
        with urllib.request.urlopen(request, timeout=30) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as error:
        return error.code


# -------------------------------------------------------------------------------------------------- what arrives


def test_an_arrival_is_reported_once_when_it_no_longer_grows(tmp_path: Path) -> None:
    (tmp_path / "old.mp4").write_bytes(b"1")
    text: list[str] = []
    watch = FolderWatcher(tmp_path, 5.0, lambda path: text.append(path.name), include_existing=False)
    (tmp_path / "new.mp4").write_bytes(b"1")
    watch.poll(0.0)
    (tmp_path / "new.mp4").write_bytes(b"12")
    watch.poll(6.0)
    watch.poll(10.0)
    assert text == []
    watch.poll(11.0)
    watch.poll(99.0)
    assert text == ["new.mp4"]
    for k, name in enumerate(("new.mp4", "old.mp4")):  # replaced: a mended copy
        (tmp_path / "part").write_bytes(b"123")
        (tmp_path / "part").rename(tmp_path / name)
        watch.poll(100.0 + 20 * k)
        watch.poll(106.0 + 20 * k)
        assert text[1 + k :] == [name]
    watch.poll(199.0)
    assert len(text) == 3


def test_a_flight_of_the_name_of_another_gets_a_folder_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Drones name the first clip of every card alike."""
    roots: list[str] = []

    def run(job: Job, _runner: RunnerConfig, _console: Console) -> RunSummary:
        roots.append(Path(job.root).name)
        if len(roots) < 3:
            raise OtherFlightError("the run of another")
        return RunSummary(root=job.root, stages=())

    monkeypatch.setattr(deployed, "run_flight", run)
    (tmp_path / "DJI_0001.MP4").write_bytes(b"")
    found = deployed._run_dropped(tmp_path / "DJI_0001.MP4", tmp_path / "runs", RunnerConfig())
    assert roots == ["DJI_0001", "DJI_0001-2", "DJI_0001-3"]
    assert Path(found.root).name == "DJI_0001-3"


def test_what_a_drone_writes_beside_a_video_is_no_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = ServeConfig(tmp_path, settle_s=0.0)
    for folder in (config.incoming, config.base_images):
        folder.mkdir(parents=True)
    emitted: list[str] = []
    monkeypatch.setattr("prefect.events.emit_event", lambda _name, *, payload, **_: emitted.append(payload["source"]))
    monkeypatch.setattr("flows.serve._POLL_INTERVAL_S", 0.01)
    with watching(config):
        for name in ("DJI_0001.SRT", "DJI_0001.LRF", "DJI_0001.MP4"):
            (config.incoming / name).write_bytes(b"1")
        until = time.monotonic() + 20
        text = ""
        while text.count("arrived") < 3 and time.monotonic() < until:
            time.sleep(0.01)
            text += capsys.readouterr().out
    assert [Path(source).name for source in emitted] == ["DJI_0001.MP4"]
    assert "DJI_0001.SRT has arrived: telemetry, read with the video of its name" in text
    assert "DJI_0001.LRF has arrived: neither a video nor a folder, not processed" in text


def test_a_dropped_folder_is_read_by_its_names(tmp_path: Path) -> None:
    drop = tmp_path / "Main St"
    for name in ("frames/1.png", "base.png", "labels.csv", "timestamps.csv", "flight.yaml"):
        (drop / name).parent.mkdir(parents=True, exist_ok=True)
        (drop / name).touch()
    inputs, config = inputs_of(drop)
    assert inputs.source == str(drop / "frames")
    assert (inputs.base, inputs.labels) == (str(drop / "base.png"), str(drop / "labels.csv"))
    assert config == drop / "flight.yaml"
    assert run_name(drop) == "Main-St"


@pytest.mark.parametrize("name", ["../secret.png", "/etc/hostname", "link.png", "none.png"])
def test_base_images_are_taken_from_their_folder_alone(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "base-images"
    folder.mkdir()
    (tmp_path / "secret.png").touch()
    (folder / "link.png").symlink_to(tmp_path / "secret.png")
    with pytest.raises(InputError, match="base-images"):
        find_image(folder, name)


def test_runs_are_taken_from_their_folder_alone(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run/flight.json").touch()
    (tmp_path / "runs").mkdir()
    with pytest.raises(InputError, match="is not in"):
        run_folders(tmp_path / "runs", "../run")
    assert run_folders(tmp_path / "runs") == []
    assert newest_image(tmp_path / "runs") is None


# -------------------------------------------------------------------------------------------------- prefect.yaml


def test_prefect_yaml_has_the_same_deployments(server: None, tmp_path: Path) -> None:
    text = {found["name"]: found for found in yaml.safe_load((ROOT / "prefect.yaml").read_text())["deployments"]}
    ours = {found.name: found for found in deployments(ServeConfig(tmp_path))}
    assert set(text) == set(ours)
    for name, deployment in ours.items():
        written = text[name]
        path, _, function = written["entrypoint"].partition(":")
        assert deployment.entrypoint == f"{path.removesuffix('.py').replace('/', '.')}.{function}"
        assert set(written["parameters"]) == set(deployment.parameters)
        assert written["description"] == deployment.description
        crons = [schedule.schedule.cron for schedule in deployment.schedules or []]
        assert [schedule["cron"] for schedule in written.get("schedules", [])] == crons
        events = [set(trigger.expect) for trigger in deployment.triggers]
        assert [set(trigger["expect"]) for trigger in written.get("triggers", [])] == events
        for trigger, here in zip(written.get("triggers", []), deployment.triggers, strict=True):
            assert set(trigger["parameters"]) == set(here.parameters or {})


# -------------------------------------------------------------------------------------------------- end to end


@dataclass
class Served:
    """A `velfield serve` of our own."""

    process: subprocess.Popen[str]
    folder: Path
    url: str

    def ask(self, path: str, body: object = None) -> Any:
        """What the API answers; asked again, as Prefect's client does, while its database is locked (503)."""
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(f"{self.url}/api{path}", data=data)
        request.add_header("Content-Type", "application/json")
        for wait_s in (2, 4, 8, 16, None):
            try:
                with urllib.request.urlopen(request, timeout=30) as answer:
                    text = answer.read()
                break
            except urllib.error.HTTPError as error:
                if error.code != 503 or wait_s is None:
                    raise
                time.sleep(wait_s)
        return json.loads(text) if text else None

    def states(self) -> dict[str, str]:
        """Deployed flow runs that have begun, by name."""
        runs = self.ask("/flow_runs/filter", {"sort": "START_TIME_DESC"})
        begun = [run for run in runs if run["deployment_id"] and run["state"]["type"] != "SCHEDULED"]
        return {run["name"]: run["state"]["type"] for run in begun}


@pytest.fixture(scope="module")
def served(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A served folder with one run in it, from a working folder with a decoy."""
    tmp_path = tmp_path_factory.mktemp("serve")
    folder, port = tmp_path / "served", free_port()
    shutil.copytree(whole, folder / "runs" / "main-street")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere/flows.py").write_text("raise RuntimeError('a decoy was imported')")
    ours = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    environment = {**ours, "PREFECT_HOME": str(tmp_path / "home"), "PYTHONPATH": str(ROOT), "PYTHONSAFEPATH": "1"}
    environment["PREFECT_LOGGING_TO_API_BATCH_INTERVAL"] = "0.5"
    command = [sys.executable, "-m", "flows.cli", "serve", str(folder), "--port", str(port), "--settle-s", "1"]
    process = subprocess.Popen(
        command, env=environment, cwd=tmp_path / "elsewhere", stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        assert process.stdout.readline().strip() == f"Prefect UI  http://127.0.0.1:{port}"
        yield Served(process, folder, f"http://127.0.0.1:{port}")
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(60)
            process.kill()
        process.stdout.close()


def wait_for(what: Callable[[], bool], seconds: float = 180) -> None:
    deadline = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.5)


def test_from_the_event_to_the_finished_reprocess(served: Served, flight: Path) -> None:
    image = cv2.imread(str(flight / "base.png"), cv2.IMREAD_GRAYSCALE)
    # Hidden names are not watched, so that only the event announces it.
    cv2.imwrite(str(served.folder / "base-images/.spring.png"), cv2.GaussianBlur(image, (0, 0), 0.8))
    wait_for(lambda: len(served.ask("/deployments/filter", {})) == 3)
    event = {
        "occurred": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "event": "velfield.base-image.arrived",
        "resource": {"prefect.resource.id": "velfield.base-image.spring"},
        "payload": {"base": ".spring.png", "run": "main-street"},
        "id": "11111111-1111-4111-8111-111111111111",
    }
    served.ask("/events", [event])
    wait_for(lambda: "COMPLETED" in served.states().values() or "FAILED" in served.states().values())
    assert served.states() == {"main-street on .spring.png": "COMPLETED"}
    results = json.loads((served.folder / "runs/main-street/results.json").read_text())["results"]
    assert [(result["name"], result["how"]) for result in results] == [("first", "run"), ("spring", "mapped")]
    made = served.ask("/artifacts/filter", {})
    (link,) = [one for one in made if re.fullmatch(r"main-street-on-spring-[0-9a-f]{6}-report", one["key"])]
    assert link["description"] == "main-street on spring: page with map and report"
    address = re.fullmatch(r"\[report\]\((http://127\.0\.0\.1:\d+/main-street/\S+)\)", link["data"])
    assert address is not None, link["data"]
    with urllib.request.urlopen(address[1], timeout=30) as answer:
        assert b"<title>" in answer.read()
    with urllib.request.urlopen(address[1].partition("/main-street/")[0], timeout=30) as answer:
        assert b'href="main-street/"' in answer.read()
    _mapped_stages_read_the_new_base_image(served)


def _mapped_stages_read_the_new_base_image(served: Served) -> None:
    """In the graph, from the one task that registers the new image to the old one."""
    (run,) = served.ask("/flow_runs/filter", {"flow_runs": {"tags": {"all_": ["reprocess", "main-street", "spring"]}}})
    asked = {"flow_runs": {"id": {"any_": [run["id"]]}}}
    wait_for(lambda: "maps" in [task["name"] for task in served.ask("/task_runs/filter", asked)])
    tasks = served.ask("/task_runs/filter", asked)
    (measured,) = [task["id"] for task in tasks if task["name"] == "new base image on the old one"]
    readers = {
        task["name"].split()[0]
        for task in tasks
        if measured in [one["id"] for inputs in task["task_inputs"].values() for one in inputs if "id" in one]
    }
    mapped = {stage.label.split()[0] for stage in STAGES if stage.new_base is NewBase.MAPPED}
    assert readers == mapped


def test_bad_input_is_one_line_in_the_log_of_a_deployed_run(served: Served) -> None:
    """Prefect's engine logs a traceback of its own for a deployed run that failed."""
    (found,) = [one for one in served.ask("/deployments/filter", {}) if one["name"] == "base-image-arrived"]
    parameters = found["parameters"] | {"base": "none.png"}
    run = served.ask(f"/deployments/{found['id']}/create_flow_run", {"parameters": parameters})
    wait_for(lambda: served.ask(f"/flow_runs/{run['id']}")["state"]["type"] in ("FAILED", "COMPLETED", "CRASHED"))
    state = served.ask(f"/flow_runs/{run['id']}")["state"]
    text = f"{served.folder / 'base-images/none.png'} does not exist; base images are taken from "
    text += f"{served.folder / 'base-images'} only"
    assert (state["name"], state["message"]) == ("Failed", text)
    asked = {"logs": {"flow_run_id": {"any_": [run["id"]]}, "level": {"ge_": 40}}}
    wait_for(lambda: served.ask("/logs/filter", asked) != [])
    time.sleep(2)  # what is logged last arrives last: four times as long as Prefect keeps lines here
    assert [line["message"] for line in served.ask("/logs/filter", asked)] == [text]


_BLINKS = """if True:
    import sys
    from flows.launch import limit_threads, prepare_process
    limit_threads()
    prepare_process(verbose=False)
    from pathlib import Path
    from tests.small_flight import job, process
    from velfield.pipeline.stages import tracklets
    true, calls = tracklets.link_unit, []

    def blinks(plan, frames):
        calls.append(frames)
        if len(calls) == 1:
            raise OSError("the disk blinked")
        return true(plan, frames)

    tracklets.link_unit = blinks
    process(job(Path(sys.argv[1]), Path(sys.argv[2])))
"""


def test_the_ui_shows_graph_retry_and_artifacts(served: Served, whole: Path, flight: Path, tmp_path: Path) -> None:
    """In a real browser: the graph drawn, a task that was tried twice shown so, the summary with its maps."""
    root = tmp_path / "blinks"
    shutil.copytree(whole, root)
    (root / "commits/tracklets/000008-000015.json").unlink()
    environment = {**os.environ, "PREFECT_API_URL": f"{served.url}/api", "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", _BLINKS, str(flight), str(root)], env=environment, check=True)
    (run,) = served.ask("/flow_runs/filter", {"flow_runs": {"name": {"any_": ["blinks"]}}})
    tasks = served.ask("/task_runs/filter", {"flow_runs": {"id": {"any_": [run["id"]]}}})
    (twice,) = [task for task in tasks if task["run_count"] > 1]
    assert twice["name"] == "tracklets 000008-000015"
    with browser(tmp_path / "profile") as found, found.page() as page:
        page.open(f"{served.url}/runs/flow-run/{run['id']}")
        page.wait("document.body.innerText.includes('Completed')")
        page.wait("document.querySelector('canvas')?.clientHeight > 100")
        assert f"{len(tasks)} Task runs" in page.value("document.body.innerText")
        page.open(f"{served.url}/runs/task-run/{twice['id']}")
        page.wait("document.body.innerText.includes('the disk blinked')")
        page.wait("/Run Count\\s+2/.test(document.body.innerText)")
        assert "Retry 1/1 will start" in page.value("document.body.innerText")
        made = served.ask("/artifacts/filter", {"flow_runs": {"id": {"any_": [run["id"]]}}})
        (summary,) = [one for one in made if re.fullmatch(r"blinks-[0-9a-f]{6}-summary", one["key"])]
        page.open(f"{served.url}/artifacts/artifact/{summary['id']}")
        page.wait("document.querySelectorAll('img[src^=data]').length == 2")
        page.wait("[...document.querySelectorAll('img')].every(img => img.naturalWidth > 100)")
        asked = {request for request in page.requests if request.startswith("http")}
        assert [request for request in asked if not request.startswith(served.url)] == []


def test_sockets_and_origins_and_that_ctrl_c_leaves_nothing(served: Served) -> None:
    """Last of all."""
    serving = psutil.Process(served.process.pid)
    family = [serving, *serving.children(recursive=True)]
    assert {address for _, address, _ in listening(*family)} <= {"127.0.0.1"}
    request = urllib.request.Request(f"{served.url}/api/health", headers={"Origin": "http://evil.example"})
    with urllib.request.urlopen(request, timeout=30) as answer:
        assert answer.headers["access-control-allow-origin"] not in ("*", "http://evil.example")

    served.process.send_signal(signal.SIGINT)
    assert served.process.wait(60) == 0
    psutil.wait_procs(family, timeout=5)
    assert [process for process in family if process.is_running() and process.status() != psutil.STATUS_ZOMBIE] == []
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(f"{served.url}/api/health", timeout=5)
