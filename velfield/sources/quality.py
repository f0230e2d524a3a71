"""Defects of a frame, the bits of a column of ``frames.zarr``, from its pixels alone or within their sequence."""

from enum import IntFlag

import cv2
import numpy as np

from schemas.arrays import Float32Array, FloatArray, GreyImage, Mask


class FrameFlag(IntFlag):
    """Why a frame is not to be trusted; 0 where no defect is known."""

    SUSPECT = 1
    """The bitstream was corrupt here or since the last key frame: the image may be wrong."""
    UNREADABLE = 2
    """No image could be read; its pixels are zeros."""
    DUPLICATE = 4
    """The same image as the frame before, or the same time: no motion can be measured between the two."""
    BLACK = 8
    """Black, or without any detail."""
    BLURRED = 16
    """Far less sharp than its neighbours."""
    OUTLIER = 32
    """Correlates with neither neighbour, while those two correlate: it is not of the flight."""


UNUSABLE = FrameFlag(sum(FrameFlag))
"""A frame with any of these is in no tracklet."""


def describe_flags(flags: int) -> str:
    """Names of the bits that are set.

    Examples
    --------
    >>> describe_flags(9)
    'black, suspect'
    """
    return ", ".join(sorted(str(flag.name).lower() for flag in FrameFlag if flag & flags))


BLACK_LEVEL = 16.0
"""A frame whose 99th percentile is below this grey level is black."""
FLAT_SD = 2.0
"""A frame whose standard deviation is below this has nothing to register by."""


