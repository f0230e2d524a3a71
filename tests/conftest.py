"""Fixtures that every test may use."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from flows.launch import prepare_process
from schemas.simulation import SimulationConfig
from schemas.summary import RunSummary
from tests.small_flight import FRAMES, digests, job, process

FOOTAGE = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture
def footage() -> Callable[[str], Path]:
    """Path of one folder of the real footage; skips the test, saying so, where it is absent."""

    def find(name: str) -> Path:
        path = FOOTAGE / name
        if not path.exists():
            pytest.skip(f"the real footage {name!r} is not there ({path})")
        return path

    return find


@pytest.fixture(scope="session")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated flight of a few seconds."""
    from velfield.synthetic import write_flight

    folder = tmp_path_factory.mktemp("flight")
    write_flight(folder, SimulationConfig(frames=FRAMES, width=640, height=480, seed=11))
    return folder


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A Prefect server of our own, once a session: its start takes longer than a small flight."""
    prepare_process(verbose=False)
    from prefect.testing.utilities import prefect_test_harness

    with prefect_test_harness(server_startup_timeout=180):
        yield


@pytest.fixture(scope="session")
def whole(flight: Path, server: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, RunSummary]]:
    """The flight's run, done once; a test that writes into it works on a copy."""
    root = tmp_path_factory.mktemp("run") / "whole"
    summary = process(job(flight, root))
    left = digests(root)
    yield root, summary
    assert digests(root) == left, "a test wrote into the run that all share"
