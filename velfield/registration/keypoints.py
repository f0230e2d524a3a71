"""SIFT keypoints of a frame, detected on a downscaled image and distributed evenly over it.

Paper: registration (SIFT). Keypoints depend on one frame alone, so frames are processed in parallel. They register a
frame to about a pixel; `alignment` refines to subpixel accuracy at full resolution.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from schemas.arrays import ByteArray, FloatArray, GreyImage, IntArray, Mask
from schemas.flight import RegistrationConfig

_CELLS_ALONG_SIDE = 12
"""Cells along the frame's longer side; the strongest keypoint of every cell comes before the second of any."""
_CONTRAST = 0.02
"""SIFT's contrast threshold, below OpenCV's 0.04: asphalt has little contrast."""
_CANDIDATES_PER_KEYPOINT = 3


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints and descriptors.

    Attributes
    ----------
    xy : (n, 2) px of the full image, ordered so that the first are the strongest of each cell.
    descriptors : (n, 128) uint8, SIFT.
    """

    xy: FloatArray
    descriptors: ByteArray

    def __len__(self) -> int:
        return len(self.xy)

    def first(self, count: int) -> "Keypoints":
        """The first ``count``: the strongest, distributed over the image."""
        return Keypoints(self.xy[:count], self.descriptors[:count])


def detect_keypoints(
    grey: GreyImage,
    config: RegistrationConfig,
    mask: Mask | None = None,
    *,
    count: int | None = None,
) -> Keypoints:
    """Detect SIFT keypoints, the strongest of each cell first.

    Parameters
    ----------
    grey
        (h, w) uint8.
    config
        ``max_keypoints`` and ``keypoint_scale``.
    mask
        (h, w) bool: where keypoints are allowed; None: everywhere.
    count
        Keypoints kept, in place of ``config.max_keypoints``.
    """
    n_keypoints = config.max_keypoints if count is None else count
    height, width = grey.shape
    size = max(8, round(width * config.keypoint_scale)), max(8, round(height * config.keypoint_scale))
    small = grey if size == (width, height) else cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    small_mask = None
    if mask is not None:
        small_mask = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    n_candidates = _CANDIDATES_PER_KEYPOINT * n_keypoints
    sift = cv2.SIFT.create(nfeatures=n_candidates, contrastThreshold=_CONTRAST, enable_precise_upscale=True)
    detected = sift.detect(small, small_mask)
    if not detected:
        return Keypoints(np.zeros((0, 2)), np.zeros((0, 128), np.uint8))
    xy = np.array([point.pt for point in detected])
    response = np.array([point.response for point in detected])
    order = _order_by_cell(xy, response, max(size) / _CELLS_ALONG_SIDE)[:n_keypoints]
    kept, descriptors = sift.compute(small, [detected[k] for k in order])
    if descriptors is None:
        return Keypoints(np.zeros((0, 2)), np.zeros((0, 128), np.uint8))
    xy = (np.array([point.pt for point in kept]) + 0.5) * (width / size[0], height / size[1]) - 0.5
    return Keypoints(xy, np.clip(np.rint(descriptors), 0, 255).astype(np.uint8))


def _order_by_cell(xy: FloatArray, response: FloatArray, cell_px: float) -> IntArray:
    """Order (n,): the strongest of every cell, then the second strongest of every cell, ..."""
    cell = np.floor(xy / cell_px).astype(np.int64)
    key = cell[:, 1] * 10_000 + cell[:, 0]
    by_cell = np.lexsort((-response, key))
    starts = np.flatnonzero(np.r_[True, np.diff(key[by_cell]) != 0])
    rank = np.arange(len(xy)) - np.repeat(starts, np.diff(np.r_[starts, len(xy)]))
    return np.asarray(by_cell[np.lexsort((-response[by_cell], rank))])
