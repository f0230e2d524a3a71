"""Layers of the network on packed matrices: against scipy, as adjoints, and the network written out by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import correlate

from schemas.arrays import Float32Array, FloatArray
from velfield.detection.cnn import model
from velfield.detection.cnn.model import (
    CONVOLUTIONS,
    STRIDE,
    TOPOLOGY,
    Conv,
    DepthToSpace,
    Network,
    PaddedBatchLayout,
    Residual,
    SpaceToDepth,
    conv2d,
    conv2d_backward,
    depth_to_space,
    forward,
    predict_heatmap,
    space_to_depth,
)

SIZES = st.integers(1, 9)
CHANNELS = st.integers(1, 4)


def normal(*shape: int, seed: int = 0) -> Float32Array:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def random_network(seed: int = 0) -> Network:
    """Random weights that keep the size of the activations."""
    rng = np.random.default_rng(seed)
    scales = {name: np.sqrt(2 / (conv.shape[0] * conv.channels_in)) for name, conv in CONVOLUTIONS.items()}
    return Network(
        {name: rng.normal(0, scales[name], conv.shape).astype(np.float32) for name, conv in CONVOLUTIONS.items()},
        {name: rng.normal(0, 0.1, conv.channels_out).astype(np.float32) for name, conv in CONVOLUTIONS.items()},
    )


def scipy_conv(image: FloatArray, weights: FloatArray) -> FloatArray:
    """Convolution of an image (h, w, c) with "same" zero padding, by scipy."""
    side = 3 if len(weights) == 9 else 1
    kernels = weights.reshape(side, side, *weights.shape[1:])
    height, width, channels = image.shape
    out = np.zeros((height, width, weights.shape[2]))
    padded = np.pad(image, ((side // 2,) * 2, (side // 2,) * 2, (0, 0)))
    for k in range(weights.shape[2]):
        for c in range(channels):
            out[..., k] += correlate(padded[..., c], kernels[:, :, c, k], mode="valid", method="direct")
    return out


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 3), SIZES, SIZES, CHANNELS, CHANNELS, st.sampled_from([1, 9]))
def test_conv2d_equals_scipy_for_any_size(
    n: int, h: int, w: int, channels_in: int, channels_out: int, taps: int
) -> None:
    layout, images = PaddedBatchLayout(n, h, w), normal(n, h, w, channels_in)
    weights = normal(taps, channels_in, channels_out, seed=1)
    out = conv2d(layout.pack(images), weights, layout)
    assert out.shape == (layout.rows, channels_out)
    for k in range(n):
        np.testing.assert_allclose(layout.interior_view(out)[k], scipy_conv(images[k], weights), atol=1e-4)
    interior = layout.interior_view(out).copy()
    layout.interior_view(out)[...] = 0
    assert not out.any()
    np.testing.assert_array_equal(layout.interior_view(layout.pack(interior)), interior)


@settings(max_examples=25, deadline=None)
@given(SIZES, SIZES, CHANNELS, CHANNELS, st.sampled_from([1, 9]))
def test_conv2d_backward_is_adjoint(h: int, w: int, channels_in: int, channels_out: int, taps: int) -> None:
    """conv2d is linear in its input and in its weights: <conv2d(x, v), g> = <x, dx> = <v, dv> for any x and v."""
    layout = PaddedBatchLayout(2, h, w)
    values, gradient = layout.pack(normal(2, h, w, channels_in)), layout.pack(normal(2, h, w, channels_out, seed=1))
    weights = normal(taps, channels_in, channels_out, seed=2)
    by_values, by_weights = conv2d_backward(values, weights, gradient, layout)
    other, other_weights = layout.pack(normal(2, h, w, channels_in, seed=3)), normal(*weights.shape, seed=4)
    expected = float((conv2d(other, weights, layout) * gradient).sum())
    assert float((by_values * other).sum()) == pytest.approx(expected, rel=1e-3, abs=1e-2)
    expected = float((conv2d(values, other_weights, layout) * gradient).sum())
    assert float((by_weights * other_weights).sum()) == pytest.approx(expected, rel=1e-3, abs=1e-2)


@pytest.mark.parametrize("rows", [1, 7, 100_000])
def test_the_size_of_blocks_does_not_matter(monkeypatch: pytest.MonkeyPatch, rows: int) -> None:
    layout, weights = PaddedBatchLayout(2, 13, 17), normal(9, 3, 4, seed=1)
    values = layout.pack(normal(2, 13, 17, 3))
    expected = conv2d(values, weights, layout)
    monkeypatch.setattr(model, "_BLOCK_ROWS", rows)
    np.testing.assert_allclose(conv2d(values, weights, layout), expected, atol=1e-5)


def test_a_layout_counts_its_borders_and_zeroes_them() -> None:
    layout = PaddedBatchLayout(2, 4, 6)
    assert layout.rows == 2 * 6 * 8
    assert layout.halved() == PaddedBatchLayout(2, 2, 3)
    assert layout.halved().doubled() == layout
    values = np.ones((layout.rows, 3), np.float32)
    layout.zero_border(values)
    assert values.sum() == 2 * 4 * 6 * 3
    assert layout.interior_view(values).all()
    layout.interior_view(values)[0, 0, 0, 0] = 7
    assert layout.padded_view(values)[0, 1, 1, 0] == 7  # views, not copies


def test_space_to_depth_orders_channels_by_row_then_column_of_the_block() -> None:
    layout = PaddedBatchLayout(1, 4, 4)
    coordinates = np.stack(np.meshgrid(np.arange(4), np.arange(4), indexing="ij"), -1).astype(np.float32)[None]
    deep = layout.halved().interior_view(space_to_depth(layout.pack(coordinates), layout))
    assert deep[0, 1, 0].tolist() == [2, 0, 2, 1, 3, 0, 3, 1]


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 3), st.integers(1, 5), st.integers(1, 5), CHANNELS)
def test_depth_to_space_inverts_space_to_depth(n: int, half_h: int, half_w: int, channels: int) -> None:
    layout, images = PaddedBatchLayout(n, 2 * half_h, 2 * half_w), normal(n, 2 * half_h, 2 * half_w, channels)
    deep = space_to_depth(layout.pack(images), layout)
    assert deep.shape == (layout.halved().rows, 4 * channels)
    np.testing.assert_array_equal(layout.interior_view(depth_to_space(deep, layout)), images)


def test_channels_and_resolutions_of_the_topology_fit() -> None:
    def walk(layers: tuple[object, ...], channels: int, stride: float) -> tuple[int, float]:
        for layer in layers:
            if isinstance(layer, Conv):
                assert layer.channels_in == channels, layer.name
                channels = layer.channels_out
            elif isinstance(layer, SpaceToDepth):
                channels, stride = 4 * channels, 2 * stride
            elif isinstance(layer, DepthToSpace):
                channels, stride = channels // 4, stride / 2
            else:
                assert isinstance(layer, Residual)
                assert walk(layer.layers, channels, stride) == (channels, stride)
        return channels, stride

    assert walk(TOPOLOGY, 1, 1) == (3, STRIDE)
    assert sum(np.prod(conv.shape) + conv.channels_out for conv in CONVOLUTIONS.values()) == 125_683


def test_forward_equals_the_network_written_out_with_scipy() -> None:
    network, image = random_network(), np.random.default_rng(1).random((16, 20))

    def conv(name: str, x: FloatArray) -> FloatArray:
        return scipy_conv(x, network.weights[name]) + network.biases[name]

    def relu(x: FloatArray) -> FloatArray:
        return np.maximum(x, 0)

    def deep(x: FloatArray) -> FloatArray:
        return np.concatenate([x[0::2, 0::2], x[0::2, 1::2], x[1::2, 0::2], x[1::2, 1::2]], axis=2)

    x = deep(relu(conv("stem", image[..., None])))
    skip = relu(conv("enc1_1", relu(conv("enc1_0", relu(conv("down1", x))))))
    x = relu(conv("down2", deep(skip)))
    x = x + relu(conv("res1_1", relu(conv("res1_0", x))))
    x = x + relu(conv("res2_1", relu(conv("res2_0", x))))
    x = conv("up1", x)
    wide = np.empty((8, 10, 32))
    for k, (row, column) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
        wide[row::2, column::2] = x[..., 32 * k : 32 * (k + 1)]
    expected = conv("head", relu(conv("dec1", relu(wide + skip))))
    out = forward(network, image.astype(np.float32)[None])
    assert out.shape == (1, 8, 10, 3)
    np.testing.assert_allclose(out[0], expected, atol=2e-4)


def test_images_of_a_batch_do_not_touch_each_other() -> None:
    network, images = random_network(), np.random.default_rng(2).random((3, 12, 16)).astype(np.float32)
    batch = forward(network, images)
    for k in range(3):
        np.testing.assert_allclose(forward(network, images[k : k + 1])[0], batch[k], atol=1e-5)


def test_a_pixel_reaches_no_farther_than_the_halo_of_a_tile() -> None:
    network, image = random_network(), np.full((1, 128, 128), 0.5, np.float32)
    changed = image.copy()
    changed[0, 64, 64] = 1
    y, x = np.nonzero((forward(network, changed) != forward(network, image))[0].any(axis=2))
    distance = np.abs(np.stack([y, x]) * STRIDE + (STRIDE - 1) / 2 - 64).max()
    assert 20 < distance < 32


@pytest.mark.parametrize("shape", [(150, 90), (64, 64), (65, 3)])
def test_tiles_do_not_show_in_the_heatmap(monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int]) -> None:
    network, image = random_network(), np.random.default_rng(3).integers(0, 255, shape).astype(np.uint8)
    whole = predict_heatmap(network, image)
    monkeypatch.setattr("velfield.detection.cnn.model._TILE_PX", 64)
    tiled = predict_heatmap(network, image)
    assert tiled[0].shape == (-(-shape[0] // 2), -(-shape[1] // 2))
    np.testing.assert_allclose(tiled[0], whole[0], atol=1e-5)
    np.testing.assert_allclose(tiled[1], whole[1], atol=1e-4)
