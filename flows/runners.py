"""The one place that knows about clusters: where the Dask graph of a unit is computed.

Measured (see CONTRIBUTING): a Prefect thread runner whose tasks compute their graphs on one pool of threads is fastest
on a laptop; the same tasks submitting their graphs to a cluster survive a killed worker. prefect-dask is not needed for
either.
"""

import asyncio
import importlib
import importlib.util
import platform
import threading
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from pydantic import Field, PositiveInt, ValidationError

from schemas.model import Model
from velfield.errors import InputError, count_text, one_line
from velfield.parallel import usable_processors
from velfield.pipeline.graphs import compute_here
from velfield.pipeline.stage import load_kernels, load_stages

T = TypeVar("T")

_WAIT_S = 10.0
_NO_WORKERS_S = 60.0
_ANSWER_S = 20.0
_RESTART_S = 60.0
_COMPARED = ("velfield", "python", "dask", "distributed", "numpy", "pandas")
"""Packages whose versions a worker should have in common with this process."""


class RunnerConfig(Model):
    """Where graphs are computed."""

    workers: int | None = None
    """Processes of a local cluster; none: the threads of this process."""
    scheduler: str | None = None
    """Address of a Dask scheduler, ``tcp://host:port``."""
    cluster_class: str | None = None
    """Import path of a class of Dask clusters, ``module.Class``: ``dask_kubernetes.operator.KubeCluster``, ..."""
    cluster_kwargs: dict[str, Any] = Field(default_factory=dict)
    """Its arguments."""


class ClusterFile(Model):
    """``--cluster FILE``: where to compute, by configuration alone."""

    cluster_class: str
    cluster_kwargs: dict[str, Any] = Field(default_factory=dict)
    workers: PositiveInt = 2
    """Number of workers."""


def read_runner(path: Path) -> RunnerConfig:
    """The runner configuration of a ``--cluster`` file.

    Raises
    ------
    InputError
        It does not exist, or is not such a file.
    """
    import yaml

    from schemas.model import load_yaml

    try:
        file = ClusterFile.model_validate(load_yaml(path.read_text(encoding="utf-8")))
    except FileNotFoundError:
        raise InputError(f"--cluster {path}: no such file; the documentation has some, on its page Examples") from None
    except (yaml.YAMLError, ValidationError, ValueError, RecursionError) as error:
        raise InputError(f"--cluster {path}: {one_line(error)}; keys: cluster_class, cluster_kwargs, workers") from None
    return RunnerConfig(**file.model_dump())


def choose_runner(workers: int | None, scheduler: str | None, cluster: Path | None) -> RunnerConfig:
    """Where the commands' options say that graphs are computed.

    Raises
    ------
    InputError
        More than one of them is given, there are no workers, the scheduler does not answer, or the file is not one.
    """
    if sum(given is not None for given in (workers, scheduler, cluster)) > 1:
        raise InputError("--workers, --scheduler and --cluster exclude each other; give only one")
    if workers is not None and workers < 1:
        raise InputError(f"--workers {workers}: must be a positive integer; omit it to run in this process")
    if scheduler is not None:
        check_scheduler(scheduler)  # before the cluster's client, which would wait for it
    return read_runner(cluster) if cluster else RunnerConfig(workers=workers, scheduler=scheduler)


class WorkersKilledError(RuntimeError):
    """Every worker that computed a graph was killed meanwhile, as often as the cluster tries."""


class Runner(ABC):
    """Computes Dask graphs; called from several threads at once."""

    description: str

    @abstractmethod
    def compute(self, graph: Any) -> Any:
        """The value of one delayed graph."""

    def compute_here(self, graph: Any) -> Any:
        """The same, on no more threads of this process than the calling one."""
        return self.compute(graph)

    @abstractmethod
    def call(self, function: Callable[..., T], *arguments: Any) -> T:
        """The value of one function, called by the calling thread, or by one worker as soon as one is free."""

    @abstractmethod
    def restart_workers(self) -> None:
        """Restart processes that hold memory of earlier work, where they are ours. Call it while nothing runs."""


class ThreadsRunner(Runner):
    """The threads of this process."""

    def __init__(self, threads: int) -> None:
        # One pool for all units at once: each on threads of its own, two cores ran four blocks at a time, out of each
        # other's cache.
        self._pool = ThreadPoolExecutor(threads, "dask")
        threading.Thread(target=_load, name="load", daemon=True).start()
        self.description = f"{threads} threads of this process"

    def compute(self, graph: Any) -> Any:
        from dask import threaded

        # By its name Dask would look for a cluster first, and import all of distributed for it: 0.4 s.
        return graph.compute(scheduler=threaded.get, pool=self._pool)

    def compute_here(self, graph: Any) -> Any:
        return compute_here(graph)

    def call(self, function: Callable[..., T], *arguments: Any) -> T:
        return function(*arguments)

    def restart_workers(self) -> None:
        pass  # its threads are of this process

    def close(self) -> None:
        """Let its threads end, without waiting for what they import."""
        self._pool.shutdown(wait=False, cancel_futures=True)


