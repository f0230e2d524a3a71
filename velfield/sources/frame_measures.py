"""Sharpness and brightness of a frame: apart from its flags, which planning reads without numba."""

from dataclasses import dataclass

import cv2
import numpy as np

from schemas.arrays import Float32Array, GreyImage


@dataclass(frozen=True)
class FrameQuality:
    """Columns of quality beside a frame."""

    sharpness: float
    """Standard deviation of the Laplacian, grey levels."""
    brightness: float
    """Mean grey level."""
    thumbnail: Float32Array
    """(16, 16) float32, the frame scaled down, its mean removed: what `flag_outlier_frames` correlates."""


def frame_quality(grey: GreyImage) -> FrameQuality:
    """Measure a grey frame, (h, w) uint8."""
    mean, _ = cv2.meanStdDev(grey)
    _, sharpness = cv2.meanStdDev(cv2.Laplacian(grey, cv2.CV_16S))
    small = cv2.resize(grey, (16, 16), interpolation=cv2.INTER_AREA).astype(np.float32)
    return FrameQuality(float(sharpness[0, 0]), float(mean[0, 0]), small - small.mean())
