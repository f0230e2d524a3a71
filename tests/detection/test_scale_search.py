"""The size of a car by the detector that ships: found at the right scale, and nowhere where there are no cars."""

from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from schemas.arrays import GreyImage
from tools.training_data import read_boxes
from velfield.bench.scenes import simulated_image
from velfield.detection.registry import shipped_detector
from velfield.detection.scale_search import STEP, View, find_scale, is_plausible_scale, spread_windows
from velfield.pipeline.stages.labels import rescale

SCALES = 0.1 * STEP ** np.arange(17)


def search(image: GreyImage) -> float | None:
    def views(scale: float, area_px: int) -> Iterator[View]:
        for x, y, width, height in spread_windows(image.shape[1], image.shape[0], area_px / scale**2):
            resampled = rescale(image[y : y + height, x : x + width], scale)
            yield resampled, np.ones(resampled.shape, bool)

    return find_scale(views, shipped_detector(), SCALES)


@pytest.mark.parametrize(("seed", "factor"), [(951, 1.0), (952, 0.75), (953, 1.3)])
def test_the_scale_of_cars_is_found(seed: int, factor: float) -> None:
    scene = simulated_image(seed)
    found = search(rescale(scene.image, factor))
    assert found == pytest.approx(16 / (factor * np.median(scene.cars[:, 3])), rel=0.06)


@pytest.mark.footage
@pytest.mark.parametrize("name", ["00003", "00972"])
def test_the_scale_of_real_cars_is_found(footage: Callable[[str], Path], name: str) -> None:
    """The median of the lengths of cars that were marked by hand; the picture shows buses as well."""
    picture, boxes = read_boxes(footage("songdo") / f"{name}.jpg")
    found = search(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))
    assert found == pytest.approx(16 / np.median(boxes[boxes[:, 0] == 0, 5]), rel=0.06)


def test_windows_are_spread_and_hold_the_area() -> None:
    assert spread_windows(300, 200, 70_000) == [(0, 0, 300, 200)]
    windows = np.array(spread_windows(3000, 2000, 600_000))
    assert (windows[:, 2] * windows[:, 3]).sum() == pytest.approx(600_000, rel=0.02)
    middles = windows[:, :2] + windows[:, 2:] / 2
    expected = [[x, y] for x in (500, 1500, 2500) for y in (500, 1500)]
    np.testing.assert_allclose(sorted(middles.tolist()), expected, atol=1)


def test_only_the_right_scale_is_plausible() -> None:
    image = simulated_image(951).image
    images = [rescale(image, factor) for factor in (0.25, 1.0, 4.0)]
    views = [[(one, np.ones(one.shape, bool))] for one in images]
    assert [is_plausible_scale(one, shipped_detector()) for one in views] == [False, True, False]


def test_no_scale_is_found_without_cars() -> None:
    rng = np.random.default_rng(4)
    coarse = rng.uniform(60, 180, (24, 32))
    ground = np.kron(coarse, np.ones((20, 20))) + rng.normal(0, 8, (480, 640))
    assert search(np.clip(ground, 0, 255).astype(np.uint8)) is None
