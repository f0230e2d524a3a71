"""AdaBoost against a plain reference, its binning against numpy, and the rules of random features."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from velfield.paper import boosting
from velfield.paper.boosting import (
    N_BINS,
    assign_bins,
    boost,
    draw_feature_pool,
    quantile_bin_edges,
    rounds_from_stumps,
)
from velfield.paper.stumps import BoostedStumps


def plain_boost(
    bins: np.ndarray, edges: np.ndarray, is_car: np.ndarray, rounds: int, car_fraction: float
) -> tuple[list[int], list[float], list[list[float]]]:
    """Real AdaBoost by the book: all features, all samples, every split tried."""
    weights = np.where(is_car, car_fraction / is_car.sum(), (1 - car_fraction) / (~is_car).sum())
    smoothing = 0.5 / len(is_car)
    features, thresholds, leaves = [], [], []
    for _ in range(rounds):
        best = (np.inf, 0, 0)
        for f in range(len(bins)):
            for edge in range(N_BINS - 1):
                above = bins[f] > edge
                loss = sum(
                    np.sqrt(weights[side & is_car].sum() * weights[side & ~is_car].sum()) for side in (~above, above)
                )
                if loss < best[0] - 1e-12:
                    best = (loss, f, edge)
        _, f, edge = best
        above = bins[f] > edge
        low_high = [
            0.5 * np.log((weights[side & is_car].sum() + smoothing) / (weights[side & ~is_car].sum() + smoothing))
            for side in (~above, above)
        ]
        leaf = np.where(above, low_high[1], low_high[0])
        weights = weights * np.exp(np.where(is_car, -leaf, leaf))
        weights /= weights.sum()
        features.append(f)
        thresholds.append(float(edges[f, edge]))
        leaves.append(low_high)
    return features, thresholds, leaves


def samples(seed: int, count: int = 120, features: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Values (features, samples), of which two tell cars a little, and which samples are cars."""
    rng = np.random.default_rng(seed)
    is_car = rng.random(count) < 0.4
    values = rng.normal(0, 1, (features, count))
    values[1] += 1.5 * is_car
    values[4] -= 1.0 * is_car
    return values.astype(np.float32), is_car


