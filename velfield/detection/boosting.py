"""AdaBoost over stumps on random rectangle sums (paper: car detection); binned, so that a round is a histogram."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from schemas.arrays import ByteArray, Float32Array, FloatArray, IntArray
from schemas.detector import Round

Int32s = NDArray[np.int32]

N_BINS = 64
ROUND_POOL = 700
"""Features that a round chooses from, drawn anew each round: as good as all, at a fraction of the cost."""
_TRIM_EVERY, _TRIMMED_WEIGHT = 10, 0.01


@dataclass(frozen=True)
class RectanglePool:
    """Random features: each a channel and some positive and negative rectangles.

    Attributes
    ----------
    table : (r, 5) int32: sign, x0, y0, x1, y1 from the centre.
    starts : (features + 1,) int32.
    channels : (features,) int32.
    """

    table: Int32s
    starts: Int32s
    channels: Int32s

    def __len__(self) -> int:
        return len(self.channels)


def random_pool(
    count: int,
    *,
    channels: int,
    sigma_xy_px: tuple[float, float],
    reach_xy_px: tuple[int, int],
    max_rectangles: int,
    rng: np.random.Generator,
    max_area_px: int | None = None,
) -> RectanglePool:
    """Features of 1 to ``max_rectangles`` rectangles of either sign, corners Gaussian about the centre.

    ``max_area_px``: those of one sign cover no more than this together, counted as often as they do.
    """
    table: list[tuple[int, int, int, int, int]] = []
    starts, chosen = [0], []

    def of_sign(sign: int) -> list[tuple[int, int, int, int, int]]:
        drawn = []
        for _ in range(int(rng.integers(1, max_rectangles + 1))):
            x0, x1 = _interval(sigma_xy_px[0], reach_xy_px[0], rng)
            y0, y1 = _interval(sigma_xy_px[1], reach_xy_px[1], rng)
            drawn.append((sign, x0, y0, x1, y1))
        fits = max_area_px is None or sum((x1 - x0) * (y1 - y0) for _, x0, y0, x1, y1 in drawn) <= max_area_px
        return drawn if fits else of_sign(sign)

    for _ in range(count):
        table += of_sign(1) + of_sign(-1)
        starts.append(len(table))
        chosen.append(int(rng.integers(channels)))
    return RectanglePool(np.array(table, np.int32), np.array(starts, np.int32), np.array(chosen, np.int32))


def _interval(sigma: float, reach: int, rng: np.random.Generator) -> tuple[int, int]:
    while True:
        low, high = sorted(int(v) for v in np.rint(np.clip(rng.normal(0, sigma, 2), -reach, reach)))
        if high > low:
            return low, high


@dataclass(frozen=True)
class Stumps:
    """The rounds of a training: which feature, its threshold, what is said at or below and above it."""

    features: IntArray
    thresholds: NDArray[np.float32]
    leaves: NDArray[np.float32]


def boost(
    bins: ByteArray,
    edges: Float32Array,
    is_car: NDArray[np.bool_],
    *,
    rounds: int,
    car_fraction: float,
    rng: np.random.Generator,
    shrinkage: float = 1.0,
) -> Stumps:
    """Train.

    Parameters
    ----------
    bins
        (features, samples) uint8: which bin each value falls in (`binned`).
    edges
        (features, bins - 1) float32 between the bins.
    is_car
        (samples,) bool.
    car_fraction
        Weight of all cars together at the start. Paper: 15 % of the samples.
    rng
        Chooses each round's features: the same seed, the same detector.
    shrinkage
        Share of what AdaBoost would say that a round does say. Paper: 1.
    """
    weights = _start_weights(is_car, car_fraction)
    smallest = 0.5 / len(is_car)
    cars, others = np.flatnonzero(is_car), np.flatnonzero(~is_car)
    features, thresholds, leaves = [], [], []
    for k in range(rounds):
        if k % _TRIM_EVERY == 0:
            active_cars, active_others = _that_matter(weights, cars), _that_matter(weights, others)
        chosen = np.sort(rng.choice(len(bins), min(ROUND_POOL, len(bins)), replace=False))
        feature, edge = _best_stump(bins, weights, active_cars, active_others, chosen)
        above = bins[feature] > edge
        said = [
            shrinkage
            * 0.5
            * np.log((weights[part & is_car].sum() + smallest) / (weights[part & ~is_car].sum() + smallest))
            for part in (~above, above)
        ]
        leaf = np.where(above, said[1], said[0])
        weights = weights * np.exp(np.where(is_car, -leaf, leaf))
        weights /= weights.sum()
        features.append(feature)
        thresholds.append(edges[feature, edge])
        leaves.append(said)
    return Stumps(np.array(features, np.int64), np.array(thresholds, np.float32), np.array(leaves, np.float32))


def _start_weights(is_car: NDArray[np.bool_], car_fraction: float) -> FloatArray:
    """Weights of the samples before the first round: all cars together weigh ``car_fraction``."""
    weights = np.where(is_car, car_fraction / is_car.sum(), (1 - car_fraction) / (~is_car).sum())
    return np.asarray(weights / weights.sum())  # one but for rounding, which decides between stumps that are alike


def _that_matter(weights: FloatArray, rows: IntArray) -> IntArray:
    """Rows without the lightest, which together weigh next to nothing: three times fewer, the same stumps."""
    order = rows[np.argsort(weights[rows], kind="stable")]
    weight = np.cumsum(weights[order])
    return np.sort(order[np.searchsorted(weight, _TRIMMED_WEIGHT * weight[-1]) :])


def bin_edges(values: Float32Array) -> Float32Array:
    """(features, bins - 1) edges from values (features, samples): as many samples in each bin."""
    return np.asarray(np.quantile(values, np.linspace(0, 1, N_BINS + 1)[1:-1], axis=1).T, np.float32)


@njit(cache=True, nogil=True)
def binned(values, edges):  # type: ignore[no-untyped-def]
    """(features, samples) uint8 bins of values (features, samples)."""
    bins = np.empty(values.shape, np.uint8)
    for f in range(values.shape[0]):
        for k in range(values.shape[1]):
            low, high = 0, edges.shape[1]
            while low < high:
                middle = (low + high) // 2
                if edges[f, middle] < values[f, k]:
                    low = middle + 1
                else:
                    high = middle
            bins[f, k] = low
    return bins


@njit(cache=True, nogil=True)
def _best_stump(bins, weights, cars, others, chosen):  # type: ignore[no-untyped-def]
    """The feature, of those chosen, and bin edge of least exponential loss."""
    best_loss, best_feature, best_edge = np.inf, chosen[0], 0
    car, other = np.zeros(256), np.zeros(256)
    car_weights, other_weights = weights[cars], weights[others]
    all_car, all_other = car_weights.sum(), other_weights.sum()
    for f in chosen:
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


def rounds_of(pool: RectanglePool, stumps: Stumps) -> tuple[Round, ...]:
    """The rounds as a detector's record holds them."""
    rounds = []
    for feature, threshold, (low, high) in zip(stumps.features, stumps.thresholds, stumps.leaves, strict=True):
        rows = pool.table[pool.starts[feature] : pool.starts[feature + 1]]
        names = ("sign", "x0", "y0", "x1", "y1")
        fields = {
            "channel": int(pool.channels[feature]),
            "rectangles": [dict(zip(names, map(int, row), strict=True)) for row in rows],
            "threshold": float(threshold),
            "leaf_low": float(low),
            "leaf_high": float(high),
        }
        rounds.append(Round.model_validate(fields))
    return tuple(rounds)


