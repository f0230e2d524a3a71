"""Fixtures that every test may use."""

import fcntl
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import hypothesis
import pytest

from flows.launch import prepare_process, spare_proxies
from schemas.simulation import CameraSimulation, SimulationConfig
from schemas.summary import RunSummary
from tests.s3_server import s3_server
from tests.small_flight import FRAMES, digests, job, process

FOOTAGE = Path(__file__).resolve().parents[2] / "shared" / "data"

# How long a case takes depends on the machine, and on whether it is the first that compiles.
hypothesis.settings.register_profile("velfield", deadline=None)
hypothesis.settings.load_profile("velfield")

# A shell that starts the tests in the background has them ignore Ctrl-C, and all that they start.
signal.signal(signal.SIGINT, signal.default_int_handler)

_LONGEST = (
    *("kills", "accuracy", "serve", "reprocess", "cluster", "s3", "viewer", "flows", "two_term_lens", "intersensor"),
    *("previews", "bench_speed", "refusals", "nth_call", "quality", "noisy_tracks", "tracks", "direct_registration"),
    *("detection", "intrasensor"),
)
"""Files that take a minute or so: begun first, or one process would sit over the last of them while the other waits."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first; order within a file stays (with `--no-loadscope-reorder` xdist keeps to it)."""
    place = {f"test_{name}.py": k for k, name in enumerate(_LONGEST)}
    items.sort(key=lambda item: place.get(item.path.name, len(place)))


@pytest.fixture(autouse=True)
def own_signals() -> Iterator[None]:
    """Take back what a command that a test calls in this process does at Ctrl-C: it would end the tests' process at the
    next interrupt, such as that of a lost lease."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    signal.set_wakeup_fd(-1)
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.fixture
def footage() -> Callable[[str], Path]:
    """Path of one folder of the real footage; skips the test, saying so, where it is absent."""

    def find(name: str) -> Path:
        path = FOOTAGE / name
        if not path.exists():
            pytest.skip(f"the real footage {name!r} is not there ({path})")
        return path

    return find


@contextmanager
def made_once(factory: pytest.TempPathFactory, name: str) -> Iterator[tuple[Path, bool]]:
    """A folder that the session's processes share, and whether it is there already; the others wait meanwhile."""
    base = factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    folder.mkdir(exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield folder, (folder / "made").exists()
        (folder / "made").touch()


@pytest.fixture(scope="session")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated flight of a few seconds."""
    from velfield.synthetic.write import write_flight

    with made_once(tmp_path_factory, "flight") as (folder, there):
        if not there:
            write_flight(
                folder / "flight",
                SimulationConfig(frames=FRAMES, width=640, height=480, camera=CameraSimulation(lens_a=0), seed=11),
            )
    return folder / "flight"


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A Prefect server of our own, once a session: its start takes longer than a small flight."""
    spare_proxies()
    prepare_process(verbose=False)
    from prefect.testing.utilities import prefect_test_harness

    with prefect_test_harness(server_startup_timeout=180):
        yield


@pytest.fixture(scope="session")
def whole(flight: Path, server: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The flight's run, done once; a test that writes into it works on a copy."""
    with made_once(tmp_path_factory, "run") as (folder, there):
        root = folder / "whole"
        if not there:
            (folder / "summary.json").write_text(process(job(flight, root)).model_dump_json())
        left = digests(root)
    yield root
    assert digests(root) == left, "a test wrote into the run that all share"


@pytest.fixture
def copy(whole: Path, tmp_path: Path) -> Path:
    """A copy of the whole run, for a test that writes into it."""
    return Path(shutil.copytree(whole, tmp_path / "run"))


@pytest.fixture
def summary(whole: Path) -> RunSummary:
    """What the flow of the whole run returned."""
    return RunSummary.model_validate_json((whole.parent / "summary.json").read_text())


@pytest.fixture(scope="session")
def s3() -> Iterator[None]:
    """A local S3 server, once a session: s3fs keeps a connection by the arguments it was opened with, and the address
    is none of them."""
    with s3_server():
        yield
