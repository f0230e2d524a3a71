"""Ensembles: several boosted classifiers as one, whose score is the mean of theirs.

With some dozens of labelled cars it is half luck which features a classifier selects. The classifiers of the spatial
folds, trained to choose the score threshold, make other errors; their mean detects more cars at fewer false positives
than the one classifier that was trained on all cars.
"""

from collections.abc import Sequence

import numpy as np

from schemas.detector import Rectangle, Round


def build_ensemble(members: Sequence[Sequence[Round]]) -> tuple[Round, ...]:
    """The rounds of a classifier whose score is the mean of its members' scores.

    The members' rounds are interleaved, so that the first ones, by which the cascade rejects candidates, come from
    every member. A round that several members share, that of a detector which they continue, is merged into one.

    Parameters
    ----------
    members
        Rounds of each; scores are sums of them divided by the square root of their number
        (`feature_image.score_poses`).
    """
    by_stump: dict[tuple[int, tuple[Rectangle, ...], float], list[tuple[float, float, Round]]] = {}
    for rounds in members:
        for k, one in enumerate(rounds):
            copies = by_stump.setdefault((one.channel, one.rectangles, one.threshold), [])
            copies.append(((k + 0.5) / len(rounds), len(rounds) ** -0.5, one))
    order = sorted(by_stump.values(), key=lambda copies: float(np.mean([position for position, _, _ in copies])))
    scale = len(order) ** 0.5 / len(members)
    return tuple(
        copies[0][2].model_copy(
            update={
                "leaf_low": scale * sum(weight * one.leaf_low for _, weight, one in copies),
                "leaf_high": scale * sum(weight * one.leaf_high for _, weight, one in copies),
            }
        )
        for copies in order
    )