@pytest.mark.parametrize("seed", range(4))
def test_boosting_is_adaboost_by_the_book(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(boosting, "_TRIMMED_WEIGHT", 0.0)  # all samples, all features: nothing left to chance
    values, is_car = samples(seed)
    edges = quantile_bin_edges(values)
    bins = assign_bins(values, edges)
    rng = np.random.default_rng(0)
    ours = boost(bins, edges, is_car, rounds=12, car_fraction=0.3, rng=rng)
    features, thresholds, leaves = plain_boost(bins, edges, is_car, 12, 0.3)
    assert ours.features.tolist() == features
    assert ours.thresholds.tolist() == pytest.approx(thresholds)
    np.testing.assert_allclose(ours.leaves, leaves, rtol=1e-5, atol=1e-6)


def scores_of(stumps: boosting.StumpSelection, values: np.ndarray) -> np.ndarray:
    above = values[stumps.features] > stumps.thresholds[:, None]
    return np.where(above, stumps.leaves[:, 1:], stumps.leaves[:, :1]).sum(axis=0)


def test_the_exponential_loss_falls_with_rounds_and_informative_features_are_selected() -> None:
    values, is_car = samples(7, count=2000, features=20)
    edges = quantile_bin_edges(values)
    bins, rng = assign_bins(values, edges), np.random.default_rng(1)
    stumps = boost(bins, edges, is_car, rounds=60, car_fraction=0.5, rng=rng)
    losses = []
    for rounds in (1, 10, 60):
        first = boosting.StumpSelection(stumps.features[:rounds], stumps.thresholds[:rounds], stumps.leaves[:rounds])
        loss = np.exp(-np.where(is_car, 1, -1) * scores_of(first, values))
        losses.append(loss[is_car].mean() + loss[~is_car].mean())
    assert losses[0] > losses[1] > losses[2]
    held_out, truth = samples(8, count=2000, features=20)
    assert ((scores_of(stumps, held_out) > 0) == truth).mean() > 0.77  # 0.82 is the best possible
    assert stumps.features[0] == 1
    assert 4 in stumps.features[:5]


def test_the_same_seed_gives_the_same_stumps_and_another_one_others() -> None:
    values, is_car = samples(3, features=900)
    edges = quantile_bin_edges(values)
    bins = assign_bins(values, edges)
    one, same, other = (
        boost(bins, edges, is_car, rounds=5, car_fraction=0.3, rng=np.random.default_rng(seed)) for seed in (0, 0, 1)
    )
    assert one.features.tolist() == same.features.tolist()
    assert one.features.tolist() != other.features.tolist()


def test_features_that_tell_nothing_and_separable_samples_give_finite_leaves() -> None:
    is_car = np.arange(40) < 15
    values = np.stack([np.where(is_car, 1.0, 0.0), np.zeros(40)]).astype(np.float32)
    edges = np.tile(np.linspace(-1, 2, N_BINS - 1, dtype=np.float32), (2, 1))
    stumps = boost(assign_bins(values, edges), edges, is_car, rounds=8, car_fraction=0.15, rng=np.random.default_rng(0))
    assert np.isfinite(stumps.leaves).all()
    assert ((scores_of(stumps, values) > 0) == is_car).all()


def test_quantile_edges_fill_the_bins_evenly() -> None:
    values = np.random.default_rng(0).normal(0, 1, (2, N_BINS * 50)).astype(np.float32)
    edges = quantile_bin_edges(values)
    assert edges.shape == (2, N_BINS - 1)
    assert (np.diff(edges, axis=1) >= 0).all()
    counts = np.bincount(assign_bins(values, edges)[0], minlength=N_BINS)
    assert counts.min() >= 45
    assert counts.max() <= 55


@given(st.integers(0, 2**32 - 1), st.integers(1, 5))
@settings(max_examples=25)
def test_random_features_keep_to_their_rules(seed: int, max_rectangles: int) -> None:
    pool = draw_feature_pool(
        8,
        sigma_xy_px=(6.0, 4.0),
        reach_xy_px=(14, 11),
        max_rectangles=max_rectangles,
        rng=np.random.default_rng(seed),
    )
    assert len(pool) == 8
    assert pool.starts[0] == 0
    assert pool.starts[-1] == len(pool.table)
    sign, x0, y0, x1, y1 = pool.table.T
    assert (np.abs([x0, x1]) <= 14).all()
    assert (np.abs([y0, y1]) <= 11).all()
    assert ((x1 > x0) & (y1 > y0)).all()
    for k in range(8):
        part = slice(pool.starts[k], pool.starts[k + 1])
        for side in (-1, 1):
            of_side = sign[part] == side
            assert 1 <= of_side.sum() <= max_rectangles


def test_stumps_survive_the_record() -> None:
    rng = np.random.default_rng(2)
    pool = draw_feature_pool(30, sigma_xy_px=(6.0, 4.0), reach_xy_px=(14, 11), max_rectangles=3, rng=rng)
    chosen = rng.integers(30, size=10)
    thresholds, leaves = rng.normal(0, 1, 10).astype(np.float32), rng.normal(0, 1, (10, 2)).astype(np.float32)
    rounds = rounds_from_stumps(pool, boosting.StumpSelection(chosen, thresholds, leaves))
    stumps = BoostedStumps.from_rounds(rounds)
    assert len(stumps) == 10
    assert stumps.thresholds.tolist() == thresholds.tolist()
    assert stumps.leaves.tolist() == leaves.tolist()
    for k, feature in enumerate(chosen):
        ours = stumps.rectangles[stumps.starts[k] : stumps.starts[k + 1]]
        assert ours.tolist() == pool.table[pool.starts[feature] : pool.starts[feature + 1]].tolist()
    assert len(BoostedStumps.from_rounds(())) == 0
