"""Ensembles: the score of several classifiers as one is the mean of theirs."""

import numpy as np
import pytest

from schemas.detector import Rectangle, Round
from velfield.detection.boosting import BoostedStumps, draw_feature_pool
from velfield.detection.cascade.ensemble import build_ensemble
from velfield.detection.cascade.feature_image import compute_features, score_poses


def random_rounds(count: int, seed: int) -> tuple[Round, ...]:
    rng = np.random.default_rng(seed)
    pool = draw_feature_pool(count, channels=3, sigma_xy_px=(6.0, 4.0), reach_xy_px=(14, 11), max_rectangles=2, rng=rng)
    found = []
    for k in range(count):
        rows = pool.table[pool.starts[k] : pool.starts[k + 1]].tolist()
        rectangles = tuple(Rectangle(**dict(zip(("sign", "x0", "y0", "x1", "y1"), row, strict=True))) for row in rows)
        low, high = rng.normal(0, 0.3, 2).tolist()
        stump = {"threshold": float(rng.normal(0, 2)), "leaf_low": low, "leaf_high": high}
        found.append(Round(channel=int(pool.channels[k]), rectangles=rectangles, **stump))  # type: ignore[arg-type]
    return tuple(found)


@pytest.mark.parametrize("shared", [0, 15])
def test_the_score_of_an_ensemble_is_the_mean_of_its_members_scores(shared: int) -> None:
    """Members of different length; with stumps that two of them share, at different leaves."""
    members = [random_rounds(40, 1), random_rounds(20, 2), random_rounds(20, 3)]
    doubled = [
        r.model_copy(update={"leaf_low": 2 * r.leaf_low, "leaf_high": 2 * r.leaf_high}) for r in members[0][:shared]
    ]
    members[1] = (*members[1], *doubled)
    rng = np.random.default_rng(4)
    features = compute_features(rng.integers(0, 256, (120, 160), dtype=np.uint8))
    xy, axes = rng.uniform([20, 20], [140, 100], (50, 2)), rng.uniform(0, np.pi, 50)
    no_offset = np.zeros((1, 2), np.int64)

    def scores(of: tuple[Round, ...]) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
        return score_poses(BoostedStumps.from_rounds(of), features, xy, axes, no_offset, contrast_floor=12.0)

    ensemble = build_ensemble(members)
    assert len(ensemble) == 80
    assert scores(ensemble) == pytest.approx(np.mean([scores(m) for m in members], axis=0), abs=1e-5)
    assert scores(ensemble).std() > 0.01


def test_its_first_rounds_come_from_every_member() -> None:
    members = [random_rounds(40, 5), random_rounds(20, 6)]
    first = {(r.rectangles, r.threshold) for r in build_ensemble(members)[:12]}
    assert [sum((r.rectangles, r.threshold) in first for r in member) for member in members] == [8, 4]


def test_an_ensemble_of_one_is_that_one() -> None:
    (member,) = members = [random_rounds(12, 7)]
    for ours, theirs in zip(build_ensemble(members), member, strict=True):
        assert (ours.rectangles, ours.threshold) == (theirs.rectangles, theirs.threshold)
        assert (ours.leaf_low, ours.leaf_high) == pytest.approx((theirs.leaf_low, theirs.leaf_high))
