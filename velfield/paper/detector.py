"""The paper's detector: a dense response, blurred, and regions grown from its maxima (paper: car detection)."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

from schemas.arrays import GreyImage, Mask
from schemas.detector import PaperConfig, PaperRecord
from velfield.detection.interface import Detections, Detector
from velfield.detection.samples import LabelledImage
from velfield.errors import InputError
from velfield.paper.response import dense_response
from velfield.paper.segmentation import region_moments, segment_response
from velfield.paper.stumps import BoostedStumps
from velfield.paper.training import train_paper


@dataclass(frozen=True)
class PaperDetector(Detector):
    """AdaBoost over decision stumps on sums of rectangles, evaluated at every pixel of the upright image."""

    record: PaperRecord
    method: ClassVar[str] = "paper"

    @cached_property
    def stumps(self) -> BoostedStumps:
        """Its classifier."""
        return BoostedStumps.from_rounds(self.record.rounds)

    def detect(self, image: GreyImage, valid: Mask | None = None, *, threshold: float | None = None) -> Detections:
        """Detect cars: regions where the blurred response exceeds the threshold, their mean and covariance."""
        response = dense_response(image, self.stumps, grey_bits=self.record.grey_bits)
        if valid is not None:
            response[~valid] = response.min(initial=0.0)
        smooth, labels = segment_response(
            response,
            sigma_px=self.record.response_sigma_px,
            threshold=self.threshold if threshold is None else threshold,
            min_region_px=self.record.min_region_px,
        )
        regions = region_moments(labels, smooth)
        return Detections.from_rows(regions[:, :5], regions[:, 5])

    @classmethod
    def train(
        cls, samples: Sequence[LabelledImage], config: PaperConfig, *, base: Detector | None = None
    ) -> "PaperDetector":
        """Train from scratch: the paper does not continue a detector."""
        if base is not None:
            raise InputError(
                f"found a detector of method {base.method} to continue, expected one of method cnn: the "
                "paper's is trained from scratch; leave --continue out"
            )
        return cls(train_paper(samples, config))


DETECTOR = PaperDetector
