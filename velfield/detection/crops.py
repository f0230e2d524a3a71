"""Pictures cut out about detections: along their axes, upright, and long strips of half the resolution."""

import cv2
import numpy as np

from schemas.arrays import Float32Array, FloatArray, GreyImage, IntArray

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
    along, across = (np.arange(size) - (size - 1) / 2 for size in (length, width))
    cosine, sine = np.cos(orientation_rad)[:, None], np.sin(orientation_rad)[:, None]
    x, y = np.empty((2, count, length, width), np.float32)
    np.subtract((xy[:, :1] + along * cosine)[:, :, None], (across * sine)[:, None], out=x)
    np.add((xy[:, 1:] + along * sine)[:, :, None], (across * cosine)[:, None], out=y)
    return _sample(image, x.reshape(count, -1), y.reshape(count, -1)).reshape(count, length, width)


def upright_chips(image: GreyImage, xy: FloatArray) -> GreyImage:
    """Crops about the rounded positions, (n, 32, 32) uint8: pixel (16, 16) is the rounded position."""
    return crops_at(image, np.rint(xy).astype(np.int64) - CHIP_PX // 2, CHIP_PX)


def crops_at(image: GreyImage, corners: IntArray, side_px: int) -> GreyImage:
    """Crops (n, side, side) uint8 whose first pixels are at (n, 2): x, y; beyond the image its edge goes on."""
    padded = cv2.copyMakeBorder(image, *(side_px,) * 4, cv2.BORDER_REPLICATE)
    x, y = (np.clip(corners[:, k], -side_px, image.shape[1 - k]) + side_px for k in (0, 1))
    return np.lib.stride_tricks.sliding_window_view(padded, (side_px, side_px))[y, x]


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
