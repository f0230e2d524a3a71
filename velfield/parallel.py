"""Threads for the work of one unit on several images, where no graph runs it in parallel already."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


def parallel_map(function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """Apply ``function`` to every item on a pool of threads, one a processor; results in the order of the items.

    Worth it where ``function`` spends its time in kernels that release the GIL.
    """
    with ThreadPoolExecutor(usable_processors()) as pool:
        return list(pool.map(function, items))


def usable_processors() -> int:
    """Number of processors that this process may use: in a container or a batch system fewer than there are."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
