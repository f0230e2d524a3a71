"""What differs from the background moves, and needs to be liked less to be taken for a car."""

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.detector import MotionRecord
from velfield.detection.orientation import at_places

Floats = NDArray[np.float64]
Grey = NDArray[np.uint8]


def difference_about(image: Grey, background: Grey, xy: Floats, car_length_px: float) -> Floats:
    """How much a frame differs from the background about (n, 2) places: mean under a fifth of a car, grey levels."""
    off = cv2.absdiff(image, background).astype(np.float32)
    return at_places(cv2.GaussianBlur(off, (0, 0), car_length_px / 5), xy)


def lift_of(motion: MotionRecord, difference: Floats) -> Floats:
    """What finds are liked more for differing from the background so much."""
    share = (difference - motion.still_grey) / (motion.moving_grey - motion.still_grey)
    return motion.lift * np.clip(share, 0.0, 1.0)
