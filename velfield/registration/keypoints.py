"""Key points of a frame: SIFT on a reduced picture, spread over the frame; a function of the frame alone.

Paper: registration (SIFT). Nothing here needs another frame, so that key points are found in parallel. They bring a
frame to within a pixel or so; `alignment` goes below the pixel at full size.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from schemas.flight import RegistrationConfig

_SPREAD_CELLS = 12
"""Cells along the frame's longer side from each of which key points are taken in turn."""
_CONTRAST = 0.02
"""SIFT's contrast threshold: asphalt has little."""
_SURPLUS = 3


@dataclass(frozen=True, eq=False)
class KeyPoints:
    """Places that look like no other, and what they look like.

    Attributes
    ----------
    xy : (n, 2) px of the picture they were found in. The first of them are the strongest and spread over the picture.
    descriptors : (n, 128) uint8, SIFT.
    """

    xy: FloatArray
    descriptors: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.xy)

    def first(self, count: int) -> "KeyPoints":
        """The first ``count``: the strongest, spread over the picture."""
        return KeyPoints(self.xy[:count], self.descriptors[:count])


def detect_key_points(
    grey: NDArray[np.uint8],
    config: RegistrationConfig,
    mask: NDArray[np.bool_] | None = None,
    *,
    count: int | None = None,
) -> KeyPoints:
    """SIFT key points of a picture, the strongest of each cell first.

    Parameters
    ----------
    grey
        (h, w) uint8.
    config
        ``key_points`` and ``key_point_scale``.
    mask
        (h, w) bool: where key points may be; none: everywhere.
    count
        Key points kept in place of ``config.key_points``.
    """
    wanted = config.key_points if count is None else count
    height, width = grey.shape
    size = max(8, round(width * config.key_point_scale)), max(8, round(height * config.key_point_scale))
    small = grey if size == (width, height) else cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    small_mask = None
    if mask is not None:
        small_mask = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    sift = cv2.SIFT.create(nfeatures=_SURPLUS * wanted, contrastThreshold=_CONTRAST, enable_precise_upscale=True)
    found = sift.detect(small, small_mask)
    if not found:
        return KeyPoints(np.zeros((0, 2)), np.zeros((0, 128), np.uint8))
    xy = np.array([point.pt for point in found])
    order = _spread_order(xy, np.array([point.response for point in found]), max(size) / _SPREAD_CELLS)[:wanted]
    chosen, descriptors = sift.compute(small, [found[k] for k in order])
    if descriptors is None:
        return KeyPoints(np.zeros((0, 2)), np.zeros((0, 128), np.uint8))
    xy = (np.array([point.pt for point in chosen]) + 0.5) * (width / size[0], height / size[1]) - 0.5
    return KeyPoints(xy, np.clip(np.rint(descriptors), 0, 255).astype(np.uint8))


def _spread_order(xy: FloatArray, response: FloatArray, cell_px: float) -> NDArray[np.int64]:
    """Order (n,): the strongest of every cell, then the second of every cell, ..."""
    cell = np.floor(xy / cell_px).astype(np.int64)
    key = cell[:, 1] * 10_000 + cell[:, 0]
    by_cell = np.lexsort((-response, key))
    starts = np.flatnonzero(np.r_[True, np.diff(key[by_cell]) != 0])
    rank = np.arange(len(xy)) - np.repeat(starts, np.diff(np.r_[starts, len(xy)]))
    return np.asarray(by_cell[np.lexsort((-response[by_cell], rank))])
