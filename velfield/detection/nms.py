"""Non-maximum suppression of oriented rectangles."""

import numpy as np

from schemas.arrays import FloatArray, Mask
from velfield.compiled import kernel
from velfield.detection.orientation import CAR_ASPECT

_NMS_ALONG, _NMS_ACROSS = 0.66, 0.4
"""Semi-axes, in car lengths, of the ellipse about a detection in which others are suppressed."""
_MAX_OVERLAP = 0.25
"""A detection is suppressed where better ones cover more than this fraction of its rectangle."""
_SPOTS_ALONG, _SPOTS_ACROSS = 12, 5
"""Sample points of a rectangle."""


def nms_oriented(cars: FloatArray, car_length_px: float) -> FloatArray:
    """Non-maximum suppression of oriented rectangles (n, 4...) as x, y, axis, score; the best first.

    A detection is suppressed by a better one whose centre is near, or by several that cover it together. In a queue the
    classifier detects the gap between two cars as well, a boot and a bonnet: such a detection overlaps both, and is too
    far from each to be suppressed by its centre.
    """
    cars = np.ascontiguousarray(cars[np.argsort(-cars[:, 3], kind="stable")])
    return np.asarray(cars[_survivors(cars, car_length_px, CAR_ASPECT * car_length_px)])


@kernel
def _survivors(cars: FloatArray, length: float, width: float) -> Mask:
    """Mask (n,) of the cars that are not suppressed; the cars are sorted by score, best first."""
    kept = np.zeros(len(cars), np.bool_)
    covered = np.empty(_SPOTS_ALONG * _SPOTS_ACROSS, np.bool_)
    for i in range(len(cars)):
        c, s = np.cos(cars[i, 2]), np.sin(cars[i, 2])
        covered[:] = False
        alone = True
        for j in range(i):
            dx, dy = cars[i, 0] - cars[j, 0], cars[i, 1] - cars[j, 1]
            if not kept[j] or dx * dx + dy * dy > (length + width) ** 2:
                continue
            cj, sj = np.cos(cars[j, 2]), np.sin(cars[j, 2])
            u, v = dx * cj + dy * sj, dy * cj - dx * sj
            if (u / (_NMS_ALONG * length)) ** 2 + (v / (_NMS_ACROSS * length)) ** 2 < 1:
                alone = False
                break
            for k in range(len(covered)):
                a = ((k // _SPOTS_ACROSS + 0.5) / _SPOTS_ALONG - 0.5) * length
                b = ((k % _SPOTS_ACROSS + 0.5) / _SPOTS_ACROSS - 0.5) * width
                x, y = dx + a * c - b * s, dy + a * s + b * c
                if abs(x * cj + y * sj) < length / 2 and abs(y * cj - x * sj) < width / 2:
                    covered[k] = True
        kept[i] = alone and covered.mean() < _MAX_OVERLAP
    return kept
