"""The field's two maps on a sheet for a report, as PDF or SVG: legend, scale bar, north, number of vehicles, date."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast

import numpy as np

from schemas.export import ExportOptions
from velfield.errors import InputError
from velfield.exports.pictures.figures import resized_map
from velfield.report.drawing import POINTS_PER_INCH, figure_bytes, new_figure
from velfield.report.figures import MapScale, direction_map, speed_map
from velfield.report.panel import WIDTH_EM, draw_legend
from velfield.run.frame_transforms import north_direction_rad
from velfield.run.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FILE_NAME = "poster.pdf"
_MM_PER_INCH = 25.4
_MARGIN, _HEAD, _LEGEND, _GAP = 10.0, 16.0, 40.0, 4.0
_MAP_WIDTH, _MAX_MAP_HEIGHT, _MIN_BODY = 165.0, 230.0, 95.0
_WIDTH_PX = 2400


def encode(run: Run, path: Path, options: ExportOptions) -> bytes:
    """See `velfield.exports.export.ExportModule`.

    Raises
    ------
    InputError
        The file's name ends neither in ``.pdf`` nor in ``.svg``.
    """
    kind = path.suffix.lower().removeprefix(".")
    if kind not in ("pdf", "svg"):
        raise InputError(f"--out {path.name}: found a poster as {path.suffix or 'no type'}, expected .pdf or .svg")
    return figure_bytes(draw_poster(run, options), cast(Literal["pdf", "svg"], kind))


def draw_poster(run: Run, options: ExportOptions) -> "Figure":
    """The sheet: direction to the left, speed to the right."""
    sized = options.model_copy(update={"width_px": options.width_px or min(run.grid.width_px, _WIDTH_PX)})
    aspect = run.grid.height_px / run.grid.width_px
    width = min(_MAP_WIDTH, _MAX_MAP_HEIGHT / aspect)
    body, column = max(width * aspect, _MIN_BODY), width + _GAP + _LEGEND
    sheet_mm = np.array([2 * _MARGIN + 2 * column + _GAP, 2 * _MARGIN + _HEAD + body])
    figure = new_figure(*(sheet_mm / _MM_PER_INCH))
    figure.text(_MARGIN / sheet_mm[0], 1 - 14 / sheet_mm[1], "Velocity field", fontsize=18, fontweight="bold")
    figure.text(_MARGIN / sheet_mm[0], 1 - 21 / sheet_mm[1], "; ".join(_facts(run, options)), fontsize=9)
    em = _LEGEND / WIDTH_EM
    # the layers are in base pixels a second, whatever the width of the sheet's maps
    scale = MapScale(run.grid.gsd_m, options.unit, north_direction_rad(run.grid))
    for k, values in enumerate((run.field.modal_direction_rad(), run.field.modal_speed_px_per_s())):
        shown = resized_map(run, values, sized)
        image, legend = (speed_map if k else direction_map)(shown.grey, shown.layer, scale)
        left = _MARGIN + k * (column + _GAP)

        def box(x: float, height: float, wide: float) -> tuple[float, float, float, float]:
            low = sheet_mm[1] - _MARGIN - _HEAD - height
            return x / sheet_mm[0], low / sheet_mm[1], wide / sheet_mm[0], height / sheet_mm[1]

        axes = figure.add_axes(box(left, width * aspect, width))
        axes.imshow(image, aspect="auto", interpolation="none")
        axes.axis("off")
        draw_legend(
            figure.add_axes(box(left + width + _GAP, body, _LEGEND)), legend, (WIDTH_EM, body / em),
            em_pt=em / _MM_PER_INCH * POINTS_PER_INCH, px_per_em=run.grid.width_px / width * em,
        )  # fmt: skip
    return figure


def _facts(run: Run, options: ExportOptions) -> list[str]:
    """Date, time, number of vehicles and coverage."""
    times = run.times_s[np.isfinite(run.times_s)]
    seconds = float(np.ptp(times)) if len(times) else 0.0
    vehicles = run.vehicles()
    states = vehicles["state"]
    count = run.field.count()
    facts = [_date(run, options), f"{seconds:.0f} s of video"]
    facts += [f"n = {int((states != 'parked').sum())} vehicles move or wait in a lane"]
    facts += [f"{int((states == 'parked').sum())} more stand throughout, vehicles by their looks alone"]
    if (count > 0).any():
        facts += [f"median of {float(np.median(count[count > 0])):.0f} vehicles at a coloured pixel"]
    return facts


def _date(run: Run, options: ExportOptions) -> str:
    """By ``--start``, else by what the camera wrote."""
    if options.start is not None:
        return f"{options.start:%Y-%m-%d %H:%M %Z}"
    if run.start is None:
        return "date not recorded (give --start)"
    return run.start.text()
