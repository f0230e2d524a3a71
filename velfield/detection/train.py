"""Training of a detector: both steps of the aligned method, or the paper's dense one; T from held-out evidence."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from schemas.detector import DetectorRecord, PrecisionRecallCurve, Proposer, Round
from schemas.flight import DetectionConfig
from velfield.detection.cascade.ensemble import committee_of
from velfield.detection.cascade.proposals import propose
from velfield.detection.cascade.training import CONTRAST_FLOOR, learn_classifier, learn_proposer
from velfield.detection.cnn.fine_tuning import fine_tune
from velfield.detection.detector import Detector, shipped_detector, sums_of
from velfield.detection.evaluation import FOLD_MIN_CARS, Evidence, curve_of, cut_of, evidence_of_part, joined, stripes
from velfield.detection.paper.classifier import train_densely
from velfield.detection.samples import LabelledImage, Scene, part_of, scene_of
from velfield.errors import InputError
from velfield.parallel import each

__all__ = ["LabelledImage", "record_of", "train_detector", "trained"]

MIN_CARS = 8
"""Fewer marked cars than this do not train a detector."""
_FOLD_SCENES = 3
"""Pictures that the folds are tried on, spread over those that there are."""
_UNTRIED_THRESHOLD = 0.15
"""T where too few cars are marked to leave some out: what it came to on most sites."""
_UNTRIED_CUT = -0.4
_COMMITTEE_MIN_CARS = 20
"""With fewer marked cars the detectors of a part of them know too little to have a say."""
_OF_ITS_OWN = 0.56
"""Share of what a member says of a find that it was not trained on which is its own error: of a committee's mean the
less is left, the more members. Measured on KIT AIS and simulated cities by T."""
_EARLIER_SAYS = 4
"""Votes of an earlier detector beside the one of the new: what knows many cars is less sure of each."""
_STRIPES_TOLD = "cars in stripes of the pictures, found by detectors trained on the other stripes"


@dataclass(frozen=True)
class Steps:
    """Both steps, trained."""

    proposer: tuple[Round, ...]
    classifier: tuple[Round, ...]
    scenes: tuple[Scene, ...]


def train_detector(
    samples: Sequence[LabelledImage], config: DetectionConfig, *, continued: Detector | None = None
) -> Detector:
    """Train a detector (paper: car detection).

    Parameters
    ----------
    samples
        Labelled pictures. The channel |frame - background| is used where all have a background and the configuration
        lets it.
    config
        ``method`` chooses the network, the aligned classifier or the paper's dense response; where cars are not of the
        size that the network which ships knows, the aligned one stands in for it.
    continued
        An earlier detector: a network learns on, one of the aligned method judges together with the new one.

    Raises
    ------
    InputError
        Too few cars; an earlier detector that cannot be continued.
    """
    count = sum(len(sample.cars) for sample in samples)
    if count < MIN_CARS:
        raise InputError(f"{count} cars to learn from, {MIN_CARS} needed; mark the cars of one frame")
    if config.method == "dense":
        return train_densely(samples, config)
    earlier = _network_to_continue(continued, config)
    if earlier is not None:
        return fine_tune(samples, earlier, config)
    has_background = config.motion_channel != "never" and all(sample.background is not None for sample in samples)
    channels = 4 if has_background else 3
    prior = _rounds_to_continue(continued, config, channels)
    steps = trained([scene_of(sample, has_background) for sample in samples], config, channels, config.seed, prior)
    evidence = None
    if count >= FOLD_MIN_CARS:
        complete = all(sample.complete for sample in samples)
        folds = config.folds if complete else 2  # else motion will tell T
        together = complete and not prior and count >= _COMMITTEE_MIN_CARS
        others, evidence = _folds(steps.scenes, config, channels, prior, folds=folds, together=together)
        if together:
            steps = replace(steps, classifier=committee_of([steps.classifier, *(one.classifier for one in others)]))
    record = record_of(steps, evidence, config, count)
    return Detector(record if continued is None else _continuing(record, continued, config, tried=evidence is not None))


def _network_to_continue(continued: Detector | None, config: DetectionConfig) -> Detector | None:
    """The network that learns on: the one given, or of its method the one that ships, where its cars are as large."""
    if continued is not None:
        return continued if continued.record.method == "network" else None
    shipped = shipped_detector()
    fits = config.working_car_length_px == shipped.record.working_car_length_px
    return shipped if config.method == "network" and fits else None


def _continuing(record: DetectorRecord, earlier: Detector, config: DetectionConfig, *, tried: bool) -> DetectorRecord:
    """The record with whose pictures the earlier detector had learnt from; T by the votes where nothing was tried."""
    update: dict[str, object] = {"attribution": earlier.record.attribution}
    if not tried and config.threshold is None:
        update["threshold"] = (_UNTRIED_THRESHOLD + _EARLIER_SAYS * earlier.threshold) / (1 + _EARLIER_SAYS)
    return record.model_copy(update=update)


def _rounds_to_continue(earlier: Detector | None, config: DetectionConfig, channels: int) -> tuple[Round, ...]:
    if earlier is None:
        return ()
    record = earlier.record
    if (
        record.method != "aligned"
        or record.contrast_floor != CONTRAST_FLOOR
        or (earlier.uses_background and channels < 4)
    ):
        raise InputError(
            f"found a detector of the {record.method} method{' with' if earlier.uses_background else ' without'} a "
            "background to continue, expected one of the aligned method that looks at what is there; train anew"
        )
    earlier.check_car_length(config.working_car_length_px)
    return record.rounds


def trained(
    scenes: Sequence[Scene], config: DetectionConfig, channels: int, seed: int, prior: tuple[Round, ...] = ()
) -> Steps:
    """Both steps of the aligned method, learnt from scenes; ``prior``: of an earlier one, which has a say as well."""
    rng = np.random.default_rng(seed)
    proposer = learn_proposer(scenes, config, channels, rng)
    sums = sums_of(proposer)

    def looked_at(scene: Scene) -> Scene:
        shape, valid = scene.sample.image.shape, scene.sample.valid
        places = propose(scene.coarse, shape, valid, sums, contrast_floor=CONTRAST_FLOOR)
        return replace(scene, places=places[:, :3])

    classifier, aligned = learn_classifier(each(looked_at, scenes), config, channels, rng)
    if prior:
        classifier = committee_of([classifier, *[prior] * _EARLIER_SAYS])
    return Steps(proposer, classifier, aligned)


def _folds(
    scenes: Sequence[Scene],
    config: DetectionConfig,
    channels: int,
    prior: tuple[Round, ...],
    *,
    folds: int,
    together: bool,
) -> tuple[list[Steps], Evidence]:
    """Detectors each learnt with some stripes left out, and what they say there; ``together``: of a committee with the
    one of all stripes, each of half the rounds.

    The fewer are left out at once, the nearer T is to the one that the detector of all stripes wants: detectors of half
    of 47 cars liked what is no car better, and T came out so high that a fifth of the cars was lost.
    """
    members = folds + 1 if together else 1
    config = config.model_copy(update={"rounds": max(config.rounds // 2, 1)}) if together else config
    tried = np.unique(np.linspace(0, len(scenes) - 1, min(_FOLD_SCENES, len(scenes))).round().astype(int))

    def of_fold(fold: int) -> tuple[Steps, list[Evidence]]:
        seen = [part_of(scene, ~stripes(scene.sample, fold, folds)) for scene in scenes]
        steps = trained(seen, config, channels, config.seed + 1 + fold, prior)
        proposer, sums = sums_of(steps.proposer), sums_of(steps.classifier)
        return steps, [
            evidence_of_part(scenes[k], stripes(scenes[k].sample, fold, folds), proposer, sums, members=members)
            for k in tried
        ]

    found = each(of_fold, range(folds))
    evidence = joined([part for _, parts in found for part in parts])
    left = 1 - _OF_ITS_OWN * (1 - 1 / members)
    said = np.where(evidence.score > 0, left * evidence.score, evidence.score)
    return [steps for steps, _ in found], replace(evidence, score=said)


def record_of(
    steps: Steps, evidence: Evidence | None, config: DetectionConfig, count: int, told: str = _STRIPES_TOLD
) -> DetectorRecord:
    """The detector's file; T and the cascade's cuts follow from evidence on cars that were left out."""
    curve: PrecisionRecallCurve | None = None
    threshold, cuts = _UNTRIED_THRESHOLD, (_UNTRIED_CUT, _UNTRIED_CUT)
    if evidence is not None:
        curve = curve_of(evidence, told)
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
