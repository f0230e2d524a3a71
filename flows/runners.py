"""The one place that knows about clusters: where the Dask graph of a unit is computed.

Measured (see CONTRIBUTING): a Prefect thread runner whose tasks compute their graphs on Dask's threads is fastest on
a laptop; the same tasks submitting their graphs to a cluster survive a killed worker. prefect-dask is not needed for
either.
"""

import os
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from schemas.model import Model


class RunnerConfig(Model):
    """Where graphs are computed."""

    workers: int | None = None
    """Processes of a local cluster; none: the threads of this process."""
    scheduler: str | None = None
    """Address of a Dask scheduler, ``tcp://host:port``."""


class Runner(ABC):
    """Computes Dask graphs, from several threads at once."""

    description: str

    @abstractmethod
    def compute(self, graph: Any) -> Any:
        """The value of one delayed graph."""


class ThreadsRunner(Runner):
    """The threads of this process."""

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self.description = f"{threads} threads of this process"

    def compute(self, graph: Any) -> Any:
        # Units run side by side on Prefect's threads, so a graph of its own needs no more than a few.
        return graph.compute(scheduler="threads", num_workers=self._threads)


class ClientRunner(Runner):
    """A Dask cluster. Graphs hold functions of ``velfield`` alone: its workers need no ``flows``."""

    def __init__(self, client: Any) -> None:
        workers = max(1, len(client.scheduler_info(n_workers=-1)["workers"]))
        self._client = client
        self.description = f"Dask at {client.scheduler.address}, {workers} workers"

    def compute(self, graph: Any) -> Any:
        return self._client.compute(graph).result()


@contextmanager
def open_runner(config: RunnerConfig) -> Iterator[Runner]:
    """A runner for the time of a flow; what it started is gone afterwards."""
    if config.scheduler is None and config.workers is None:
        yield ThreadsRunner(_usable_cores())
        return
    from dask.distributed import Client, LocalCluster

    if config.scheduler is not None:
        with Client(config.scheduler, timeout="30s", set_as_default=False) as client:
            yield ClientRunner(client)
        return
    with (
        LocalCluster(
            n_workers=config.workers,
            threads_per_worker=1,
            dashboard_address="127.0.0.1:0",
            host="127.0.0.1",
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield ClientRunner(client)


def parallel_units(config: RunnerConfig) -> int:
    """How many units are worth having under way at once, as told before the runner is opened."""
    if config.scheduler is not None:
        return 32
    return 2 * config.workers if config.workers is not None else _usable_cores()


def _usable_cores() -> int:

    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
