"""Threads for what one unit of work does to several pictures, where no graph runs it in parallel already."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


def each(function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """``function`` of every item, in their order; as many at once as this process may use processors.

    Worth it where ``function`` spends its time in kernels that let go of Python's lock.
    """
    with ThreadPoolExecutor(usable_processors()) as pool:
        return list(pool.map(function, items))


def usable_processors() -> int:
    """How many processors this process may use: fewer than there are, in a container or under a batch system."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
