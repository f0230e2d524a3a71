"""Trains the network on several sites, and evaluates it by leave-one-site-out cross-validation."""

from collections.abc import Sequence
from dataclasses import dataclass

from schemas.detector import CnnConfig
from velfield.detection.cnn.detector import CnnDetector
from velfield.detection.cnn.fine_tuning import evaluate_network, make_record, select_threshold
from velfield.detection.cnn.network import Network
from velfield.detection.evaluation import HeldOutScores, merge_scores
from velfield.detection.samples import LabelledImage
from velfield.parallel import parallel_map

_EXTRA_WEIGHT = 2.0
"""Sampling weight of the extra images, where that of a site is 1."""
_FOLD_STEPS_FRACTION = 0.3
"""Of the steps: networks of the folds serve the threshold and the report only."""


@dataclass(frozen=True)
class Site:
    """A site: images to train on, and images, unaugmented, to evaluate on."""

    name: str
    training: Sequence[LabelledImage]
    evaluation: Sequence[LabelledImage]


def train_leave_one_site_out(
    sites: Sequence[Site], extra: Sequence[LabelledImage], *, seed: int, steps: int, teacher: Network | None = None
) -> tuple[CnnDetector, dict[str, HeldOutScores]]:
    """Train on all sites and on the ``extra`` images; choose the threshold on held-out sites.

    A ``teacher`` was trained on all sites: the networks of the folds have none.

    Returns
    -------
    The detector, and the evaluation of each site by a network trained on all others and on the extra images.
    """

    def train_fold(held_out: int | None) -> tuple[Network, HeldOutScores | None]:
        if held_out is None:
            return _train(sites, extra, seed, steps, teacher), None
        others = [site for k, site in enumerate(sites) if k != held_out]
        network = _train(others, extra, seed + 1 + held_out, round(_FOLD_STEPS_FRACTION * steps))
        return network, merge_scores([evaluate_network(network, sample) for sample in sites[held_out].evaluation])

    (network, _), *folds = parallel_map(train_fold, [None, *range(len(sites))])
    by_site = {
        site.name: evaluation for site, (_, evaluation) in zip(sites, folds, strict=True) if evaluation is not None
    }
    description = f"cars of {len(sites)} sites, each detected by a detector that was not trained on its site"
    threshold, curve = select_threshold(merge_scores(list(by_site.values())), 0.0, description)
    cars = sum(len(sample.cars) for site in sites for sample in site.evaluation) + sum(len(s.cars) for s in extra)
    return CnnDetector(make_record(network, threshold, curve, cars, CnnConfig())), by_site


def _train(
    sites: Sequence[Site], extra: Sequence[LabelledImage], seed: int, steps: int, teacher: Network | None = None
) -> Network:
    from tools.pretraining import pretrain  # PyTorch, which the tests that read images with these tools need not have

    groups = [*(site.training for site in sites), extra]
    return pretrain(groups, [*(1.0 for _ in sites), _EXTRA_WEIGHT], seed=seed, steps=steps, teacher=teacher)
