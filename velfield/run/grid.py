"""The base image of a run and the grid of its pixels."""

import json
from functools import lru_cache

import numpy as np

from schemas.arrays import FloatArray, GreyImage
from schemas.flight import FramesConfig
from schemas.records import FORMAT_VERSION, GridRecord, WorkingRecord
from schemas.renames import upgrade_record
from velfield.errors import InputError
from velfield.run.layout import RunLayout
from velfield.run.paths import local_copy


def read_grid(layout: RunLayout) -> GridRecord:
    """``base/grid.json``.

    Raises
    ------
    InputError
        There is no base image yet.
    """
    if not layout.grid.exists():
        raise InputError(f"{layout.grid} is not there: run `velfield run` on this folder first")
    return _parse_grid(layout.grid.read_bytes(), layout.format_version)


def read_working(layout: RunLayout) -> WorkingRecord:
    """``base/working.json``.

    Raises
    ------
    InputError
        There is no detector yet.
    """
    if not layout.working.exists():
        raise InputError(f"{layout.working} is not there: run `velfield run` on this folder first")
    data = layout.working.read_bytes()
    if layout.format_version == FORMAT_VERSION:
        return WorkingRecord.model_validate_json(data)
    return WorkingRecord.model_validate(upgrade_record("working", json.loads(data)))


def read_base_image(layout: RunLayout, config: FramesConfig) -> GreyImage:
    """The base image, (y, x) grey uint8: the GeoTIFF where the run has one, else the PNG."""
    from velfield.sources.images import read_grey_image  # opening a run loads no rasterio

    path = layout.base_image_tif if layout.base_image_tif.exists() else layout.base_image
    with local_copy(path) as local:
        return read_grey_image(local, config.max_pixels)


def north_direction_rad(grid: GridRecord) -> float | None:
    """Direction of north in the image, from +x towards +y (down); None without a georeference."""
    if grid.affine is None:
        return None
    a, b, _, d, e, _ = grid.affine
    # One step north in the CRS, as a step of pixels: the inverse of [[a, b], [d, e]] times (0, 1).
    determinant = a * e - b * d
    return float(np.arctan2(a / determinant, -b / determinant))


def heading_deg(direction_rad: FloatArray, north_rad: float | None) -> FloatArray:
    """Compass heading of directions of motion in [0, 360), clockwise from north; from the image's up if None.

    Examples
    --------
    >>> heading_deg(np.array([0.0, np.pi / 2]), None).tolist()
    [90.0, 180.0]
    """
    return np.mod(np.degrees(direction_rad - (-np.pi / 2 if north_rad is None else north_rad)), 360.0)


@lru_cache(maxsize=8)
def _parse_grid(data: bytes, format_version: int) -> GridRecord:
    if format_version == FORMAT_VERSION:
        return GridRecord.model_validate_json(data)
    return GridRecord.model_validate(upgrade_record("grid", json.loads(data)))
