"""The boosted cascade as a detector: region proposals, then a boosted classifier of crops rotated to the car's axis."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from schemas.arrays import GreyImage, Mask
from schemas.detector import CascadeConfig, CascadeRecord
from velfield.detection.boosting import BoostedStumps
from velfield.detection.cascade.classifier import (
    PoseScorer,
    classify_proposals,
    propose_regions,
    suppress_and_centre,
)
from velfield.detection.cascade.feature_image import COARSE, compute_features
from velfield.detection.cascade.fitting import train_cascade
from velfield.detection.cascade.training import CONTRAST_FLOOR
from velfield.detection.detector import Detections, Detector
from velfield.detection.frame import SearchableFrame, whole_frame
from velfield.detection.orientation import CAR_ASPECT
from velfield.detection.samples import LabelledImage
from velfield.detection.unlabelled import UnlabelledFlight, with_motion_threshold
from velfield.errors import InputError

_WEAK_MARGIN = 0.5
"""Of the difference between a typical car's score and the threshold."""


@dataclass(frozen=True)
class CascadeDetector(Detector):
    """Region proposals and their classification, each by AdaBoost with decision stumps on sums of rectangles."""

    record: CascadeRecord
    method: ClassVar[str] = "cascade"

    @cached_property
    def classifier(self) -> BoostedStumps:
        """The classifier of the proposals."""
        return BoostedStumps.from_rounds(self.record.rounds)

    @cached_property
    def proposer(self) -> BoostedStumps:
        """The coarse classifier that proposes regions."""
        return BoostedStumps.from_rounds(self.record.proposer.rounds)

    @property
    def uses_background(self) -> bool:
        """Whether any round reads the channel |frame - background|."""
        return any(one.channel == 3 for one in self.record.rounds)

    @property
    def weak_margin(self) -> float:
        """A part of what lies between the threshold and a typical car's score."""
        above = _median_car_score(self) - self.threshold
        return _WEAK_MARGIN * max(above, 0.0) if np.isfinite(above) else 0.0

    def detect(
        self,
        image: GreyImage,
        valid: Mask | None = None,
        background: GreyImage | None = None,
        *,
        threshold: float | None = None,
    ) -> Detections:
        """Detect cars: proposals, the classifier on them, non-maximum suppression, long vehicles centred."""
        found = self.find(image, valid, background, threshold=threshold)
        return self.refine(whole_frame(image, valid), found)

    def find(
        self,
        image: GreyImage,
        valid: Mask | None = None,
        background: GreyImage | None = None,
        *,
        threshold: float | None = None,
    ) -> Detections:
        """Proposals that the classifier scores above the threshold."""
        record, ground = self.record, background if self.uses_background else None
        proposals = propose_regions(
            compute_features(image, ground, COARSE),
            image.shape,
            valid,
            self.proposer,
            contrast_floor=record.contrast_floor,
            min_score=record.proposer.min_score,
        )
        rows = classify_proposals(
            PoseScorer(compute_features(image, ground), self.classifier, record.contrast_floor),
            proposals,
            min_score=self.threshold if threshold is None else threshold,
            min_stage1_score=record.proposer.min_stage1_score,
        )
        length_px = record.working_car_length_px
        return Detections.from_rows(rows, np.full(len(rows), length_px * length_px * CAR_ASPECT))

    def refine(self, frame: SearchableFrame, found: Detections, kept: Detections | None = None) -> Detections:
        """Non-maximum suppression; long vehicles centred."""
        return suppress_and_centre(frame, found, kept, self.record.working_car_length_px)

    @classmethod
    def train(
        cls, samples: Sequence[LabelledImage], config: CascadeConfig, *, base: Detector | None = None
    ) -> "CascadeDetector":
        """Train the proposals' and the crops' classifier; with a base, the ensemble of both."""
        has_background = config.motion_channel != "never" and all(sample.background is not None for sample in samples)
        if base is not None:
            _check_base(base, config, has_background=has_background)
        earlier = base.record if isinstance(base, CascadeDetector) else None
        return cls(train_cascade(samples, config, earlier, has_background=has_background))

    @classmethod
    def train_from_motion(cls, flight: UnlabelledFlight, config: CascadeConfig) -> Detector:
        """By appearance alone where that is sufficient, else with the difference to the background."""
        by_appearance = cls.train_by_appearance(flight, config)
        return flight.calibrate(flight.train(config), config) if by_appearance is None else by_appearance

    @classmethod
    def train_by_appearance(cls, flight: UnlabelledFlight, config: CascadeConfig) -> Detector | None:
        """A cascade that reads no background, so that it detects stationary cars as well.

        By the difference to the background a car that waits at a light for long, and so is in the background, is not
        detected: on a simulated city recall of the cars that move at some time was 0.79, by appearance 0.91.

        Returns
        -------
        None where ``motion_channel`` forces or forbids the background, or appearance is not sufficient.
        """
        if config.motion_channel != "auto":
            return None
        detector = flight.train(config.model_copy(update={"motion_channel": "never"}))
        evaluation = flight.evaluate(detector)
        if not evaluation.appearance_is_sufficient(_median_car_score(detector)):
            return None
        return detector if config.threshold is not None else with_motion_threshold(detector, evaluation)


def _median_car_score(detector: Detector) -> float:
    """Median score of held-out cars; infinite where half of them were not detected at all."""
    curve = detector.curve
    if curve is None or not curve.recall or curve.recall[-1] < 0.5:
        return float("inf")
    return float(np.interp(0.5, curve.recall, curve.threshold))


def _check_base(base: Detector, config: CascadeConfig, *, has_background: bool) -> None:
    """Raise InputError where a detector cannot vote together with a new one."""
    record = base.record
    if (
        not isinstance(record, CascadeRecord)
        or record.contrast_floor != CONTRAST_FLOOR
        or (base.uses_background and not has_background)
    ):
        raise InputError(
            f"found a detector of method {record.method} {'with' if base.uses_background else 'without'} a background "
            "channel to continue, expected one of method cascade without; train from scratch, without --continue"
        )
    base.check_car_length(config.working_car_length_px)


DETECTOR = CascadeDetector