def is_black(grey: GreyImage) -> bool:
    """Whether a frame is black (a cap on the lens, a fade) or flat (fog): nothing can be registered by it."""
    count = np.bincount(grey[::4, ::4].ravel(), minlength=256)
    below, level = np.cumsum(count), np.arange(256)
    last = int(below[-1]) - 1
    # The 99th percentile lies between two of the sorted levels, as NumPy interpolates it.
    before, after = (int(np.searchsorted(below, k, side="right")) for k in (99 * last // 100, -(-99 * last // 100)))
    percentile = before + (after - before) * (0.99 * last - 99 * last // 100)
    mean = float(count @ level) / (last + 1)
    deviation = np.sqrt(float(count @ (level - mean) ** 2) / (last + 1))
    return bool(percentile < BLACK_LEVEL or deviation < FLAT_SD)


def is_duplicate(grey: GreyImage, previous: GreyImage) -> bool:
    """Whether two frames are the same image.

    Only equality to the grey level counts: the noise of a real sensor changes every frame, and a nearly still camera
    over nearly still traffic must not be taken for a frozen one.
    """
    if grey.shape != previous.shape:
        return False
    some = slice(None, None, 64)  # most frames differ everywhere
    return not any(np.any(cv2.absdiff(grey[rows], previous[rows]) > 1) for rows in (some, slice(None)))


def flag_blurred(sharpness: FloatArray) -> Mask:
    """Frames less than half as sharp (n,) as the median of the 15 frames about them; NaN where unreadable."""
    sharpness = np.asarray(sharpness, np.float64)
    if sharpness.size < 3:
        return np.zeros(sharpness.shape, np.bool_)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(sharpness, 7, constant_values=np.nan), 15)
    seen = np.isfinite(around).any(axis=1)
    usual = np.full(sharpness.shape, np.nan)
    usual[seen] = np.nanmedian(around[seen], axis=1)
    return np.asarray(sharpness < 0.5 * usual, np.bool_)


DARK_LEVEL = 30.0
"""Mean grey level below which a flight is reported as dark; daylight footage lies between 80 and 150."""
FAINT_SD, FAINT_SHARPNESS = 6.0, 2.5
"""Contrast of the thumbnails and sharpness below which, both, a flight is reported to be in fog."""
MAX_CUT_CORRELATION, MIN_SCENE_CORRELATION = 0.5, 0.7
"""Correlation of the thumbnails' detail across a cut at most, and within the scenes before and after it at least. Two
places share up to 0.4; the frames of a flight 0.84 and more."""
_LAYOUT_PX = 3.0
"""Standard deviation of the Gaussian that two places have in common, by a lens's vignetting and where a town lies
in the picture, px of a thumbnail: with it two simulated places of twenty share more than 0.5."""
_CUT_FRAMES = 5


def find_cuts(thumbnails: Float32Array) -> list[int]:
    """Frames from which on the thumbnails (n, 16, 16) of `frame_quality` are uncorrelated to those before."""
    flat = _detail(thumbnails)
    cuts: list[int] = []
    for k in range(2, len(flat) - 1):
        if _correlation(flat[k - 1], flat[k]) >= MAX_CUT_CORRELATION:
            continue
        before, after = flat[max(0, k - _CUT_FRAMES) : k], flat[k : k + _CUT_FRAMES]
        across = max(_correlation(one, other) for one in before for other in after)
        within = min(_correlation(part[0], part[-1]) for part in (before, after))
        if across < MAX_CUT_CORRELATION and within >= MIN_SCENE_CORRELATION:
            cuts.append(k)
    return cuts


def _detail(thumbnails: Float32Array) -> FloatArray:
    """(n, 256) of thumbnails (n, 16, 16), without what is smooth over the picture."""
    fine = np.array(
        [t - cv2.GaussianBlur(t, (0, 0), _LAYOUT_PX, borderType=cv2.BORDER_REFLECT) for t in thumbnails], np.float64
    )
    return fine.reshape(len(thumbnails), -1)


def _correlation(one: FloatArray, other: FloatArray) -> float:
    norm = float(np.linalg.norm(one) * np.linalg.norm(other))
    return float(one @ other) / norm if norm > 0 else 0.0


def describe_light(brightness: FloatArray, contrast: FloatArray, sharpness: FloatArray) -> list[str]:
    """Describe what the light of a flight makes uncertain, one line each; arguments (n,) for its usable frames.

    Examples
    --------
    >>> describe_light(np.full(3, 12.0), np.full(3, 20.0), np.full(3, 9.0))
    ['the flight is dark (mean grey level 12, 30 or more expected): vehicles without contrast to the road are missed']
    >>> describe_light(np.full(3, 110.0), np.full(3, 30.0), np.full(3, 12.0))
    []
    """
    if not brightness.size:
        return []
    found = []
    level = float(np.nanmedian(brightness))
    if level < DARK_LEVEL:
        found.append(
            f"the flight is dark (mean grey level {level:.0f}, {DARK_LEVEL:.0f} or more expected): vehicles without "
            "contrast to the road are missed"
        )
    elif float(np.nanmedian(contrast)) < FAINT_SD and float(np.nanmedian(sharpness)) < FAINT_SHARPNESS:
        found.append(
            f"the flight has little contrast (sharpness {float(np.nanmedian(sharpness)):.1f} grey levels, "
            f"{FAINT_SHARPNESS:g} or more expected), as in fog: registration and detection are less certain"
        )
    return found


def flag_outlier_frames(thumbnails: Float32Array) -> Mask:
    """Frames whose thumbnails (n, 16, 16) correlate with neither neighbour, while those two do with each other."""
    count = len(thumbnails)
    outlier = np.zeros(count, np.bool_)
    flat = _detail(thumbnails)
    norm = np.linalg.norm(flat, axis=1, keepdims=True)
    unit = np.divide(flat, norm, out=np.zeros_like(flat), where=norm > 0)
    if count >= 3:
        step = np.einsum("ij,ij->i", unit[:-1], unit[1:])
        across = np.einsum("ij,ij->i", unit[:-2], unit[2:])
        same_scene = across > MIN_SCENE_CORRELATION
        outlier[1:-1] = (np.maximum(step[:-1], step[1:]) < MAX_CUT_CORRELATION) & same_scene
    return outlier
