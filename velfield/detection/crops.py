"""Pictures cut out about detections: along their axes, upright, and long strips of half the resolution."""

import cv2
import numpy as np

from schemas.arrays import ByteArray, Float32Array, FloatArray, GreyImage, IntArray
from velfield.compiled import kernel

CHIP_PX = 32
"""Side of the upright chips, the widest crops."""


def oriented_patches(
    image: GreyImage, xy: FloatArray, orientation_rad: FloatArray, *, width: int = 8, length: int = 16
) -> GreyImage:
    """Patches rotated so that the car's axis runs along the columns (paper: the 8 x 16 oriented patch).

    Parameters
    ----------
    image
        (h, w) uint8 on the working grid.
    xy, orientation_rad
        (n, 2) centres, working px, and (n,) axes.

    Returns
    -------
    (n, length, width) uint8
    """
    count = len(xy)
    if not count:
        return np.empty((0, length, width), np.uint8)
    x, y = _grid_kernel(xy, np.cos(orientation_rad), np.sin(orientation_rad), length, width)
    return _sample(image, x, y).reshape(count, length, width)


@kernel
def _grid_kernel(
    xy: FloatArray, cosine: FloatArray, sine: FloatArray, length: int, width: int
) -> tuple[Float32Array, Float32Array]:
    """Where the pixels of patches lie in an image, row by row: x and y, each (n, length width) float32."""
    x, y = np.empty((len(xy), length * width), np.float32), np.empty((len(xy), length * width), np.float32)
    for n in range(len(xy)):
        for i in range(length):
            along = i - (length - 1) / 2
            begin_x, begin_y = xy[n, 0] + along * cosine[n], xy[n, 1] + along * sine[n]
            for j in range(width):
                across = j - (width - 1) / 2
                x[n, i * width + j] = begin_x - across * sine[n]
                y[n, i * width + j] = begin_y + across * cosine[n]
    return x, y


def upright_chips(image: GreyImage, xy: FloatArray) -> GreyImage:
    """Crops about the rounded positions, (n, 32, 32) uint8: pixel (16, 16) is the rounded position."""
    return crops_at(image, np.rint(xy).astype(np.int64) - CHIP_PX // 2, CHIP_PX)


def crops_at(image: GreyImage, corners: IntArray, side_px: int) -> GreyImage:
    """Crops (n, side, side) uint8 whose first pixels are at (n, 2): x, y; beyond the image its edge goes on."""
    return np.asarray(_chips_kernel(image, corners, side_px))


@kernel
def _chips_kernel(image: ByteArray, corners: IntArray, side: int) -> ByteArray:
    """Crops with these corners (n, 2); beyond the image its edge goes on."""
    height, width = image.shape
    out = np.empty((len(corners), side, side), np.uint8)
    for n in range(len(corners)):
        left, top = corners[n]
        if 0 <= left <= width - side and 0 <= top <= height - side:
            for i in range(side):
                source, target = image[top + i], out[n, i]
                for j in range(np.uint64(side)):
                    target[j] = source[np.uint64(left) + j]
            continue
        for i in range(side):
            y = min(max(corners[n, 1] + i, 0), height - 1)
            for j in range(side):
                out[n, i, j] = image[y, min(max(corners[n, 0] + j, 0), width - 1)]
    return out


def patches_of_chips(chips: GreyImage, offset_px: FloatArray, orientation_rad: FloatArray) -> GreyImage:
    """Oriented patches (n, 16, 8) uint8 of cars by their upright chips, which they do not reach beyond.

    Parameters
    ----------
    chips
        (n, 32, 32) uint8, as of `upright_chips`.
    offset_px, orientation_rad
        (n, 2) centres from the rounded positions, and (n,) axes.
    """
    parts = [np.empty((0, 16, 8), np.uint8)]
    for start in range(0, len(chips), 1000):  # one below the other: remap takes images of less than 32,767 rows
        some = slice(start, start + 1000)
        top = CHIP_PX * np.arange(len(chips[some]))
        xy = CHIP_PX // 2 + offset_px[some] + np.column_stack([np.zeros(len(top)), top])
        parts.append(oriented_patches(chips[some].reshape(-1, CHIP_PX), xy, orientation_rad[some]))
    return np.concatenate(parts)


def oriented_strips(half_image: GreyImage, xy: FloatArray, orientation_rad: FloatArray) -> GreyImage:
    """Patches of twice a bus's length at half the resolution, the axis along the columns: (n, 32, 10) uint8.

    Parameters
    ----------
    half_image
        The image on the working grid at half its resolution, as of `ComparableFrame.half_image`.
    """
    return oriented_patches(half_image, (xy - 0.5) / 2, orientation_rad, width=10, length=32)


def _sample(image: GreyImage, x: Float32Array, y: Float32Array) -> GreyImage:
    rows = []
    for start in range(0, len(x), 16_000):  # remap takes at most 32,767 rows
        part = slice(start, start + 16_000)
        rows.append(cv2.remap(image, x[part], y[part], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    return np.asarray(np.concatenate(rows) if len(rows) > 1 else rows[0], np.uint8)
