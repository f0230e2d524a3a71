"""Figures over the dimmed base image (paper: velocity field): direction as hue; speed and changes as colour."""

import io
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from schemas.arrays import FloatArray, GreyImage, RGBImage
from schemas.export import PER_M_PER_S, SpeedUnit
from velfield.errors import InputError
from velfield.report.colours import change_colours, direction_colours, ramp_colours
from velfield.report.panel import Legend, legend_panel

_DIMMED = 0.5
"""Brightness of the base image under the colours."""
_COVER = 0.88
"""Opacity of the colour of a known pixel; the rest is the image's texture."""


@dataclass(frozen=True)
class MapScale:
    """Scale and orientation of a map, for its legend."""

    gsd_m: float | None = None
    """Metres a base pixel; None: speeds are shown in px/s and the scale bar in px."""
    unit: SpeedUnit = "km/h"
    """Unit of speed in the figure."""
    north_rad: float | None = None
    """Direction of north in the image, from +x towards +y (down): -pi/2 where it is up. None: unknown."""

    @property
    def shown_unit(self) -> SpeedUnit:
        """The unit that speeds are shown in."""
        return "px/s" if self.gsd_m is None else self.unit

    def shown_speed(self, speed_px_per_s: NDArray[np.floating]) -> FloatArray:
        """Speeds in that unit."""
        speed = np.asarray(speed_px_per_s, np.float64)
        if self.gsd_m is None or self.unit == "px/s":
            return speed
        return speed * self.gsd_m * PER_M_PER_S[self.unit]


def direction_map(grey: GreyImage, direction_rad: NDArray[np.floating], scale: MapScale) -> tuple[RGBImage, Legend]:
    """The modal direction as hue over the base image, (h, w, 3), and its legend; parameters as `direction_figure`."""
    image = blend_over_image(grey, direction_rad, direction_colours(direction_rad))
    note = "Hue: the direction of most vehicles. Bare grey: none, or stationary."
    return image, Legend("Direction of travel", note, "direction", gsd_m=scale.gsd_m, north_rad=scale.north_rad)


def direction_figure(grey: GreyImage, direction_rad: NDArray[np.floating], scale: MapScale) -> RGBImage:
    """The modal direction as hue, with a colour wheel beside it.

    Parameters
    ----------
    grey
        (h, w) base image.
    direction_rad
        (h, w) direction of motion, from +x towards +y (down). NaN is not drawn.
    scale
        Scale of the map, for the legend.

    Returns
    -------
    ndarray
        (h, w + legend, 3) uint8 RGB; the map itself at base resolution, its pixels unmoved.

    Raises
    ------
    InputError
        Where the shapes differ.
    """
    return beside(*direction_map(grey, direction_rad, scale))


def speed_map(grey: GreyImage, speed_px_per_s: NDArray[np.floating], scale: MapScale) -> tuple[RGBImage, Legend]:
    """The modal speed as colour over the base image, (h, w, 3), up to `colour_scale_max` rounded up as on the page;
    and its legend. Parameters as in `speed_figure`."""
    shown = scale.shown_speed(speed_px_per_s)
    top = round_up(colour_scale_max(shown) or 10.0)
    image = blend_over_image(grey, shown, ramp_colours(shown / top))
    note = "Colour: the speed of most vehicles. Bare grey: no vehicles."
    maximum = float(np.nanmax(shown, initial=0.0))
    if maximum > top:
        note += f" Speeds above {top:g} have the last colour; the maximum is {maximum:.3g}."
    title = f"Speed, {scale.shown_unit}"
    return image, Legend(title, note, "speed", top, scale.gsd_m, scale.north_rad)


def speed_figure(
    grey: GreyImage, speed_px_per_s: NDArray[np.floating], scale: MapScale, *, bar_gsd_m: float | None = None
) -> RGBImage:
    """The modal speed as colour, with a bar beside it; parameters as in `direction_figure`.

    Parameters
    ----------
    speed_px_per_s
        (h, w) speed, px/s. NaN is not drawn.
    bar_gsd_m
        Metres a pixel of the figure, for the scale bar, where it is not drawn at base resolution.
    """
    image, legend = speed_map(grey, speed_px_per_s, scale)
    return beside(image, legend if bar_gsd_m is None else replace(legend, gsd_m=bar_gsd_m))


def change_figure(grey: GreyImage, change: NDArray[np.floating], scale: MapScale, *, title: str) -> RGBImage:
    """The change of one quantity between two fields: blue for less, orange for more; else as `direction_figure`.

    Parameters
    ----------
    change
        (h, w) change, in the unit in the title. NaN is not drawn.
    """
    known = np.isfinite(change)
    top = round_up(float(np.percentile(np.abs(change[known]), 99))) if known.any() else 10.0
    image = blend_over_image(grey, change, change_colours(change / top))
    note = "After minus before, where significant. Bare grey: no significant change."
    return beside(image, Legend(title, note, "change", top, scale.gsd_m, scale.north_rad))


def beside(image: RGBImage, legend: Legend) -> RGBImage:
    """A map with its legend to the right of it."""
    return np.hstack([image, legend_panel(image.shape, legend)])


def colour_scale_max(speed: NDArray[np.floating]) -> float | None:
    """99th percentile of the known speeds, the end of the colour scale before rounding: one false fast track does not
    compress it. None where no speed is known."""
    known = speed[np.isfinite(speed)]
    return float(np.percentile(known, 99)) if known.size else None


def round_up(value: float) -> float:
    """The next number of 1, 1.2, 1.5, 2, 3, 4, 5, 6, 8 times a power of ten.

    Examples
    --------
    >>> round_up(53.0), round_up(0.0), round_up(106.0), round_up(140.0)
    (60.0, 1.0, 120.0, 150.0)
    """
    if not value > 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    for step in (1.0, 1.2, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0):
        if value <= step * power * (1 + 1e-9):
            return float(step * power)
    return float(10 * power)


def png_bytes(image: NDArray[np.uint8]) -> bytes:
    """An RGB, RGBA or grey image as PNG."""
    return _saved(Image.fromarray(image), "PNG", compress_level=2)


def jpeg_bytes(rgb: RGBImage, *, max_side: int) -> bytes:
    """An RGB image as JPEG, reduced so that no side is longer than ``max_side``: for small pages."""
    image = Image.fromarray(rgb)
    image.thumbnail((max_side, max_side), Image.Resampling.BOX)
    return _saved(image, "JPEG", quality=88)


def _saved(image: Image.Image, kind: str, **options: int) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, kind, **options)
    return buffer.getvalue()


def blend_over_image(grey: GreyImage, values: NDArray[np.floating], colours: RGBImage) -> RGBImage:
    """(h, w, 3) colours over the dimmed image where the values are known.

    Raises
    ------
    InputError
        Where the shapes differ.
    """
    if grey.shape != values.shape:
        raise InputError(
            f"the base image is {grey.shape} and the field {values.shape} (height, width): they must agree"
        )
    known = np.isfinite(values)
    image = np.repeat((grey.astype(np.float32) * _DIMMED).astype(np.uint8)[..., None], 3, axis=2)
    # Modulated by the image, so that kerbs and lanes stay visible.
    image[known] = colours[known] * (_COVER + (1 - _COVER) * grey[known][:, None].astype(np.float32) / 255)
    return image
