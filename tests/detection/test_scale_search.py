"""The size of a car by the detector that ships: found at the right scale, and nowhere where there are no cars."""

from collections.abc import Iterator

import numpy as np
import pytest

from schemas.arrays import FloatArray, GreyImage
from velfield.bench.scenes import simulated_image
from velfield.detection.registry import shipped_detector
from velfield.detection.scale_search import STEP, View, find_scale, is_plausible_scale
from velfield.pipeline.stages.labels import rescale
from velfield.tracking.dimensions import measure

SCALES = 0.4 * STEP ** np.arange(11)


def measure_px(strips: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    size = measure(strips)
    return size.length, size.length_sd, size.width


def search(image: GreyImage) -> float | None:
    def views(scale: float) -> Iterator[View]:
        resampled = rescale(image, scale)
        yield resampled, np.ones(resampled.shape, bool)

    return find_scale(views, shipped_detector(), SCALES, measure_px)


@pytest.mark.parametrize(("seed", "factor"), [(951, 1.0), (952, 0.75), (953, 1.3)])
def test_the_scale_of_cars_is_found(seed: int, factor: float) -> None:
    image = simulated_image(seed).image
    found = search(rescale(image, factor))
    assert found is not None
    assert found == pytest.approx(1 / factor, rel=0.2)


def test_only_the_right_scale_is_plausible() -> None:
    image = simulated_image(951).image
    images = [rescale(image, factor) for factor in (0.25, 1.0, 4.0)]
    views = [[(one, np.ones(one.shape, bool))] for one in images]
    assert [is_plausible_scale(one, shipped_detector(), measure_px) for one in views] == [False, True, False]


def test_no_scale_is_found_without_cars() -> None:
    rng = np.random.default_rng(4)
    coarse = rng.uniform(60, 180, (24, 32))
    ground = np.kron(coarse, np.ones((20, 20))) + rng.normal(0, 8, (480, 640))
    assert search(np.clip(ground, 0, 255).astype(np.uint8)) is None
