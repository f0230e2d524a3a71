"""Background subtraction: the difference of a registered frame to the temporal median of the flight.

Half a pixel of registration error makes |frame - background| large at every edge of every roof. The difference is
therefore the distance of the frame *outside the range* that the background takes in a window around each pixel, after
smooth differences of exposure are removed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from schemas.arrays import Float32Array, GreyImage, Mask
from velfield.errors import InputError
from velfield.registration.background import median_background

_BLUR_SIGMA_PX = 0.8
_EXPOSURE_CELL_PX = 64
_MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True)
class MotionFrame:
    """A registered frame on the working grid.

    Attributes
    ----------
    image : uint8 (h, w)
        Grey image, warped to the working grid.
    valid : bool (h, w)
        Where the frame covers the grid.
    time_s : float
        True time of the frame, s.
    """

    image: GreyImage
    valid: Mask
    time_s: float


@dataclass(frozen=True)
class MotionBackground:
    """Temporal median of registered frames, and its range in a window around each pixel.

    Attributes
    ----------
    median, low, high : uint8 (h, w)
        The median, and its minimum and maximum in the window (3 x 3 by default).
    valid : bool (h, w)
        Where enough frames contributed to the median.
    """

    median: GreyImage
    low: GreyImage
    high: GreyImage
    valid: Mask


def background_from_median(median: GreyImage, valid: Mask | None = None, *, reach_px: int = 1) -> MotionBackground:
    """Background from a given median image, such as a base image built from the flight.

    Parameters
    ----------
    median : uint8 (h, w)
        Temporal median of registered frames.
    valid : bool (h, w), optional
        Where the median is known; everywhere by default.
    reach_px : int
        Largest registration error, px: half the window, less the centre pixel.
    """
    window = np.ones((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)
    everywhere = np.ones(median.shape, np.bool_)
    low = np.asarray(cv2.erode(median, window), np.uint8)
    high = np.asarray(cv2.dilate(median, window), np.uint8)
    return MotionBackground(median, low, high, everywhere if valid is None else valid)


def motion_background(frames: Sequence[MotionFrame], *, max_frames: int = 15, min_frames: int = 3) -> MotionBackground:
    """Background from frames spread over the flight (5 to 7 suffice; 3 consecutive ones do not).

    Parameters
    ----------
    frames : sequence of MotionFrame
        Registered frames of one shape, in time order.
    max_frames : int
        At most this many are used, evenly spread.
    min_frames : int
        A pixel covered by fewer frames has no background.

    Raises
    ------
    InputError
        Fewer frames than `min_frames`, or of several shapes.
    """
    if len(frames) < min_frames:
        raise InputError(
            f"a background needs {min_frames} registered frames or more, found {len(frames)}: label one frame"
        )
    shapes = {frame.image.shape for frame in frames}
    if len(shapes) > 1:
        raise InputError(f"registered frames must be of one shape, found {sorted(shapes)}: warp them to one window")
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(max_frames, len(frames))).round().astype(int))
    ranked = median_background([frames[i].image for i in chosen], [frames[i].valid for i in chosen])
    return background_from_median(ranked.median, ranked.count >= min_frames)


def signed_difference(image: GreyImage, valid: Mask, background: MotionBackground) -> Float32Array:
    """Distance of a registered frame above (+) or below (-) the background's range, grey levels, blurred by 0.8 px.

    The sign separates a bright car from its shadow, which is never brighter than the road.

    Parameters
    ----------
    image, valid : uint8 and bool (h, w)
        Frame on the background's grid.
    background : MotionBackground

    Returns
    -------
    float32 (h, w)
        0 within the range, and where frame or background are unknown.
    """
    known = valid & background.valid
    level = image - _exposure_offset(image.astype(np.float32) - background.median, known)
    outside = np.maximum(level - background.high, 0) - np.maximum(background.low - level, 0)
    outside[~known] = 0
    blurred = cv2.GaussianBlur(outside, (0, 0), _BLUR_SIGMA_PX)
    return np.where(known, blurred, np.float32(0))


def absolute_difference(image: GreyImage, valid: Mask, background: MotionBackground) -> Float32Array:
    """Magnitude of `signed_difference`, grey levels."""
    return np.abs(signed_difference(image, valid, background))


def estimate_noise(image: GreyImage, valid: Mask, background: MotionBackground) -> float:
    """Standard deviation of frame minus background, by the median absolute deviation, grey levels."""
    known = valid & background.valid
    if not known.any():
        return 0.0
    signed = (image.astype(np.int16) - background.median)[known][::7]
    return float(_MAD_TO_SIGMA * np.median(np.abs(signed - np.median(signed))))


def _exposure_offset(signed: Float32Array, known: Mask) -> Float32Array:
    """Difference in exposure and vignetting: the median of each cell, larger than any car, interpolated."""
    height, width = signed.shape
    rows, columns = (max(1, round(side / _EXPOSURE_CELL_PX)) for side in (height, width))
    # Every fourth pixel suffices for a cell's median, at a sixteenth of the cost.
    step = 4 if min(height, width) >= 4 * max(rows, columns) else 1
    sampled, sampled_known = signed[::step, ::step], known[::step, ::step]
    cells = np.zeros((rows, columns), np.float32)
    edges_y = np.linspace(0, sampled.shape[0], rows + 1).astype(int)
    edges_x = np.linspace(0, sampled.shape[1], columns + 1).astype(int)
    for i in range(rows):
        for j in range(columns):
            part = (slice(edges_y[i], edges_y[i + 1]), slice(edges_x[j], edges_x[j + 1]))
            values = sampled[part][sampled_known[part]]
            cells[i, j] = np.median(values) if values.size else 0
    smooth = cv2.blur(cells, (3, 3), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.resize(smooth, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
