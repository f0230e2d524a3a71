"""The grid of base pixels of a run."""

from functools import lru_cache

from schemas.records import GridRecord
from velfield.errors import InputError
from velfield.layout import RunLayout
from velfield.plan import Plan


def read_grid(plan: Plan) -> GridRecord:
    """``base/grid.json`` of a plan's run folder."""
    return read_grid_of(plan.layout)


def read_grid_of(layout: RunLayout) -> GridRecord:
    """``base/grid.json``.

    Raises
    ------
    InputError
        The base image was not made yet.
    """
    if not layout.grid.exists():
        raise InputError(f"{layout.grid} is not there: run `velfield run` on this folder first")
    return _parse(layout.grid.read_bytes())


@lru_cache(maxsize=8)
def _parse(data: bytes) -> GridRecord:
    return GridRecord.model_validate_json(data)
