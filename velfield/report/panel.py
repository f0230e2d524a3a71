"""The legend of a map: colour wheel or bar, north, scale bar; beside the map's pixels, or on a sheet."""

import textwrap
from dataclasses import dataclass
from math import cos, pi, sin
from typing import TYPE_CHECKING, Literal

import numpy as np

from schemas.arrays import FloatArray, RGBImage
from velfield.report.colours import change_colours, direction_colours, ramp_colours
from velfield.report.drawing import POINTS_PER_INCH, figure_pixels, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDTH_EM = 11.5
"""Width of a legend in letter heights."""
_DARK, _LIGHT = ("#12151a", "#f0f2f5", "#a8afb8"), ("#ffffff", "#14161a", "#58616b")
"""Background, text, and text of less weight."""
_LETTER_EM = 0.6


@dataclass(frozen=True)
class Legend:
    """A legend's content."""

    title: str
    note: str
    colours: Literal["direction", "speed", "change"]
    """Which scale: a wheel of directions, a bar of speeds from 0 to ``top``, or one of changes from ``-top``."""
    top: float = 1.0
    gsd_m: float | None = None
    """Metres a pixel of the map; None: the scale bar is in pixels."""
    north_rad: float | None = None
    """Direction of north in the image; None: unknown."""


def legend_panel(map_shape: tuple[int, ...], legend: Legend) -> RGBImage:
    """(h, legend, 3) legend for the right side of a map of ``map_shape``."""
    height = int(map_shape[0])
    usual = (height * int(map_shape[1])) ** 0.5 / 46
    em = int(min(max(usual, 13.0), 52.0, max(height / 24, 8.0)))
    width = round(WIDTH_EM * em)
    figure = new_figure(width / POINTS_PER_INCH, height / POINTS_PER_INCH, dpi=POINTS_PER_INCH)
    figure.set_facecolor(_DARK[0])
    draw_legend(figure.add_axes((0, 0, 1, 1)), legend, (WIDTH_EM, height / em), em_pt=em, px_per_em=em, dark=True)
    return figure_pixels(figure)[:height, :width]


def draw_legend(
    axes: "Axes", legend: Legend, size_em: tuple[float, float], *, em_pt: float, px_per_em: float, dark: bool = False
) -> None:
    """Draw a legend into axes of its size.

    Parameters
    ----------
    size_em
        Width and height, in letter heights.
    em_pt
        Height of a letter, pt.
    px_per_em
        Pixels of the map over that height, for the scale bar.
    """
    _, text, faint = _DARK if dark else _LIGHT
    width, height = size_em
    axes.set(xlim=(0, width), ylim=(height, 0), autoscale_on=False)
    axes.axis("off")

    def write(y: float, words: str, size: float, colour: str) -> float:
        lines = textwrap.wrap(words, max(int((width - 1.5) / (_LETTER_EM * size)), 8))
        for k, line in enumerate(lines):
            axes.text(1, y + 1.25 * size * (k + 0.8), line, fontsize=em_pt * size, color=colour)
        return y + 1.25 * size * len(lines) + 0.5

    y = write(0.7, legend.title, 1.1, text)
    draw = _draw_wheel if legend.colours == "direction" else _draw_bar
    y = draw(axes, legend, y, size_em, em_pt, text)
    y = write(y, legend.note, 0.8, faint)
    if legend.north_rad is None:
        write(y, "North is unknown.", 0.8, faint)
    per_px, unit = (1.0, "px") if legend.gsd_m is None else (legend.gsd_m, "m")
    length = round_down((width - 2) * px_per_em * per_px)
    right, foot = 1 + length / per_px / px_per_em, height - 0.8
    axes.plot([1, 1, right, right], [foot - 0.3, foot, foot, foot - 0.3], color=text, linewidth=em_pt / 8)
    label = f"{length / 1000:g} km" if unit == "m" and length >= 1000 else f"{length:g} {unit}"
    axes.text(1, foot - 0.5, label, fontsize=0.9 * em_pt, color=text)


