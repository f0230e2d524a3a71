"""The kernels of the classifier of long vehicles against plain loops over pixels."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from velfield.detection.long_vehicles.feature_image import (
    PAD_PX,
    FeatureImage,
    OffsetScorer,
    PatchScale,
    features_of_reduced,
    pack_words_kernel,
)
from velfield.detection.stumps import BoostedStumps
from velfield.paper.boosting import FeaturePool, draw_feature_pool

FLOOR = 12.0
FINE = PatchScale(1, (14, 11))
SEEDS = st.integers(0, 2**32 - 1)


def noise(seed: int, shape: tuple[int, int] = (90, 120)) -> np.ndarray:
    image = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 2.0), np.uint8)


def pool(seed: int, count: int, channels: int, scale: PatchScale) -> FeaturePool:
    rng = np.random.default_rng(seed)
    return draw_feature_pool(
        count, channels=channels, sigma_xy_px=(5.0, 4.0), reach_xy_px=scale.reach, max_rectangles=2, rng=rng
    )


def stumps(seed: int, rounds: int, channels: int, scale: PatchScale) -> BoostedStumps:
    rng, drawn = np.random.default_rng(seed), pool(seed, rounds, channels, scale)
    thresholds, leaves = rng.normal(0, 1, rounds).astype(np.float32), rng.normal(0, 1, (rounds, 2)).astype(np.float32)
    return BoostedStumps(drawn.table, drawn.starts, drawn.channels, thresholds, leaves)


def score(
    of: BoostedStumps, features: FeatureImage, xy: np.ndarray, axes: np.ndarray, offsets: np.ndarray, rounds: int = 0
) -> np.ndarray:
    scorer = OffsetScorer(of, offsets, FINE)
    return scorer.scores(features, xy, axes, contrast_floor=FLOOR, rounds=rounds or len(of))


def plain_channels(features: FeatureImage, x: float, y: float, angle: float, reach: tuple[int, int]) -> np.ndarray:
    """Channels (channels, rows, columns) of a patch of twice ``reach`` about a position, pixel by pixel."""
    u, v = np.meshgrid(np.arange(2 * reach[0]) - reach[0] + 0.5, np.arange(2 * reach[1]) - reach[1] + 0.5)
    c, s = np.cos(angle), np.sin(angle)
    px = (x + 0.5) / features.scale.step + PAD_PX
    py = (y + 0.5) / features.scale.step + PAD_PX
    columns, rows = np.floor(px + u * c - v * s).astype(int), np.floor(py + u * s + v * c).astype(int)
    index = rows * features.stride + columns
    words = features.words[index].astype(np.int64)
    grey, gx, gy = words & 255, ((words >> 8) & 1023) - 512, ((words >> 18) & 1023) - 512
    channels = [grey, np.trunc(np.abs(gx * c + gy * s)), np.trunc(np.abs(gy * c - gx * s))]
    return np.asarray(channels, np.float64)


def plain_value(patch: np.ndarray, reach: tuple[int, int], channel: int, rectangles: np.ndarray) -> float:
    """A feature: its signed sum, less that of the window's mean grey, by the window's mean gradient plus the floor."""
    total = 0.0
    mean = patch[0].mean() if channel == 0 else 0.0
    for sign, x0, y0, x1, y1 in rectangles:
        part = patch[channel, reach[1] + y0 : reach[1] + y1, reach[0] + x0 : reach[0] + x1]
        total += sign * (part - mean).sum()
    return float(total / (patch[1].mean() + patch[2].mean() + FLOOR))


@pytest.mark.parametrize("shape", [(40, 57), (1, 9), (2, 3)])
def test_words_hold_the_grey_and_the_gradients_of_sobel(shape: tuple[int, int]) -> None:
    grey = np.random.default_rng(4).integers(0, 256, shape).astype(np.uint8)
    along, across = (cv2.Sobel(grey, cv2.CV_16S, 1 - k, k).astype(np.int64) >> 1 for k in (0, 1))
    np.testing.assert_array_equal(pack_words_kernel(grey), grey + (along + 512) * 256 + ((across + 512) << 18))


def plain_score(of: BoostedStumps, patch: np.ndarray, reach: tuple[int, int], rounds: int) -> float:
    total = 0.0
    for k in range(rounds):
        value = plain_value(patch, reach, of.channels[k], of.rectangles[of.starts[k] : of.starts[k + 1]])
        total += of.leaves[k, int(value > of.thresholds[k])]
    return total / np.sqrt(rounds)


@given(SEEDS)
@settings(max_examples=10, deadline=None)
def test_scores_are_those_of_plain_loops(seed: int) -> None:
    rng = np.random.default_rng(seed)
    features, classifier = features_of_reduced(noise(seed % 1000), FINE), stumps(seed, 15, 3, FINE)
    xy, axes = rng.uniform([15, 15], [105, 75], (8, 2)), rng.uniform(0, np.pi, 8)
    offsets = np.array([[0, 0], [3, -1]], np.int64)
    scores = OffsetScorer(classifier, offsets, FINE).scores(
        features, xy, axes, contrast_floor=FLOOR, rounds=len(classifier)
    )
    off = []
    for k in range(8):
        for m, (u, v) in enumerate(offsets):
            c, s = np.cos(axes[k]), np.sin(axes[k])
            patch = plain_channels(features, xy[k, 0] + u * c - v * s, xy[k, 1] + u * s + v * c, axes[k], FINE.reach)
            off.append(abs(scores[k, m] - plain_score(classifier, patch, FINE.reach, 15)))
    assert np.median(off) < 1e-4  # a value next to its threshold may fall on the other side


@given(SEEDS, st.integers(1, 40))
@settings(max_examples=15, deadline=None)
def test_poses_are_scored_independently_of_how_many_there_are(seed: int, count: int) -> None:
    """Sixteen lanes at a time: the last group is filled up, and cut off again."""
    rng = np.random.default_rng(seed)
    features, classifier = features_of_reduced(noise(7), FINE), stumps(9, 10, 3, FINE)
    xy, axes = rng.uniform(0, 90, (count, 2)), rng.uniform(0, np.pi, count)
    offset = np.zeros((1, 2), np.int64)
    together = OffsetScorer(classifier, offset, FINE).scores(
        features, xy, axes, contrast_floor=FLOOR, rounds=len(classifier)
    )
    one = [
        OffsetScorer(classifier, offset, FINE).scores(
            features, xy[k : k + 1], axes[k : k + 1], contrast_floor=FLOOR, rounds=len(classifier)
        )[0]
        for k in range(count)
    ]
    np.testing.assert_array_equal(together, one)


def test_the_first_rounds_are_scored_alone() -> None:
    features, classifier = features_of_reduced(noise(7), FINE), stumps(9, 10, 3, FINE)
    first = BoostedStumps(
        classifier.rectangles[: classifier.starts[4]],
        classifier.starts[:5],
        classifier.channels[:4],
        classifier.thresholds[:4],
        classifier.leaves[:4],
    )
    xy, axes, offset = np.array([[40.0, 40.0]]), np.array([0.3]), np.zeros((1, 2), np.int64)
    np.testing.assert_array_equal(
        score(classifier, features, xy, axes, offset, 4),
        score(first, features, xy, axes, offset),
    )
