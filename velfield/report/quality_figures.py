"""Figures of geometric quality: a frame before and after undistortion, the registration error over the frame."""

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from schemas.arrays import FloatArray, GreyImage, RGBImage
from velfield.camera.lens import Lens
from velfield.report.colours import ramp_colours

_LINES = 9
"""Straight lines drawn over the image each way."""
_LINE_RGB = (255, 176, 32)
_SIDE_PX = 900
"""Largest width of a frame in a figure."""
_COVER = 0.55
_BAND_ROWS = 128
_LEGEND_PX = 32


def undistortion_figure(grey: GreyImage, lens: Lens) -> RGBImage:
    """A raw frame (h, w) and the same undistorted, side by side, with a grid that is straight on the ground."""
    height, width = grey.shape
    raw = np.empty((height, width, 2), np.float32)
    for top in range(0, height, _BAND_ROWS):  # all points at once would take half a gigabyte
        y, x = np.mgrid[top : min(top + _BAND_ROWS, height), 0:width].astype(np.float64)
        raw[top : top + len(y)] = lens.distort_points(np.column_stack([x.ravel(), y.ravel()])).reshape(*y.shape, 2)
    after = cv2.remap(grey, raw[..., 0], raw[..., 1], cv2.INTER_LINEAR)
    straight = _straight_lines(width, height)
    distorted = [lens.distort_points(line) for line in straight]
    shown = [
        _with_lines(grey, distorted, "as taken"),
        _with_lines(np.asarray(after, dtype=np.uint8), straight, "undistorted"),
    ]
    gap = np.full((shown[0].shape[0], 8, 3), 255, np.uint8)
    return np.concatenate([shown[0], gap, shown[1]], axis=1)


def _straight_lines(width: int, height: int) -> list[FloatArray]:
    along = np.linspace(-0.05, 1.05, 200)
    lines = []
    for fraction in np.linspace(0.0, 1.0, _LINES):
        level = np.full_like(along, fraction)
        lines += [np.column_stack([along * (width - 1), level * (height - 1)])]
        lines += [np.column_stack([level * (width - 1), along * (height - 1)])]
    return lines


def _with_lines(grey: GreyImage, lines: list[FloatArray], title: str) -> RGBImage:
    scale = min(1.0, _SIDE_PX / grey.shape[1])
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    image = Image.fromarray(np.repeat(small[..., None], 3, axis=2))
    draw = ImageDraw.Draw(image)
    for line in lines:
        seen = line[np.isfinite(line).all(axis=1)]
        draw.line([(float(px), float(py)) for px, py in seen * scale], fill=_LINE_RGB, width=1)
    _label(draw, title, 8, 8)
    return np.asarray(image, dtype=np.uint8)


def registration_error_figure(grey: GreyImage, error_px: NDArray[np.floating], *, full_px: float) -> RGBImage:
    """Hold-out error of the registration by cell of the frame, as colour and number, over a raw frame.

    Parameters
    ----------
    grey
        (h, w) uint8.
    error_px
        (rows, columns) base px; NaN where no control point lies.
    full_px
        Error at the end of the colour ramp.
    """
    scale = min(1.0, _SIDE_PX / grey.shape[1])
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    height, width = small.shape
    rows, columns = error_px.shape
    row = np.arange(height) * rows // height
    column = np.arange(width) * columns // width
    at = np.asarray(error_px, dtype=np.float64)[row[:, None], column[None, :]]
    colours = ramp_colours(at / full_px).astype(np.float64)
    cover = np.where(np.isfinite(at), _COVER, 0.0)[..., None]
    mixed = (1 - cover) * small[..., None] + cover * colours
    image = Image.fromarray(np.rint(mixed).astype(np.uint8))
    draw = ImageDraw.Draw(image)
    for i in range(rows):
        for j in range(columns):
            text = f"{error_px[i, j]:.2f}" if np.isfinite(error_px[i, j]) else "no points"
            _label(draw, text, (j + 0.5) * width / columns, (i + 0.5) * height / rows, anchor="mm")
    return np.concatenate([np.asarray(image, dtype=np.uint8), _error_legend(width, full_px)])


def _error_legend(width: int, full_px: float) -> RGBImage:
    """Legend of the numbers and the ramp from 0 to ``full_px``, (height, width, 3), for below the image."""
    image = Image.new("RGB", (width, _LEGEND_PX))
    draw = ImageDraw.Draw(image)
    bar = max(1, width // 5)
    ramp = np.broadcast_to(np.linspace(0.0, 1.0, bar), (_LEGEND_PX // 2, bar))
    end = width - _LEGEND_PX * 3
    image.paste(Image.fromarray(ramp_colours(ramp)), (end - bar, _LEGEND_PX // 4))
    _label(draw, "0", end - bar - 6, _LEGEND_PX / 2, anchor="rm")
    _label(draw, f"{full_px:g} px", end + 6, _LEGEND_PX / 2, anchor="lm")
    _label(draw, "hold-out error, RMS", 8, _LEGEND_PX / 2, anchor="lm")
    return np.asarray(image, dtype=np.uint8)


def _label(draw: ImageDraw.ImageDraw, text: str, x: float, y: float, anchor: str = "la") -> None:
    font = ImageFont.load_default(16)
    draw.text((x, y), text, font=font, fill=(255, 255, 255), anchor=anchor, stroke_width=2, stroke_fill=(0, 0, 0))
