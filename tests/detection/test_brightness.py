"""A dark flight is brightened before the network sees it."""

import numpy as np
import pytest

from schemas.arrays import GreyImage
from schemas.detector import CnnConfig
from velfield.bench.scenes import simulated_image
from velfield.detection.cnn.brightness import USUAL_MEDIAN, brighten, gamma_of
from velfield.detection.evaluation import f_measure, match_labels
from velfield.detection.registry import shipped_detector
from velfield.detection.samples import LabelledImage


def underexposed(image: GreyImage, factor: float) -> GreyImage:
    return np.rint(image * factor).astype(np.uint8)


def f1(image: GreyImage, sample: LabelledImage) -> float:
    found = shipped_detector().detect(image)
    right, counted = match_labels(found.xy[np.argsort(-found.score)], sample.cars, sample.ignore)
    return f_measure(right[counted].mean(), right[counted].sum() / len(sample.cars))


@pytest.mark.parametrize("level", [80, 120, 170])
def test_the_median_is_brought_to_the_usual_one(level: int) -> None:
    image = np.array([[0, level, 255]], np.uint8)
    assert brighten(image, gamma_of(image))[0, 1] == pytest.approx(255 * USUAL_MEDIAN, abs=1)
    assert brighten(image, gamma_of(image))[0, [0, 2]].tolist() == [0, 255]


def test_bright_images_and_their_order_of_greys_stay() -> None:
    levels = np.arange(256, dtype=np.uint8)[None]
    np.testing.assert_array_equal(brighten(levels, gamma_of(np.full((4, 4), 200, np.uint8))), levels)
    assert (np.diff(brighten(levels, 0.5).astype(int)) >= 0).all()


def test_an_underexposed_city_is_seen_as_well() -> None:
    """A fifth of the light; without brightening F1 falls from 0.95 to 0.86."""
    sample = simulated_image(9803)
    usual = f1(sample.image, sample)
    assert f1(underexposed(sample.image, 0.2), sample) > usual - 0.03


def test_a_flight_has_one_exponent() -> None:
    """That of all its images, not of a part of a frame, in the file that the run keeps."""
    dark, bright = np.full((64, 64), 50, np.uint8), np.full((64, 64), 230, np.uint8)
    record = shipped_detector().in_light_of([dark, dark, bright]).for_flight([bright], CnnConfig()).record
    assert record.gamma == gamma_of(dark)
    assert shipped_detector().record.gamma is None
