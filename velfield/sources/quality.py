"""How good a frame is, from its picture alone, and which frames stick out of a sequence."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

BLACK_LEVEL = 16.0
"""A frame whose 99th percentile is below this grey level is black."""
FLAT_SD = 2.0
"""A frame whose standard deviation is below this has nothing to register by."""


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
        (16, 16) float32, the frame's coarse look with its mean removed: tells a foreign frame.
    """

    sharpness: float
    brightness: float
    contrast: float
    thumbnail: NDArray[np.float32]


def frame_quality(grey: NDArray[np.uint8]) -> FrameQuality:
    """Measure a grey frame, (h, w) uint8."""
    mean, deviation = cv2.meanStdDev(grey)
    _, edges = cv2.meanStdDev(cv2.Laplacian(grey, cv2.CV_16S))
    small = cv2.resize(grey, (16, 16), interpolation=cv2.INTER_AREA).astype(np.float32)
    return FrameQuality(float(edges[0, 0]), float(mean[0, 0]), float(deviation[0, 0]), small - small.mean())


def is_black(grey: NDArray[np.uint8]) -> bool:
    """Whether a frame is black (a cap on the lens, a fade) or flat (fog): nothing can be registered by it."""
    sample = grey[::4, ::4]
    return bool(np.percentile(sample, 99) < BLACK_LEVEL or sample.std() < FLAT_SD)


def is_duplicate(grey: NDArray[np.uint8], previous: NDArray[np.uint8]) -> bool:
    """Whether two frames are one picture twice.

    Only equality to the grey level counts: the noise of a real sensor changes every frame, and a nearly still camera
    over nearly still traffic must not be taken for a frozen one.
    """
    return grey.shape == previous.shape and not np.any(cv2.absdiff(grey, previous) > 1)


def flag_blurred(sharpness: NDArray[np.float64], *, share: float = 0.5, window: int = 15) -> NDArray[np.bool_]:
    """Frames less than `share` as sharp as the median of their neighbours.

    Parameters
    ----------
    sharpness
        (n,) as `frame_quality` gives it; NaN where unreadable.
    share
        Below this share of the neighbours' median a frame is blurred.
    window
        How many frames, the frame itself in the middle, are its neighbours.

    Examples
    --------
    >>> flag_blurred(np.array([10.0, 11, 3, 10, 12, 10])).tolist()
    [False, False, True, False, False, False]
    """
    sharpness = np.asarray(sharpness, np.float64)
    if sharpness.size < 3:
        return np.zeros(sharpness.shape, np.bool_)
    half = window // 2
    around = np.lib.stride_tricks.sliding_window_view(np.pad(sharpness, half, constant_values=np.nan), 2 * half + 1)
    seen = np.isfinite(around).any(axis=1)
    usual = np.full(sharpness.shape, np.nan)
    usual[seen] = np.nanmedian(around[seen], axis=1)
    return np.asarray(sharpness < share * usual, np.bool_)


def flag_foreign(thumbnails: NDArray[np.float32], *, alike: float = 0.3, neighbours: float = 0.7) -> NDArray[np.bool_]:
    """Frames unlike the frame before and after, which are like each other.

    Parameters
    ----------
    thumbnails
        (n, 16, 16) as `frame_quality` gives them.
    alike
        A correlation below this is "unlike".
    neighbours
        A correlation above this between the frame before and the frame after says that the scene went on.
    """
    count = len(thumbnails)
    foreign = np.zeros(count, np.bool_)
    flat = np.asarray(thumbnails, np.float64).reshape(count, -1)
    norm = np.linalg.norm(flat, axis=1, keepdims=True)
    unit = np.divide(flat, norm, out=np.zeros_like(flat), where=norm > 0)
    if count >= 3:
        step = np.einsum("ij,ij->i", unit[:-1], unit[1:])
        across = np.einsum("ij,ij->i", unit[:-2], unit[2:])
        foreign[1:-1] = (np.maximum(step[:-1], step[1:]) < alike) & (across > neighbours)
    return foreign
