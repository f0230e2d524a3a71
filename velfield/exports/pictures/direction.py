"""The figure of modal directions, as PNG."""

from pathlib import Path

import numpy as np

from schemas.export import ExportOptions
from velfield.exports.pictures.figures import resized_map
from velfield.field.segments import stationary_speed_px_per_s
from velfield.report.figures import direction_figure, png_bytes
from velfield.run.run import Run

FILE_NAME = "direction.png"


def encode(run: Run, _path: Path, options: ExportOptions) -> bytes:
    """See `velfield.exports.export.ExportModule`."""
    slow = stationary_speed_px_per_s(run.record.config.field, run.grid.gsd_m)
    moving = run.field.modal_speed_px_per_s() >= slow
    shown = resized_map(run, np.where(moving, run.field.modal_direction_rad(), np.nan), options)
    return png_bytes(direction_figure(shown.grey, shown.layer, shown.scale))
