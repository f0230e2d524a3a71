"""Pre-training in PyTorch against the project's own training: the same network, the same loss."""

import numpy as np
import pytest

from tools.hard_patches import HardPatchDataset
from velfield.bench.scenes import simulated_image
from velfield.detection.cnn.inference import Predictor
from velfield.detection.cnn.model import detect_cars
from velfield.detection.cnn.network import Network
from velfield.detection.cnn.trainer import LossNormaliser, Trainer, focal_loss_and_gradient
from velfield.detection.registry import shipped_detector

torch = pytest.importorskip("torch", reason="PyTorch is not installed: `pip install torch`")


def shipped() -> Network:
    network: Network = shipped_detector().network
    return network


def test_training_starts_from_the_network_given_and_the_loss_is_that_of_fine_tuning() -> None:
    from tools.pretraining import focal_loss, start_from, to_network

    batch = HardPatchDataset([[simulated_image(9504)]], [1.0], 0)(0)
    module = start_from(shipped(), batch.images)
    with torch.no_grad():
        out = module(torch.from_numpy(batch.images)[:, None])
        loss = float(focal_loss(out[:, :3], batch))
    expected = Trainer.from_network(shipped()).predict(batch.images)
    np.testing.assert_allclose(out[:, :3].numpy().transpose(0, 2, 3, 1), expected, atol=2e-3)
    assert not out[:, 3:].any()
    assert loss == pytest.approx(focal_loss_and_gradient(expected, batch, LossNormaliser.of(batch))[0], rel=1e-3)
    again = Trainer.from_network(to_network(module)).predict(batch.images)
    np.testing.assert_allclose(again, expected, atol=2e-3)


def test_pretraining_lowers_the_loss_and_learns_sizes() -> None:
    from tools.pretraining import SizedBatch, pretrain

    groups, seen = [[simulated_image(9504)]], []
    pretrain(groups, [1.0], start=shipped(), seed=0, steps=60, on_step=lambda _, loss, module: seen.append(loss))
    assert np.mean(seen[-8:]) < 0.9 * np.mean(seen[:8])
    batch = SizedBatch.of(HardPatchDataset(groups, [1.0], 0).make_patches(0))
    lengths = 16 * np.exp(batch.size[batch.size_weight[..., 0] > 0.5][:, 0])
    assert 10 < lengths.min() < lengths.max() < 70


def test_unlabelled_tiles_are_labelled_only_where_both_networks_are_certain() -> None:
    from tools.pretraining import label_tiles, start_from

    tile = simulated_image(9504)
    x, y = np.rint(tile.cars[len(tile.cars) // 2, :2] - 44).astype(int).clip(0)
    part = type(tile)(np.ascontiguousarray(tile.image[y : y + 88, x : x + 88]), np.empty((0, 5)))
    module = start_from(shipped(), np.stack([np.zeros((96, 96), np.float32), np.ones((96, 96), np.float32)]))
    (labelled,) = label_tiles(module, shipped(), [part])
    assert 0.2 < labelled.valid.mean() <= 1
    rows, columns = (np.rint(labelled.cars[:, k]).astype(int) for k in (1, 0))
    assert labelled.valid[rows, columns].all()


def test_sizes_are_fitted_to_the_network_which_stays_as_it_is() -> None:
    from tools.sizes import fit_sizes

    bare = Trainer.from_network(shipped()).network()
    assert not bare.measures
    scene = simulated_image(9504)
    fitted = fit_sizes(bare, [[scene]], [1.0], seed=0, steps=30)
    for name, weights in bare.weights.items():
        np.testing.assert_array_equal(fitted.weights[name], weights)
    found = detect_cars(Predictor(fitted), scene.image, None)
    distance = np.hypot(*(found[:, None, :2] - scene.cars[None, :, :2]).transpose(2, 0, 1))
    near = distance.min(axis=1) < 3
    lengths = scene.cars[distance.argmin(axis=1)[near], 3]
    assert near.sum() > 20
    assert np.median(np.abs(np.log(found[near, 5] / lengths))) < 0.12
