"""The field's two maps on a sheet for a report, as PDF or SVG: legend, scale bar, north, number of vehicles, date."""

from dataclasses import dataclass
from math import cos, pi, sin
from pathlib import Path

import numpy as np

from schemas.arrays import FloatArray, RGBImage
from schemas.export import ExportOptions
from velfield.errors import InputError
from velfield.exports.figures import resized_map
from velfield.field.segments import stationary_speed_px_per_s
from velfield.report.colours import direction_colours, ramp_colours
from velfield.report.figures import MapScale, blend_over_image, colour_scale_max, round_up
from velfield.report.panel import bar_ticks, round_down
from velfield.report.sheet import Point, Sheet
from velfield.run.run import Run

FILE_NAME = "poster.pdf"

_MARGIN, _HEAD, _FOOT, _LEGEND, _GAP = 10.0, 16.0, 12.0, 34.0, 4.0
_MAP_WIDTH, _MAX_MAP_HEIGHT, _MIN_BODY = 165.0, 230.0, 95.0
_WIDTH_PX = 2400
_WEDGES = 72
_FAINT = (88, 97, 107)


def encode(run: Run, path: Path, options: ExportOptions) -> bytes:
    """See `velfield.exports.export.ExportModule`.

    Raises
    ------
    InputError
        The file's name ends neither in ``.pdf`` nor in ``.svg``.
    """
    suffix = path.suffix.lower()
    if suffix not in (".pdf", ".svg"):
        raise InputError(f"--out {path.name}: found a poster as {suffix or 'no type'}, expected .pdf or .svg")
    sheet = draw_poster(run, options)
    return sheet.to_pdf() if suffix == ".pdf" else sheet.to_svg()


@dataclass(frozen=True)
class _Map:
    """A map, and where its legend begins."""

    image: RGBImage
    title: str
    note: str
    legend_at: Point


def draw_poster(run: Run, options: ExportOptions) -> Sheet:
    """The sheet: direction to the left, speed to the right."""
    sized = options.model_copy(update={"width_px": options.width_px or min(run.grid.width_px, _WIDTH_PX)})
    aspect = run.grid.height_px / run.grid.width_px
    width = min(_MAP_WIDTH, _MAX_MAP_HEIGHT / aspect)
    height = width * aspect
    column = width + _GAP + _LEGEND
    sheet = Sheet(2 * _MARGIN + 2 * column + 2 * _GAP, 2 * _MARGIN + _HEAD + max(height, _MIN_BODY) + _FOOT)
    top = _MARGIN + _HEAD
    sheet.text((_MARGIN, _MARGIN + 6), "Velocity field", size_pt=18, bold=True)
    sheet.text((_MARGIN, _MARGIN + 12), "; ".join(_facts(run, options)), size_pt=9, colour=_FAINT)
    slow = stationary_speed_px_per_s(run.record.config.field, run.grid.gsd_m)
    speed = run.field.modal_speed_px_per_s()
    scale = resized_map(run, speed, sized).scale
    directions = np.where(speed >= slow, run.field.modal_direction_rad(), np.nan)
    per_mm = run.grid.width_px / width
    for k, (values, name) in enumerate(((directions, "direction"), (speed, "speed"))):
        left = _MARGIN + k * (column + 2 * _GAP)
        shown = resized_map(run, values, sized)
        legend_at = (left + width + _GAP, top)
        if name == "direction":
            colours = direction_colours(shown.layer)
            _draw_wheel(sheet, legend_at, scale.north_rad)
        else:
            colours = _draw_speeds(sheet, legend_at, shown.layer, MapScale(run.grid.gsd_m, options.unit))
        sheet.image(blend_over_image(shown.grey, shown.layer, colours), (left, top), (width, height))
        _draw_scale_bar(sheet, (left, top + height + 6), run.grid.gsd_m, per_mm, width)
    return sheet


def _facts(run: Run, options: ExportOptions) -> list[str]:
    """Number of vehicles, time and coverage."""
    times = run.times_s[np.isfinite(run.times_s)]
    seconds = float(np.ptp(times)) if len(times) else 0.0
    states = run.vehicles()["state"]
    count = run.field.count()
    known = int((count > 0).sum())
    facts = [_date(run, options)]
    facts += [f"{seconds:.0f} s of video", f"n = {int((states != 'parked').sum())} vehicles in traffic"]
    facts += [f"{int((states == 'parked').sum())} parked or stationary throughout"]
    if known:
        facts += [f"median of {float(np.median(count[count > 0])):.0f} vehicles at a coloured pixel"]
    return facts


