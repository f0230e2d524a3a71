"""Segmentation of the dense response (paper): blur, maxima, region growing above the threshold, image moments."""

import cv2
import numpy as np
from numpy.typing import NDArray
from skimage.segmentation import watershed

from schemas.arrays import Float32Array, FloatArray


def segment_response(
    response: Float32Array, *, sigma_px: float, threshold: float, min_region_px: int
) -> tuple[Float32Array, NDArray[np.int32]]:
    """The blurred response, and the regions that grow above the threshold from its maxima with four neighbours.

    Returns
    -------
    (h, w) float32, and (h, w) int32 labels, 0 where there is no region; regions under ``min_region_px`` are dropped.
    """
    smooth = cv2.GaussianBlur(response, (0, 0), sigma_px)
    above = smooth > threshold
    peak = above & (smooth >= cv2.dilate(smooth, np.ones((3, 3), np.uint8)))
    _, markers = cv2.connectedComponents(peak.astype(np.uint8), connectivity=8)
    # On a constant image watershed assigns each pixel to the seed that is fewest steps away: the paper's growing.
    labels = watershed(np.zeros(smooth.shape, np.uint8), markers, connectivity=1, mask=above).astype(np.int32)
    size = np.bincount(labels.ravel())
    labels[size[labels] < min_region_px] = 0
    return smooth, labels


def region_moments(labels: NDArray[np.int32], smooth: Float32Array) -> FloatArray:
    """Mean, axis and peak of each region, from its first and second moments.

    Returns
    -------
    (n, 6): x, y, axis in [0, pi), peak response, axis' standard deviation, area.
    """
    y, x = np.nonzero(labels)
    _, region = np.unique(labels[y, x], return_inverse=True)
    n = int(region.max(initial=-1)) + 1
    if not n:
        return np.empty((0, 6))
    area = np.bincount(region, minlength=n).astype(np.float64)
    cx, cy = (np.bincount(region, c, n) / area for c in (x, y))
    dx, dy = x - cx[region], y - cy[region]
    xx, yy, xy = (np.bincount(region, v, n) / area for v in (dx * dx, dy * dy, dx * dy))
    axis = np.mod(0.5 * np.arctan2(2 * xy, xx - yy), np.pi)
    elongation = np.sqrt((xx - yy) ** 2 + 4 * xy**2) / np.maximum(xx + yy, 1e-9)
    # A round region has no axis; that of a car, twice as long as wide, is accurate to a few degrees.
    sd = np.clip(1.0 / (np.sqrt(area) * np.maximum(elongation, 1e-3)), 0.05, np.pi / 4)
    peak = np.full(n, -np.inf)
    np.maximum.at(peak, region, smooth[y, x])
    return np.column_stack([cx, cy, axis, peak, sd, area])
