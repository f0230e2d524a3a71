"""The convolutional network as a detector: pre-trained, and fine-tuned on labelled cars."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from schemas.arrays import GreyImage, IntArray, Mask
from schemas.detector import CnnConfig, CnnRecord, DetectorConfig
from velfield.detection.cnn.brightness import brighten, brighten_by_itself, gamma_of
from velfield.detection.cnn.fine_tuning import fine_tune
from velfield.detection.cnn.graph import network_from_record
from velfield.detection.cnn.inference import BORDER_PX, Predictor
from velfield.detection.cnn.model import detect_cars
from velfield.detection.cnn.network import Network
from velfield.detection.cnn.quantization import INEXACT, calibrate, is_exact
from velfield.detection.interface import Detections, Detector
from velfield.detection.nms import nms_oriented
from velfield.detection.orientation import CAR_ASPECT
from velfield.detection.runtime import current_device, device_limitations, uses_cuda
from velfield.detection.samples import LabelledImage
from velfield.errors import InputError

_WEAK_MARGIN = 0.2
"""Below the threshold: in a simulated city a fifth more candidates, among them most cars that are not detected."""


@dataclass(frozen=True)
class CnnDetector(Detector):
    """A fully convolutional network: a heatmap of car centres, and the axis at every cell."""

    record: CnnRecord
    method: ClassVar[str] = "cnn"
    context_px: ClassVar[int] = 16
    box_cost_px: ClassVar[int] = 2000

    @cached_property
    def network(self) -> Network:
        """Its weights."""
        return network_from_record(self.record.onnx)

    @cached_property
    def predictor(self) -> Predictor:
        """The network where it is run."""
        return Predictor(self.network, self.record.activation_ranges)

    def in_light_of(self, images: Sequence[GreyImage]) -> "CnnDetector":
        """With the exponent that brightens these images."""
        gamma = gamma_of(np.concatenate([image.ravel() for image in images])) if images else None
        return CnnDetector(self.record.model_copy(update={"gamma": gamma}))

    def for_flight(self, images: Sequence[GreyImage], config: DetectorConfig) -> "CnnDetector":
        """With the ranges of the activations on these images, so that it can be run in 8 bits."""
        wanted = isinstance(config, CnnConfig) and config.precision == "int8"
        ranges = calibrate(self.network, [self._brighten(image) for image in images]) if wanted else None
        return CnnDetector(self.record.model_copy(update={"activation_ranges": ranges}))

    @property
    def limitations(self) -> list[str]:
        """A GPU that does not start."""
        return device_limitations(current_device())

    @property
    def notes(self) -> list[str]:
        """That this processor has no exact sums of products of 8 bits: results are right, and take longer."""
        wanted = self.record.activation_ranges is not None and not uses_cuda(current_device())
        return [INEXACT] if wanted and not is_exact() else []

    @property
    def weak_margin(self) -> float:
        """In terms of probability."""
        return _WEAK_MARGIN

    def detect(self, image: GreyImage, valid: Mask | None = None, *, threshold: float | None = None) -> Detections:
        """Detect cars: peaks of the heatmap, non-maximum suppression."""
        return self.refine(self._find(image, valid, threshold, border_px=BORDER_PX))

    def find(self, image: GreyImage, valid: Mask | None = None, *, threshold: float | None = None) -> Detections:
        """Peaks of the heatmap above the threshold."""
        return self._find(image, valid, threshold)

    def find_in_crops(
        self,
        image: GreyImage,
        valid: Mask | None,
        crops: IntArray,
        *,
        threshold: float | None = None,
    ) -> Detections:
        """The network run on each crop by itself, those of one size at once; its heatmaps are searched together."""
        return self._find(image, valid, threshold, crops=crops)

    def _find(
        self,
        image: GreyImage,
        valid: Mask | None,
        threshold: float | None,
        *,
        border_px: int = 0,
        crops: IntArray | None = None,
    ) -> Detections:
        length_px, seen = self.record.working_car_length_px, self._brighten(image, valid)
        rows = detect_cars(self.predictor, seen, valid, border_px=border_px, crops=crops)
        above = rows[rows[:, 3] > (self.threshold if threshold is None else threshold)] if len(rows) else rows
        return Detections.from_rows(above, np.full(len(above), length_px * length_px * CAR_ASPECT), above[:, 5:])

    def _brighten(self, image: GreyImage, valid: Mask | None = None) -> GreyImage:
        gamma = self.record.gamma
        return brighten_by_itself(image, valid) if gamma is None else brighten(image, gamma)

    def refine(self, found: Detections, kept: Detections | None = None) -> Detections:
        """Non-maximum suppression."""
        rows = nms_oriented(super().refine(found, kept).to_rows(), self.record.working_car_length_px)
        return Detections.from_all(rows)

    @classmethod
    def train(cls, samples: Sequence[LabelledImage], config: CnnConfig, *, base: Detector | None = None) -> Detector:
        """Fine-tune the base."""
        if not isinstance(base, CnnDetector):
            found = "nothing" if base is None else f"a detector of method {base.method}"
            raise InputError(f"found {found} to continue, expected a detector of method cnn; omit --continue")
        base.check_car_length(config.working_car_length_px)
        return cls(fine_tune(samples, base.network, base.record, config))


DETECTOR = CnnDetector
