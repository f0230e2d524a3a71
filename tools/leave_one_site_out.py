"""The network learnt on several places, each left out in turn: how good it is where it has never been."""

from collections.abc import Sequence
from dataclasses import dataclass

from schemas.flight import DetectionConfig
from velfield.detection.cnn.fine_tuning import (
    chosen_threshold,
    evidence_of_network,
    network_from_nothing,
    record_of,
)
from velfield.detection.cnn.model import Network
from velfield.detection.detector import Detector
from velfield.detection.evaluation import Evidence, joined
from velfield.detection.samples import LabelledImage
from velfield.parallel import each

_ALWAYS_SHARE = 2.0
"""How often what is always learnt is looked at, beside a place."""
_STEPS_TRIED = 0.3
"""Of the steps: what is left out is there for T and to be told, not to be kept."""


@dataclass(frozen=True)
class Place:
    """A place: pictures to learn from, and those, as they were taken, to try a detector on."""

    name: str
    learnt: Sequence[LabelledImage]
    tried: Sequence[LabelledImage]


def train_on_places(
    places: Sequence[Place], always: Sequence[LabelledImage], *, seed: int, steps: int
) -> tuple[Detector, dict[str, Evidence]]:
    """Learn from all places, and from what is ``always`` learnt; T comes from places left out.

    Returns
    -------
    The detector, and by place what networks said that were learnt on all others and on what is always learnt.
    """

    def without(k: int | None) -> tuple[Network, Evidence | None]:
        if k is None:
            return _learnt(places, always, seed, steps), None
        others = [place for j, place in enumerate(places) if j != k]
        network = _learnt(others, always, seed + 1 + k, round(_STEPS_TRIED * steps))
        return network, joined([evidence_of_network(network, sample) for sample in places[k].tried])

    (network, _), *tried = each(without, [None, *range(len(places))])
    found = {place.name: said for place, (_, said) in zip(places, tried, strict=True) if said is not None}
    told = f"cars of {len(places)} places, each found by a detector that never saw its place"
    threshold, curve = chosen_threshold(joined(list(found.values())), 0.0, told)
    cars = sum(len(sample.cars) for place in places for sample in place.tried) + sum(len(s.cars) for s in always)
    return Detector(record_of(network, threshold, curve, cars, DetectionConfig())), found


def _learnt(places: Sequence[Place], always: Sequence[LabelledImage], seed: int, steps: int) -> Network:
    groups = [*(place.learnt for place in places), always]
    return network_from_nothing(groups, [*(1.0 for _ in places), _ALWAYS_SHARE], seed, steps=steps)
