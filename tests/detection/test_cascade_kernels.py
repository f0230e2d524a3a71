"""The kernels of the cascade against plain loops over pixels."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from velfield.detection.boosting import BoostedStumps, FeaturePool, draw_feature_pool
from velfield.detection.cascade.feature_image import (
    COARSE,
    FINE,
    PAD_PX,
    FeatureImage,
    PatchScale,
    RotatedPatch,
    compute_features,
    fill_integrals,
    pack_poses,
    pack_words_kernel,
    score_poses,
)
from velfield.detection.cascade.feature_matrix import feature_values, fit_feature_binner
from velfield.detection.cascade.scenes import Poses

FLOOR = 12.0
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
    if features.channels == 4:
        channels.append(features.difference[index])
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


@pytest.mark.parametrize("scale", [FINE, COARSE])
@pytest.mark.parametrize("has_background", [False, True])
def test_feature_values_are_those_of_plain_loops(scale: PatchScale, *, has_background: bool) -> None:
    rng = np.random.default_rng(5)
    features = compute_features(noise(1), noise(2) if has_background else None, scale)
    drawn = pool(3, 40, features.channels, scale)
    xy, axes = rng.uniform([10, 10], [110, 80], (19, 2)), rng.uniform(0, np.pi, 19)
    poses = Poses(np.column_stack([xy, axes]), np.ones(19), np.zeros(19, bool))
    values = feature_values(features, poses, drawn, FLOOR)
    assert values.shape == (40, 19)
    close = []
    for k in range(19):
        patch = plain_channels(features, *xy[k], axes[k], scale.reach)
        for f in range(40):
            rectangles = drawn.table[drawn.starts[f] : drawn.starts[f + 1]]
            expected = plain_value(patch, scale.reach, drawn.channels[f], rectangles)
            close.append(abs(values[f, k] - expected) <= 1e-3 + 0.02 * abs(expected))
    # Single precision moves a sampled pixel to its neighbour now and then.
    assert np.mean(close) > 0.98


def plain_score(of: BoostedStumps, patch: np.ndarray, reach: tuple[int, int], rounds: int) -> float:
    total = 0.0
    for k in range(rounds):
        value = plain_value(patch, reach, of.channels[k], of.rectangles[of.starts[k] : of.starts[k + 1]])
        total += of.leaves[k, int(value > of.thresholds[k])]
    return total / np.sqrt(rounds)


@pytest.mark.parametrize("channels", [3, 4])
def test_integral_images_are_sums_over_the_nearest_pixels(channels: int) -> None:
    features = compute_features(noise(4), noise(5))
    rng = np.random.default_rng(6)
    poses = pack_poses(rng.uniform(5, 70, (16, 2)), rng.uniform(0, np.pi, 16), FINE)[0]
    patch = RotatedPatch.for_offsets(np.array([[3, 0]], np.int64), channels, FINE)
    found = patch.allocate()
    fill_integrals(features.words, features.difference, features.stride, poses, channels, found)
    v, u = (np.float32(np.arange(size) - (size - 1) / 2) for size in (patch.across, patch.along))
    x, y = (
        (poses[k] + v[:, None] * poses[4 + k])[:, None] + u[:, None] * poses[2 + k] for k in (0, 1)
    )  # (across, along, LANES)
    index = y.astype(np.int32) * features.stride + x.astype(np.int32)
    words = features.words[index]
    gx, gy = (np.float32((words >> shift & 1023).astype(np.int32) - 512) for shift in (8, 18))
    c, s = poses[6], poses[7]
    sampled = [words & 255, np.abs(gx * c + gy * s), np.abs(gy * c - gx * s), features.difference[index]]
    expected = np.zeros_like(found)
    for k in range(channels):
        expected[k, 1:, 1:] = sampled[k].astype(np.int32).cumsum(axis=0).cumsum(axis=1)
    np.testing.assert_array_equal(found, expected)


@given(SEEDS)
@settings(max_examples=10, deadline=None)
def test_scores_are_those_of_plain_loops(seed: int) -> None:
    rng = np.random.default_rng(seed)
    features, classifier = compute_features(noise(seed % 1000)), stumps(seed, 15, 3, FINE)
    xy, axes = rng.uniform([15, 15], [105, 75], (8, 2)), rng.uniform(0, np.pi, 8)
    offsets = np.array([[0, 0], [3, -1]], np.int64)
    scores = score_poses(classifier, features, xy, axes, offsets, contrast_floor=FLOOR)
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
    features, classifier = compute_features(noise(7)), stumps(9, 10, 3, FINE)
    xy, axes = rng.uniform(0, 90, (count, 2)), rng.uniform(0, np.pi, count)
    offset = np.zeros((1, 2), np.int64)
    together = score_poses(classifier, features, xy, axes, offset, contrast_floor=FLOOR)
    one = [
        score_poses(classifier, features, xy[k : k + 1], axes[k : k + 1], offset, contrast_floor=FLOOR)[0]
        for k in range(count)
    ]
    np.testing.assert_array_equal(together, one)


def test_the_first_rounds_are_scored_alone() -> None:
    features, classifier = compute_features(noise(7)), stumps(9, 10, 3, FINE)
    first = BoostedStumps(
        classifier.rectangles[: classifier.starts[4]],
        classifier.starts[:5],
        classifier.channels[:4],
        classifier.thresholds[:4],
        classifier.leaves[:4],
    )
    xy, axes, offset = np.array([[40.0, 40.0]]), np.array([0.3]), np.zeros((1, 2), np.int64)
    np.testing.assert_array_equal(
        score_poses(classifier, features, xy, axes, offset, contrast_floor=FLOOR, rounds=4),
        score_poses(first, features, xy, axes, offset, contrast_floor=FLOOR),
    )


@pytest.mark.parametrize(("gain", "shift"), [(1.0, 30), (0.5, 0), (0.5, 60)])
def test_features_hardly_change_with_brightness_and_contrast(gain: float, shift: int) -> None:
    image = np.clip(noise(11).astype(float) * 0.6 + 40, 0, 180).astype(np.uint8)
    other = np.clip(image * gain + shift, 0, 255).astype(np.uint8)
    drawn = pool(3, 60, 1, FINE)
    poses = Poses(np.array([[60.0, 45.0, 0.4], [40.0, 40.0, 1.2]]), np.ones(2), np.zeros(2, bool))
    values = [feature_values(compute_features(each), poses, drawn, 0.01) for each in (image, other)]
    assert np.corrcoef(values[0].ravel(), values[1].ravel())[0, 1] > 0.99
    ratio = np.linalg.norm(values[1]) / np.linalg.norm(values[0])
    assert ratio == pytest.approx(1, abs=0.1)


def test_without_a_difference_to_the_background_that_channel_is_zero() -> None:
    image = noise(3)
    features = compute_features(image, image)
    assert features.channels == 4
    assert not features.difference.any()
    shifted = compute_features(np.roll(image, 1, axis=1), image)
    inner = shifted.difference.reshape(-1, shifted.stride)[PAD_PX + 4 : -PAD_PX - 4, PAD_PX + 4 : -PAD_PX - 4]
    assert inner.max() <= 1  # a shift of one pixel is no difference but for the smoothing's rounding


def test_the_binner_fills_its_bins_and_mirrors_what_is_mirrored() -> None:
    rng = np.random.default_rng(0)
    features, drawn = compute_features(noise(4)), pool(1, 10, 3, FINE)
    rows = np.column_stack([rng.uniform(10, 80, (3000, 2)), rng.uniform(0, np.pi, 3000)])
    poses = Poses(rows, np.ones(3000), np.zeros(3000, bool))
    binner = fit_feature_binner(drawn, FLOOR, [(features, poses)], np.random.default_rng(0))
    bins = binner.bins(features, poses)
    assert bins.shape == (10, 3000)
    counts = np.bincount(bins[0], minlength=64)
    assert counts.max() < 4 * counts.mean()
    assert binner.bins_of_images([(features, poses[:5]), (features, poses[5:9])]).tolist() == bins[:, :9].tolist()
    assert binner.bins(features, poses[:0]).shape == (10, 0)
