"""Training of the network: loss against a plain loop, gradients against finite differences, optimiser, schedule."""

from dataclasses import replace

import numpy as np
import pytest

from schemas.arrays import FloatArray
from tests.detection.test_cnn_layers import random_network
from velfield.detection.cnn.network import Network
from velfield.detection.cnn.trainer import (
    MAX_GRAD_NORM,
    WEIGHT_DECAY,
    Batch,
    LossNormaliser,
    Trainer,
    focal_loss_and_gradient,
    lr_schedule,
    train,
)


def random_batch(n: int = 2, side: int = 16, seed: int = 3) -> Batch:
    rng = np.random.default_rng(seed)
    half = (n, side // 2, side // 2)
    heatmap, weight = rng.random(half) ** 6, rng.random(half)
    heatmap.flat[0] = 1  # a car's centre
    parts = (rng.random((n, side, side)), heatmap, rng.random(half) < 0.8, rng.normal(size=(*half, 2)), weight)
    return Batch(*(part.astype(np.float32) for part in parts))


def as_double(batch: Batch) -> Batch:
    """Targets in double precision, for differences of small steps."""
    double = {name: values.astype(float) for name, values in vars(batch).items()}
    return Batch(**double)


def trained() -> Trainer:
    """A new trainer of weights that have seen a few steps."""
    trainer = Trainer.from_network(random_network(1))
    for _ in range(5):
        trainer.train_step(random_batch(), 1e-3)
    return Trainer.from_network(trainer.network())


def naive_loss(out: FloatArray, batch: Batch, normaliser: LossNormaliser) -> float:
    """The focal loss of CornerNet and the weighted squared error of the orientation, pixel by pixel."""
    heatmap_loss = orientation_loss = 0.0
    for index in np.ndindex(batch.heatmap.shape):
        y, known = float(batch.heatmap[index]), float(batch.mask[index])
        p = 1 / (1 + np.exp(-float(out[index][0])))
        heatmap_loss -= known * y**4 * (1 - p) ** 2 * np.log(p)
        heatmap_loss -= known * (1 - y) ** 2 * max(p - y, 0) ** 2 * np.log(1 - p)
        residual = out[index][1:] - batch.orientation[index]
        orientation_loss += float(batch.orientation_weight[index]) * float(residual @ residual)
    return heatmap_loss / normaliser.cars + 0.5 * orientation_loss / normaliser.orientation


def test_the_loss_equals_a_plain_loop() -> None:
    batch = random_batch()
    out = np.random.default_rng(0).normal(0, 2, (2, 8, 8, 3))
    normaliser = LossNormaliser.of(batch)
    assert normaliser.cars == pytest.approx(1 + sum((batch.heatmap**4 * batch.mask).ravel()), rel=1e-5)
    assert normaliser.orientation == pytest.approx(1 + batch.orientation_weight.sum(), rel=1e-5)
    loss, _ = focal_loss_and_gradient(out, as_double(batch), normaliser)
    assert loss == pytest.approx(naive_loss(out, batch, normaliser), rel=1e-6)


def test_the_gradient_of_the_loss_equals_finite_differences() -> None:
    batch = as_double(random_batch(n=1, side=8))
    out, normaliser = np.random.default_rng(0).normal(0, 2, (1, 4, 4, 3)), LossNormaliser.of(batch)
    _, gradient = focal_loss_and_gradient(out, batch, normaliser)
    for index in np.ndindex(out.shape):
        step = np.zeros(out.shape)
        step[index] = 1e-6
        above, _ = focal_loss_and_gradient(out + step, batch, normaliser)
        below, _ = focal_loss_and_gradient(out - step, batch, normaliser)
        assert (above - below) / 2e-6 == pytest.approx(gradient[index], rel=1e-4, abs=1e-7), index


def test_unknown_pixels_have_no_influence() -> None:
    batch = random_batch()
    batch = replace(batch, orientation_weight=batch.orientation_weight * batch.mask)
    normaliser = LossNormaliser.of(batch)
    out = np.random.default_rng(0).normal(0, 2, (2, 8, 8, 3))
    other = out + 3 * (batch.mask[..., None] == 0)
    loss, gradient = focal_loss_and_gradient(out, batch, normaliser)
    assert focal_loss_and_gradient(other, batch, normaliser)[0] == loss
    assert not gradient[batch.mask == 0].any()
    assert gradient[batch.mask > 0].any()


def test_pixels_predicted_well_count_little_and_those_near_a_centre_less_than_others() -> None:
    one = np.ones((1, 1, 1), np.float32)

    def loss(logit: float, heatmap: float) -> float:
        batch = Batch(np.zeros((1, 2, 2), np.float32), heatmap * one, one, np.zeros((1, 1, 1, 2), np.float32), 0 * one)
        return focal_loss_and_gradient(np.array([[[[logit, 0, 0]]]]), batch, LossNormaliser(1, 1))[0]

    assert loss(3, 1) < 0.01 * loss(0, 1)
    assert loss(-3, 0) < 0.01 * loss(0, 0)
    assert loss(0, 0.4) < 0.05 * loss(0, 0)
    assert np.isfinite(loss(-500, 1))
    assert np.isfinite(loss(500, 0))


def test_the_halves_of_a_batch_add_up_to_it() -> None:
    batch = random_batch(n=5)
    first, second = batch.halves()
    for name, values in vars(batch).items():
        np.testing.assert_array_equal(np.concatenate([getattr(first, name), getattr(second, name)]), values)
    out, normaliser = np.random.default_rng(0).normal(0, 1, (5, 8, 8, 3)), LossNormaliser.of(batch)
    whole, gradient = focal_loss_and_gradient(out, batch, normaliser)
    (one, by_one), (two, by_two) = (
        focal_loss_and_gradient(part, half, normaliser) for part, half in ((out[:2], first), (out[2:], second))
    )
    assert one + two == pytest.approx(whole, rel=1e-6)
    np.testing.assert_allclose(np.concatenate([by_one, by_two]), gradient)


def test_gradients_equal_finite_differences() -> None:
    trainer = trained()
    _, gradients = trainer.loss_and_gradients(random_batch())
    assert gradients.keys() == trainer.parameters.keys()
    for name, gradient in gradients.items():
        norm = float(np.linalg.norm(gradient.astype(np.float64)))
        value, step = trainer.parameters[name], (2e-3 / norm * gradient).astype(np.float32)
        trainer.parameters[name] = value + step
        above, _ = trainer.loss_and_gradients(random_batch())
        trainer.parameters[name] = value - step
        below, _ = trainer.loss_and_gradients(random_batch())
        trainer.parameters[name] = value
        assert (above - below) / 4e-3 == pytest.approx(norm, rel=0.05, abs=2e-4), name


def test_the_forward_pass_of_training_is_that_of_inference() -> None:
    trainer, batch = trained(), random_batch(n=1)
    expected, _ = focal_loss_and_gradient(
        Trainer.from_network(trainer.network()).predict(batch.images), batch, LossNormaliser.of(batch)
    )
    assert trainer.loss_and_gradients(batch)[0] == expected


def test_fine_tuning_does_not_depend_on_how_a_batch_is_halved() -> None:
    trainer, batch = trained(), random_batch(n=3)
    order = [2, 0, 1]
    shuffled = Batch(**{name: values[order] for name, values in vars(batch).items()})
    loss, gradients = trainer.loss_and_gradients(batch)
    other_loss, other = trainer.loss_and_gradients(shuffled)
    assert other_loss == pytest.approx(loss, rel=1e-5)
    for name, gradient in gradients.items():
        np.testing.assert_allclose(other[name], gradient, rtol=1e-3, atol=1e-4 * np.abs(gradient).max())


def test_fine_tuning_starts_from_copies_of_the_weights() -> None:
    network = trained().network()
    before = {name: weights.copy() for name, weights in network.weights.items()}
    trainer = Trainer.from_network(network)
    trainer.train_step(random_batch(), 1e-2)
    for name, weights in before.items():
        np.testing.assert_array_equal(network.weights[name], weights)
        assert not np.array_equal(trainer.network().weights[name], weights), name


def test_the_first_step_is_that_of_adam_with_decoupled_weight_decay() -> None:
    """Bias correction makes the first step the sign of the gradient, whatever its size."""
    trainer, rate = trained(), 1e-3
    before = dict(trainer.parameters)
    loss, gradients = trainer.loss_and_gradients(random_batch())
    assert trainer.train_step(random_batch(), rate) == loss
    norm = np.sqrt(sum(float((gradient.astype(float) ** 2).sum()) for gradient in gradients.values()))
    for name, gradient in gradients.items():
        clipped = gradient * min(1.0, MAX_GRAD_NORM / norm)
        expected = before[name] * (1 - rate * WEIGHT_DECAY) - rate * clipped / (np.abs(clipped) + 1e-8)
        np.testing.assert_allclose(trainer.parameters[name], expected, atol=1e-6)


def test_the_learning_rate_warms_up_and_decays_along_a_cosine() -> None:
    assert lr_schedule(0) == pytest.approx(0.05)
    assert lr_schedule(0.05) == pytest.approx(0.525)
    assert lr_schedule(0.1) == pytest.approx(1, abs=2e-3)
    assert lr_schedule(0.55) == pytest.approx(0.5, abs=2e-3)
    assert lr_schedule(1) == pytest.approx(1e-3)


def test_training_follows_the_schedule_and_reports_each_step(monkeypatch: pytest.MonkeyPatch) -> None:
    rates: list[float] = []
    steps: list[tuple[int, float]] = []
    trainer = trained()
    monkeypatch.setattr(Trainer, "train_step", lambda self, batch, rate: rates.append(rate) or len(rates))
    batches = [random_batch(n=1, seed=k) for k in range(4)]
    network = train(
        trainer, batches.__getitem__, steps=4, learning_rate=2.0, on_step=lambda step, loss: steps.append((step, loss))
    )
    assert isinstance(network, Network)
    assert rates == [2 * lr_schedule(k / 4) for k in range(4)]
    assert steps == [(0, 1), (1, 2), (2, 3), (3, 4)]


def test_a_single_batch_can_be_overfitted() -> None:
    losses: list[float] = []
    train(
        Trainer.from_network(random_network(0)),
        lambda _: random_batch(n=1, side=16),
        steps=150,
        learning_rate=3e-3,
        on_step=lambda _, loss: losses.append(loss),
    )
    assert losses[-1] < 0.1 * losses[0]
