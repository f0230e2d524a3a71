"""Difference of a registered frame to the background: what moved, and how sure the noise lets us be of it.

The background is the temporal median of registered frames. A frame's difference to it is not |frame - background| as it
stands: half a pixel of registration error lights up every edge of every roof. It is the distance *outside the range*
that the background takes within a pixel around, after the slow differences of exposure are taken out.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import GreyImage, Mask
from velfield.errors import InputError
from velfield.registration.background import median_background

_BLUR_SIGMA_PX = 0.8
_OFFSET_CELL_PX = 64


@dataclass(frozen=True)
class MotionFrame:
    """A registered frame on the working grid.

    Attributes
    ----------
    image : uint8 (h, w)
        Grey picture, warped to the working grid.
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
    """Temporal median of registered frames, and the range it takes within a pixel around.

    Attributes
    ----------
    median, low, high : uint8 (h, w)
        The median, and its least and greatest value in the window of 3 x 3.
    valid : bool (h, w)
        Where enough frames stood behind the median.
    """

    median: GreyImage
    low: GreyImage
    high: GreyImage
    valid: Mask


def background_of(median: GreyImage, valid: Mask | None = None, *, reach_px: int = 1) -> MotionBackground:
    """Background from a median picture that is there already, such as a base image built from the flight.

    Parameters
    ----------
    median : uint8 (h, w)
        Temporal median of registered frames.
    valid : bool (h, w), optional
        Where the median stands on frames; everywhere by default.
    reach_px : int
        How far registration may be off, px: the range is taken within this distance.
    """
    window = np.ones((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)
    everywhere = np.ones(median.shape, np.bool_)
    low = np.asarray(cv2.erode(median, window), np.uint8)
    high = np.asarray(cv2.dilate(median, window), np.uint8)
    return MotionBackground(median, low, high, everywhere if valid is None else valid)


def motion_background(frames: Sequence[MotionFrame], *, max_frames: int = 15, min_frames: int = 3) -> MotionBackground:
    """Temporal median of frames spread over the flight (5 to 7 are enough; 3 consecutive ones are not).

    Parameters
    ----------
    frames : sequence of MotionFrame
        Registered frames of one shape, in time order.
    max_frames : int
        So many are used at most, evenly spread.
    min_frames : int
        A pixel that fewer frames cover has no background.

    Raises
    ------
    InputError
        Fewer frames than `min_frames`, or of several shapes.
    """
    if len(frames) < min_frames:
        raise InputError(
            f"a background needs {min_frames} registered frames or more, found {len(frames)}: mark one frame"
        )
    shapes = {frame.image.shape for frame in frames}
    if len(shapes) > 1:
        raise InputError(f"registered frames must be of one shape, found {sorted(shapes)}: warp them to one window")
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(max_frames, len(frames))).round().astype(int))
    ranked = median_background([frames[i].image for i in chosen], [frames[i].valid for i in chosen])
    return background_of(ranked.median, ranked.count >= min_frames)


def signed_motion(image: GreyImage, valid: Mask, background: MotionBackground) -> NDArray[np.float32]:
    """How far a registered frame is above (+) or below (-) the background's range, grey levels, blurred by 0.8 px.

    The sign tells a bright car from its own shadow, which is never brighter than the road.

    Parameters
    ----------
    image, valid : uint8 and bool (h, w)
        Frame on the background's grid.
    background : MotionBackground

    Returns
    -------
    float32 (h, w)
        0 where nothing moved and where frame or background are not known.
    """
    known = valid & background.valid
    level = image - _slow_offset(image.astype(np.float32) - background.median, known)
    outside = np.maximum(level - background.high, 0) - np.maximum(background.low - level, 0)
    outside[~known] = 0
    blurred = cv2.GaussianBlur(outside, (0, 0), _BLUR_SIGMA_PX)
    return np.where(known, blurred, np.float32(0))


def motion_difference(image: GreyImage, valid: Mask, background: MotionBackground) -> NDArray[np.float32]:
    """Distance of a registered frame outside the background's range, grey levels: the size of `signed_motion`."""
    return np.abs(signed_motion(image, valid, background))


def noise_sigma(image: GreyImage, valid: Mask, background: MotionBackground) -> float:
    """Standard deviation of frame minus background by the median absolute deviation, grey levels."""
    known = valid & background.valid
    if not known.any():
        return 0.0
    signed = (image.astype(np.int16) - background.median)[known][::7]
    return float(1.4826 * np.median(np.abs(signed - np.median(signed))))


def _slow_offset(signed: NDArray[np.float32], known: Mask) -> NDArray[np.float32]:
    """Exposure and vignetting: the median of each cell, which no car is large enough to move, interpolated."""
    height, width = signed.shape
    rows, columns = (max(1, round(side / _OFFSET_CELL_PX)) for side in (height, width))
    # Every fourth pixel is enough for a cell's median, and a sixteenth of the work.
    step = 4 if min(height, width) >= 4 * max(rows, columns) else 1
    thin, thin_known = signed[::step, ::step], known[::step, ::step]
    cells = np.zeros((rows, columns), np.float32)
    edges_y = np.linspace(0, thin.shape[0], rows + 1).astype(int)
    edges_x = np.linspace(0, thin.shape[1], columns + 1).astype(int)
    for i in range(rows):
        for j in range(columns):
            part = (slice(edges_y[i], edges_y[i + 1]), slice(edges_x[j], edges_x[j + 1]))
            values = thin[part][thin_known[part]]
            cells[i, j] = np.median(values) if values.size else 0
    smooth = cv2.blur(cells, (3, 3), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.resize(smooth, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
