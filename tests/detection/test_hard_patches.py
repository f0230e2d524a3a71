"""What pre-training does to patches."""

import numpy as np

from tests.detection.test_cnn_dataset import bars, patches, sample
from tools.hard_patches import HardPatchDataset, camouflage_cars, compress, cut_by_edge
from velfield.detection.cnn.dataset import PATCH_PX
from velfield.detection.cnn.network import STRIDE


def test_camouflage_brings_cars_nearer_to_the_road_and_leaves_the_rest() -> None:
    patch = np.full((PATCH_PX, PATCH_PX), 0.4, np.float32)
    patch[44:52, 40:56] = 0.9
    vehicles = np.array([[47.5, 47.5, 0, 16, 8]])
    contrasts = []
    for seed in range(40):
        changed = camouflage_cars(patch.copy(), vehicles, np.random.default_rng(seed))
        np.testing.assert_array_equal(changed[:30], patch[:30])
        contrasts.append(float(changed[47, 48] - changed[10, 10]))
    assert min(contrasts) < 0.25  # of 0.5
    assert np.isclose(contrasts, 0.5).sum() > 10  # most patches and half of the cars stay as they are
    assert max(contrasts) <= 0.52


def test_beyond_the_edge_lies_the_mirror_image_which_is_not_counted() -> None:
    for seed in range(8):
        patch = np.random.default_rng(seed).random((PATCH_PX, PATCH_PX)).astype(np.float32)
        mask = np.ones((PATCH_PX // STRIDE,) * 2, bool)
        cut = cut_by_edge(patch, mask, np.random.default_rng(seed))
        kept = np.flatnonzero((cut == patch).all(axis=0))
        edge = kept[-1] if kept[0] == 0 else kept[0]
        step = 1 if kept[0] == 0 else -1
        np.testing.assert_array_equal(cut[:, edge + step], patch[:, edge - step])
        counted = np.flatnonzero(mask.all(axis=0))
        assert 0 < len(counted) < PATCH_PX // STRIDE
        assert abs(len(counted) * STRIDE - len(kept)) <= STRIDE


def test_the_losses_of_video_keep_a_patch_and_its_range() -> None:
    patch = patches(bars()).images[0]
    lossy = compress(patch, np.random.default_rng(0))
    assert lossy.shape == patch.shape
    assert 0 <= lossy.min() < lossy.max() <= 1
    assert 0.002 < np.abs(lossy - patch).mean() < 0.1


def test_patches_are_centred_near_long_vehicles_more_often() -> None:
    cars = np.array([[100.0, 100, 0, 16, 7], [300.0, 300, 0, 45, 9]])
    one, rng = HardPatchDataset([[sample(np.zeros((400, 400), np.uint8), cars)]], [1.0], 0), np.random.default_rng(0)
    assert np.mean([one.choose_car(cars, rng) for _ in range(400)]) > 2.5 / 3.5
