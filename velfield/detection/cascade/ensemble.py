"""Several classifiers as one: what detectors that learnt from parts of the marked cars say together.

Of some dozens of marked cars it is half luck what a classifier takes for a sign of one. The detectors that are learnt
with a part of the cars left out, to choose T, err elsewhere; together they find more and err less than the one that saw
all.
"""

from collections.abc import Sequence

import numpy as np

from schemas.detector import Rectangle, Round


def committee_of(members: Sequence[Sequence[Round]]) -> tuple[Round, ...]:
    """The rounds of a classifier whose score is the mean of its members' scores.

    They are woven, so that the first of them hear every member; a round that several members share, that of a detector
    which they continue, is one.

    Parameters
    ----------
    members
        Each one's rounds; scores are sums of these divided by the root of their number (`turned.scores_at`).
    """
    found: dict[tuple[int, tuple[Rectangle, ...], float], list[tuple[float, float, Round]]] = {}
    for rounds in members:
        for k, one in enumerate(rounds):
            seen = found.setdefault((one.channel, one.rectangles, one.threshold), [])
            seen.append(((k + 0.5) / len(rounds), len(rounds) ** -0.5, one))
    order = sorted(found.values(), key=lambda seen: float(np.mean([place for place, _, _ in seen])))
    share = len(order) ** 0.5 / len(members)
    return tuple(
        seen[0][2].model_copy(
            update={
                "leaf_low": share * sum(weight * one.leaf_low for _, weight, one in seen),
                "leaf_high": share * sum(weight * one.leaf_high for _, weight, one in seen),
            }
        )
        for seen in order
    )
