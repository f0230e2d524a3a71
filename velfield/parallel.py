"""Threads for the work of one unit on several images or models, where no graph runs it in parallel already.

The steps of long work, for a progress bar: those of a stage, or of a training, whatever the method.
"""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from threading import Lock
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


def parallel_map(function: Callable[[T], R], items: Iterable[T], *, at_most: int | None = None) -> list[R]:
    """Apply ``function`` to every item on a pool of threads, one a processor; results in the order of the items.

    Worth it where ``function`` spends its time in kernels that release the GIL. ``at_most`` so many threads, where each
    takes much memory.
    """
    with ThreadPoolExecutor(min(usable_processors(), at_most or usable_processors())) as pool:
        return list(pool.map(function, items))


def for_each_behind(function: Callable[[T], object], items: Iterable[T]) -> None:
    """Apply ``function`` to every item, in order, on another thread, while the next are made: at most two wait."""
    with ThreadPoolExecutor(1) as pool:
        try:
            for _ in map_ahead(pool, function, items, ahead=2):
                pass
        finally:
            pool.shutdown(cancel_futures=True)


def map_ahead(pool: ThreadPoolExecutor, function: Callable[[T], R], items: Iterable[T], *, ahead: int) -> Iterator[R]:
    """Results of ``function`` in the order of the items: ``ahead`` more are under way, or wait, while one is used."""
    waiting = deque[Future[R]]()
    for item in items:
        waiting.append(pool.submit(function, item))
        if len(waiting) > ahead:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()


def once(function: Callable[[], R]) -> Callable[[], R]:
    """A function that gives what ``function`` gave when it was called first, and calls it in one thread only."""
    lock, found = Lock(), list[R]()

    def call() -> R:
        with lock:
            if not found:
                found.append(function())
            return found[0]

    return call


StepListener = Callable[[int, int, str], None]
_step_listeners: list[StepListener] = []


def count_steps(done: int, announced: int = 0, stage: str = "") -> None:
    """Publish that so many more steps of a stage are done, and that so many more will follow; no stage: a training."""
    for listener in tuple(_step_listeners):
        listener(done, announced, stage)


@contextmanager
def subscribe_steps(listener: StepListener) -> Iterator[None]:
    """Call ``listener`` with the steps of this process within the context, from any thread.

    On a worker of a cluster nothing listens, and publishing costs nothing; there progress is shown unit by unit.

    Examples
    --------
    >>> received = []
    >>> with subscribe_steps(lambda *steps: received.append(steps)):
    ...     count_steps(0, announced=8)
    ...     count_steps(1, stage="detections")
    >>> received
    [(0, 8, ''), (1, 0, 'detections')]
    """
    _step_listeners.append(listener)
    try:
        yield
    finally:
        _step_listeners.remove(listener)


def usable_processors() -> int:
    """Number of processors that this process may use: in a container or a batch system fewer than there are."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
