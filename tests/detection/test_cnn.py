"""The network: layers against scipy, gradients against finite differences, its file, training, detections."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.signal import correlate

from schemas.arrays import FloatArray
from schemas.detector import CnnConfig
from velfield.bench.scenes import simulated_image
from velfield.detection.cnn.convolution import (
    PaddedBatchLayout,
    conv2d,
    conv2d_backward,
    depth_to_space,
    space_to_depth,
)
from velfield.detection.cnn.dataset import PatchDataset
from velfield.detection.cnn.fine_tuning import evaluate_network, fine_tune
from velfield.detection.cnn.inference import detect_cars
from velfield.detection.cnn.model import (
    CONVOLUTIONS,
    Network,
    forward,
    network_from_record,
    network_to_record,
    predict_heatmap,
)
from velfield.detection.cnn.trainer import Batch, Trainer, train
from velfield.detection.detector import from_record
from velfield.detection.files import shipped_detector
from velfield.detection.orientation import axial_difference, with_axes
from velfield.detection.samples import LabelledImage
from velfield.errors import InputError


def random(*shape: int, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


@pytest.mark.parametrize("taps", [1, 9])
def test_conv2d_equals_scipy_correlate(taps: int) -> None:
    layout, values, weights = PaddedBatchLayout(2, 13, 41), random(2, 13, 41, 3), random(taps, 3, 5, seed=1)
    out = layout.padded_view(conv2d(layout.pack(values), weights, layout))
    side = 3 if taps == 9 else 1
    for image in range(2):
        for k in range(5):
            kernel = weights[:, :, k].reshape(side, side, 3)
            expected = sum(correlate(values[image, :, :, c], kernel[:, :, c], mode="same") for c in range(3))
            np.testing.assert_allclose(out[image, 1:-1, 1:-1, k], expected, atol=1e-4)
    assert not out[:, 0].any()
    assert not out[:, -1].any()
    assert not out[:, :, 0].any()
    assert not out[:, :, -1].any()


@pytest.mark.parametrize("taps", [1, 9])
def test_conv2d_backward_is_the_adjoint_of_conv2d(taps: int) -> None:
    layout = PaddedBatchLayout(2, 12, 17)
    values, gradient = layout.pack(random(2, 12, 17, 4)), layout.pack(random(2, 12, 17, 6, seed=1))
    weights = random(taps, 4, 6, seed=2)
    product = float((conv2d(values, weights, layout) * gradient).sum())
    by_values, by_weights = conv2d_backward(values, weights, gradient, layout)
    assert float((by_values * values).sum()) == pytest.approx(product, rel=1e-3, abs=1e-2)
    assert float((by_weights * weights).sum()) == pytest.approx(product, rel=1e-3, abs=1e-2)


def test_depth_to_space_inverts_space_to_depth() -> None:
    layout, values = PaddedBatchLayout(3, 8, 12), random(3, 8, 12, 5)
    deep = space_to_depth(layout.pack(values), layout)
    assert layout.halved().interior_view(deep)[0, 1, 2, :5].tolist() == values[0, 2, 4].tolist()
    np.testing.assert_array_equal(layout.interior_view(depth_to_space(deep, layout)), values)


def batch() -> Batch:
    rng = np.random.default_rng(3)
    maps = [rng.random(shape).astype(np.float32) for shape in ((2, 16, 16), (2, 8, 8), (2, 8, 8), (2, 8, 8))]
    return Batch(maps[0], maps[1] ** 6, np.ones((2, 8, 8), np.float32), random(2, 8, 8, 2, seed=4), maps[3])


@pytest.mark.parametrize("normalised", [True, False])
def test_gradients_equal_finite_differences(normalised: bool) -> None:
    trainer = Trainer.initialise(1)
    for _ in range(20):
        trainer.train_step(batch(), 1e-3)
    trainer = trainer if normalised else Trainer.from_network(trainer.network())
    _, gradients = trainer.loss_and_gradients(batch())
    assert gradients.keys() == trainer.parameters.keys()
    for name, gradient in gradients.items():
        norm = float(np.linalg.norm(gradient.astype(np.float64)))
        value, step = trainer.parameters[name], (2e-3 / norm * gradient).astype(np.float32)
        trainer.parameters[name] = value + step
        above, _ = trainer.loss_and_gradients(batch())
        trainer.parameters[name] = value - step
        below, _ = trainer.loss_and_gradients(batch())
        trainer.parameters[name] = value
        assert (above - below) / 4e-3 == pytest.approx(norm, rel=0.05, abs=2e-4), name


@cache
def city(seed: int) -> LabelledImage:
    return simulated_image(seed)


def shipped() -> Network:
    return shipped_detector().network


def test_batch_normalisation_is_folded_into_the_weights() -> None:
    trainer = Trainer.initialise(2)
    for learning_rate in [1e-3] * 10 + [0.0] * 250:  # then the running statistics are those of this batch
        trainer.train_step(batch(), learning_rate)
    loss, _ = Trainer.from_network(trainer.network()).loss_and_gradients(batch())
    assert loss == pytest.approx(trainer.loss_and_gradients(batch())[0], rel=1e-3)


def test_tiled_inference_equals_that_of_the_whole_image() -> None:
    image = np.tile(city(77).image, (2, 2))[:500, :900]
    probability, orientation = predict_heatmap(shipped(), image)
    whole = forward(shipped(), (image / np.float32(255))[None])[0]
    inner = slice(32, -32)
    assert probability.shape == (250, 450)
    np.testing.assert_allclose(probability[inner, inner], 1 / (1 + np.exp(-whole[inner, inner, 0])), atol=1e-5)
    np.testing.assert_allclose(orientation[inner, inner], whole[inner, inner, 1:], atol=1e-4)


@pytest.mark.parametrize("shape", [(61, 83), (4, 4), (30, 500)])
def test_images_of_any_size_are_processed(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(0).integers(0, 255, shape).astype(np.uint8)
    assert predict_heatmap(shipped(), image)[0].shape == (-(-shape[0] // 2), -(-shape[1] // 2))
    assert detect_cars(shipped(), image, None).shape[1] == 5


def test_a_network_survives_its_record_at_half_precision() -> None:
    network = Trainer.from_network(shipped()).network()
    again = network_from_record(network_to_record(network))
    for name in CONVOLUTIONS:
        np.testing.assert_allclose(again.weights[name], network.weights[name], rtol=1e-3, atol=1e-6)
        np.testing.assert_allclose(again.biases[name], network.biases[name], rtol=1e-3, atol=1e-6)


def test_a_network_of_other_layers_is_an_input_error() -> None:
    record = network_to_record(shipped())
    with pytest.raises(InputError, match=r"layer head is None, expected \(1, 32, 3\)"):
        network_from_record({name: layer for name, layer in record.items() if name != "head"})
    with pytest.raises(InputError, match=r"layer head is \(9, 1, 16\)"):
        network_from_record({**record, "head": record["stem"]})


def test_batches_follow_from_their_number_and_the_seed() -> None:
    one, two = (PatchDataset([[city(9501)], [city(9502)]], [1.0, 2.0], seed) for seed in (4, 4))
    first = one(0)
    one(1)
    two(1)
    again = two(0)
    np.testing.assert_array_equal(first.images, again.images)
    np.testing.assert_array_equal(one(5).orientation, two(5).orientation)
    assert not np.array_equal(first.images, PatchDataset([[city(9501)], [city(9502)]], [1.0, 2.0], 5)(0).images)


def test_target_orientations_rotate_with_the_patch() -> None:
    """The outline of a car in a patch runs along its target orientation."""
    made = PatchDataset([[city(9501)]], [1.0], 0)(0)
    errors = []
    for image, heatmap, orientation in zip(made.images, made.heatmap, made.orientation, strict=True):
        for y, x in np.argwhere(heatmap > 0.9):
            if 8 < x < 40 and 8 < y < 40:
                car = np.array([[2 * x + 0.5, 2 * y + 0.5, np.nan, 16.0, 7.2]])
                estimated = with_axes((255 * image).astype(np.uint8), car)[:, 2]
                target = 0.5 * np.arctan2(orientation[y, x, 1:], orientation[y, x, :1])
                errors.append(axial_difference(estimated, target))
    assert len(errors) > 20
    assert np.median(errors) < np.radians(8)


def test_training_from_scratch_lowers_the_loss() -> None:
    losses: list[float] = []
    dataset = PatchDataset([[city(9501), city(9502)]], [1.0], 0)
    trainer = Trainer.initialise(0)
    train(trainer, dataset, steps=60, learning_rate=3e-3, on_step=lambda _, loss: losses.append(loss))
    assert np.mean(losses[-10:]) < 0.6 * np.mean(losses[:5])


def test_the_shipped_network_detects_cars_of_an_unseen_city() -> None:
    evaluation = evaluate_network(shipped(), city(9503))
    above = evaluation.score > shipped_detector().threshold
    assert evaluation.right[above].mean() > 0.85
    assert evaluation.right[above].sum() > 0.75 * evaluation.cars


def test_fine_tuning_is_deterministic_and_keeps_the_attribution() -> None:
    few = replace(city(9504), cars=city(9504).cars[:12], complete=False)
    config = CnnConfig(fine_tune_steps=5)
    one, again = (fine_tune([few], shipped_detector(), config) for _ in range(2))
    assert one.record == again.record
    assert one.record.attribution == shipped_detector().record.attribution
    assert one.threshold == shipped_detector().threshold  # too few cars for folds
    assert one.record.layers != shipped_detector().record.layers


def test_the_threshold_of_few_cars_is_shrunk_towards_the_pretrained_one() -> None:
    labelled = city(9504)
    own = fine_tune([labelled], shipped_detector(), CnnConfig(fine_tune_steps=2)).record
    strict = shipped_detector().record.model_copy(update={"threshold": shipped_detector().threshold + 0.1})
    shrunk = fine_tune([labelled], from_record(strict), CnnConfig(fine_tune_steps=2)).record
    weight = len(labelled.cars) / (len(labelled.cars) + 150)
    assert shrunk.threshold - own.threshold == pytest.approx(0.1 * (1 - weight))
    assert own.curve is not None
    assert own.curve.operating_point is not None
    assert own.curve.threshold[own.curve.operating_point] == pytest.approx(own.threshold, abs=0.03)


def test_a_network_for_cars_of_another_size_is_not_fine_tuned() -> None:
    with pytest.raises(InputError, match="cars of 16 px to continue, expected 20 px"):
        fine_tune([city(9504)], shipped_detector(), CnnConfig(working_car_length_px=20.0))


def test_a_car_truncated_by_the_frame_is_not_detected() -> None:
    """Two cars on a road: one whole, which is detected, one cut in half by the border."""
    image = np.full((96, 160), 90, np.uint8)
    image[:] += np.random.default_rng(0).integers(0, 12, image.shape).astype(np.uint8)
    for x in (0, 80):
        image[44:52, max(x - 8, 0) : x + 8] = 225
        image[46:50, max(x - 3, 0) : x + 3] = 60
    detections = detect_cars(shipped(), image, None)
    likely = detections[detections[:, 3] > 0]
    assert (np.hypot(likely[:, 0] - 79.5, likely[:, 1] - 47.5) < 4).any()
    assert not (likely[:, 0] < 3).any()
