"""The dense response: every round's rectangle sums at every pixel, whole rows at a time over one integral picture."""

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from velfield.detection.detector import BoostedSums

MARGIN_PX = 64
"""The picture is continued by so much at its edges: no rectangle reaches farther."""


def dense_response(image: NDArray[np.uint8], sums: BoostedSums) -> NDArray[np.float32]:
    """The classifier's response C at every pixel, (h, w) float32.

    Sums are of int32 over 8-bit grey: exact for any rectangle that fits the margin.
    """
    padded = np.pad(image, MARGIN_PX, mode="reflect" if min(image.shape) > MARGIN_PX else "edge")
    integral = cv2.integral(padded, sdepth=cv2.CV_32S)
    out = np.zeros(image.shape, np.float32)
    rectangles, starts = sums.rectangles, sums.starts
    _response(np.ascontiguousarray(integral), rectangles, starts, sums.thresholds, sums.leaves, MARGIN_PX, out)
    return out


@njit(cache=True, nogil=True)
def _response(integral, rectangles, starts, thresholds, leaves, margin, out):  # type: ignore[no-untyped-def]
    height, width = out.shape
    row = np.empty(width, np.int32)
    for y in range(height):
        said = out[y]
        for f in range(len(thresholds)):
            row[:] = 0
            for r in range(starts[f], starts[f + 1]):
                top = integral[y + margin + rectangles[r, 2]]
                bottom = integral[y + margin + rectangles[r, 4]]
                left, right = margin + rectangles[r, 1], margin + rectangles[r, 3]
                # Slices, whose index numba knows to be no negative one: only so is the loop a vector one.
                a, b = bottom[right : right + width], bottom[left : left + width]
                c, d = top[right : right + width], top[left : left + width]
                if rectangles[r, 0] > 0:
                    for x in range(width):
                        row[x] += a[x] - b[x] - c[x] + d[x]
                else:
                    for x in range(width):
                        row[x] -= a[x] - b[x] - c[x] + d[x]
            threshold, below, above = thresholds[f], leaves[f, 0], leaves[f, 1]
            for x in range(width):
                said[x] += above if row[x] > threshold else below
