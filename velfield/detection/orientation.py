"""The axis of what stands at a place, from the structure tensor of the picture: three blurs and a lookup."""

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray

GRADIENT_SIGMA_PX = 0.8
WINDOW_SIGMA_PX = 3.0


def structure_axis(image: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Axis and coherence at every pixel.

    Returns
    -------
    (h, w) axis in [0, pi), from +x towards +y (down), along the edges; (h, w) coherence in [0, 1].
    """
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), GRADIENT_SIGMA_PX)
    gx, gy = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    xx, yy, xy = (cv2.GaussianBlur(g, (0, 0), WINDOW_SIGMA_PX) for g in (gx * gx, gy * gy, gx * gy))
    # The gradient stands across the axis: a quarter turn from the tensor's main direction.
    axis = 0.5 * np.arctan2(2 * xy, xx - yy) + np.pi / 2
    coherence = np.sqrt((xx - yy) ** 2 + 4 * xy**2) / np.maximum(xx + yy, 1e-6)
    return np.mod(axis, np.pi).astype(np.float32), coherence.astype(np.float32)


def at_places(values: NDArray[np.float32], xy: FloatArray) -> FloatArray:
    """Values of a picture at the nearest pixels to (n, 2) places."""
    x = np.clip(np.rint(xy[:, 0]), 0, values.shape[1] - 1).astype(np.int64)
    y = np.clip(np.rint(xy[:, 1]), 0, values.shape[0] - 1).astype(np.int64)
    return np.asarray(values[y, x], np.float64)


def axial_difference(a: FloatArray, b: FloatArray) -> FloatArray:
    """Angle between axes, [0, pi / 2].

    Examples
    --------
    >>> axial_difference(np.array([0.1]), np.array([np.pi - 0.1])).round(3).tolist()
    [0.2]
    """
    return np.asarray(np.abs((a - b + np.pi / 2) % np.pi - np.pi / 2))
