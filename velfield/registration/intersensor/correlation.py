"""Normalised cross-correlation of patches on a grid: the displacement between two images to subpixel accuracy.

Paper: inter-sensor registration. Points every 50 px, patches of 75 x 75, the maximum of the normalised correlation
within a search window. Images are compared in a `Modality`, because grey levels of two sensors differ.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from schemas.arrays import FloatArray, GreyImage, Mask
from velfield.registration.intersensor.modality import INTENSITY, Modality

_MIN_CONTRAST = 2.0
_MIN_COVERAGE = 0.9


@dataclass(frozen=True)
class GridMatches:
    """Matches at grid points: ``points`` (n, 2) px, ``displacement`` (n, 2) px, ``score`` (n,) peak correlation."""

    points: FloatArray
    displacement: FloatArray
    score: FloatArray


def match_grid(
    moving: GreyImage,
    mask: Mask,
    reference: GreyImage,
    *,
    spacing_px: int,
    patch_px: int,
    radius_px: int,
    modality: Modality = INTENSITY,
) -> GridMatches:
    """Locate patches of a moving image (h, w) uint8, valid in a mask, in a reference image on the same grid.

    The side of the patches is rounded up to an odd number. Displacements point from a position in the moving image to
    the matching one in the reference; one of ``radius_px``, at the border of the search window, is rejected.
    """
    half = patch_px // 2
    height, width = reference.shape
    ys = np.arange(half, height - half, spacing_px)
    xs = np.arange(half, width - half, spacing_px)
    coverage = cv2.boxFilter(mask.astype(np.float32), -1, (2 * half + 1, 2 * half + 1), borderType=cv2.BORDER_CONSTANT)
    moving, reference = modality.transform(moving), modality.transform(reference)
    rows = []
    for y in ys:
        for x in xs:
            if coverage[y, x] < _MIN_COVERAGE:
                continue
            patch = moving[y - half : y + half + 1, x - half : x + half + 1]
            if patch.std() < _MIN_CONTRAST:
                continue
            top, left = max(y - half - radius_px, 0), max(x - half - radius_px, 0)
            window = reference[top : y + half + radius_px + 1, left : x + half + radius_px + 1]
            peak = _find_peak(patch, window, modality.sign)
            if peak is not None:
                dx, dy, score = peak
                rows.append((x, y, left + dx - (x - half), top + dy - (y - half), score))
    table = np.array(rows, dtype=np.float64).reshape(-1, 5)
    return GridMatches(table[:, :2], table[:, 2:4], table[:, 4])


def _find_peak(patch: GreyImage, window: GreyImage, sign: float) -> tuple[float, float, float] | None:
    """Subpixel offset (x, y) of the correlation peak and its height; None at the border or in a flat window."""
    if window.std() < _MIN_CONTRAST:
        return None
    scores = sign * cv2.matchTemplate(window, patch, cv2.TM_CCOEFF_NORMED)
    _, height, _, (x, y) = cv2.minMaxLoc(scores)
    if not (0 < x < scores.shape[1] - 1 and 0 < y < scores.shape[0] - 1) or not np.isfinite(height):
        return None
    dx = parabola_vertex(scores[y, x - 1], scores[y, x], scores[y, x + 1])
    dy = parabola_vertex(scores[y - 1, x], scores[y, x], scores[y + 1, x])
    return x + dx, y + dy, float(height)


def parabola_vertex(before: float, middle: float, after: float) -> float:
    """Abscissa of the maximum of the parabola through three values at -1, 0, 1; 0 if there is no maximum."""
    curvature = float(before) - 2.0 * float(middle) + float(after)
    return 0.0 if curvature >= 0 else 0.5 * (float(before) - float(after)) / curvature
