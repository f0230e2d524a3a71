"""Pre-training in PyTorch against the project's own training: the same network, the same loss."""

import numpy as np
import pytest

from velfield.bench.scenes import simulated_image
from velfield.detection.cnn.dataset import PatchDataset
from velfield.detection.cnn.network import TOPOLOGIES, Topology
from velfield.detection.cnn.trainer import LossNormaliser, Trainer, focal_loss_and_gradient

torch = pytest.importorskip("torch", reason="PyTorch is not installed: `pip install torch`")


@pytest.mark.parametrize("topology", TOPOLOGIES)
def test_the_module_is_the_network_and_its_loss_the_same(topology: Topology) -> None:
    from tools.pretraining import build_module, focal_loss, to_network

    batch = PatchDataset([[simulated_image(9504)]], [1.0], 0, hard=True)(0)
    module = build_module(0, topology).eval()
    with torch.no_grad():
        out = module(torch.from_numpy(batch.images)[:, None])
        loss = float(focal_loss(out, batch))
    expected = Trainer.from_network(to_network(module, topology)).predict(batch.images)
    np.testing.assert_allclose(out.numpy().transpose(0, 2, 3, 1), expected, atol=1e-3)
    assert loss == pytest.approx(focal_loss_and_gradient(expected, batch, LossNormaliser.of(batch))[0], rel=1e-4)


def test_pretraining_lowers_the_loss_with_a_teacher() -> None:
    from tools.pretraining import pretrain
    from velfield.detection.detector import shipped_detector

    losses: list[float] = []
    groups, teacher = [[simulated_image(9504)]], shipped_detector().network
    pretrain(groups, [1.0], seed=0, steps=40, teacher=teacher, on_step=lambda _, loss: losses.append(loss))
    assert np.mean(losses[-8:]) < 0.6 * np.mean(losses[:8])
