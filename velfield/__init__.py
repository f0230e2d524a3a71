"""velfield: aerial video of a city in, a probability distribution over vehicle velocity at every pixel of the map out.

The system of Rosten, Loveland, Hickman, "Automatic creation of urban velocity fields from aerial video", and more.

>>> import velfield
>>> callable(velfield.open_run)
True
"""

import os
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from velfield.run.run import Run, open_run

__all__ = ["Run", "open_run"]

_LOCATORS = "velfield.kernel_cache.Locator,UserProvidedCacheLocator,InTreeCacheLocator,UserWideCacheLocator,\
IPythonCacheLocator,ZipCacheLocator"
"""Where numba looks for compiled code: of our kernels by what they import, of others as ever."""
os.environ.setdefault("NUMBA_CACHE_LOCATOR_CLASSES", _LOCATORS)  # before numba is imported, in workers too
if "numba" in sys.modules and not sys.modules["numba"].config.CACHE_LOCATOR_CLASSES:
    sys.modules["numba"].config.CACHE_LOCATOR_CLASSES = _LOCATORS


def __getattr__(name: str) -> Any:
    # Late: `velfield --help` must not wait for zarr and pandas.
    if name in __all__:
        from velfield.run import run

        return getattr(run, name)
    if name == "__version__":
        from importlib.metadata import version

        return version("velfield")
    raise AttributeError(f"module 'velfield' has no attribute {name!r}")
