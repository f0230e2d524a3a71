"""How a process of ours that uses Prefect or Dask is set up: before either is imported.

A person's own settings win: every variable is a default.
"""

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from subprocess import DEVNULL, Popen

PAGES, PAGES_OF = "VELFIELD_PAGES", "VELFIELD_PAGES_OF"
"""Environment: where `velfield serve` shows the pages of runs, and of which folder."""
_SETTINGS: dict[str, str] = {
    # The temporary server imports from the working folder: a module there with a common name would break it.
    "PYTHONSAFEPATH": "1",
    # The first flow on a cold machine took 8-20 s to get its server, whose time-out is 20 s.
    "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS": "180",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "DO_NOT_TRACK": "1",
    # Prefect's default lets any page that a browser shows talk to the server.
    "PREFECT_SERVER_CORS_ALLOWED_ORIGINS": "http://127.0.0.1",
    # Pickle is Prefect's default; what is kept of us there is plain.
    "PREFECT_RESULTS_DEFAULT_SERIALIZER": "json",
    "DASK_DISTRIBUTED__LOGGING__DISTRIBUTED": "error",
    # A hundred looks a second at what each worker does, for a page that nobody has open.
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "false",
    # Every process of a cluster looks after itself 50 times a second, after its memory 10 times, waiting or not: on
    # two processors that was 6 % of all they can do.
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
"""glibc's settings: environment for workers; number and bytes for `mallopt` here. Pictures of some MB come and go:
asked of the system and given back each time, they cost a quarter of all processor time; with the 64 KiB that Dask sets
for its workers half as much again."""
_QUIET: dict[str, str] = {
    # Only the terminal is quiet: PREFECT_LOGGING_LEVEL would hide retries in the UI too.
    "PREFECT_LOGGING_HANDLERS_CONSOLE_LEVEL": "CRITICAL",
}


def limit_threads() -> None:
    """Keep libraries from starting threads of their own. Call before anything imports numpy."""
    for name in _ONE_THREAD:
        os.environ.setdefault(name, "1")


def prepare_process(*, verbose: bool) -> None:
    """Set this process up to run flows. Call before anything imports prefect."""
    for name, value in (_SETTINGS if verbose else _SETTINGS | _QUIET).items():
        os.environ.setdefault(name, value)
    _keep_memory()
    import cv2

    # The work is parallel by frames: OpenCV's own threads would only compete with it.
    cv2.setNumThreads(1)


def _keep_memory() -> None:
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    for name, (number, size) in _MEMORY.items():
        if name not in os.environ:
            os.environ[name] = str(size)
            if mallopt is not None:
                mallopt(number, size)


def first_start() -> bool:
    """Whether Prefect has yet to lay out its temporary server's data base: half a minute that a person wonders at."""
    from prefect.settings import get_current_settings

    settings = get_current_settings()
    url = settings.server.database.connection_url
    kind, _, file = url.get_secret_value().partition(":///") if url else ("", "", "")
    return settings.api.url is None and kind.startswith("sqlite") and not Path(file).exists()


@contextmanager
def first_start_beside() -> Iterator[None]:
    """Prefect's first start, where it is to come, in a process of its own while this one does something else.

    Should it fail, nothing is lost: the start itself does what is left, and says what is wrong.
    """
    if not first_start():
        yield
        return
    command = [sys.executable, "-m", "prefect", "server", "database", "upgrade", "-y"]
    with Popen(command, stdout=DEVNULL, stderr=DEVNULL) as beside:
        try:
            yield
        except BaseException:
            beside.terminate()
            raise


@contextmanager
def kernels_beside() -> Iterator[None]:
    """Where numba has yet to compile the kernels: a process that does it, on a tiny job, while this one works.

    A minute of a first run is waiting for the compiler on one processor, kernel after kernel; so the later ones are
    there when they are wanted. Should it fail, nothing is lost.
    """
    spec = find_spec("velfield")
    folders = spec.submodule_search_locations if spec else None
    if (
        any(found for folder in folders or () for found in Path(folder).rglob("*.nbi"))
        or "NUMBA_CACHE_DIR" in os.environ
    ):
        yield
        return
    command = [sys.executable, "-m", "velfield.pipeline.local"]
    with Popen(command, stdout=DEVNULL, stderr=DEVNULL) as beside:
        try:
            yield
        finally:
            beside.terminate()
