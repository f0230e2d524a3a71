"""Functions compiled by numba, of which the type checker sees what they take and give."""

from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit, types

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(**options: Any) -> Callable[[Function], Function]:
    """Decorator of a function that numba compiles, keeps on disk, and runs without the interpreter's lock.

    Further options are `numba.njit`'s: ``error_model="numpy"``, ``fastmath=True``.
    """

    def decorate(function: Function) -> Function:
        # Without numba's second wrapper, for callers in C, of which there are none: compiled a twentieth sooner.
        dispatcher: Any = njit(cache=True, nogil=True, no_cfunc_wrapper=True, **options)(function)
        find = dispatcher.get_call_template

        def find_without_literals(args: tuple[Any, ...], kws: dict[str, Any]) -> Any:
            """What another kernel calls, literal types widened: else numba compiles again for each number in a call."""
            return find(tuple(map(types.unliteral, args)), {name: types.unliteral(kind) for name, kind in kws.items()})

        dispatcher.get_call_template = find_without_literals
        compiled_function: Function = dispatcher
        return compiled_function

    return decorate


def kernel(function: Function) -> Function:
    """`compiled` without further options."""
    return compiled()(function)
