"""AdaBoost with decision stumps on integral-image features (Viola and Jones 2001; paper: car detection).

A feature is a signed sum of random rectangles, as in integral channel features (Dollár 2009). Values are binned once,
so that a round of boosting is a histogram for each feature. Each round searches a random subset of the features, and
weights are trimmed (Friedman, Hastie and Tibshirani 2000). Hand-written: scikit-learn would be another dependency, and
its AdaBoost sorts unbinned values for every stump.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import ByteArray, Float32Array, FloatArray, IntArray, Mask
from schemas.detector import Round
from velfield.compiled import kernel
from velfield.parallel import count_steps

Int32s = NDArray[np.int32]

N_BINS = 64
FEATURES_PER_ROUND = 700
"""Features that a round searches, drawn at random: as accurate as all of them, at a fraction of the cost."""
_TRIM_EVERY, _TRIMMED_WEIGHT = 10, 0.01


@dataclass(frozen=True)
class FeaturePool:
    """Random features: for each some positive and negative rectangles."""

    table: Int32s
    """(r, 5) int32: sign, x0, y0, x1, y1 from the centre."""
    starts: Int32s
    """(features + 1,) int32: the rectangles of feature k are ``starts[k]:starts[k + 1]``."""

    def __len__(self) -> int:
        return len(self.starts) - 1


def draw_feature_pool(
    count: int,
    *,
    sigma_xy_px: tuple[float, float],
    reach_xy_px: tuple[int, int],
    max_rectangles: int,
    rng: np.random.Generator,
) -> FeaturePool:
    """Draw features of 1 to ``max_rectangles`` rectangles of either sign, their corners Gaussian about the centre."""
    table: list[tuple[int, int, int, int, int]] = []
    starts = [0]

    for _ in range(count):
        for sign in (1, -1):
            for _ in range(int(rng.integers(1, max_rectangles + 1))):
                x0, x1 = _draw_interval(sigma_xy_px[0], reach_xy_px[0], rng)
                y0, y1 = _draw_interval(sigma_xy_px[1], reach_xy_px[1], rng)
                table.append((sign, x0, y0, x1, y1))
        starts.append(len(table))
    return FeaturePool(np.array(table, np.int32).reshape(-1, 5), np.array(starts, np.int32))


def _draw_interval(sigma: float, reach: int, rng: np.random.Generator) -> tuple[int, int]:
    while True:
        low, high = sorted(int(v) for v in np.rint(np.clip(rng.normal(0, sigma, 2), -reach, reach)))
        if high > low:
            return low, high


@dataclass(frozen=True)
class StumpSelection:
    """The stumps of a training: for each round the feature, its threshold, and the leaves at or below and above it."""

    features: IntArray
    """(rounds,) indices into the pool."""
    thresholds: Float32Array
    """(rounds,)"""
    leaves: Float32Array
    """(rounds, 2) float32."""


def boost(
    bins: ByteArray,
    edges: Float32Array,
    is_car: Mask,
    *,
    rounds: int,
    car_fraction: float,
    rng: np.random.Generator,
) -> StumpSelection:
    """Train a boosted classifier (real AdaBoost: leaves are half the log odds of the weights).

    Parameters
    ----------
    bins
        (features, samples) uint8: the bin of each value (`assign_bins`).
    edges
        (features, bins - 1) float32 between the bins.
    is_car
        (samples,): positive samples.
    car_fraction
        Summed initial weight of the positive samples. Paper: they are 15 % of the samples.
    rng
        Draws the features of each round: the same seed gives the same detector.
    """
    weights = _initial_weights(is_car, car_fraction)
    smoothing = 0.5 / len(is_car)
    cars, others = np.flatnonzero(is_car), np.flatnonzero(~is_car)
    features, thresholds, leaves = [], [], []
    count_steps(0, announced=rounds)
    for k in range(rounds):
        count_steps(1)
        if k % _TRIM_EVERY == 0:
            active_cars, active_others = _trim(weights, cars), _trim(weights, others)
        searched = np.sort(rng.choice(len(bins), min(FEATURES_PER_ROUND, len(bins)), replace=False))
        feature, edge = _best_stump(bins, weights, active_cars, active_others, searched)
        above = bins[feature] > edge
        low_high = [
            0.5 * np.log((weights[side & is_car].sum() + smoothing) / (weights[side & ~is_car].sum() + smoothing))
            for side in (~above, above)
        ]
        leaf = np.where(above, low_high[1], low_high[0])
        weights = weights * np.exp(np.where(is_car, -leaf, leaf))
        weights /= weights.sum()
        features.append(feature)
        thresholds.append(edges[feature, edge])
        leaves.append(low_high)
    return StumpSelection(np.array(features, np.int64), np.array(thresholds, np.float32), np.array(leaves, np.float32))


def _initial_weights(is_car: Mask, car_fraction: float) -> FloatArray:
    """Weights of the samples before the first round; those of the cars sum to ``car_fraction``."""
    weights = np.where(is_car, car_fraction / is_car.sum(), (1 - car_fraction) / (~is_car).sum())
    return np.asarray(weights / weights.sum())  # one but for rounding, which decides between stumps of equal loss


def _trim(weights: FloatArray, rows: IntArray) -> IntArray:
    """Rows without the lightest, whose summed weight is next to nothing: three times fewer, the same stumps."""
    order = rows[np.argsort(weights[rows], kind="stable")]
    weight = np.cumsum(weights[order])
    return np.sort(order[np.searchsorted(weight, _TRIMMED_WEIGHT * weight[-1]) :])


def quantile_bin_edges(values: Float32Array) -> Float32Array:
    """(features, bins - 1) edges of values (features, samples), with equally many samples in each bin."""
    return np.asarray(np.quantile(values, np.linspace(0, 1, N_BINS + 1)[1:-1], axis=1).T, np.float32)


def assign_bins(values: Float32Array, edges: Float32Array) -> ByteArray:
    """(features, samples) uint8 bins of values (features, samples)."""
    return np.stack([np.searchsorted(*one) for one in zip(edges, values, strict=True)]).astype(np.uint8)


@kernel
def _best_stump(
    bins: ByteArray, weights: FloatArray, cars: IntArray, others: IntArray, searched: IntArray
) -> tuple[int, int]:
    """The feature, of those searched, and the bin edge with the lowest exponential loss."""
    best_loss, best_feature, best_edge = np.inf, searched[0], 0
    car, other = np.zeros(256), np.zeros(256)
    car_weights, other_weights = weights[cars], weights[others]
    all_car, all_other = car_weights.sum(), other_weights.sum()
    for f in searched:
        car[:] = 0
        other[:] = 0
        row = bins[f]
        for k in range(len(cars)):
            car[row[cars[k]]] += car_weights[k]
        for k in range(len(others)):
            other[row[others[k]]] += other_weights[k]
        low_car = low_other = 0.0
        for edge in range(N_BINS - 1):
            low_car += car[edge]
            low_other += other[edge]
            high_car, high_other = max(all_car - low_car, 0.0), max(all_other - low_other, 0.0)
            loss = np.sqrt(low_car * low_other) + np.sqrt(high_car * high_other)
            if loss < best_loss:
                best_loss, best_feature, best_edge = loss, f, edge
    return best_feature, best_edge


def rounds_from_stumps(pool: FeaturePool, stumps: StumpSelection) -> tuple[Round, ...]:
    """The rounds as a detector's record holds them."""
    rounds = []
    for feature, threshold, (low, high) in zip(stumps.features, stumps.thresholds, stumps.leaves, strict=True):
        rows = pool.table[pool.starts[feature] : pool.starts[feature + 1]]
        names = ("sign", "x0", "y0", "x1", "y1")
        fields = {
            "channel": 0,
            "rectangles": [dict(zip(names, map(int, row), strict=True)) for row in rows],
            "threshold": float(threshold),
            "leaf_low": float(low),
            "leaf_high": float(high),
        }
        rounds.append(Round.model_validate(fields))
    return tuple(rounds)
