"""Two colour scales in OKLab, which is perceptually uniform: a wheel for direction, a ramp for speed.

The ramp increases in lightness from violet to yellow, so that it is readable in greyscale and with colour blindness,
and starts light enough to be visible on a dimmed aerial image. The wheel is a closed curve in lightness and both axes
of colour at once: who does not see red and green apart still sees lightness go round with blue and yellow, and who does
not see blue and yellow apart sees it go round with red and green. Its coefficients maximise the least difference
(CIEDE2000) of directions 45 degrees and more apart, over normal sight, protanopia, deuteranopia and tritanopia.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, IntArray, Mask, RGBImage

TONES = ("#1f3b73", "#c8553d", "#3a8f6b", "#8a6fb0", "#b08a1e", "#5b6770")
"""Tones of things by their number: dark enough for text, and told apart in greyscale with strokes or marks."""
_STEPS = 1024
_WHEEL = np.array(  # lightness, a, b: mean, cosine and sine of the direction, cosine and sine of twice that
    [
        [0.7105, -0.1769, 0.1368, 0.0080, -0.0116],
        [0.0016, 0.0846, 0.0033, 0.0070, -0.0011],
        [0.0149, 0.0425, 0.1331, -0.0004, -0.0045],
    ]
)
_RAMP = np.array(  # lightness, chroma, hue (degrees)
    [[0.49, 0.21, 285.0], [0.57, 0.23, 315.0], [0.65, 0.22, 365.0], [0.76, 0.16, 415.0], [0.95, 0.17, 466.0]]
)


def direction_colours(direction_rad: NDArray[np.floating]) -> RGBImage:
    """(..., 3) colours of directions; opposite directions get opposite hues and lightness. NaN is black.

    Examples
    --------
    >>> east, west = direction_colours(np.array([0.0, np.pi])).astype(int)
    >>> bool(east[0] > east[2]), bool(west[0] < west[2])  # reddish and dark, bluish and light
    (True, True)
    """
    known = ~np.isnan(direction_rad)
    turns = direction_rad[known] / (2 * np.pi)
    return _look_up(_wheel(), np.floor(turns * _STEPS + 0.5).astype(np.int64) % _STEPS, known)


def ramp_colours(fraction: NDArray[np.floating]) -> RGBImage:
    """(..., 3) colours of numbers in [0, 1], clipped to it. NaN is black."""
    known = ~np.isnan(fraction)
    index = np.floor(fraction[known].clip(0, 1) * (_STEPS - 1) + 0.5).astype(np.int64)
    return _look_up(_ramp(), index, known)


def _look_up(scale: RGBImage, index: IntArray, known: Mask) -> RGBImage:
    """The colours of the known pixels, black elsewhere: of a field most are unknown, and cost neither time nor
    memory."""
    colours = np.zeros((*known.shape, 3), np.uint8)
    colours[known] = scale[index]
    return colours


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
    angle = np.arange(_STEPS) * 2 * np.pi / _STEPS
    harmonics = np.stack([np.ones(_STEPS), np.cos(angle), np.sin(angle), np.cos(2 * angle), np.sin(2 * angle)])
    return _srgb(_linear_rgb(*(_WHEEL @ harmonics)))


@cache
def _ramp() -> RGBImage:
    at = np.linspace(0, 1, _STEPS)
    knots = np.linspace(0, 1, len(_RAMP))
    lightness, chroma, hue = (np.interp(at, knots, column) for column in _RAMP.T)
    return _srgb(_linear_rgb(lightness, chroma * np.cos(np.radians(hue)), chroma * np.sin(np.radians(hue))))


def _linear_rgb(lightness: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """OKLab to linear sRGB (Ottosson's matrices), not clipped."""
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
