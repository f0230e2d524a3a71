"""A first run compiles the kernels in a process of its own, and no folder of the user's is needed."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from flows import launch, prefect_server
from tests.browser import served
from velfield.errors import CacheWarning, DeviceWarning, InputError


@pytest.mark.parametrize("compiled", [True, False], ids=["compiled", "not yet"])
def test_kernels_are_compiled_beside_a_first_run_only(
    compiled: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "velfield.field").mkdir()
    if compiled:
        (tmp_path / "velfield.field/kernels.nbi").touch()
    started: list[subprocess.Popen[bytes]] = []

    def start(command: list[str], **options: int) -> "subprocess.Popen[bytes]":
        assert command[1:] == ["-m", "velfield.pipeline.compile_kernels", "--late"]
        started.append(subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], **options))
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


def test_this_machine_is_reached_without_a_proxy_and_unusable_proxies_are_left_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, value in {
        "no_proxy": "",
        "NO_PROXY": "intranet",
        "http_proxy": "http://127.0.0.1:9",
        "https_proxy": "proxy:3128",
        "ALL_PROXY": "socks5h://user:secret@127.0.0.1:9",
    }.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(launch, "find_spec", lambda name: None)
    with pytest.warns(DeviceWarning, match="ALL_PROXY = socks5h") as warned:
        launch.spare_proxies()
    assert "secret" not in str(warned[0].message)
    assert os.environ["no_proxy"] == os.environ["NO_PROXY"] == "intranet,127.0.0.1,localhost,::1"
    assert "ALL_PROXY" not in os.environ
    assert (os.environ["http_proxy"], os.environ["https_proxy"]) == ("http://127.0.0.1:9", "proxy:3128")
    launch.spare_proxies()
    assert os.environ["no_proxy"] == "intranet,127.0.0.1,localhost,::1"


@pytest.mark.parametrize("url", ["http://127.0.0.1:9/api", "nonsense", "http://not-there.invalid/api", "silent"])
def test_an_address_without_a_server_is_one_line_within_seconds(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before Prefect is imported; ``silent`` takes connections and answers none."""
    for proxy in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(proxy, raising=False)
    monkeypatch.setattr(prefect_server, "_ANSWER_S", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"http://127.0.0.1:{silent.getsockname()[1]}/api" if url == "silent" else url
        monkeypatch.setenv("PREFECT_API_URL", address)
        with pytest.raises(InputError, match=f"{address}: found no Prefect server") as caught:
            prefect_server.check_address()
    assert "\n" not in str(caught.value)
    assert "(`unset PREFECT_API_URL`)" in str(caught.value)


def test_an_address_of_another_server_is_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """As that of Prefect's pages is, where ``/api`` is left out."""
    launch.spare_proxies()
    with served(tmp_path) as address:
        monkeypatch.setenv("PREFECT_API_URL", address)
        with pytest.raises(InputError, match=r"not Prefect's interface there, whose address ends with /api"):
            prefect_server.check_address()


def test_a_server_that_does_not_answer_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    from prefect.settings import PREFECT_API_URL, temporary_settings

    from flows.prefect_server import check_server

    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    dead = "http://127.0.0.1:9/api"
    with temporary_settings({PREFECT_API_URL: dead}), pytest.raises(InputError, match=f"{dead}: found no") as caught:
        check_server()
    assert "\n" not in str(caught.value)
    assert "`prefect config unset PREFECT_API_URL`" in str(caught.value)


def test_an_analysis_keeps_the_memory_of_large_arrays(monkeypatch: pytest.MonkeyPatch) -> None:
    for large, threshold in ((False, 32 << 20), (True, 1 << 30)):
        for name in ("MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_"):
            monkeypatch.setenv(name, "")
            monkeypatch.delenv(name)
        launch.keep_memory(large_arrays=large)
        assert os.environ["MALLOC_MMAP_THRESHOLD_"] == str(threshold)
    monkeypatch.setenv("MALLOC_MMAP_THRESHOLD_", "4096")
    launch.keep_memory(large_arrays=True)
    assert os.environ["MALLOC_MMAP_THRESHOLD_"] == "4096"  # the user's