def _draw_wheel(
    axes: "Axes", legend: Legend, y: float, size_em: tuple[float, float], em_pt: float, colour: str
) -> float:
    """A ring coloured by direction, oriented as the map, with N at north; returns where it ends."""
    radius = max(min(size_em[0] / 2 - 2.3, size_em[1] / 6), 1.5)
    x, y = size_em[0] / 2, y + radius + 1.3
    at = np.linspace(-1, 1, 301)
    across, down = np.meshgrid(at, at)
    distance = np.hypot(across, down)
    ring = (distance <= 1) & (distance >= 0.42)
    image = np.dstack([direction_colours(np.arctan2(down, across)), np.where(ring, 255, 0).astype(np.uint8)])
    axes.imshow(image, extent=(x - radius, x + radius, y + radius, y - radius), aspect="auto")
    axes.set(xlim=(0, size_em[0]), ylim=(size_em[1], 0))
    for k in range(4):
        _arrow(axes, (x, y), k * pi / 2, 0.05 * radius, 0.38 * radius, colour, em_pt)
    north = legend.north_rad
    names = {"up": -pi / 2} if north is None else {n: north + k * pi / 2 for k, n in enumerate("NESW")}
    for name, angle in names.items():
        place = x + (radius + 0.75) * cos(angle), y + (radius + 0.75) * sin(angle)
        axes.text(*place, name, fontsize=em_pt, color=colour, ha="center", va="center")
    return y + radius + 1.6


def _draw_bar(axes: "Axes", legend: Legend, y: float, size_em: tuple[float, float], em_pt: float, colour: str) -> float:
    """A bar of colours with ticks, and an arrow to north where it is known; returns where it ends."""
    changes, height, y = legend.colours == "change", max(size_em[1] * 0.36, 3.0), y + 0.5
    bottom = -legend.top if changes else 0.0
    values = np.linspace(legend.top, bottom, 256)[:, None] / legend.top
    image = change_colours(values) if changes else ramp_colours(values)
    axes.imshow(image, extent=(1, 2.6, y + height, y), aspect="auto")
    axes.set(xlim=(0, size_em[0]), ylim=(size_em[1], 0))
    ticks = bar_ticks(legend.top)
    for tick in [*-ticks[:0:-1], *ticks] if changes else ticks:
        level = y + height * (legend.top - tick) / (legend.top - bottom)
        axes.plot([2.6, 2.95], [level, level], color=colour, linewidth=em_pt / 12)
        name = f"{tick:+g}" if changes else f"{tick:g}"
        axes.text(3.2, level, name, fontsize=em_pt, color=colour, va="center")
    if legend.north_rad is not None:
        centre = size_em[0] - 2.2, y + 1.6
        _arrow(axes, centre, legend.north_rad, -1.2, 0.7, colour, em_pt)
        place = centre[0] + 1.4 * cos(legend.north_rad), centre[1] + 1.4 * sin(legend.north_rad)
        axes.text(*place, "N", fontsize=em_pt, color=colour, ha="center", va="center")
    return y + height + 1


def _arrow(
    axes: "Axes", at: tuple[float, float], angle: float, start: float, end: float, colour: str, em_pt: float
) -> None:
    tail, tip = ((at[0] + d * cos(angle), at[1] + d * sin(angle)) for d in (start, end))
    style = {"arrowstyle": "-|>", "color": colour, "linewidth": em_pt / 12, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", xy=tip, xytext=tail, arrowprops={**style, "mutation_scale": 0.7 * em_pt})


def bar_ticks(top: float) -> FloatArray:
    """Round numbers from 0 to ``top``, four to eleven of them; the last is ``top`` itself where that is round.

    Examples
    --------
    >>> bar_ticks(60.0), bar_ticks(150.0)
    (array([ 0., 10., 20., 30., 40., 50., 60.]), array([  0.,  50., 100., 150.]))
    """
    steps = [round_down(top / parts) for parts in (4, 3)]
    step = next((step for step in steps if abs(top / step - round(top / step)) < 1e-6), steps[0])
    return np.arange(0, top * (1 + 1e-9), step)


def round_down(value: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above ``value``.

    Examples
    --------
    >>> round_down(47.0), round_down(0.3)
    (20.0, 0.2)
    """
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step * power for step in (1.0, 2.0, 5.0) if step * power <= value * (1 + 1e-9)))
