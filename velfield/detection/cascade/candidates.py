"""Places where a car may be, at high recall and with no training: extrema of a difference of Gaussians."""

import cv2
import numpy as np
from numpy.typing import NDArray

FINE_SIGMA_PX, COARSE_SIGMA_PX = 2.5, 4.0
PER_MEGAPIXEL = 5000


def candidate_places(
    image: NDArray[np.uint8], valid: NDArray[np.bool_] | None = None, *, per_megapixel: float = PER_MEGAPIXEL
) -> NDArray[np.float64]:
    """The strongest extrema of the DoG of 16 sqrt(grey), bright or dark.

    Returns
    -------
    (n, 2) working px, strongest first.
    """
    root = 16 * np.sqrt(image.astype(np.float32))
    dog = np.abs(cv2.GaussianBlur(root, (0, 0), FINE_SIGMA_PX) - cv2.GaussianBlur(root, (0, 0), COARSE_SIGMA_PX))
    peak = dog >= cv2.dilate(dog, np.ones((3, 3), np.uint8))
    peak &= dog > 0.05
    if valid is not None:
        peak &= valid
    y, x = np.nonzero(peak)
    count = int(per_megapixel * image.size / 1e6) + 1
    order = np.argsort(-dog[y, x], kind="stable")[:count]
    return np.column_stack([x[order], y[order]]).astype(np.float64)
