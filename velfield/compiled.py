"""Functions compiled by numba, of which the type checker sees what they take and give."""

from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(**options: Any) -> Callable[[Function], Function]:
    """Decorator of a function that numba compiles, keeps on disk, and runs without the interpreter's lock.

    Further options are `numba.njit`'s: ``error_model="numpy"``, ``fastmath=True``.
    """
    decorator: Callable[[Function], Function] = njit(cache=True, nogil=True, **options)
    return decorator


def kernel(function: Function) -> Function:
    """`compiled` without further options."""
    return compiled()(function)
