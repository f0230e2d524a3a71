"""A frame on the working grid as a search for cars reads it: whole at half the resolution, elsewhere by cells."""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import cv2
import numpy as np

from schemas.arrays import GreyImage, Mask


class SearchableFrame(Protocol):
    """Interface of a frame to search: `ComparableFrame`, or `velfield.registration.warp.Rectification`."""

    @property
    def image(self) -> GreyImage:
        """(h, w) uint8; any value in cells that were not asked for by `resample`."""
        ...

    @property
    def valid(self) -> Mask:
        """(h, w): where the frame covers the grid; likewise."""
        ...

    @property
    def half_image(self) -> GreyImage:
        """The whole frame at half the resolution, sizes rounded up."""
        ...

    @property
    def half_valid(self) -> Mask:
        """Mask of `half_image`, true where the frame covers it."""
        ...

    def resample(self, cells: Mask, side_px: int) -> None:
        """Fill `image` and `valid` in the cells (rows, columns) of a mask; cells are ``side_px`` wide and high."""
        ...


def half_resolution(image: GreyImage) -> GreyImage:
    """The image at half its resolution, sizes rounded up."""
    even = cv2.copyMakeBorder(image, 0, image.shape[0] % 2, 0, image.shape[1] % 2, cv2.BORDER_REPLICATE)
    size = even.shape[1] // 2, even.shape[0] // 2
    return np.asarray(cv2.resize(even, size, interpolation=cv2.INTER_AREA), np.uint8)


@dataclass(frozen=True, eq=False)
class ComparableFrame:
    """A frame on the working grid, computed whole."""

    image: GreyImage
    valid: Mask
    """(h, w) where the frame covers the grid."""

    @cached_property
    def half_image(self) -> GreyImage:
        """At half the resolution, sizes rounded up."""
        return half_resolution(self.image)

    @cached_property
    def half_valid(self) -> Mask:
        """Every other pixel of every other row."""
        return np.ascontiguousarray(self.valid[::2, ::2])

    def resample(self, cells: Mask, side_px: int) -> None:
        """Nothing: all of it is there."""
