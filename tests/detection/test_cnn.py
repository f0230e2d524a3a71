"""The network in use: its file, training from scratch, fine-tuning and the score threshold, images of any size."""

from base64 import b64encode
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from schemas.detector import CnnConfig, LayerRecord
from tests.detection.test_cnn_layers import random_network
from velfield.bench.scenes import simulated_image
from velfield.detection.cnn.dataset import PatchDataset
from velfield.detection.cnn.fine_tuning import evaluate_network, fine_tune
from velfield.detection.cnn.model import detect_cars, predict_heatmap
from velfield.detection.cnn.network import (
    FORMER_TOPOLOGY,
    Network,
    convolutions,
    network_from_layers,
    network_from_record,
    network_to_record,
)
from velfield.detection.cnn.trainer import Trainer, train
from velfield.detection.registry import shipped_detector, train_detector
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
    assert predict_heatmap(shipped(), image)[0].shape == (-(-shape[0] // 2), -(-shape[1] // 2))
    assert detect_cars(shipped(), image, None).shape[1] == 5


def test_a_network_survives_its_record_at_half_precision() -> None:
    network = Trainer.from_network(shipped()).network()
    again = network_from_record(network_to_record(network))
    for name in network.weights:
        np.testing.assert_allclose(again.weights[name], network.weights[name], rtol=1e-3, atol=1e-6)
        np.testing.assert_allclose(again.biases[name], network.biases[name], rtol=1e-3, atol=1e-6)


def layers_of(network: Network) -> dict[str, LayerRecord]:
    """The layers as a detector file of format version 1 holds them."""
    record = {}
    for name, conv in convolutions(network.topology).items():
        values = np.concatenate([network.weights[name].ravel(), network.biases[name]]).astype("<f2")
        record[name] = LayerRecord(shape=conv.shape, weights_f16=b64encode(values.tobytes()).decode())
    return record


def test_the_network_of_a_file_of_format_version_1_is_read() -> None:
    network = random_network(0, FORMER_TOPOLOGY)
    again = network_from_layers(layers_of(network))
    assert again.topology == FORMER_TOPOLOGY
    for name in network.weights:
        np.testing.assert_array_equal(again.weights[name], network.weights[name])
        np.testing.assert_array_equal(again.biases[name], network.biases[name])


def test_a_network_of_other_layers_is_an_input_error() -> None:
    record = layers_of(random_network(0, FORMER_TOPOLOGY))
    with pytest.raises(InputError, match=r"layer head is None, expected \(1, 32, 3\)"):
        network_from_layers({name: layer for name, layer in record.items() if name != "head"})
    with pytest.raises(InputError, match=r"layer head is \(9, 1, 16\)"):
        network_from_layers({**record, "head": record["stem"]})


def test_training_from_scratch_lowers_the_loss() -> None:
    losses: list[float] = []
    dataset = PatchDataset([[city(9501), city(9502)]], [1.0], 0)
    trainer = Trainer.initialise(0)
    train(trainer, dataset, steps=60, learning_rate=3e-3, on_step=lambda _, loss: losses.append(loss))
    assert np.mean(losses[-10:]) < 0.6 * np.mean(losses[:5])


def test_the_shipped_network_detects_cars_of_an_unseen_city() -> None:
    evaluation = evaluate_network(shipped(), city(9503))
    above = evaluation.score > shipped_detector().threshold
    assert evaluation.correct[above].mean() > 0.85
    assert evaluation.correct[above].sum() > 0.75 * evaluation.car_count


def test_fine_tuning_is_deterministic_and_keeps_the_attribution() -> None:
    few = replace(city(9504), cars=city(9504).cars[:12], complete=False)
    config = CnnConfig(fine_tune_steps=5)
    record = shipped_detector().record
    one, again = (fine_tune([few], shipped(), record, config) for _ in range(2))
    assert one == again
    assert one.attribution == record.attribution
    assert one.threshold == record.threshold  # too few cars for folds
    assert one.onnx != record.onnx


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


def test_a_network_for_cars_of_another_size_is_not_fine_tuned() -> None:
    with pytest.raises(InputError, match="cars of 16 px to continue, expected 20 px"):
        train_detector([city(9504)], CnnConfig(working_car_length_px=20.0))
