"""A flight in which nobody labelled a car: labels from motion to train on, and detections that move to evaluate by."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from schemas.detector import DetectorConfig
from velfield.detection.detector import Detector, train_detector
from velfield.detection.evaluation import to_curve_record
from velfield.detection.motion.difference import MotionBackground, MotionFrame
from velfield.detection.motion.evaluation import MotionEvaluation, evaluate_detector, select_bursts
from velfield.detection.motion.labels import MotionLabels
from velfield.detection.samples import LabelledImage

_FRAMES = 6
"""Labelled frames to train on, spread over the flight: more of them show the same cars on the same ground."""
_BURSTS = 6
_DESCRIPTION = "detections in bursts of three frames: those that move along their axis, against isolated ones"

AnyDetector = TypeVar("AnyDetector", bound=Detector)


@dataclass(frozen=True)
class UnlabelledFlight:
    """Registered frames on the working grid, with their labels from motion.

    Attributes
    ----------
    frames, labels : the frames, in time order, and the labels from motion of each.
    background : temporal median of the flight.
    max_interval_s : frames farther apart than this are no neighbours.
    """

    frames: Sequence[MotionFrame]
    labels: MotionLabels
    background: MotionBackground
    max_interval_s: float

    def samples(self, count: int = _FRAMES) -> list[LabelledImage]:
        """So many labelled frames, spread over the flight."""
        labelled = [
            pair for pair in zip(self.frames, self.labels.frames, strict=True) if pair[1].labelled and len(pair[1].cars)
        ]
        chosen = np.unique(np.linspace(0, len(labelled) - 1, min(count, len(labelled))).round().astype(int))
        return [
            LabelledImage(
                image=frame.image,
                valid=frame.valid & self.background.valid,
                background=self.background.median,
                cars=label.cars,
                ignore=label.ignore,
                complete=False,
            )
            for frame, label in (labelled[k] for k in chosen)
        ]

    def bursts(self) -> list[MotionFrame]:
        """Bursts of three frames, in which detections can be seen to move."""
        chosen = select_bursts([frame.time_s for frame in self.frames], _BURSTS, self.max_interval_s)
        return [self.frames[k] for k in chosen]

    def train(self, config: DetectorConfig) -> Detector:
        """A detector trained on labels from motion, its score threshold from cars held out of them."""
        return train_detector(self.samples(), config)

    def evaluate(self, detector: Detector) -> MotionEvaluation:
        """Precision and recall of a detector from how its detections move."""
        background = self.background.median if detector.uses_background else None
        return evaluate_detector(detector, self.bursts(), background, max_interval_s=self.max_interval_s)

    def calibrate(self, detector: AnyDetector, config: DetectorConfig) -> AnyDetector:
        """The detector with the score threshold that motion gives, where the configuration sets none."""
        if config.threshold is not None:
            return detector
        return with_motion_threshold(detector, self.evaluate(detector))


def with_motion_threshold(detector: AnyDetector, evaluation: MotionEvaluation) -> AnyDetector:
    """The detector with the threshold at which its detections move as cars do; unchanged where too few move."""
    threshold = evaluation.operating_threshold
    if not np.isfinite(threshold):
        return detector
    curve = to_curve_record(
        evaluation.precision, evaluation.recall, evaluation.thresholds, evaluation.operating_index, _DESCRIPTION
    )
    return detector.with_threshold(threshold, curve)
