"""Modalities: what inter-sensor registration correlates in place of grey levels, which differ between two sensors.

The coarse search, the grid matching and the verification loop over the one table `MODALITIES`. For another kind of base
image (thermal, SAR) add an entry: a transform to apply to both images, and the sign of their correlation.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from schemas.arrays import GreyImage

Transform = Callable[[GreyImage], GreyImage]


@dataclass(frozen=True)
class Modality:
    """A representation in which two images are compared by normalised cross-correlation."""

    name: str
    """As in messages."""
    transform: Transform
    """Applied to both images, (h, w) uint8 to (h, w) uint8."""
    sign: float = 1.0
    """Of the correlation; -1 where what is bright in one image is dark in the other."""
    sift_transform: Transform | None = None
    """Applied to the frame alone before its SIFT features are matched to those of the base image; None: no SIFT
    candidate of this modality's own."""


def identity(grey: GreyImage) -> GreyImage:
    """The image itself."""
    return grey


def invert(grey: GreyImage) -> GreyImage:
    """The negative of an image."""
    return np.asarray(np.bitwise_not(grey), dtype=np.uint8)


def gradient_magnitude(grey: GreyImage) -> GreyImage:
    """Square root of the gradient magnitude after a blur of 1 px; the root keeps a few roofs from dominating."""
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0).astype(np.float32)
    magnitude = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    return np.asarray(np.clip(np.sqrt(magnitude) * 8.0, 0, 255), dtype=np.uint8)


INTENSITY = Modality("intensity", identity, sift_transform=identity)
INVERTED = Modality("inverted", identity, sign=-1.0, sift_transform=invert)
GRADIENT = Modality("gradient", gradient_magnitude)
"""Edges are what two sensors share most exactly: the last refinement uses them, whatever modality came first."""

MODALITIES: dict[str, Modality] = {modality.name: modality for modality in (INTENSITY, INVERTED, GRADIENT)}
"""The modalities that are tried, in order."""
