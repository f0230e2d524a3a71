"""A first run compiles the kernels in a process of its own, and only where none are cached."""

import subprocess
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path

import pytest

from flows import launch


@pytest.mark.parametrize("compiled", [True, False], ids=["compiled", "not yet"])
def test_kernels_are_compiled_beside_a_first_run_only(
    compiled: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "field/__pycache__").mkdir(parents=True)
    if compiled:
        (tmp_path / "field/__pycache__/kernels.nbi").touch()
    spec = ModuleSpec("velfield", None, is_package=True)
    spec.submodule_search_locations = [str(tmp_path)]
    started: list[subprocess.Popen[bytes]] = []

    def start(command: list[str], **options: int) -> "subprocess.Popen[bytes]":
        assert command[1:] == ["-m", "velfield.pipeline.local"]
        started.append(subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], **options))  # type: ignore[call-overload]
        return started[-1]

    monkeypatch.setattr(launch, "find_spec", lambda name: spec)
    monkeypatch.setattr(launch, "Popen", start)
    with launch.kernels_beside():
        assert [process.poll() for process in started] == ([] if compiled else [None])
    assert all(process.poll() is not None for process in started)  # it does not outlive the run
