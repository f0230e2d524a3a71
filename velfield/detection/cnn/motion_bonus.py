"""What differs from the background moves, and needs to be liked less to be taken for a car."""

import cv2
import numpy as np

from schemas.arrays import FloatArray, GreyImage
from schemas.detector import MotionRecord
from velfield.detection.orientation import at_places


def difference_about(image: GreyImage, background: GreyImage, xy: FloatArray, car_length_px: float) -> FloatArray:
    """How much a frame differs from the background about (n, 2) places: mean under a fifth of a car, grey levels."""
    off = cv2.absdiff(image, background).astype(np.float32)
    return at_places(cv2.GaussianBlur(off, (0, 0), car_length_px / 5), xy)


def lift_of(motion: MotionRecord, difference: FloatArray) -> FloatArray:
    """What finds are liked more for differing from the background so much."""
    share = (difference - motion.still_grey) / (motion.moving_grey - motion.still_grey)
    return motion.lift * np.clip(share, 0.0, 1.0)
