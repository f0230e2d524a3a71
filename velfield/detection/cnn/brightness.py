"""Grey levels as the network sees them: a dark flight is brightened by one exponent, as a longer exposure would.

A dark car on dark asphalt differs from it by few grey levels; a power below one spreads these.
"""

from dataclasses import replace

import cv2
import numpy as np

from schemas.arrays import ByteArray, GreyImage, Mask
from velfield.detection.samples import LabelledImage

USUAL_MEDIAN = 0.7
"""Median grey, of 1, that darker images are brought to. Brighter ones stay: haze is no better for being darkened."""
MIN_GAMMA = 0.3


def gamma_of(grey: ByteArray) -> float:
    """Exponent that brings grey levels of any shape to the usual median; 1 where they are as bright already.

    Examples
    --------
    >>> round(gamma_of(np.full((4, 4), 125, np.uint8)), 2), gamma_of(np.full(4, 200, np.uint8))
    (0.5, 1.0)
    """
    counts = np.bincount(grey.ravel(), minlength=256)
    median = np.searchsorted(np.cumsum(counts), counts.sum() / 2) / 255
    return float(np.clip(np.log(USUAL_MEDIAN) / np.log(np.clip(median, 1 / 255, 254 / 255)), MIN_GAMMA, 1.0))


def brighten(image: GreyImage, gamma: float) -> GreyImage:
    """An image (h, w) with its grey levels, as fractions of 255, raised to a power."""
    levels = np.rint(255 * (np.arange(256) / 255) ** gamma).astype(np.uint8)
    return np.asarray(cv2.LUT(image, levels), np.uint8)


def brighten_by_itself(image: GreyImage, valid: Mask | None = None) -> GreyImage:
    """An image (h, w) as its own grey levels ask for, those where it is ``valid``."""
    return brighten(image, gamma_of(image if valid is None else image[valid]))


def brighten_sample(sample: LabelledImage) -> LabelledImage:
    """A labelled image as the network is to see it."""
    return replace(sample, image=brighten_by_itself(sample.image, sample.valid))
