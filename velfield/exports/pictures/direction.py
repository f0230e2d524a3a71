"""The figure of modal directions, as PNG."""

from pathlib import Path

from schemas.export import ExportOptions
from velfield.exports.pictures.figures import resized_map
from velfield.report.figures import direction_figure, png_bytes
from velfield.run.run import Run

FILE_NAME = "direction.png"


def encode(run: Run, _path: Path, options: ExportOptions) -> bytes:
    """See `velfield.exports.export.ExportModule`."""
    shown = resized_map(run, run.field.modal_direction_rad(), options)
    return png_bytes(direction_figure(shown.grey, shown.layer, shown.scale))
