"""The legend beside a map: colour wheel or bar, north, scale bar. Drawn with Pillow at the map's height."""

from dataclasses import dataclass
from math import cos, pi, sin

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from schemas.arrays import FloatArray, RGBImage
from velfield.report.colours import change_colours, direction_colours, ramp_colours

_BACKGROUND = (18, 21, 26)
_TEXT, _FAINT = (240, 242, 245), (168, 175, 184)
_SUPERSAMPLING = 3  # supersampling of the drawing, for smooth edges


@dataclass(frozen=True)
class Legend:
    """Texts of a legend."""

    title: str
    note: str


class _Panel:
    """A column drawn from the top down, with a scale bar at its foot."""

    def __init__(self, map_shape: tuple[int, ...], legend: Legend) -> None:
        height, width = int(map_shape[0]), int(map_shape[1])
        usual = (height * width) ** 0.5 / 46
        self.text_px = int(min(max(usual, 13.0), 52.0, max(height / 24, 8.0)))
        self.margin = self.text_px
        self.width, self.height = round(11.5 * self.text_px), height
        self.image = Image.new("RGB", (self.width, height), _BACKGROUND)
        self.draw = ImageDraw.Draw(self.image)
        self.y = float(self.margin)
        self.write(legend.title, 1.15, _TEXT)
        self.note = legend.note

    @property
    def inner(self) -> int:
        """Width between the margins."""
        return self.width - 2 * self.margin

    def font(self, size: float = 1.0) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
        return ImageFont.load_default(max(8.0, self.text_px * size))

    def write(self, text: str, size: float, colour: tuple[int, int, int]) -> None:
        """A paragraph, its lines broken at words."""
        font = self.font(size)
        for line in self._lines(text, font):
            self.draw.text((self.margin, self.y), line, font=font, fill=colour)
            self.y += 1.25 * size * self.text_px
        self.y += 0.5 * self.text_px

    def _lines(self, text: str, font: ImageFont.FreeTypeFont | ImageFont.ImageFont) -> list[str]:
        lines = [""]
        for word in text.split():
            longer = f"{lines[-1]} {word}".strip()
            if self.draw.textlength(longer, font=font) <= self.inner:
                lines[-1] = longer
            else:
                lines.append(word)
        return [line for line in lines if line]

    def finish(self, gsd_m: float | None, north_rad: float | None) -> RGBImage:
        self.write(self.note, 0.8, _FAINT)
        if north_rad is None:
            self.write("North is unknown.", 0.8, _FAINT)
        self._scale_bar(gsd_m)
        return np.asarray(self.image).copy()

    def _scale_bar(self, gsd_m: float | None) -> None:
        """A bar of a round length that fits, at the map's scale."""
        per_px, unit = (1.0, "px") if gsd_m is None else (gsd_m, "m")
        length = round_down(self.inner * per_px)
        x, y, half = self.margin, self.height - self.margin, self.text_px / 4
        right = x + length / per_px
        stroke = max(1, self.text_px // 8)
        for line in ((x, y, right, y), (x, y - half, x, y + half), (right, y - half, right, y + half)):
            self.draw.line(line, fill=_TEXT, width=stroke)
        label = f"{length / 1000:g} km" if unit == "m" and length >= 1000 else f"{length:g} {unit}"
        self.draw.text((x, y - half - 1.2 * self.text_px), label, font=self.font(0.9), fill=_TEXT)


def draw_wheel_panel(
    map_shape: tuple[int, ...], legend: Legend, *, gsd_m: float | None, north_rad: float | None
) -> RGBImage:
    """(h, legend, 3) legend of directions; the wheel is oriented as the map, with N at north."""
    panel = _Panel(map_shape, legend)
    side = min(panel.inner, max(panel.height // 3, 3 * panel.text_px))
    letter = 1.3 * panel.text_px
    radius = side / 2 - letter
    centre = (panel.width / 2, panel.y + side / 2)
    _paste_wheel(panel, centre, radius)
    names = {"up": -pi / 2} if north_rad is None else {n: north_rad + k * pi / 2 for k, n in enumerate("NESW")}
    for name, angle in names.items():
        position = centre[0] + (radius + letter / 2) * cos(angle), centre[1] + (radius + letter / 2) * sin(angle)
        panel.draw.text(position, name, font=panel.font(), fill=_TEXT, anchor="mm")
    panel.y += side + 0.5 * panel.text_px
    return panel.finish(gsd_m, north_rad)


def _paste_wheel(panel: _Panel, centre: tuple[float, float], radius: float) -> None:
    """A ring coloured by direction, with outward arrows inside."""
    side = 2 * int(radius) + 1
    axis = (np.arange(side * _SUPERSAMPLING) + 0.5) / _SUPERSAMPLING - side / 2
    x, y = np.meshgrid(axis, axis)
    distance = np.hypot(x, y)
    ring = (distance <= radius) & (distance >= 0.42 * radius)
    colours = np.where(ring[..., None], direction_colours(np.arctan2(y, x)), np.array(_BACKGROUND, np.uint8))
    wheel = Image.fromarray(colours.astype(np.uint8)).resize((side, side), Image.Resampling.BOX)
    panel.image.paste(wheel, (round(centre[0] - side / 2), round(centre[1] - side / 2)))
    for k in range(4):
        _arrow(panel, centre, k * pi / 2, 0.08 * radius, 0.36 * radius)


def _arrow(panel: _Panel, centre: tuple[float, float], angle: float, start: float, end: float) -> None:
    ux, uy = cos(angle), sin(angle)
    tip = (centre[0] + end * ux, centre[1] + end * uy)
    head = max(3.0, (end - start) * 0.4)
    stroke = max(1, panel.text_px // 10)
    foot = (tip[0] - head * ux, tip[1] - head * uy)
    panel.draw.line((centre[0] + start * ux, centre[1] + start * uy, *foot), fill=_FAINT, width=stroke)
    wings = [(foot[0] - s * 0.5 * head * uy, foot[1] + s * 0.5 * head * ux) for s in (1, -1)]
    panel.draw.polygon([tip, *wings], fill=_FAINT)


def draw_bar_panel(
    map_shape: tuple[int, ...],
    legend: Legend,
    *,
    top: float,
    gsd_m: float | None,
    north_rad: float | None,
    changes: bool = False,
) -> RGBImage:
    """(h, legend, 3) legend of a quantity from 0 to ``top``, of changes from ``-top``; with an arrow to north where
    it is known."""
    panel = _Panel(map_shape, legend)
    height = int(max(panel.height * 0.36, 3 * panel.text_px))
    width = round(1.6 * panel.text_px)
    x, y = panel.margin, round(panel.y + 0.5 * panel.text_px)
    bottom = -top if changes else 0.0
    values = np.repeat(np.linspace(top, bottom, height)[:, None], width, axis=1) / top
    panel.image.paste(Image.fromarray(change_colours(values) if changes else ramp_colours(values)), (x, y))
    ticks = bar_ticks(top)
    for tick in [*-ticks[:0:-1], *ticks] if changes else ticks:
        level = y + (height - 1) * (top - tick) / (top - bottom)
        panel.draw.line((x + width, level, x + width + 0.35 * panel.text_px, level), fill=_TEXT)
        position = (x + width + 0.6 * panel.text_px, level)
        panel.draw.text(position, f"{tick:+g}" if changes else f"{tick:g}", font=panel.font(), fill=_TEXT, anchor="lm")
    if north_rad is not None:
        _north(panel, north_rad, (panel.width - panel.margin - 1.2 * panel.text_px, y + 1.6 * panel.text_px))
    panel.y = y + height + panel.text_px
    return panel.finish(gsd_m, north_rad)


def _north(panel: _Panel, north_rad: float, centre: tuple[float, float]) -> None:
    length = 1.4 * panel.text_px
    _arrow(panel, centre, north_rad, -length, 0.5 * length)
    position = (centre[0] + length * cos(north_rad), centre[1] + length * sin(north_rad))
    panel.draw.text(position, "N", font=panel.font(), fill=_TEXT, anchor="mm")


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