class ClientRunner(Runner):
    """A Dask cluster. Graphs hold functions of ``velfield`` alone, so workers need no ``flows``."""

    def __init__(
        self,
        client: Any,
        warn: Callable[[str], None],
        *,
        cluster: Any,
        asked: int,
        own_workers: bool,
    ) -> None:
        self._own_workers, self._cluster, self._asked = own_workers, cluster, asked
        self._client, self._warn = client, warn
        workers = self._count_workers()
        self._address = str(client.scheduler.address)
        self._lock, self._without_since_s = threading.Lock(), float("inf")
        self.description = f"Dask at {self._address}, {count_text(workers, 'worker')}"

    def compute(self, graph: Any) -> Any:
        return self._wait(self._client.compute(graph))

    def call(self, function: Callable[..., T], *arguments: Any) -> T:
        # Before the units that wait for a worker.
        found: T = self._wait(self._client.submit(function, *arguments, pure=False, priority=1))
        return found

    def restart_workers(self) -> None:
        # Libraries, kernels and models of the stages before take a gigabyte, which no call gives back.
        if not self._own_workers:
            return
        end_s = time.monotonic() + _WAIT_S
        while self._client.run_on_scheduler(_count_tasks) and time.monotonic() < end_s:
            time.sleep(0.05)  # what is released is forgotten a moment later; until then it would be computed again
        # Others in their place: while Dask restarts them, its cluster may give them up.
        self._cluster.scale(0)
        while self._count_workers() and time.monotonic() < end_s + _RESTART_S:
            time.sleep(0.05)
        self._cluster.scale(self._asked)

    def _wait(self, future: Any) -> Any:
        from distributed.scheduler import KilledWorker

        try:
            while True:
                try:
                    return future.result(timeout=_WAIT_S)
                except KilledWorker as error:
                    raise WorkersKilledError(
                        f"{count_text(error.allowed_failures + 1, 'worker')} of {self._address} ended while computing "
                        f"it, the last at {error.last_worker.address}: the memory limit is too small for it, or "
                        "something kills them"
                    ) from None
                except TimeoutError:
                    if future.done():  # the graph's own error, or it ended as the wait did
                        return future.result()
                    self._look_for_workers()
        finally:
            future.release()  # else the scheduler computes it again where the worker that holds it ends

    def _count_workers(self) -> int:
        return len(self._client.scheduler_info(n_workers=-1)["workers"])

    def _look_for_workers(self) -> None:
        """Say, once a minute, that there is nothing that could compute: Dask waits for workers without a word.

        A cluster of ours gives up a worker that is away for 15 s, as after it was killed on a busy machine, and starts
        another one only if it is asked again for as many as before.
        """
        workers = self._count_workers()
        with self._lock:
            if workers < self._asked:
                self._cluster.scale(self._asked)
            now_s = time.monotonic()
            self._without_since_s = float("inf") if workers else min(self._without_since_s, now_s)
            waited_s = now_s - self._without_since_s
            if waited_s < _NO_WORKERS_S:
                return
            self._without_since_s = now_s
        self._warn(
            f"found no workers at {self._address} for {waited_s:.0f} s, expected one at least; start some "
            f"(`dask worker {self._address}`; one that ends at once has the reason in its log, as where velfield is "
            "not installed): the run waits for them, and if you stop it the same command resumes"
        )


def _load() -> None:
    """Import what the later stages need while the first frames are decoded, which is done outside the interpreter."""
    with suppress(Exception):  # what fails here fails again, and is told, where it is needed
        load_stages()
        load_kernels()


def _count_tasks(dask_scheduler: Any) -> int:
    return len(dask_scheduler.tasks)


@contextmanager
def open_runner(config: RunnerConfig, warn: Callable[[str], None] = warnings.warn) -> Iterator[Runner]:
    """A runner for the duration of a flow; a cluster that it started is shut down afterwards.

    ``warn`` is called when a worker ends that had work, and once a minute at most while a cluster has no workers.
    """
    if config == RunnerConfig():
        runner = ThreadsRunner(usable_processors())
        try:
            yield runner
        finally:
            runner.close()
        return
    from distributed import Client
    from distributed.versions import VersionMismatchWarning

    if config.scheduler is not None:
        check_scheduler(config.scheduler)
    with _cluster(config) as cluster:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", VersionMismatchWarning)  # a table of several lines: `_check_workers`
            client = Client(cluster, timeout="60s", set_as_default=False)
        with client:
            client.subscribe_topic("all", lambda event: _say_lost_worker(event, warn))
            if config.cluster_class is not None:
                _wait_for_worker(client, warn)
            _check_workers(client, warn)
            own = config.scheduler is None and config.cluster_class is None
            if own:
                _load_stages(client)
            asked = 0 if config.scheduler is not None else config.workers or 0
            yield ClientRunner(client, warn, cluster=cluster, asked=asked, own_workers=own)


