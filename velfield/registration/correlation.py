"""Normalised cross-correlation of patches on a grid: where a moving picture lies on a reference one, below the pixel.

Paper: inter-sensor registration. Points every 50 px, patches of 75 x 75, the best normalised correlation within a
window. Tones of two sensors differ, even in sign; so pictures are compared by one of three looks, and the caller tries
them.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from schemas.arrays import FloatArray, GreyImage, Mask

Look = Literal["tones", "inverted", "edges"]
"""How two pictures are compared: by grey, by grey with its sign turned, or by steepness."""

_LEAST_CONTRAST = 2.0
_LEAST_COVER = 0.9


@dataclass(frozen=True)
class GridMatches:
    """Matches at grid points: ``points`` (n, 2) px, ``displacement`` (n, 2) px, ``score`` (n,) the peak's height."""

    points: FloatArray
    displacement: FloatArray
    score: FloatArray


def seen_as(grey: GreyImage, look: Look) -> GreyImage:
    """The picture as a look sees it: its grey, or its steepness."""
    if look != "edges":
        return grey
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0).astype(np.float32)
    steepness = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    # The root: a few roofs must not outweigh all the rest.
    return np.asarray(np.clip(np.sqrt(steepness) * 8.0, 0, 255), dtype=np.uint8)


def match_grid(
    moving: GreyImage,
    mask: Mask,
    reference: GreyImage,
    *,
    spacing_px: int,
    patch_px: int,
    radius_px: int,
    look: Look = "tones",
) -> GridMatches:
    """Where patches of a moving picture lie on a reference picture of the same grid.

    Parameters
    ----------
    moving, mask
        (h, w) uint8 picture and where it has a value.
    reference
        (h, w) uint8.
    spacing_px
        Distance of the grid's points.
    patch_px
        Side of the patches; made odd.
    radius_px
        Farthest displacement searched. A peak on the border is none.
    look
        How the pictures are compared.

    Returns
    -------
    GridMatches
        ``displacement`` leads from a place in the moving picture to the same place in the reference.
    """
    half = patch_px // 2
    height, width = reference.shape
    ys = np.arange(half, height - half, spacing_px)
    xs = np.arange(half, width - half, spacing_px)
    cover = cv2.boxFilter(mask.astype(np.float32), -1, (2 * half + 1, 2 * half + 1), borderType=cv2.BORDER_CONSTANT)
    moving, reference = seen_as(moving, look), seen_as(reference, look)
    rows = []
    for y in ys:
        for x in xs:
            if cover[y, x] < _LEAST_COVER:
                continue
            patch = moving[y - half : y + half + 1, x - half : x + half + 1]
            if patch.std() < _LEAST_CONTRAST:
                continue
            top, left = max(y - half - radius_px, 0), max(x - half - radius_px, 0)
            window = reference[top : y + half + radius_px + 1, left : x + half + radius_px + 1]
            found = _peak(patch, window, -1.0 if look == "inverted" else 1.0)
            if found is not None:
                dx, dy, score = found
                rows.append((x, y, left + dx - (x - half), top + dy - (y - half), score))
    table = np.array(rows, dtype=np.float64).reshape(-1, 5)
    return GridMatches(table[:, :2], table[:, 2:4], table[:, 4])


def _peak(patch: GreyImage, window: GreyImage, sign: float) -> tuple[float, float, float] | None:
    """Offset (x, y) of the best correlation, by parabolas, and its height; None on the border or in a flat window."""
    if window.std() < _LEAST_CONTRAST:
        return None
    scores = sign * cv2.matchTemplate(window, patch, cv2.TM_CCOEFF_NORMED)
    _, height, _, (x, y) = cv2.minMaxLoc(scores)
    if not (0 < x < scores.shape[1] - 1 and 0 < y < scores.shape[0] - 1) or not np.isfinite(height):
        return None
    dx = _vertex(scores[y, x - 1], scores[y, x], scores[y, x + 1])
    dy = _vertex(scores[y - 1, x], scores[y, x], scores[y + 1, x])
    return x + dx, y + dy, float(height)


def _vertex(before: float, middle: float, after: float) -> float:
    """Where, in (-1, 1) about the middle, the parabola through three equidistant values is highest."""
    bend = float(before) - 2.0 * float(middle) + float(after)
    return 0.0 if bend >= 0 else 0.5 * (float(before) - float(after)) / bend
