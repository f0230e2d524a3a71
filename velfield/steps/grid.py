"""The grid of base pixels of a run."""

from functools import lru_cache

import numpy as np

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


def north_of(grid: GridRecord) -> float | None:
    """Where north is in the picture, from +x towards +y (down); none where the base image has no place on earth."""
    if grid.affine is None:
        return None
    a, b, _, d, e, _ = grid.affine
    # One step north in the CRS, as a step of pixels: the inverse of [[a, b], [d, e]] times (0, 1).
    determinant = a * e - b * d
    return float(np.arctan2(a / determinant, -b / determinant))


@lru_cache(maxsize=8)
def _parse(data: bytes) -> GridRecord:
    return GridRecord.model_validate_json(data)
