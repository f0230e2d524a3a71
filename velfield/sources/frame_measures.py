"""Sharpness, brightness and contrast of a frame: apart from its flags, which planning reads without numba."""

from dataclasses import dataclass

import cv2
import numpy as np

from schemas.arrays import ByteArray, Float32Array, GreyImage
from velfield.compiled import kernel


@dataclass(frozen=True)
class FrameQuality:
    """Columns of quality beside a frame.

    Attributes
    ----------
    sharpness
        Standard deviation of the Laplacian, grey levels.
    brightness
        Mean grey level.
    contrast
        Standard deviation, grey levels.
    thumbnail
        (16, 16) float32, the frame scaled down, its mean removed: what `flag_outlier_frames` correlates.
    """

    sharpness: float
    brightness: float
    contrast: float
    thumbnail: Float32Array


def frame_quality(grey: GreyImage) -> FrameQuality:
    """Measure a grey frame, (h, w) uint8."""
    mean, deviation = cv2.meanStdDev(grey)
    sharpness = float(_laplacian_sd(cv2.copyMakeBorder(grey, 1, 1, 1, 1, cv2.BORDER_REFLECT_101)))
    small = cv2.resize(grey, (16, 16), interpolation=cv2.INTER_AREA).astype(np.float32)
    return FrameQuality(sharpness, float(mean[0, 0]), float(deviation[0, 0]), small - small.mean())


@kernel
def _laplacian_sd(bordered: ByteArray) -> float:
    """Standard deviation of the Laplacian inside a border of one pixel: `cv2.Laplacian`'s, which is not kept."""
    height, width = bordered.shape[0] - 2, bordered.shape[1] - 2
    total, squares = np.int64(0), np.int64(0)
    one, two = np.uint64(1), np.uint64(2)  # unsigned: numba checks no index for its sign
    for y in range(height):
        above, here, below = bordered[y], bordered[y + 1], bordered[y + 2]
        row, row_squares = np.int32(0), np.int64(0)
        for x in range(np.uint64(width)):
            beside = np.int32(here[x]) + np.int32(here[x + two]) + np.int32(above[x + one]) + np.int32(below[x + one])
            value = beside - np.int32(4) * np.int32(here[x + one])
            row += value
            row_squares += np.int64(value * value)
        total += row
        squares += row_squares
    mean = total / (height * width)
    return float(np.sqrt(max(squares / (height * width) - mean * mean, 0.0)))
