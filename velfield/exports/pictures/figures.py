"""Common parts of the exported figures: base image and layer at the requested width."""

from dataclasses import dataclass

import cv2
import numpy as np

from schemas.arrays import FloatArray, GreyImage
from schemas.export import ExportOptions
from velfield.errors import InputError
from velfield.report.figures import MapScale
from velfield.run.frame_transforms import north_direction_rad
from velfield.run.run import Run

_MAX_SIDE_PX = 20_000


@dataclass(frozen=True)
class ResizedMap:
    """Base image and layer at the figure's size, (h, w), and the scale of its legend."""

    grey: GreyImage
    layer: FloatArray
    scale: MapScale


def resized_map(run: Run, layer: FloatArray, options: ExportOptions) -> ResizedMap:
    """Resize a run's base image and one of its layers.

    Raises
    ------
    InputError
        The figure would be larger than 20,000 px.
    """
    grey, grid = run.base_image, run.grid
    factor = 1.0 if options.width_px is None else options.width_px / grid.width_px
    size = max(1, round(grid.width_px * factor)), max(1, round(grid.height_px * factor))
    if max(size) > _MAX_SIDE_PX:
        raise InputError(
            f"--width {options.width_px}: found a figure of {size[0]} x {size[1]} px, expected at most "
            f"{_MAX_SIDE_PX}; give less"
        )
    image = cv2.resize(grey, size, interpolation=cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC)
    values = cv2.resize(np.asarray(layer, np.float32), size, interpolation=cv2.INTER_NEAREST_EXACT)
    gsd_m = None if grid.gsd_m is None else grid.gsd_m / factor
    scale = MapScale(gsd_m=gsd_m, unit=options.unit, north_rad=north_direction_rad(grid))
    return ResizedMap(np.asarray(image, np.uint8), np.asarray(values, np.float64), scale)
