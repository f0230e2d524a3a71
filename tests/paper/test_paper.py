"""The paper's detector: its dense response against plain ones, its segmentation against scikit-image."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import label, maximum_filter
from skimage.measure import regionprops
from skimage.segmentation import watershed

from schemas.detector import PaperConfig
from velfield.detection.orientation import axial_difference
from velfield.detection.registry import train_detector
from velfield.detection.samples import LabelledImage
from velfield.paper.boosting import draw_feature_pool
from velfield.paper.response import MARGIN_PX, dense_response
from velfield.paper.segmentation import region_moments, segment_response
from velfield.paper.stumps import BoostedStumps

SEEDS = st.integers(0, 2**32 - 1)


def random_stumps(rounds: int, *, seed: int = 1) -> BoostedStumps:
    rng = np.random.default_rng(seed)
    pool = draw_feature_pool(rounds, sigma_xy_px=(10.0, 10.0), reach_xy_px=(40, 40), max_rectangles=5, rng=rng)
    leaves = rng.normal(0, 1, (rounds, 2)).astype(np.float32)
    return BoostedStumps(pool.table, pool.starts, np.zeros(rounds, np.float32), leaves)


@settings(max_examples=25)
@given(SEEDS, st.integers(65, 100), st.integers(65, 100), st.integers(1, 30), st.sampled_from([3, 5, 8]))
def test_the_response_is_that_of_the_sums_of_its_rectangles(
    seed: int, height: int, width: int, rounds: int, bits: int
) -> None:
    image = np.random.default_rng(seed).integers(0, 256, (height, width), dtype=np.uint8)
    stumps = random_stumps(rounds, seed=seed)
    padded = np.pad(image.astype(np.int64) >> (8 - bits), MARGIN_PX, mode="reflect")
    y, x = (at.item() + MARGIN_PX for at in np.random.default_rng(seed).integers(0, (height, width), 2)[:, None])
    expected = 0.0
    for k in range(rounds):
        parts = stumps.rectangles[stumps.starts[k] : stumps.starts[k + 1]]
        total = sum(sign * padded[y + y0 : y + y1, x + x0 : x + x1].sum() for sign, x0, y0, x1, y1 in parts)
        expected += stumps.leaves[k, int(total > stumps.thresholds[k])]
    response = dense_response(image, stumps, grey_bits=bits)
    assert response[y - MARGIN_PX, x - MARGIN_PX] == pytest.approx(expected, abs=1e-4)


def test_an_image_smaller_than_the_margin() -> None:
    assert dense_response(np.full((20, 31), 90, np.uint8), random_stumps(5)).shape == (20, 31)


def test_without_rounds_the_response_is_zero() -> None:
    assert not dense_response(np.full((30, 40), 90, np.uint8), random_stumps(0)).any()


def smooth_noise(seed: int, shape: tuple[int, int] = (60, 80), sigma: float = 3.0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, 1, shape).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), sigma) * 10, np.float32)


@given(SEEDS, st.floats(-0.5, 1.0))
@settings(max_examples=25)
def test_regions_are_those_above_the_threshold_each_grown_from_one_maximum(seed: int, threshold: float) -> None:
    response = smooth_noise(seed)
    smooth, labels = segment_response(response, sigma_px=1.5, threshold=threshold, min_region_px=1)
    np.testing.assert_allclose(smooth, cv2.GaussianBlur(response, (0, 0), 1.5))
    above = smooth > threshold
    # A maximum is one among eight neighbours, a region grows through four: of the pixels above the threshold just those
    # components grow that hold a maximum (a lone pixel below the corner of a higher one has none).
    components, _ = label(above)
    peaks = above & (smooth >= maximum_filter(smooth, 3))
    assert ((labels > 0) == (above & np.isin(components, components[peaks]))).all()
    for region in range(1, int(labels.max()) + 1):
        inside = labels == region
        assert label(inside)[1] == 1  # connected by four neighbours
        assert len(np.unique(components[inside])) == 1
        y, x = np.unravel_index(np.where(inside, smooth, -np.inf).argmax(), smooth.shape)
        window = smooth[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
        assert smooth[y, x] == window.max() or (labels[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2] != region).any()


@given(SEEDS)
@settings(max_examples=15)
def test_regions_grow_as_a_watershed_of_the_distance_to_the_seeds(seed: int) -> None:
    """Each pixel of a region is at most as many steps from its own seed, within the mask, as from any other."""
    response = smooth_noise(seed, (40, 50))
    smooth, labels = segment_response(response, sigma_px=1.0, threshold=0.0, min_region_px=1)
    peaks = (smooth > 0) & (smooth >= cv2.dilate(smooth, np.ones((3, 3), np.uint8)))
    markers, _ = label(peaks, np.ones((3, 3)))
    flooded = watershed(np.zeros_like(smooth), markers, connectivity=1, mask=smooth > 0)
    pairs = {(int(a), int(b)) for a, b in zip(labels.ravel(), flooded.ravel(), strict=True)}
    assert len(pairs) == len({a for a, _ in pairs}) == len({b for _, b in pairs})


@pytest.mark.parametrize("min_region_px", [1, 30, 200, 10_000])
def test_small_regions_are_dropped(min_region_px: int) -> None:
    response = smooth_noise(4)
    _, every = segment_response(response, sigma_px=1.0, threshold=0.2, min_region_px=1)
    _, kept = segment_response(response, sigma_px=1.0, threshold=0.2, min_region_px=min_region_px)
    sizes = np.bincount(every.ravel())
    assert (kept == np.where(sizes[every] >= min_region_px, every, 0)).all()


def test_moments_are_those_of_regionprops() -> None:
    response = smooth_noise(9)
    smooth, labels = segment_response(response, sigma_px=1.0, threshold=0.3, min_region_px=20)
    found, regions = region_moments(labels, smooth), regionprops(labels, intensity_image=smooth)
    assert len(found) == len(regions) > 3
    for row, region in zip(found, regions, strict=True):
        x, y, axis, peak, sd, area = row
        assert (y, x) == pytest.approx(region.centroid)
        assert area == region.area
        assert peak == pytest.approx(float(region.intensity_max))
        # regionprops measures the major axis from the rows' axis; ours from +x towards +y.
        if region.axis_major_length > 1.1 * region.axis_minor_length:
            expected = np.array([np.pi / 2 - region.orientation])
            assert axial_difference(np.array([axis]), expected)[0] < 1e-6
        assert 0.05 <= sd <= np.pi / 4


def test_bars_become_regions_with_the_axis_of_their_covariance() -> None:
    response = np.full((80, 120), -1.0, np.float32)
    response[20:28, 10:40] = 2.0
    response[50:74, 80:88] = 2.0
    response[5:7, 100:102] = 2.0
    smooth, labels = segment_response(response, sigma_px=1.0, threshold=0.0, min_region_px=10)
    found = region_moments(labels, smooth)
    assert len(found) == 2
    np.testing.assert_allclose(found[:, :2], [[24.5, 23.5], [83.5, 61.5]], atol=0.5)
    assert axial_difference(found[:, 2], np.array([0.0, np.pi / 2])).max() < 0.05


def test_no_region_gives_no_row() -> None:
    assert region_moments(np.zeros((10, 10), np.int32), np.zeros((10, 10), np.float32)).shape == (0, 6)


def parking(seed: int, cars: int = 12) -> LabelledImage:
    """Bright rectangles on a dark, noisy ground."""
    rng = np.random.default_rng(seed)
    image = rng.integers(40, 60, (160, 200), dtype=np.uint8)
    table = np.full((cars, 5), np.nan)
    for k in range(cars):
        x, y = 30 + 45 * (k % 4), 30 + 50 * (k // 4)
        image[y - 4 : y + 4, x - 8 : x + 8] = 200
        table[k, :3] = x - 0.5, y - 0.5, 0.0
    return LabelledImage(image=image, cars=table)


def test_it_detects_rectangles_and_their_axes_and_keeps_its_settings_in_its_record() -> None:
    config = PaperConfig(rounds=80, feature_pool=300, response_sigma_px=2.0, min_region_px=20)
    detector = train_detector([parking(0)], config)
    assert (detector.record.response_sigma_px, detector.record.min_region_px) == (2.0, 20)
    sample = parking(1)
    found = detector.detect(sample.image)
    gap = np.hypot(*(sample.cars[:, None, :2] - found.xy[None]).transpose(2, 0, 1))
    assert (gap.min(axis=1) < 4).all()
    nearest = gap.argmin(axis=1)
    assert np.median(axial_difference(found.orientation_rad[nearest], np.zeros(12))) < 0.4
    assert (found.area_px[nearest] >= 20).all()


def test_a_configured_threshold_is_the_detectors() -> None:
    config = PaperConfig(rounds=5, feature_pool=40, threshold=0.75)
    assert train_detector([parking(0)], config).threshold == 0.75
