"""Layers of the network on packed matrices: against scipy, as adjoints, and the network written out by hand."""

import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import correlate

from schemas.arrays import Float32Array, FloatArray, GreyImage
from velfield.detection.cnn import layers
from velfield.detection.cnn.graph import network_from_onnx, network_to_onnx
from velfield.detection.cnn.inference import HALO_PX, Predictor, predict_heatmap
from velfield.detection.cnn.layers import conv2d, conv2d_backward, relu_backward
from velfield.detection.cnn.network import (
    LAYERS,
    SIZE_STRIDE,
    STRIDE,
    Network,
)
from velfield.detection.cnn.trainer import Trainer
from velfield.errors import InputError

SIZES = st.integers(1, 9)
CHANNELS = st.integers(1, 4)


def normal(*shape: int, seed: int = 0) -> Float32Array:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def random_network(seed: int = 0) -> Network:
    """Random weights that keep the size of the activations, exact at half precision."""
    rng, weights, biases = np.random.default_rng(seed), {}, {}
    for name, conv in LAYERS.items():
        scale = np.sqrt(2 / (conv.shape[0] * conv.channels_in))
        weights[name] = rng.normal(0, scale, conv.shape).astype(np.float16).astype(np.float32)
        biases[name] = rng.normal(0, 0.1, conv.channels_out).astype(np.float16).astype(np.float32)
    return Network(weights, biases)


def grey(seed: int, *shape: int) -> GreyImage:
    return np.random.default_rng(seed).integers(0, 256, shape).astype(np.uint8)


def scipy_conv(image: FloatArray, weights: FloatArray) -> FloatArray:
    """Convolution of an image (h, w, c) with zeros about it, by scipy; a kernel of 4 x 4 at every second pixel."""
    side = {1: 1, 9: 3, 16: 4}[len(weights)]
    kernels, border = weights.reshape(side, side, *weights.shape[1:]), int(side > 1)
    padded = np.pad(image, ((border, border), (border, border), (0, 0)))
    out = [
        sum(
            correlate(padded[..., c], kernels[:, :, c, k], mode="valid", method="direct") for c in range(image.shape[2])
        )
        for k in range(weights.shape[2])
    ]
    step = 2 if side == 4 else 1
    return np.stack(out, axis=-1)[::step, ::step]


def sized(taps: int, size: int) -> int:
    """Even where the kernel has stride 2."""
    return 2 * size if taps == 16 else size


@settings(max_examples=40)
@given(st.integers(1, 3), SIZES, SIZES, CHANNELS, CHANNELS, st.sampled_from([1, 9, 16]))
def test_conv2d_equals_scipy_for_any_size(
    n: int, h: int, w: int, channels_in: int, channels_out: int, taps: int
) -> None:
    images = normal(n, sized(taps, h), sized(taps, w), channels_in)
    weights, bias = normal(taps, channels_in, channels_out, seed=1), normal(channels_out, seed=2)
    out = conv2d(images, weights)
    assert out.shape == (n, h, w, channels_out)
    for k in range(n):
        np.testing.assert_allclose(out[k], scipy_conv(images[k], weights), atol=1e-4)
    np.testing.assert_array_equal(conv2d(images, weights, bias), out + bias)
    np.testing.assert_array_equal(conv2d(images, weights, bias, relu=True), np.maximum(out + bias, 0))


