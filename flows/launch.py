"""Set-up of a process that uses Prefect or Dask, before either is imported.

The user's own settings win: every variable is a default.
"""

import ctypes
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from subprocess import DEVNULL, Popen

from velfield.errors import CacheWarning, DeviceWarning
from velfield.kernel_cache import cache_root, is_writable, temporary_cache, user_home

PAGES, PAGES_OF = "VELFIELD_PAGES", "VELFIELD_PAGES_OF"
"""Environment: where `velfield serve` shows the pages of runs, and of which folder."""
_SETTINGS: dict[str, str] = {
    # Prefect's server imports from the working folder: a module there with a common name would break it.
    "PYTHONSAFEPATH": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "DO_NOT_TRACK": "1",
    # Prefect's default lets any page that a browser shows talk to the server.
    "PREFECT_SERVER_CORS_ALLOWED_ORIGINS": "http://127.0.0.1",
    # Pickle is Prefect's default; our results there are plain.
    "PREFECT_RESULTS_DEFAULT_SERIALIZER": "json",
    "DASK_DISTRIBUTED__LOGGING__DISTRIBUTED": "error",
    # It samples each worker a hundred times a second, for a page that nobody has open.
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "false",
    # Every process of a cluster checks its state 50 times a second and its memory 10 times, idle or not: on two
    # processors that was 6 % of their time.
    "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "1s",
    "DASK_DISTRIBUTED__ADMIN__SYSTEM_MONITOR__INTERVAL": "5s",
    "DASK_DISTRIBUTED__WORKER__MEMORY__MONITOR_INTERVAL": "1s",
}
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
"""The work is parallel by frames. Small solves on BLAS threads of their own cost a frame 8 s in place of 0.4."""
_MEMORY: dict[str, tuple[int, int]] = {
    "MALLOC_MMAP_THRESHOLD_": (-3, 32 << 20),
    "MALLOC_TRIM_THRESHOLD_": (-1, 256 << 20),
}
"""glibc's settings: environment for workers; number and bytes for `mallopt` here. Images of some MB are
allocated and freed all the time: from and to the system each time, they cost a quarter of all processor time; with the
64 KiB that Dask sets for its workers half as much again."""
_LARGE_ARRAYS = 1 << 30
"""`MALLOC_MMAP_THRESHOLD_` of an analysis: arrays of all tracks, of tens of MB and more, cost it an eighth of its time
from and to the system. Runs would hold some 150 MB more at 4K."""
_HOMES = {"PREFECT_HOME": "prefect", "MPLCONFIGDIR": "matplotlib", "XDG_CACHE_HOME": "cache"}
"""Environment: folders that libraries have in the home folder, and their names in a temporary one."""
_THIS_MACHINE = ("127.0.0.1", "localhost", "::1")
_QUIET: dict[str, str] = {
    # Only the terminal is quiet: PREFECT_LOGGING_LEVEL would hide retries in the UI too.
    "PREFECT_LOGGING_HANDLERS_CONSOLE_LEVEL": "CRITICAL",
}


def limit_threads() -> None:
    """Keep libraries from starting threads of their own. Call before numpy is imported."""
    for name in _ONE_THREAD:
        os.environ.setdefault(name, "1")


def prepare_process(*, verbose: bool) -> None:
    """Set this process up to run flows. Call before prefect is imported."""
    for name, value in (_SETTINGS if verbose else _SETTINGS | _QUIET).items():
        os.environ.setdefault(name, value)
    keep_memory()
    import cv2

    # The work is parallel by frames: OpenCV's own threads would only compete with it.
    cv2.setNumThreads(1)


def spare_proxies() -> None:
    """Reach this machine's own server without a proxy, and leave out proxies that Prefect cannot use, with a warning.

    Its client refuses to start where one is set that it cannot speak with, even where it would not use it.
    """
    given = os.environ.get("no_proxy") or os.environ.get("NO_PROXY") or ""
    hosts = [host for host in given.split(",") if host.strip()]
    hosts += [host for host in _THIS_MACHINE if host not in hosts]
    os.environ["no_proxy"] = os.environ["NO_PROXY"] = ",".join(hosts)
    known = ("http", "https", *(("socks5", "socks5h") if find_spec("socksio") else ()))
    for name in [one for one in os.environ if one.lower() in ("http_proxy", "https_proxy", "all_proxy")]:
        scheme, separator, _ = os.environ[name].partition("://")
        if separator and scheme.lower() not in known:
            del os.environ[name]
            warnings.warn(
                f"ignoring {name} = {scheme}://..., which Prefect cannot use; to reach a server through it, set "
                "an http:// proxy, or install httpx[socks]",
                DeviceWarning,
                stacklevel=3,
            )


def use_writable_folders() -> None:
    """Keep in a temporary folder what libraries keep in the home folder, where that cannot be written, and warn.

    Call before matplotlib, numba and prefect are imported.

    Raises
    ------
    InputError
        There is no writable temporary folder either.
    """
    home = user_home()
    missing = {name: folder for name, folder in _HOMES.items() if name not in os.environ}
    if not missing or (home is not None and is_writable(home)):
        return
    temporary = temporary_cache()
    os.environ.update({name: str(temporary / folder) for name, folder in missing.items()})
    warnings.warn(
        f"the home folder ({os.environ.get('HOME') or 'HOME is not set'}) is not writable: compiled code "
        f"and other caches go to {temporary}; set HOME to a writable folder to keep them",
        CacheWarning,
        stacklevel=2,
    )


def keep_memory(*, large_arrays: bool = False) -> None:
    """Keep freed memory for what is allocated next, that of large arrays too if asked for."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    larger = {"MALLOC_MMAP_THRESHOLD_": (-3, _LARGE_ARRAYS)} if large_arrays else {}
    for name, (number, size) in (_MEMORY | larger).items():
        if name not in os.environ:
            os.environ[name] = str(size)
            if mallopt is not None:
                mallopt(number, size)


@contextmanager
def kernels_beside() -> Iterator[None]:
    """Compile the later half of the numba kernels, where none are cached, in another process while this one works.

    A minute of a first run is waiting for the compiler on one processor, kernel after kernel; this way the later ones
    are cached when they are needed. Should it fail, nothing is lost.
    """
    if any(cache_root().rglob("*.nbi")):
        yield
        return
    command = [sys.executable, "-m", "velfield.pipeline.compile_kernels", "--late"]
    with Popen(command, stdout=DEVNULL, stderr=DEVNULL) as beside:
        try:
            yield
        finally:
            beside.terminate()