def _say_lost_worker(event: tuple[float, Any], warn: Callable[[str], None]) -> None:
    """Say of an event of the scheduler that a worker ended with work: Dask computes that elsewhere without a word."""
    found = event[1]
    if not isinstance(found, dict) or found.get("action") != "remove-worker" or found["expected"]:
        return
    if found["processing-tasks"] or found["lost-computed-tasks"]:
        limit = "unless it has ended too many workers"  # then Dask gives it up, of which the event does not tell
        warn(f"worker {found['worker']} ended, or was lost: its work is computed again on another, {limit}")


def _load_stages(client: Any) -> None:
    """Let each worker import what it will need; without waiting for it.

    Its one thread has just the time for it: kernels are loaded when they are called first.
    """
    for address in client.scheduler_info(n_workers=-1)["workers"]:
        loaded = client.submit(load_stages, workers=[address], pure=False)
        loaded.add_done_callback(lambda future: future.release())


def check_scheduler(address: str) -> None:
    """Refuse an address at which no Dask scheduler answers: a client would wait at another service for ever.

    Raises
    ------
    InputError
        The address is not one, nothing answers there, or it is no scheduler.
    """
    from distributed import rpc
    from distributed.security import Security

    expected = "give the address that `dask scheduler` prints, such as tcp://HOST:8786, not the dashboard's"

    async def ask() -> str:
        async with rpc(address, connection_args=Security().get_connection_args("client")) as service:
            return str((await service.identity())["type"])

    try:
        found = asyncio.run(asyncio.wait_for(ask(), _ANSWER_S))
    except TimeoutError:
        found = f"no answer within {_ANSWER_S:.0f} s"
    except Exception as error:  # of the address, of the name's look-up, of what another service answers
        found = one_line(error)
    if found != "Scheduler":
        raise InputError(f"--scheduler {address}: no Dask scheduler there ({found}); {expected}")


def _wait_for_worker(client: Any, warn: Callable[[str], None]) -> None:
    """Until a cluster that was asked for workers has one: a queue may take hours over it."""
    while True:
        try:
            client.wait_for_workers(1, timeout=_NO_WORKERS_S)
            return
        except TimeoutError:
            warn(
                f"no workers at {client.scheduler.address} after {_NO_WORKERS_S:.0f} s; the run waits: check the "
                "cluster's queue for their jobs, and their logs"
            )


def _check_workers(client: Any, warn: Callable[[str], None]) -> None:
    """Refuse workers that could not compute: one without velfield ends when it is sent work, then the next one.

    Only by functions of the standard library: all others would end such a worker too.
    """
    found = client.run(importlib.util.find_spec, "velfield", on_error="return")
    without = sorted(address for address, spec in found.items() if spec is None or isinstance(spec, Exception))
    if without:
        raise InputError(
            f"velfield is not installed on {_list_some(without)} of the cluster's {len(found)} workers; "
            "install the wheel in the environment from which `dask worker` is started, or stop those workers"
        )
    versions = client.get_versions(packages=["velfield"])
    here = {name: versions["client"]["packages"][name] for name in _COMPARED}
    others: dict[tuple[str, str], list[str]] = {}
    for address, worker in versions["workers"].items():
        for name in _COMPARED:
            if worker["packages"][name] != here[name]:
                others.setdefault((name, str(worker["packages"][name])), []).append(address)
    for (name, other), addresses in sorted(others.items()):
        version_here = platform.python_version() if name == "python" else here[name]
        text = f"found {name} {other} on {_list_some(addresses)} of its workers, expected {version_here} as here"
        if name == "velfield":
            raise InputError(f"{text}; install the same wheel there")
        warn(f"{text}: results may differ slightly, or tasks may fail; install the same versions there")


def _list_some(addresses: list[str]) -> str:
    return f"{len(addresses)} ({', '.join(addresses[:3])}{', ...' if len(addresses) > 3 else ''})"


@contextmanager
def _cluster(config: RunnerConfig) -> Iterator[Any]:
    """The target of a client: an address, or a cluster that lives as long as the context."""
    if config.scheduler is not None:
        yield config.scheduler
        return
    if config.cluster_class is None:
        from dask.distributed import LocalCluster

        here = {"dashboard_address": "127.0.0.1:0", "host": "127.0.0.1"}
        with LocalCluster(n_workers=config.workers, threads_per_worker=1, **here) as cluster:
            yield cluster
        return
    cluster_class, arguments = _import_class(config)
    with cluster_class(**arguments) as cluster:
        cluster.scale(config.workers)
        yield cluster


def _import_class(config: RunnerConfig) -> tuple[Any, dict[str, Any]]:
    module, _, name = str(config.cluster_class).rpartition(".")
    try:
        return getattr(importlib.import_module(module), name), config.cluster_kwargs
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(
            f"cluster_class {config.cluster_class!r}: {error}; install its package, or correct the name"
        ) from None


def parallel_units(config: RunnerConfig) -> int:
    """Number of units to submit at once, known before the runner is opened."""
    if config.scheduler is not None:
        return 32
    return 2 * config.workers if config.workers is not None else usable_processors()