@settings(max_examples=40)
@given(SIZES, SIZES, CHANNELS, CHANNELS, st.sampled_from([1, 9, 16]))
def test_conv2d_backward_is_adjoint(h: int, w: int, channels_in: int, channels_out: int, taps: int) -> None:
    """conv2d is linear in its input and in its weights: <conv2d(x, v), g> = <x, dx> = <v, dv> for any x and v."""
    shape = (2, sized(taps, h), sized(taps, w), channels_in)
    values, gradient = normal(*shape), normal(2, h, w, channels_out, seed=1)
    weights = normal(taps, channels_in, channels_out, seed=2)
    by_values, by_weights = conv2d_backward(values, weights, gradient)
    assert by_values.shape == values.shape
    other, other_weights = normal(*shape, seed=3), normal(*weights.shape, seed=4)
    expected = float((conv2d(other, weights) * gradient).sum())
    assert float((by_values * other).sum()) == pytest.approx(expected, rel=1e-3, abs=1e-2)
    expected = float((conv2d(values, other_weights) * gradient).sum())
    assert float((by_weights * other_weights).sum()) == pytest.approx(expected, rel=1e-3, abs=1e-2)
    nothing, alone = conv2d_backward(values, weights, gradient, by_images=False)
    assert nothing is None
    np.testing.assert_allclose(alone, by_weights, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("rows", [1, 7, 100_000])
@pytest.mark.parametrize("taps", [9, 16])
def test_the_size_of_blocks_does_not_matter(monkeypatch: pytest.MonkeyPatch, rows: int, taps: int) -> None:
    values, weights = normal(2, 14, 18, 3), normal(taps, 3, 4, seed=1)
    out = conv2d(values, weights)
    gradient = normal(*out.shape, seed=2)
    expected = conv2d_backward(values, weights, gradient)
    monkeypatch.setattr(layers, "_BLOCK_ROWS", rows)
    np.testing.assert_allclose(conv2d(values, weights), out, atol=1e-5)
    for found, one in zip(conv2d_backward(values, weights, gradient), expected, strict=True):
        np.testing.assert_allclose(found, one, atol=1e-4)


def test_convolutions_of_several_threads_do_not_share_their_memory() -> None:
    """Each thread has its own: the images of another would show in the result."""
    images, weights = [normal(2, 40, 40, 8, seed=k) for k in range(16)], normal(9, 8, 8, seed=99)
    alone = [conv2d(image, weights) for image in images]
    with ThreadPoolExecutor(4) as pool:
        for found, expected in zip(pool.map(lambda image: conv2d(image, weights), images), alone, strict=True):
            np.testing.assert_array_equal(found, expected)


def test_the_gradient_of_a_relu_is_that_of_what_is_positive() -> None:
    out, gradient = np.maximum(normal(2, 3, 5, 4), 0), normal(2, 3, 5, 4, seed=1)
    before = gradient.copy()
    found, total = relu_backward(gradient, out)
    np.testing.assert_array_equal(found, gradient * (out > 0))
    np.testing.assert_allclose(total, found.sum(axis=(0, 1, 2)), rtol=1e-5)
    np.testing.assert_array_equal(gradient, before)


def test_a_relu_keeps_what_is_not_a_number() -> None:
    """Else training that diverged would look as if nothing were seen."""
    images = np.full((1, 2, 2, 1), np.nan, np.float32)
    assert np.isnan(conv2d(images, normal(1, 1, 1), np.zeros(1, np.float32), relu=True)).all()


def test_forward_equals_the_network_written_out_with_scipy() -> None:
    network, image = random_network(), np.random.default_rng(1).random((16, 32))

    def conv(name: str, x: FloatArray) -> FloatArray:
        return scipy_conv(x, network.weights[name]) + network.biases[name]

    def relu(x: FloatArray) -> FloatArray:
        return np.maximum(x, 0)

    def deep(x: FloatArray) -> FloatArray:
        return np.concatenate([x[0::2, 0::2], x[0::2, 1::2], x[1::2, 0::2], x[1::2, 1::2]], axis=2)

    def wide(x: FloatArray) -> FloatArray:
        channels = x.shape[2] // 4
        out = np.empty((2 * x.shape[0], 2 * x.shape[1], channels))
        for k, (row, column) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
            out[row::2, column::2] = x[..., channels * k : channels * (k + 1)]
        return out

    skip = relu(conv("enc1", relu(conv("down1", relu(conv("stem", image[..., None]))))))
    x = relu(conv("down2", deep(skip)))
    x = x + relu(conv("res1_1", relu(conv("res1_0", x))))
    y = relu(conv("down3", deep(x)))
    y = y + relu(conv("res3_1", relu(conv("res3_0", y))))
    x = relu(wide(conv("up2", y)) + x)
    x = x + relu(conv("res2_1", relu(conv("res2_0", x))))
    expected = wide(conv("head", relu(conv("dec1", relu(wide(conv("up1", x)) + skip)))))
    out = Trainer.from_network(network).predict(image.astype(np.float32)[None])
    assert out.shape == (1, 8, 16, 3)
    np.testing.assert_allclose(out[0], expected, atol=2e-4)


@pytest.mark.parametrize("shape", [(1, 64, 96), (3, 48, 48)])
def test_onnxruntime_equals_the_numpy_reference(shape: tuple[int, int, int]) -> None:
    network, images = random_network(1), grey(2, *shape)
    expected = Trainer.from_network(network).predict(images.astype(np.float32) / 255)
    probability, orientation, size = Predictor(network)(images)
    assert size.shape == (len(images), 4, shape[1] // SIZE_STRIDE, shape[2] // SIZE_STRIDE)
    np.testing.assert_allclose(probability, 1 / (1 + np.exp(-expected[..., 0])), atol=2e-5)
    np.testing.assert_allclose(orientation, expected[..., 1:].transpose(0, 3, 1, 2), atol=5e-4)


def test_a_network_comes_back_from_onnx_with_the_same_weights() -> None:
    network = random_network(3)
    again = network_from_onnx(network_to_onnx(network))
    for name in network.weights:
        np.testing.assert_array_equal(again.weights[name], network.weights[name])
        np.testing.assert_array_equal(again.biases[name], network.biases[name])


def test_what_is_no_network_of_ours_is_refused_in_one_line() -> None:
    for data in (b"", b"not a model", network_to_onnx(random_network())[:5000]):
        with pytest.raises(InputError, match="train the detector again"):
            network_from_onnx(data)
    for change in ("shape", "external", "nan", "name"):
        model = onnx.ModelProto.FromString(network_to_onnx(random_network()))
        tensor = next(t for t in model.graph.initializer if t.name == "head.bias")
        if change == "shape":
            tensor.dims[0] = 1 << 40
        elif change == "external":
            tensor.data_location = onnx.TensorProto.EXTERNAL
        elif change == "nan":
            tensor.raw_data = np.full(len(tensor.raw_data) // 2, np.nan, np.float16).tobytes()
        else:
            tensor.name = "other"
        with pytest.raises(InputError, match="train the detector again"):
            network_from_onnx(bytes(model.SerializeToString()))


def test_the_onnx_model_is_valid_and_of_few_operators() -> None:
    model = onnx.ModelProto.FromString(network_to_onnx(random_network()))
    onnx.checker.check_model(model, full_check=True)
    known = {"Cast", "Mul", "Conv", "Relu", "Add", "DepthToSpace", "Slice", "Sigmoid"}
    assert {node.op_type for node in model.graph.node} == known


def test_a_pixel_reaches_no_farther_than_the_halo_of_a_tile() -> None:
    forward, image = Predictor(random_network(0)), np.full((1, 256, 256), 128, np.uint8)
    changed = image.copy()
    changed[0, 126:130, 126:130] = 255
    differs = forward(changed)[1][0] != forward(image)[1][0]
    y, x = np.nonzero(differs.any(axis=0))
    distance = np.abs(np.stack([y, x]) * STRIDE + (STRIDE - 1) / 2 - 127.5).max()
    assert 20 < distance < HALO_PX


@pytest.mark.parametrize("shape", [(150, 90), (64, 64), (65, 3)])
def test_tiles_do_not_show_in_the_heatmap(monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int]) -> None:
    network, image = random_network(), grey(3, *shape)
    whole = predict_heatmap(Predictor(network), image)
    monkeypatch.setattr("velfield.detection.cnn.inference._TILE_PX", 64)
    tiled = predict_heatmap(Predictor(network), image)
    assert tiled[0].shape == (-(-shape[0] // 2), -(-shape[1] // 2))
    np.testing.assert_allclose(tiled[0], whole[0], atol=1e-5)
    np.testing.assert_allclose(tiled[1], whole[1], atol=1e-4)
    np.testing.assert_allclose(tiled[2], whole[2], atol=1e-4)


def test_a_network_crosses_processes_without_its_session() -> None:
    forward, image = Predictor(random_network()), grey(4, 1, 32, 32)
    expected = forward(image)
    again = pickle.loads(pickle.dumps(forward))
    np.testing.assert_array_equal(again(image)[0], expected[0])
