"""Two colour scales in OKLab, which is perceptually uniform: a wheel for direction, a ramp for speed.

The ramp increases in lightness from violet to yellow, so that it is readable in greyscale and with colour blindness,
and starts light enough to be visible on a dimmed aerial image. The wheel has each hue at the largest chroma within the
sRGB gamut, and varies a little in lightness: a wheel of one lightness would be pale.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, RGBImage

_STEPS = 1024
_WHEEL_ROTATION_DEG = 29.0  # red points along +x, as on the usual hue wheel
_RAMP = np.array(  # lightness, chroma, hue (degrees)
    [[0.49, 0.21, 285.0], [0.57, 0.23, 315.0], [0.65, 0.22, 365.0], [0.76, 0.16, 415.0], [0.95, 0.17, 466.0]]
)


def direction_colours(direction_rad: NDArray[np.floating]) -> RGBImage:
    """(..., 3) colours of directions; opposite directions get opposite hues. NaN is black.

    Examples
    --------
    >>> red, cyan = direction_colours(np.array([0.0, np.pi])).astype(int)
    >>> bool(red[0] > 200 > red[2]), bool(cyan[0] < 120 < cyan[2])
    (True, True)
    """
    turns = np.nan_to_num(direction_rad) / (2 * np.pi)
    index = np.floor(turns * _STEPS + 0.5).astype(np.int64) % _STEPS
    return np.where(np.isnan(direction_rad)[..., None], np.uint8(0), _wheel()[index])


def ramp_colours(fraction: NDArray[np.floating]) -> RGBImage:
    """(..., 3) colours of numbers in [0, 1], clipped to it. NaN is black."""
    index = np.floor(np.nan_to_num(fraction).clip(0, 1) * (_STEPS - 1) + 0.5).astype(np.int64)
    return np.where(np.isnan(fraction)[..., None], np.uint8(0), _ramp()[index])


def change_colours(change: NDArray[np.floating]) -> RGBImage:
    """(..., 3) colours of changes from -1 (blue) by 0 (white) to 1 (orange). NaN is black.

    Examples
    --------
    >>> change_colours(np.array([-1.0, 0.0, 1.0])).tolist()
    [[58, 124, 255], [240, 240, 240], [255, 122, 26]]
    """
    at = np.nan_to_num(change).clip(-1, 1)
    out = np.stack([np.interp(at, (-1, 0, 1), ends) for ends in ((58, 240, 255), (124, 240, 122), (255, 240, 26))], -1)
    return np.asarray(np.where(np.isnan(change)[..., None], 0, np.floor(out + 0.5)), np.uint8)


@cache
def _wheel() -> RGBImage:
    hue = np.radians(np.arange(_STEPS) * 360 / _STEPS + _WHEEL_ROTATION_DEG)
    lightness = 0.72 + 0.06 * np.cos(hue - np.radians(120))
    chroma = np.full(_STEPS, 0.30)
    for _ in range(60):  # reduce the chroma of each hue until it is in gamut
        out_of_gamut = (np.abs(_linear_rgb(lightness, chroma, hue) - 0.5) > 0.5).any(axis=-1)
        chroma = np.where(out_of_gamut, chroma * 0.97, chroma)
    return _srgb(_linear_rgb(lightness, _smooth_round(chroma), hue))


@cache
def _ramp() -> RGBImage:
    at = np.linspace(0, 1, _STEPS)
    knots = np.linspace(0, 1, len(_RAMP))
    lightness, chroma, hue = (np.interp(at, knots, column) for column in _RAMP.T)
    return _srgb(_linear_rgb(lightness, chroma, np.radians(hue)))


def _smooth_round(values: FloatArray) -> FloatArray:
    """A moving mean around the circle, so that the gamut's corners do not show as seams."""
    width = _STEPS // 16
    around = np.concatenate([values[-width:], values, values[:width]])
    return np.convolve(around, np.ones(2 * width + 1) / (2 * width + 1), mode="valid")


def _linear_rgb(lightness: FloatArray, chroma: FloatArray, hue_rad: FloatArray) -> FloatArray:
    """OKLCH to linear sRGB (Ottosson's matrices), not clipped."""
    a, b = chroma * np.cos(hue_rad), chroma * np.sin(hue_rad)
    lms = np.stack(
        [
            lightness + 0.3963377774 * a + 0.2158037573 * b,
            lightness - 0.1055613458 * a - 0.0638541728 * b,
            lightness - 0.0894841775 * a - 1.2914855480 * b,
        ],
        axis=-1,
    )
    to_rgb = np.array(
        [
            [4.0767416621, -3.3077115913, 0.2309699292],
            [-1.2684380046, 2.6097574011, -0.3413193965],
            [-0.0041960863, -0.7034186147, 1.7076147010],
        ]
    )
    return np.asarray(lms**3 @ to_rgb.T)


def _srgb(linear: FloatArray) -> RGBImage:
    linear = linear.clip(0, 1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.floor(encoded * 255 + 0.5).astype(np.uint8)
