"""velfield: aerial video of a city in, a probability distribution over vehicle velocity at every pixel of the map out.

The system of Rosten, Loveland, Hickman, "Automatic creation of urban velocity fields from aerial video", and more.

>>> import velfield
>>> callable(velfield.open_run)
True
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from velfield.run.run import Run, open_run

__all__ = ["Run", "open_run"]


def __getattr__(name: str) -> Any:
    # Late: `velfield --help` must not wait for zarr and pandas.
    if name in __all__:
        from velfield.run import run

        return getattr(run, name)
    raise AttributeError(f"module 'velfield' has no attribute {name!r}")
