"""A network learnt from nothing, or going on from an earlier one on a flight's own cars; T from cars left out."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import Float32Array
from schemas.detector import DetectorRecord, PrecisionRecallCurve
from schemas.flight import DetectionConfig
from velfield.detection.cascade.classifier import distinct
from velfield.detection.cnn.dataset import Pieces
from velfield.detection.cnn.inference import network_finds
from velfield.detection.cnn.model import Network, odds_map, record_of_network
from velfield.detection.cnn.trainer import Learner, learnt
from velfield.detection.detector import Detector
from velfield.detection.evaluation import FOLD_MIN_CARS, Evidence, curve_of, joined, matched, stripes
from velfield.detection.label_orientation import with_axes
from velfield.detection.samples import LabelledImage, lies_in, within
from velfield.parallel import each

_FOLDS = 2
_SIZE_ON = 1e-3
_SIZE = 3e-3
_MAYBE, _ABOUT_CAR_PX, _ABOUT_LIKED_PX = 0.12, 18, 3
"""Where not every car is marked: places likelier than this may be one; about those that are marked it is known, their
shadow too."""
_CURVE_FROM = -0.25
_EARLIER_CARS = 150
"""T of so many marked cars counts as much as the one of before: of 47 it came to one at which a third of the cars of
another place were lost, without a gain; the best one lay nearer to the one of before in four cases of four."""
_TOLD = "cars in stripes of the pictures, found by detectors trained on the other stripes"


def network_from_nothing(
    groups: Sequence[Sequence[LabelledImage]], shares: Sequence[float], seed: int, *, steps: int
) -> Network:
    """Learn a network; ``groups`` of pictures and how often each is taken from, as for `Pieces`."""
    return learnt(Learner.from_nothing(seed), Pieces(groups, shares, seed), steps=steps, size=_SIZE)


def train_on(samples: Sequence[LabelledImage], earlier: Detector, config: DetectionConfig) -> Detector:
    """Let an earlier network learn on from marked cars.

    Parameters
    ----------
    samples
        Labelled pictures; where not all cars are marked, what the earlier network likes is no background.

    Raises
    ------
    InputError
        An earlier detector of cars of another size.
    """
    earlier.check_car_length(config.working_car_length_px)
    known = each(lambda sample: _known(sample, earlier.network), samples)
    count = sum(len(sample.cars) for sample in samples)
    network, *tried = each(
        lambda fold: _on(known, earlier.network, config, fold),
        range(-1, _FOLDS if count >= FOLD_MIN_CARS else 0),
    )
    evidence = joined([part for _, parts in tried for part in parts]) if tried else None
    threshold, curve = chosen_threshold(evidence, earlier.threshold, _TOLD)
    if curve is not None:
        own = count / (count + _EARLIER_CARS)
        threshold = own * threshold + (1 - own) * earlier.threshold
        at = int(np.abs(np.array(curve.threshold) - threshold).argmin())
        curve = curve.model_copy(update={"chosen": at})
    record = record_of(network[0], threshold if config.threshold is None else config.threshold, curve, count, config)
    return Detector(record.model_copy(update={"attribution": earlier.record.attribution}))


def learnt_on(samples: Sequence[LabelledImage], earlier: Detector, config: DetectionConfig, *, share: float) -> Network:
    """An earlier network, its weights so far (0 to 1) towards those that it learnt on from labelled pictures."""
    before = earlier.network
    network, _ = _on(each(lambda sample: _known(sample, before), samples), before, config, -1)

    def between(old: Float32Array, new: Float32Array) -> Float32Array:
        return old + np.float32(share) * (new - old)

    weights = {name: between(old, network.weights[name]) for name, old in before.weights.items()}
    return Network(weights, {name: between(old, network.biases[name]) for name, old in before.biases.items()})


def chosen_threshold(
    evidence: Evidence | None, otherwise: float, told: str
) -> tuple[float, PrecisionRecallCurve | None]:
    """T and the curve of cars that were left out, or the T of before."""
    curve = None if evidence is None else curve_of(evidence, told)
    if curve is None or curve.chosen is None:
        return otherwise, None
    return curve.threshold[curve.chosen], curve


def record_of(
    network: Network, threshold: float, curve: PrecisionRecallCurve | None, count: int, config: DetectionConfig
) -> DetectorRecord:
    """The detector's file."""
    return DetectorRecord(
        method="network",
        working_car_length_px=config.working_car_length_px,
        network=record_of_network(network),
        threshold=float(threshold),
        curve=curve,
        cars=count,
    )


def _on(
    samples: Sequence[LabelledImage], earlier: Network, config: DetectionConfig, fold: int
) -> tuple[Network, list[Evidence]]:
    """Learnt on without a fold's stripes, and what is found there; of fold -1, from all."""
    steps, seed = config.network_steps, config.seed
    if fold < 0:
        return learnt(Learner.of(earlier), Pieces([samples], [1.0], seed), steps=steps, size=_SIZE_ON), []
    left = [stripes(sample, fold, _FOLDS) for sample in samples]
    seen = [within(sample, ~region) for sample, region in zip(samples, left, strict=True)]
    pieces = Pieces([seen], [1.0], seed + 1 + fold)
    network = learnt(Learner.of(earlier), pieces, steps=steps, size=_SIZE_ON)
    return network, [evidence_of_network(network, sample, region) for sample, region in zip(samples, left, strict=True)]


def _known(sample: LabelledImage, network: Network) -> LabelledImage:
    """Every axis told, without the places that may be a car that is not marked."""
    sample = replace(sample, cars=with_axes(sample.image, sample.cars, sample.tilts), tilts=None)
    if sample.complete:
        return sample
    likely, _ = odds_map(network, sample.image)
    liked = cv2.resize(likely, sample.image.shape[::-1]) > _MAYBE
    maybe = cv2.dilate(liked.astype(np.uint8), np.ones((2 * _ABOUT_LIKED_PX + 1,) * 2, np.uint8))
    for x, y in sample.cars[:, :2]:
        cv2.circle(maybe, (round(float(x)), round(float(y))), _ABOUT_CAR_PX, (0,), -1)
    known = maybe == 0
    return replace(sample, valid=known if sample.valid is None else sample.valid & known)


def evidence_of_network(network: Network, sample: LabelledImage, region: NDArray[np.bool_] | None = None) -> Evidence:
    """Try a network on a part (h, w) of a labelled picture, or on all of it."""
    found = distinct(network_finds(network, sample.image, sample.valid), 16.0)
    found = found[found[:, 3] > _CURVE_FROM]
    cars = sample.cars
    if region is not None:
        found, cars = found[lies_in(region, found)], cars[lies_in(region, cars)]
    right = matched(found, cars)
    for x, y, radius in sample.ignore:
        counted = right | (np.hypot(found[:, 0] - x, found[:, 1] - y) > radius)
        found, right = found[counted], right[counted]
    never = np.full(len(found), -1.0)
    return Evidence(found[:, 3], right, never, never, len(cars), sample.complete)
