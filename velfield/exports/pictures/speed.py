"""The figure of modal speeds, as PNG."""

from dataclasses import replace
from pathlib import Path

from schemas.export import ExportOptions
from velfield.exports.pictures.figures import resized_map
from velfield.report.figures import png_bytes, speed_figure
from velfield.run.run import Run

FILE_NAME = "speed.png"


def encode(run: Run, _path: Path, options: ExportOptions) -> bytes:
    """See `velfield.exports.export.ExportModule`."""
    shown = resized_map(run, run.field.modal_speed_px_per_s(), options)
    # the layer is in base pixels a second, whatever the figure's size
    scale = replace(shown.scale, gsd_m=run.grid.gsd_m)
    return png_bytes(speed_figure(shown.grey, shown.layer, scale, bar_gsd_m=shown.scale.gsd_m))
