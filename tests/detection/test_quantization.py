"""The network in integers of 8 bits."""

import numpy as np
import pytest

from schemas.arrays import GreyImage
from schemas.detector import CnnConfig
from tests.detection.test_cnn_layers import random_network
from velfield.detection import runtime
from velfield.detection.cnn.graph import network_to_onnx
from velfield.detection.cnn.inference import Predictor, predict_crops
from velfield.detection.cnn.quantization import INEXACT, calibrate, quantized_to_onnx
from velfield.detection.registry import load_detector, shipped_detector


def cars(seed: int = 0, shape: tuple[int, int] = (208, 304)) -> GreyImage:
    """Cars of 16 x 8 px on noise, some brighter and some darker than the ground."""
    rng = np.random.default_rng(seed)
    image = rng.normal(110, 6, shape)
    for y, x in np.stack([rng.integers(12, size - 12, 30) for size in shape], axis=1):
        image[y - 4 : y + 4, x - 8 : x + 8] = rng.choice([40, 70, 190, 230])
        image[y - 3 : y + 3, x + 2 : x + 5] = 30
    return np.clip(image, 0, 255).astype(np.uint8)


@pytest.mark.usefixtures("exact")
def test_eight_bits_give_nearly_the_heatmap_of_floating_point() -> None:
    network, image = shipped_detector().network, cars()[None]
    wanted, axes, sizes = Predictor(network)(image)
    found, found_axes, found_sizes = Predictor(network, calibrate(network, [cars(1), cars(2)]))(image)
    at = wanted > 0.2
    assert at.sum() > 100
    assert not np.array_equal(wanted, found)
    assert np.sqrt(np.mean((wanted - found)[at] ** 2)) < 0.03
    assert np.median(np.abs(axes - found_axes)[0, :, at[0]]) < 0.05
    at_sizes = at[0].reshape(52, 2, 76, 2).any(axis=(1, 3))
    assert np.median(np.abs(sizes - found_sizes)[0, :2, at_sizes]) < 0.02


@pytest.mark.usefixtures("exact")
def test_a_network_of_random_weights_is_near_to_floating_point() -> None:
    network = random_network(3)
    wanted, *_ = Predictor(network)(cars()[None])
    found, *_ = Predictor(network, calibrate(network, [cars(1)], crops=16))(cars()[None])
    assert np.ptp(wanted) > 0.9
    assert np.sqrt(np.mean((wanted - found) ** 2)) < 0.02


@pytest.mark.usefixtures("exact")
def test_a_crop_gives_the_same_alone_and_among_others() -> None:
    network = shipped_detector().network
    predict = Predictor(network, calibrate(network, [cars(1)], crops=16))
    images = np.stack([cars(k, (96, 96)) for k in range(5)])
    np.testing.assert_array_equal(predict(images)[0], np.concatenate([predict(one[None])[0] for one in images]))


def test_of_long_crops_of_one_size_each_is_predicted() -> None:
    """They are longer than a tile, and several would fit into a batch."""
    network = shipped_detector().predictor
    image = np.random.default_rng(4).integers(0, 256, (64, 2112), dtype=np.uint8)
    crops = np.array([(0, 0, 24, 2056), (32, 16, 24, 2056)])
    together = predict_crops(network, image, crops)
    for y, x, height, width in crops:
        alone = predict_crops(network, image, np.array([(y, x, height, width)]))
        part = slice(y // 2, (y + height) // 2), slice(x // 2, (x + width) // 2)
        np.testing.assert_array_equal(together[0][part], alone[0][part])
        assert alone[0][part].any()
        np.testing.assert_array_equal(together[1][:, *part], alone[1][:, *part])
        part = slice(y // 4, (y + height) // 4), slice(x // 4, (x + width) // 4)
        np.testing.assert_array_equal(together[2][:, *part], alone[2][:, *part])


def test_crops_of_an_image_are_predicted_as_if_alone() -> None:
    network, image = shipped_detector().predictor, cars(2, (120, 160))
    crops = np.array([(0, 0, 48, 32), (0, 32, 48, 32), (48, 8, 64, 112), (0, 80, 48, 48)])
    probability, orientation = np.zeros((60, 80), np.float32), np.zeros((2, 60, 80), np.float32)
    sizes = np.zeros((4, 30, 40), np.float32)
    for y, x, height, width in crops:
        part = slice(y // 2, (y + height) // 2), slice(x // 2, (x + width) // 2)
        alone = network(image[None, y : y + height, x : x + width])
        probability[part], orientation[:, *part] = alone[0][0], alone[1][0]
        sizes[:, y // 4 : (y + height) // 4, x // 4 : (x + width) // 4] = alone[2][0]
    found = predict_crops(network, image, crops)
    np.testing.assert_allclose(found[0], probability, atol=1e-5)
    np.testing.assert_allclose(found[1], orientation, atol=1e-5)
    np.testing.assert_allclose(found[2], sizes, atol=1e-5)
    assert not found[0][:, 64:].any()


def test_ranges_are_of_the_flight_and_the_setting_and_come_back_from_the_file(tmp_path) -> None:
    detector = shipped_detector()
    eight = detector.for_flight([cars(1)], CnnConfig())
    again = detector.for_flight([cars(1)], CnnConfig())
    assert eight.record.activation_ranges == again.record.activation_ranges
    assert eight.record.activation_ranges != detector.for_flight([cars(2)], CnnConfig()).record.activation_ranges
    eight.save(tmp_path / "detector.json")
    loaded = load_detector(tmp_path / "detector.json")
    assert loaded.predictor.ranges == eight.record.activation_ranges
    assert eight.for_flight([cars(1)], CnnConfig(precision="float32")).predictor.ranges is None


def test_small_images_are_calibrated_on_smaller_crops_and_smaller_ones_refused() -> None:
    network = shipped_detector().network
    assert calibrate(network, [cars(1, (60, 90))], crops=4)
    with pytest.raises(ValueError, match="expected 96 or more"):
        calibrate(network, [np.zeros((4, 90), np.uint8)], crops=4)


def test_a_processor_that_saturates_takes_floating_point_and_says_so(monkeypatch) -> None:
    for module in ("detector", "inference"):
        monkeypatch.setattr(f"velfield.detection.cnn.{module}.is_exact", lambda: False)
    monkeypatch.setattr(runtime, "_limitations_reported", False)
    detector = shipped_detector().for_flight([cars(1)], CnnConfig())
    assert (detector.notes, detector.limitations) == ([INEXACT], [])
    with pytest.warns(RuntimeWarning, match="VNNI"):
        found, *_ = detector.predictor(cars()[None])
    np.testing.assert_array_equal(found, shipped_detector().predictor(cars()[None])[0])


def test_the_model_holds_bytes() -> None:
    network = shipped_detector().network
    model = quantized_to_onnx(network, calibrate(network, [cars(1)], crops=4))
    assert len(model) < len(network_to_onnx(network))
