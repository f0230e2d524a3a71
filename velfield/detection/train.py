"""Training of a detector: both steps of the aligned method, or the paper's dense one; T from held-out evidence."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from schemas.detector import DetectorRecord, PrecisionRecallCurve, Proposer, Round
from schemas.flight import DetectionConfig
from velfield.detection.dense import train_densely
from velfield.detection.detector import Detector, sums_of
from velfield.detection.learning import CONTRAST_FLOOR, learn_classifier, learn_proposer
from velfield.detection.samples import LabelledImage, Scene, part_of, scene_of
from velfield.detection.scan import propose
from velfield.detection.validation import Evidence, curve_of, cut_of, evidence_of_part, joined, stripes
from velfield.errors import InputError

__all__ = ["LabelledImage", "train_detector"]

MIN_CARS = 8
"""Fewer marked cars than this do not train a detector."""
_FOLD_MIN_CARS = 16
_FOLD_SCENES = 3
"""Pictures that the folds are tried on, spread over those that there are."""
_UNTRIED_THRESHOLD = 0.15
"""T where too few cars are marked to leave some out: what it came to on most sites."""
_UNTRIED_CUT = -0.4


@dataclass(frozen=True)
class _Steps:
    """Both steps, trained."""

    proposer: tuple[Round, ...]
    classifier: tuple[Round, ...]
    scenes: tuple[Scene, ...]


def train_detector(samples: Sequence[LabelledImage], config: DetectionConfig) -> Detector:
    """Train a detector (paper: car detection).

    Parameters
    ----------
    samples
        Labelled pictures. The channel |frame - background| is used where all have a background and the configuration
        lets it.
    config
        ``method`` chooses the paper's dense response or the aligned classifier.

    Raises
    ------
    InputError
        Too few cars.
    """
    count = sum(len(sample.cars) for sample in samples)
    if count < MIN_CARS:
        raise InputError(f"{count} cars to learn from, {MIN_CARS} needed; mark the cars of one frame")
    if config.method == "dense":
        return train_densely(samples, config)
    has_background = config.motion_channel != "never" and all(sample.background is not None for sample in samples)
    channels = 4 if has_background else 3
    steps = _trained([scene_of(sample, has_background) for sample in samples], config, channels, config.seed)
    evidence = _held_out(steps.scenes, config, channels) if count >= _FOLD_MIN_CARS else None
    return Detector(_record(steps, evidence, config, count))


def _trained(scenes: Sequence[Scene], config: DetectionConfig, channels: int, seed: int) -> _Steps:
    rng = np.random.default_rng(seed)
    proposer = learn_proposer(scenes, config, channels, rng)
    sums = sums_of(proposer)
    looked_at = []
    for scene in scenes:
        shape, valid = scene.sample.image.shape, scene.sample.valid
        places = propose(scene.coarse, shape, valid, sums, contrast_floor=CONTRAST_FLOOR)
        looked_at.append(replace(scene, places=places[:, :3]))
    classifier, aligned = learn_classifier(looked_at, config, channels, rng)
    return _Steps(proposer, classifier, aligned)


def _held_out(scenes: Sequence[Scene], config: DetectionConfig, channels: int) -> Evidence:
    """Train on every other stripe of the pictures, try on the stripes between; then the other way round."""
    tried = np.unique(np.linspace(0, len(scenes) - 1, min(_FOLD_SCENES, len(scenes))).round().astype(int))
    parts = []
    for fold in (0, 1):
        seen = [part_of(scene, stripes(scene, fold)) for scene in scenes]
        steps = _trained(seen, config, channels, config.seed + 1 + fold)
        proposer, sums = sums_of(steps.proposer), sums_of(steps.classifier)
        parts += [evidence_of_part(scenes[k], stripes(scenes[k], 1 - fold), proposer, sums) for k in tried]
    return joined(parts)


def _record(steps: _Steps, evidence: Evidence | None, config: DetectionConfig, count: int) -> DetectorRecord:
    curve: PrecisionRecallCurve | None = None
    threshold, cuts = _UNTRIED_THRESHOLD, (_UNTRIED_CUT, _UNTRIED_CUT)
    if evidence is not None:
        curve = curve_of(evidence)
        if curve is not None and curve.chosen is not None:
            threshold = curve.threshold[curve.chosen]
        surely = evidence.right & (evidence.score >= threshold)
        cuts = cut_of(evidence.proposed[surely]), cut_of(evidence.first[surely])
    return DetectorRecord(
        method="aligned",
        working_car_length_px=config.working_car_length_px,
        rounds=steps.classifier,
        threshold=float(threshold if config.threshold is None else config.threshold),
        contrast_floor=CONTRAST_FLOOR,
        proposer=Proposer(rounds=steps.proposer, least_score=cuts[0], least_first_score=cuts[1]),
        curve=curve,
        cars=count,
    )