@dataclass(frozen=True)
class BoostedSums:
    """Rounds of boosting as arrays, for the kernels.

    Attributes
    ----------
    rectangles
        (r, 5) int32: sign, x0, y0, x1, y1 from the centre.
    starts
        (rounds + 1,) int32: rectangles of round k are ``starts[k]:starts[k + 1]``.
    channels
        (rounds,) int32.
    thresholds, leaves
        (rounds,) and (rounds, 2) float32: what is said at or below, and above.
    """

    rectangles: NDArray[np.int32]
    starts: NDArray[np.int32]
    channels: NDArray[np.int32]
    thresholds: NDArray[np.float32]
    leaves: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.thresholds)


def sums_of(rounds: Sequence[Round]) -> BoostedSums:
    """Rounds as arrays."""
    table = [(r.sign, r.x0, r.y0, r.x1, r.y1) for one in rounds for r in one.rectangles]
    starts = np.cumsum([0, *(len(one.rectangles) for one in rounds)])
    return BoostedSums(
        rectangles=np.array(table, np.int32).reshape(-1, 5),
        starts=starts.astype(np.int32),
        channels=np.array([one.channel for one in rounds], np.int32),
        thresholds=np.array([one.threshold for one in rounds], np.float32),
        leaves=np.array([(one.leaf_low, one.leaf_high) for one in rounds], np.float32),
    )
