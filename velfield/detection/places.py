"""Training on several places, each left out in turn: how good the detector will be where it has never been."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from schemas.flight import DetectionConfig
from velfield.detection.committee import committee_of
from velfield.detection.detector import Detector, sums_of
from velfield.detection.samples import LabelledImage, Scene, scene_of
from velfield.detection.train import Steps, record_of, trained
from velfield.detection.validation import Evidence, evidence_of_part, joined

_MEMBERS, _APART = 3, 1000
"""Classifiers in the committee, and the seeds between them."""


@dataclass(frozen=True)
class Place:
    """A place: pictures to learn from, and those, as they were taken, to try a detector on."""

    name: str
    learnt: Sequence[LabelledImage]
    tried: Sequence[LabelledImage]


def left_out(
    places: Sequence[Place], always: Sequence[LabelledImage], config: DetectionConfig
) -> Iterator[tuple[str, Evidence]]:
    """What detectors say of each place, trained on all others and on what is ``always`` learnt."""
    for k, place in enumerate(places):
        others = [sample for j, other in enumerate(places) if j != k for sample in other.learnt]
        steps = _together([*others, *always], config, config.seed + 1 + k)
        proposer, sums = sums_of(steps.proposer), sums_of(steps.classifier)
        parts = [
            evidence_of_part(scene, np.ones(scene.sample.image.shape, bool), proposer, sums)
            for scene in _scenes(place.tried)
        ]
        yield place.name, joined(parts)


def train_on_places(
    places: Sequence[Place], always: Sequence[LabelledImage], config: DetectionConfig, evidence: Sequence[Evidence]
) -> Detector:
    """Train on all places; T and the cascade's cuts come from the places left out.

    Parameters
    ----------
    places, always
        As for `left_out`.
    config
        The aligned method's rounds (of each member of a committee), pool and seed.
    evidence
        What `left_out` gave, a place each.
    """
    samples = [*(sample for place in places for sample in place.learnt), *always]
    steps = _together(samples, config, config.seed)
    cars = sum(len(sample.cars) for place in places for sample in place.tried) + sum(len(s.cars) for s in always)
    told = f"cars of {len(places)} places, each found by a detector that never saw its place"
    return Detector(record_of(steps, joined(evidence), config, cars, told))


def _together(samples: Sequence[LabelledImage], config: DetectionConfig, seed: int) -> Steps:
    """Several classifiers that differ by their seed, as one: on places unseen better than one of as many rounds."""
    scenes = _scenes(samples)
    members = [trained(scenes, config, 3, seed + _APART * k) for k in range(_MEMBERS)]
    return replace(members[0], classifier=committee_of([one.classifier for one in members]))


def _scenes(samples: Sequence[LabelledImage]) -> list[Scene]:
    return [scene_of(sample, has_background=False) for sample in samples]
