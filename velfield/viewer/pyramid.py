"""The base image as a pyramid of JPEG tiles: a page shows a map of any size without loading all of it."""

from collections.abc import Iterator

import cv2
import numpy as np

from schemas.arrays import GreyImage
from velfield.errors import InputError

TILE_PX = 512
OVERLAP_PX = 1
"""Overlap of a tile with its right and lower neighbours: edges at fractions of a screen pixel would show as seams."""
_QUALITY = 88


def pyramid_levels(height: int, width: int) -> int:
    """Number of levels until the whole image fits into a tile.

    Examples
    --------
    >>> pyramid_levels(1920, 2560), pyramid_levels(100, 512)
    (4, 1)
    """
    levels = 1
    while max(height, width) > TILE_PX << (levels - 1):
        levels += 1
    return levels


def pyramid_tiles(grey: GreyImage) -> Iterator[tuple[str, bytes]]:
    """Name ``<level>/<row>-<column>.jpg`` and bytes of every tile; those at the right and lower edge are smaller."""
    image = grey
    for level in range(pyramid_levels(*grey.shape)):
        if level:
            size = (-(-image.shape[1] // 2), -(-image.shape[0] // 2))
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        for row in range(-(-image.shape[0] // TILE_PX)):
            for column in range(-(-image.shape[1] // TILE_PX)):
                y, x = row * TILE_PX, column * TILE_PX
                yield (
                    f"{level}/{row}-{column}.jpg",
                    _jpeg(image[y : y + TILE_PX + OVERLAP_PX, x : x + TILE_PX + OVERLAP_PX]),
                )


def _jpeg(grey: GreyImage) -> bytes:
    good, data = cv2.imencode(".jpg", np.ascontiguousarray(grey), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not good:
        raise InputError(f"a tile of {grey.shape} px cannot be written as JPEG")
    return data.tobytes()
