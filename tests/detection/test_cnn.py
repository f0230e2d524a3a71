"""The network in use: its file, fine-tuning and the score threshold, images of any size."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from schemas.detector import CnnConfig
from velfield.bench.scenes import simulated_image
from velfield.detection.cnn.fine_tuning import fine_tune
from velfield.detection.cnn.graph import network_from_record, network_to_record
from velfield.detection.cnn.inference import Predictor, predict_heatmap
from velfield.detection.cnn.model import detect_cars
from velfield.detection.cnn.network import Network
from velfield.detection.cnn.trainer import Trainer
from velfield.detection.registry import shipped_detector
from velfield.detection.samples import LabelledImage
from velfield.errors import InputError


@cache
def city(seed: int) -> LabelledImage:
    return simulated_image(seed)


def shipped() -> Network:
    return shipped_detector().network


@pytest.mark.parametrize("shape", [(61, 83), (4, 4), (30, 500)])
def test_images_of_any_size_are_processed(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(0).integers(0, 255, shape).astype(np.uint8)
    assert predict_heatmap(Predictor(shipped()), image)[0].shape == (-(-shape[0] // 2), -(-shape[1] // 2))
    assert detect_cars(Predictor(shipped()), image, None).shape[1] == 5


def test_a_network_survives_its_record_at_half_precision() -> None:
    network = Trainer.from_network(shipped()).network()
    again = network_from_record(network_to_record(network))
    for name in network.weights:
        np.testing.assert_allclose(again.weights[name], network.weights[name], rtol=1e-3, atol=1e-6)
        np.testing.assert_allclose(again.biases[name], network.biases[name], rtol=1e-3, atol=1e-6)


def test_fine_tuning_is_deterministic_and_keeps_the_attribution() -> None:
    few = replace(city(9504), cars=city(9504).cars[:12], complete=False)
    config = CnnConfig(fine_tune_steps=5)
    record = shipped_detector().record
    one, again = (fine_tune([few], shipped(), record, config) for _ in range(2))
    assert one == again
    assert one.attribution == record.attribution
    assert one.threshold == record.threshold  # too few cars to hold some out
    assert one.onnx != record.onnx


def test_labels_that_do_not_lie_on_cars_are_refused() -> None:
    """Those of another picture would train a detector that finds nothing."""
    labelled, other = city(9504), city(9505)
    config, record = CnnConfig(fine_tune_steps=2), shipped_detector().record
    with pytest.raises(InputError, match="labels do not lie on the cars of these pictures"):
        fine_tune([replace(labelled, cars=other.cars)], shipped(), record, config)


def test_the_threshold_of_few_cars_is_shrunk_towards_the_pretrained_one() -> None:
    labelled = city(9504)
    config, record = CnnConfig(fine_tune_steps=2), shipped_detector().record
    own = fine_tune([labelled], shipped(), record, config)
    strict = record.model_copy(update={"threshold": record.threshold + 0.1})
    shrunk = fine_tune([labelled], shipped(), strict, config)
    weight = len(labelled.cars) / (len(labelled.cars) + 150)
    assert shrunk.threshold - own.threshold == pytest.approx(0.1 * (1 - weight))
    assert own.curve is not None
    assert own.curve.operating_point is not None
    assert own.curve.threshold[own.curve.operating_point] == pytest.approx(own.threshold, abs=0.03)