def _date(run: Run, options: ExportOptions) -> str:
    """By ``--start``, else by what the camera wrote."""
    if options.start is not None:
        return f"{options.start:%Y-%m-%d %H:%M %Z}"
    if run.start is None:
        return "date not recorded (give --start)"
    clock = "UTC" if run.start.is_utc else "by the camera's clock"
    return f"{run.start.time:%Y-%m-%d %H:%M} {clock}"


def _draw_wheel(sheet: Sheet, at: Point, north_rad: float | None) -> None:
    sheet.text((at[0], at[1] + 4), "Direction of travel", size_pt=11, bold=True)
    centre, outer, inner = (at[0] + _LEGEND / 2, at[1] + 25), 12.0, 5.0
    step = 2 * pi / _WEDGES
    colours = direction_colours(np.arange(_WEDGES) * step).tolist()
    for k, colour in enumerate([*colours, colours[0]]):
        # Each reaches over the next, the last over the first, which is drawn again: no line between them.
        angles = (k - 0.5) * step, (k + (1.5 if k < _WEDGES else 0.5)) * step
        ring = [(outer, angles[0]), (outer, angles[1]), (inner, angles[1]), (inner, angles[0])]
        sheet.area([(centre[0] + r * cos(a), centre[1] + r * sin(a)) for r, a in ring], tuple(colour))
    names = {"up": -pi / 2} if north_rad is None else {n: north_rad + k * pi / 2 for k, n in enumerate("NESW")}
    for name, angle in names.items():
        place = centre[0] + 15 * cos(angle), centre[1] + 15 * sin(angle) + 1.2
        sheet.text(place, name, size_pt=10, bold=True, centred=True)
    lines = ["Hue: the direction of most", "vehicles. Bare grey: none,", "or stationary."]
    _write_note(sheet, (at[0], at[1] + 48), [*lines, *([] if north_rad is not None else ["North is not known."])])


def _draw_speeds(sheet: Sheet, at: Point, speed_px_per_s: FloatArray, scale: MapScale) -> RGBImage:
    """The bar of speeds; returns the map's colours."""
    shown = scale.shown_speed(speed_px_per_s)
    top = round_up(colour_scale_max(shown) or 10.0)
    sheet.text((at[0], at[1] + 4), f"Speed, {scale.shown_unit}", size_pt=11, bold=True)
    first, height, width = at[1] + 10, 55.0, 6.0
    steps = 110
    for k, colour in enumerate(ramp_colours(np.linspace(1, 0, steps)).tolist()):
        y0, y1 = first + k * height / steps, first + (k + 1.3) * height / steps
        sheet.area([(at[0], y0), (at[0] + width, y0), (at[0] + width, y1), (at[0], y1)], tuple(colour))
    for tick in bar_ticks(top):
        y = first + height * (1 - tick / top)
        sheet.line([(at[0] + width, y), (at[0] + width + 1.5, y)])
        sheet.text((at[0] + width + 2.5, y + 1.1), f"{tick:g}", size_pt=9)
    highest = float(np.nanmax(shown, initial=0.0))
    lines = ["Colour: the speed of most", "vehicles. Bare grey: none."]
    lines += [f"Above {top:g} the last colour;", f"the maximum is {highest:.3g}."] if highest > top else []
    _write_note(sheet, (at[0], first + height + 7), lines)
    return ramp_colours(shown / top)


def _write_note(sheet: Sheet, at: Point, lines: list[str]) -> None:
    for k, line in enumerate(lines):
        sheet.text((at[0], at[1] + 3.6 * k), line, size_pt=7.5, colour=_FAINT)


def _draw_scale_bar(sheet: Sheet, at: Point, gsd_m: float | None, per_mm: float, width: float) -> None:
    per_px, unit = (1.0, "px") if gsd_m is None else (gsd_m, "m")
    length = round_down(width / 3 * per_mm * per_px)
    right = at[0] + length / (per_mm * per_px)
    sheet.line([(at[0], at[1] - 1.2), (at[0], at[1]), (right, at[1]), (right, at[1] - 1.2)], width=0.5)
    sheet.text((right + 2, at[1] + 0.8), f"{length:g} {unit}", size_pt=9)
