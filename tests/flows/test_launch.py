"""A first run compiles the kernels in a process of its own, and no folder of the user's is needed."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from flows import launch
from velfield.errors import CacheWarning


@pytest.mark.parametrize("compiled", [True, False], ids=["compiled", "not yet"])
def test_kernels_are_compiled_beside_a_first_run_only(
    compiled: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "velfield.field").mkdir()
    if compiled:
        (tmp_path / "velfield.field/kernels.nbi").touch()
    started: list[subprocess.Popen[bytes]] = []

    def start(command: list[str], **options: int) -> "subprocess.Popen[bytes]":
        assert command[1:] == ["-m", "velfield.pipeline.local"]
        started.append(subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], **options))  # type: ignore[call-overload]
        return started[-1]

    monkeypatch.setattr(launch, "cache_root", lambda: tmp_path)
    monkeypatch.setattr(launch, "Popen", start)
    with launch.kernels_beside():
        assert [process.poll() for process in started] == ([] if compiled else [None])
    assert all(process.poll() is not None for process in started)  # it does not outlive the run


@pytest.mark.parametrize("home", ["/dev/null/home", ""], ids=["not there", "not set"])
def test_without_a_home_caches_are_temporary_and_one_line_names_them(
    home: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in launch._HOMES:
        monkeypatch.setenv(name, "of the user")  # to be restored
        monkeypatch.delenv(name)
    monkeypatch.setenv("HOME", home)
    monkeypatch.setenv("PREFECT_HOME", "of the user")
    monkeypatch.setattr(launch, "user_home", lambda: None)
    monkeypatch.setattr(launch, "temporary_cache", lambda: tmp_path)
    with pytest.warns(CacheWarning, match="HOME"):
        launch.use_writable_folders()
    launch.use_writable_folders()  # a warning is an error: once is enough
    assert os.environ["PREFECT_HOME"] == "of the user"
    assert os.environ["MPLCONFIGDIR"] == str(tmp_path / "matplotlib")
