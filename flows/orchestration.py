"""Where flows and their units are run and shown: by Prefect where a server is set, else on threads of this process.

Prefect takes 3 s of processor time to import and a server of its own as much again, which no one can look at: without
a server that is set, a run imports none of it. Its run folder holds all that it knows either way.
"""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

from flows.runners import WorkersKilledError
from schemas.summary import RunSummary
from velfield.errors import InputError, is_disk_full
from velfield.pipeline.plan import Plan

T = TypeVar("T")
RETRY_S = 1.0
"""Delay before a unit is tried again."""


class Orchestration(ABC):
    """Runs a flow, and its units as tasks."""

    @abstractmethod
    def run(
        self, flow: Callable[[], T], *, name: str, folder: str, result: str = "", threads: int, parameters: Any
    ) -> T:
        """The result of a flow, which may submit tasks.

        Parameters
        ----------
        name
            The flow's name.
        folder
            Path of the run folder from the root on: two runs on a folder `RUN` of two places must not be taken for one.
            The run is shown by the folder's name.
        result
            Name of the result within the folder that the flow makes; empty: the folder's own.
        threads
            Number of tasks that run at a time.
        parameters
            What is shown with the run.

        Raises
        ------
        InputError
            As the flow raises it.
        """

    @abstractmethod
    def submit(
        self, do: Callable[[], T], *, name: str, run_name: str, retries: int = 0, after: "Sequence[Future[Any]]" = ()
    ) -> "Future[T]":
        """Submit a task of the running flow; it is tried again where `worth_retrying`.

        Parameters
        ----------
        name, run_name
            What it is called, and in this run.
        retries
            How often it is tried again.
        after
            Tasks that have ended, whose results it reads: for the lineage.
        """

    @abstractmethod
    def mark_killed(self, folder: str) -> None:
        """Mark earlier runs of this folder as ended: they were killed. Call while holding the folder's lock."""

    @abstractmethod
    def show_progress(self, stage: str, steps: int) -> Callable[[int], None]:
        """Show a stage of so many steps; returns what is to be called with the number that are done."""

    @abstractmethod
    def publish(self, plan: Plan, summary: RunSummary) -> None:
        """Show a run's summary."""


class Threads(Orchestration):
    """Threads of this process; nothing is shown."""

    def run(
        self, flow: Callable[[], T], *, name: str, folder: str, result: str = "", threads: int, parameters: Any
    ) -> T:
        with ThreadPoolExecutor(threads, name) as self._pool:
            return flow()

    def submit(
        self, do: Callable[[], T], *, name: str, run_name: str, retries: int = 0, after: "Sequence[Future[Any]]" = ()
    ) -> "Future[T]":
        return self._pool.submit(_call_with_retries, do, retries)

    def mark_killed(self, folder: str) -> None:
        pass  # nothing remembers them

    def show_progress(self, stage: str, steps: int) -> Callable[[int], None]:
        return lambda done: None

    def publish(self, plan: Plan, summary: RunSummary) -> None:
        pass


def _call_with_retries(do: Callable[[], T], retries: int) -> T:
    attempts = 1
    while True:
        try:
            return do()
        except Exception as error:
            if attempts > retries or not worth_retrying(error, attempts):
                raise
        attempts += 1
        time.sleep(RETRY_S)


def worth_retrying(error: BaseException, attempts: int) -> bool:
    """Whether what failed may pass, such as a killed worker: bad input stays bad, and a full disk full.

    A unit that killed all workers that tried it gets one more, fresh worker: further ones would kill other units too.
    """
    if isinstance(error, WorkersKilledError):
        return attempts <= 1
    return isinstance(error, Exception) and not isinstance(error, InputError) and not is_disk_full(error)
