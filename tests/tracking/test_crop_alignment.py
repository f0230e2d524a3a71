"""Sub-pixel displacement: the car's, not the background's, with a calibrated standard deviation."""

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.tracking_scenes import CROP_PX, Car, Detector, appearance, car, crops_of, draw, road, watch
from velfield.tracking import crop_alignment
from velfield.tracking.crop_alignment import (
    align_prepared,
    prepare_crops,
)


def moved_cars(n: int, *, noise: float = 3.0, jitter: float = 0.8):
    """Crops of cars before and after a displacement over a fixed background; axes; the true shift between the crops."""
    rng = np.random.default_rng(11)
    ground = road(rng, (96, 96))
    before, after, axes, shifts = [], [], [], []
    for _ in range(n):
        heading, style = rng.uniform(0, np.pi), appearance(rng)
        at = rng.uniform(38, 42, 2)
        step = rng.uniform(8, 20) * np.array([np.cos(heading), np.sin(heading)])
        seen = []
        for k in (0, 1):
            x, y = at + k * step
            it = Car(lambda t, x=x, y=y: (x, y), lambda t, h=heading: h, *style)
            image = draw(ground, [it], 0.0) + rng.normal(0, noise, (96, 96))
            found = np.array([[x, y]]) + rng.normal(0, jitter, (1, 2))
            (before, after)[k].append(crops_of(image, found)[0])
            seen.append((x, y) - np.rint(found[0]))
        axes.append(heading + rng.normal(0, 0.05))
        shifts.append(seen[1] - seen[0])
    return np.array(before), np.array(after), np.array(axes) % np.pi, np.array(shifts)


def align_crops(before, after, axis_before, axis_after, first, second):
    return align_prepared(prepare_crops(before, axis_before), prepare_crops(after, axis_after), first, second)


def test_alignment_is_ten_times_more_accurate_than_the_detections() -> None:
    before, after, axes, shifts = moved_cars(60)
    index = np.arange(60)
    found = align_crops(before, after, axes, axes, index, index)
    aligned = np.isfinite(found[:, 2])
    errors = found[aligned, :2] - shifts[aligned]
    assert aligned.mean() >= 0.95
    assert np.sqrt(np.mean(errors**2)) < 0.12  # the detections' own: 1.1
    assert np.mean(np.abs(errors) <= 1.645 * found[aligned, 2:]) >= 0.87


def test_forward_and_backward_shifts_are_opposite() -> None:
    before, after, axes, _ = moved_cars(10)
    index = np.arange(10)
    forward = align_crops(before, after, axes, axes, index, index)
    backward = align_crops(after, before, axes, axes, index, index)
    both = np.isfinite(forward[:, 0] + backward[:, 0])
    assert both.sum() >= 9
    assert np.allclose(forward[both, :2], -backward[both, :2], atol=0.1)


def test_uniform_crops_do_not_align() -> None:
    flat = np.full((1, CROP_PX, CROP_PX), 100, np.uint8)
    zero = np.zeros(1, np.int64)
    assert np.isnan(align_crops(flat, flat, np.zeros(1), np.zeros(1), zero, zero)).all()


def test_an_alignment_does_not_depend_on_the_other_links() -> None:
    before, after, axes, _ = moved_cars(8)
    together = align_crops(before, after, axes, axes, np.arange(8), np.arange(8))
    for k in range(8):
        alone = align_crops(before, after, axes, axes, np.array([k]), np.array([k]))
        assert np.array_equal(alone[0], together[k], equal_nan=True)


@pytest.mark.parametrize("scale", [0.8, 1.7])
def test_displacements_are_in_base_pixels_at_any_working_scale(scale: float) -> None:
    from dataclasses import replace

    from schemas.flight import TrackingConfig
    from velfield.tracking.tracklets import link_windows

    rng = np.random.default_rng(2)
    perfect = Detector(recall=1.0, false_alarms=0.0, jitter_px=0.5)
    seen = watch([car(rng, (60.0, 60.0), (50.0, 0.0))], [0.0, 0.2, 0.4], rng=rng, detector=perfect)
    scaled = [replace(t, x_px=t.x_px / scale + 7, y_px=t.y_px / scale - 3, working_scale=scale) for t in seen.tables]
    found, log = link_windows(scaled, TrackingConfig(), gsd_m=None, starts=range(1))
    assert log["links_refined"] == 2
    expected = np.full(1, 50.0 / scale)
    assert np.allclose(found["vx_01_px_per_s"], expected, atol=1.0)
    assert np.allclose(found["vx_12_px_per_s"], expected, atol=1.0)


def test_crops_of_different_cars_do_not_align() -> None:
    rng = np.random.default_rng(4)
    one: NDArray[np.uint8] = rng.integers(0, 255, (1, CROP_PX, CROP_PX), np.uint8)
    other: NDArray[np.uint8] = rng.integers(0, 255, (1, CROP_PX, CROP_PX), np.uint8)
    zero = np.zeros(1, np.int64)
    found = align_crops(one, other, np.zeros(1), np.zeros(1), zero, zero)
    assert np.isnan(found).all() or found[0, 2] > 0.1


@pytest.mark.parametrize("spread", [3.0, 60.0])
@pytest.mark.parametrize("offset", [0.0, -30.0])
def test_the_median_is_that_of_the_values_that_count(spread: float, offset: float) -> None:
    """Near zero, where fewer steps lead to it, and far away; to a sixteenth of a grey level."""
    rng = np.random.default_rng(3)
    values = np.clip(rng.normal(offset, spread, 384), -255, 255).astype(np.float32)
    values[rng.permutation(384)[:181]] = 1e6
    counted = values[values < 256]
    middle = crop_alignment._median(values, np.float32(-256), len(counted))
    assert middle == pytest.approx(np.median(counted), abs=1 / 16)
    distance = crop_alignment._median(np.abs(values - middle), np.float32(0), len(counted))
    assert distance == pytest.approx(np.median(np.abs(counted - middle)), abs=1 / 16)
