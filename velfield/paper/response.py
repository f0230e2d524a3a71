"""The paper's dense response: the rectangle sums of all rounds at every pixel, whole rows at a time."""

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import Float32Array, GreyImage
from velfield.compiled import kernel
from velfield.paper.stumps import BoostedStumps

MARGIN_PX = 64
"""Images are extended by this at their edges: no rectangle reaches farther."""
GREY_BITS = 5
"""Bits of a new detector: five to eight detect cars alike."""


def padded_integral(image: GreyImage, grey_bits: int) -> NDArray[np.int32]:
    """Integral image of ``grey_bits`` of the grey levels, extended by the margin: (h + 129, w + 129)."""
    coarse = image >> np.uint8(8 - grey_bits)
    padded = np.pad(coarse, MARGIN_PX, mode="reflect" if min(image.shape) > MARGIN_PX else "edge")
    return np.asarray(cv2.integral(padded, sdepth=cv2.CV_32S), np.int32)


def dense_response(image: GreyImage, stumps: BoostedStumps, *, grey_bits: int = GREY_BITS) -> Float32Array:
    """The classifier's response C at every pixel, (h, w) float32 (paper: car detection)."""
    out = np.zeros(image.shape, np.float32)
    integral = padded_integral(image, grey_bits)
    _add_rounds(integral, stumps.rectangles, stumps.starts, stumps.thresholds, stumps.leaves, out)
    return out


@kernel
def _add_rounds(integral, rectangles, starts, thresholds, leaves, out) -> None:  # type: ignore[no-untyped-def]
    height, width = out.shape
    row = np.empty(width, np.int32)
    for y in range(height):
        response = out[y]
        for f in range(len(thresholds)):
            row[:] = 0
            for k in range(starts[f], starts[f + 1]):
                sign, x0, y0 = rectangles[k, 0], rectangles[k, 1], rectangles[k, 2]
                x1, y1 = rectangles[k, 3], rectangles[k, 4]
                left, right = (MARGIN_PX + x0, MARGIN_PX + x1) if sign > 0 else (MARGIN_PX + x1, MARGIN_PX + x0)
                top, bottom = integral[y + MARGIN_PX + y0], integral[y + MARGIN_PX + y1]
                a, b = bottom[right : right + width], bottom[left : left + width]
                c, d = top[right : right + width], top[left : left + width]
                for x in range(width):
                    row[x] += a[x] - b[x] - c[x] + d[x]
            threshold, low, high = thresholds[f], leaves[f, 0], leaves[f, 1]
            for x in range(width):
                response[x] += high if row[x] > threshold else low
