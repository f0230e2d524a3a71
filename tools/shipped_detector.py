"""Trains the shipped detectors: ``make detector DATA=FOLDER``, where the folder holds the sets of `training_data`.

The network that ships is trained further on real pictures of those sets and on simulated cities, and then the layer of
sizes is fitted to it; only weights go into the file. The score threshold and the reported accuracy are those of the
parts of the sets that are held out, of which each counts alike, however many cars it shows. The file is written only
where the new network is worse than the former one on none of them.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from schemas.detector import CnnConfig
from tools.training_data import (
    ATTRIBUTION,
    Site,
    read_sites,
    read_swissimage_unlabelled,
)
from velfield.bench.scenes import simulated_image
from velfield.detection.cnn.brightness import brighten_sample
from velfield.detection.cnn.detector import CnnDetector
from velfield.detection.cnn.fine_tuning import evaluate_network, make_record
from velfield.detection.cnn.graph import network_to_record
from velfield.detection.cnn.network import Network
from velfield.detection.evaluation import HeldOutScores, f_measure, merge_scores, precision_recall_curve
from velfield.detection.registry import shipped_detector
from velfield.detection.samples import LabelledImage
from velfield.parallel import parallel_map

STEPS, TILES_FROM, SEED = 32_000, 10_667, 7
SIMULATED_SEEDS = (*range(9001, 9061), *range(9301, 9501))
"""Every third of them with many long vehicles."""
SIMULATED_SEEDS_HELD_OUT = range(9201, 9213)
_SIMULATED_WEIGHT = 5.0
_LARGE_VEHICLE_FRACTION = 0.35
"""Fraction of long vehicles in every third simulated city, as a usual city has too few."""
_TOLERANCE = 0.005
"""Decrease of F1 up to which a network is not worse, or by one car of the part where that is more."""


def _simulate_city(seed: int) -> LabelledImage:
    return simulated_image(seed, large_share=_LARGE_VEHICLE_FRACTION if seed % 3 == 0 else None)


def make_shipped_detector(data: Path, out: Path, steps: int = STEPS) -> list[str]:
    """Train the network further; returns lines with the former and the new accuracy on each held-out part.

    The detector is written where its F1 is smaller than the former one's on no part.
    """
    from tools.pretraining import pretrain  # PyTorch, which the tests that read images with these tools need not have
    from tools.sizes import fit_sizes

    former = shipped_detector()
    assert isinstance(former, CnnDetector)
    sites, simulated = read_sites(data), parallel_map(_simulate_city, SIMULATED_SEEDS)
    groups, weights = _training_groups(sites, simulated)
    network = pretrain(
        groups,
        weights,
        start=former.network,
        seed=SEED,
        steps=steps,
        tiles=parallel_map(brighten_sample, read_swissimage_unlabelled(data)),
        tiles_from=steps * TILES_FROM // STEPS,
    )
    network = fit_sizes(network, groups, weights, seed=SEED)
    held_out = _held_out(sites)
    found = _evaluate(network, held_out)
    threshold = best_threshold(list(found.values()))
    count = sum(len(sample.cars) for site in sites for sample in site.training) + sum(len(s.cars) for s in simulated)
    before = _evaluate(former.network, held_out)
    lines = [line for name in found for line in (
        _accuracy_line(f"{name}, former", before[name], former.threshold),
        _accuracy_line(f"{name}, new", found[name], threshold),
    )]  # fmt: skip
    worse = [
        name
        for name, part in found.items()
        if _f_score(part, threshold) < _f_score(before[name], former.threshold) - max(_TOLERANCE, 1 / part.car_count)
    ]
    if worse:
        return [*lines, f"not written: the new network is worse on {', '.join(worse)}"]
    curve = precision_recall_curve(
        merge_scores(list(found.values())), "labelled cars in parts of its data sets that were held out of training"
    )
    if curve is not None:
        nearest = int(np.abs(np.array(curve.threshold) - threshold).argmin())
        curve = curve.model_copy(update={"operating_point": nearest})
    record = make_record(network, threshold, curve, count, CnnConfig())
    CnnDetector(record.model_copy(update={"attribution": ATTRIBUTION})).save(out)
    return lines


def fit_shipped_sizes(data: Path, out: Path) -> list[str]:
    """Fit the layer of sizes to the network that ships, whose other layers and threshold stay as they are, and write
    it; returns lines with the former and the new errors of the lengths on each held-out part."""
    from tools.sizes import fit_sizes, size_errors

    former = shipped_detector()
    assert isinstance(former, CnnDetector)
    sites = read_sites(data)
    network = fit_sizes(
        former.network, *_training_groups(sites, parallel_map(_simulate_city, SIMULATED_SEEDS)), seed=SEED
    )
    CnnDetector(former.record.model_copy(update={"onnx": network_to_record(network)})).save(out)
    return [
        f"{name}, {which}: {size_errors(one, samples)}"
        for name, samples in _held_out(sites).items()
        for which, one in (("former", former.network), ("new", network))
    ]


def _training_groups(
    sites: Sequence[Site], simulated: Sequence[LabelledImage]
) -> tuple[list[list[LabelledImage]], list[float]]:
    """Groups of images to train on, as the network is to see them, and their weights."""
    groups = [parallel_map(brighten_sample, group) for group in (*(site.training for site in sites), simulated)]
    return groups, [*(site.weight for site in sites), _SIMULATED_WEIGHT]


def _held_out(sites: Sequence[Site]) -> dict[str, Sequence[LabelledImage]]:
    """Parts of the sets that are held out of training, by name."""
    held_out = {site.name: site.held_out for site in sites if site.held_out}
    held_out["simulated cities"] = parallel_map(_simulate_city, SIMULATED_SEEDS_HELD_OUT)
    return {name: parallel_map(brighten_sample, samples) for name, samples in held_out.items()}


def _evaluate(network: Network, held_out: dict[str, Sequence[LabelledImage]]) -> dict[str, HeldOutScores]:
    return {
        name: merge_scores([evaluate_network(network, sample) for sample in samples])
        for name, samples in held_out.items()
    }


def best_threshold(parts: Sequence[HeldOutScores]) -> float:
    """Score threshold at which the mean F0.8 over the parts is highest, to 0.01: what it misses, tracks can confirm."""
    every = np.concatenate([part.score for part in parts])
    steps = np.arange(np.floor(every.min() * 100), np.ceil(every.max() * 100)) / 100
    return float(steps[np.argmax([np.mean([_f_score(part, float(step), 0.8) for part in parts]) for step in steps])])


def _precision_recall(evaluation: HeldOutScores, threshold: float) -> tuple[float, float]:
    above = evaluation.score > threshold
    correct = int(evaluation.correct[above].sum())
    return correct / max(int(above.sum()), 1), correct / evaluation.car_count


def _f_score(evaluation: HeldOutScores, threshold: float, beta: float = 1.0) -> float:
    precision, recall = np.array(_precision_recall(evaluation, threshold))
    return float(f_measure(precision, recall, beta=beta))


def _accuracy_line(name: str, evaluation: HeldOutScores, threshold: float) -> str:
    precision, recall = _precision_recall(evaluation, threshold)
    return f"{name:28} {evaluation.car_count:4} vehicles  precision {precision:.3f}  recall {recall:.3f}"
