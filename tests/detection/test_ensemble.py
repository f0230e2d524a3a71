"""Several classifiers as one: its score is the mean of theirs."""

import numpy as np
import pytest

from schemas.detector import Rectangle, Round
from velfield.detection.boosting import random_pool, sums_of
from velfield.detection.cascade.ensemble import committee_of
from velfield.detection.cascade.feature_image import picture_of, scores_at


def rounds(count: int, seed: int) -> tuple[Round, ...]:
    """Rounds that say something at random."""
    rng = np.random.default_rng(seed)
    pool = random_pool(count, channels=3, sigma_xy_px=(6.0, 4.0), reach_xy_px=(14, 11), max_rectangles=2, rng=rng)
    found = []
    for k in range(count):
        rows = pool.table[pool.starts[k] : pool.starts[k + 1]].tolist()
        rectangles = tuple(Rectangle(**dict(zip(("sign", "x0", "y0", "x1", "y1"), row, strict=True))) for row in rows)
        below, above = rng.normal(0, 0.3, 2).tolist()
        channel = int(pool.channels[k])
        said = {"threshold": float(rng.normal(0, 2)), "leaf_low": below, "leaf_high": above}
        found.append(Round(channel=channel, rectangles=rectangles, **said))  # type: ignore[arg-type]
    return tuple(found)


@pytest.mark.parametrize("shared", [0, 15])
def test_a_committee_says_the_mean_of_what_its_members_say(shared: int) -> None:
    """Members of different length; with rounds that two of them share and say with different force."""
    members = [rounds(40, 1), rounds(20, 2), rounds(20, 3)]
    doubled = [
        r.model_copy(update={"leaf_low": 2 * r.leaf_low, "leaf_high": 2 * r.leaf_high}) for r in members[0][:shared]
    ]
    members[1] = (*members[1], *doubled)
    rng = np.random.default_rng(4)
    picture = picture_of(rng.integers(0, 256, (120, 160), dtype=np.uint8))
    xy, axes = rng.uniform([20, 20], [140, 100], (50, 2)), rng.uniform(0, np.pi, 50)
    spot = np.zeros((1, 2), np.int64)

    def scores(of: tuple[Round, ...]) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
        return scores_at(sums_of(of), picture, xy, axes, spot, contrast_floor=12.0)

    together = committee_of(members)
    assert len(together) == 80
    assert scores(together) == pytest.approx(np.mean([scores(m) for m in members], axis=0), abs=1e-5)
    assert scores(together).std() > 0.01


def test_its_first_rounds_hear_every_member() -> None:
    members = [rounds(40, 5), rounds(20, 6)]
    first = {(r.rectangles, r.threshold) for r in committee_of(members)[:12]}
    heard = [sum((r.rectangles, r.threshold) in first for r in member) for member in members]
    assert heard == [8, 4]
