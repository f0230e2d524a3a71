"""The network in integers of 8 bits."""

from dataclasses import replace

import numpy as np
import pytest

from schemas.arrays import GreyImage
from schemas.detector import CnnConfig
from velfield.detection.cnn import network as networks
from velfield.detection.cnn import quantization
from velfield.detection.cnn.detector import CnnDetector
from velfield.detection.cnn.model import forward, predict_crops
from velfield.detection.cnn.network import (
    FORMER_TOPOLOGY,
    TOPOLOGY,
    Conv,
    GraphBuilder,
    Network,
    Topology,
    convolutions,
)
from velfield.detection.cnn.quantization import (
    FirstLayer,
    calibrate,
    is_exact,
    place_heatmaps_kernel,
    quantized_to_onnx,
)
from velfield.detection.registry import load_detector, shipped_detector


def cars(seed: int = 0, shape: tuple[int, int] = (208, 304)) -> GreyImage:
    """Cars of 16 x 8 px on noise, some brighter and some darker than the ground."""
    rng = np.random.default_rng(seed)
    image = rng.normal(110, 6, shape)
    for y, x in np.stack([rng.integers(12, size - 12, 30) for size in shape], axis=1):
        image[y - 4 : y + 4, x - 8 : x + 8] = rng.choice([40, 70, 190, 230])
        image[y - 3 : y + 3, x + 2 : x + 5] = 30
    return np.clip(image, 0, 255).astype(np.uint8)


def shipped() -> CnnDetector:
    detector = shipped_detector()
    assert isinstance(detector, CnnDetector)
    return detector


@pytest.fixture
def exact() -> None:
    if not is_exact():
        pytest.skip("this processor saturates sums of products of 8 bits")


@pytest.mark.usefixtures("exact")
def test_eight_bits_give_nearly_the_heatmap_of_floating_point() -> None:
    network, image = shipped().network, cars()[None]
    eight = replace(network, ranges=calibrate(network, [cars(1), cars(2)]))
    (wanted, axes), (found, found_axes) = forward(network, image), forward(eight, image)
    at = wanted > 0.2
    assert at.sum() > 100
    assert not np.array_equal(wanted, found)
    assert np.sqrt(np.mean((wanted - found)[at] ** 2)) < 0.03
    assert np.median(np.abs(axes - found_axes)[0, :, at[0]]) < 0.05


class PlainGraph(quantization._QuantizedGraph):
    """Every layer by onnxruntime's own operator, the first one in bytes as well."""

    def depth_to_space(self, value: str) -> str:
        return GraphBuilder.depth_to_space(self, value)

    def conv(self, layer: Conv, value: str, block: int) -> str:
        if value != "image":
            return super().conv(layer, value, block)
        scale = self._scale["image"]
        grey = self._dequantize("image", self._constants("image", scale, 0), scale)
        return super().conv(layer, grey, block)


@pytest.mark.usefixtures("exact")
def test_a_first_layer_of_our_own_and_rows_of_channels_change_nothing() -> None:
    network = replace(shipped().network, ranges=calibrate(shipped().network, [cars(1), cars(2)]))
    assert network.ranges is not None
    plain = PlainGraph(network, network.ranges)
    session = networks.open_session(plain.finish(plain.layers(network.topology, "image")), "cpu")
    images = np.stack([cars(3), cars(4)])
    expected = session.run(None, {"image": images[:, None]})
    found = forward(network, images)
    np.testing.assert_array_equal(found[0], expected[0][:, 0])
    np.testing.assert_array_equal(found[1], expected[1])


@pytest.mark.parametrize("shape", [(1, 4, 4), (2, 40, 24), (3, 36, 68)])
def test_the_first_layer_is_a_strided_convolution_in_blocks(shape: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(5)
    weights = rng.integers(-127, 128, (16, 16)).astype(np.float32)
    biases = rng.integers(-20_000, 20_000, 16).astype(np.float32)
    factors = rng.uniform(0.001, 0.02, 16).astype(np.float32)
    images = rng.integers(0, 256, shape).astype(np.uint8)
    padded = np.pad(images, ((0, 0), (1, 1), (1, 1))).astype(np.float32)
    taps = np.lib.stride_tricks.sliding_window_view(padded, (4, 4), (1, 2))[:, ::2, ::2].reshape(-1, 16)
    sums = np.maximum(taps.astype(np.int64) @ weights.astype(np.int64) + biases.astype(np.int64), 0)
    levels = np.minimum(np.rint(sums.astype(np.float32) * factors), 255).astype(np.uint8)
    count, rows, columns = shape[0], shape[1] // 2, shape[2] // 2
    framed = np.pad(levels.reshape(count, rows, columns, 16), ((0, 0), (1, 1), (1, 1), (0, 0)))
    blocks = framed.reshape(count, rows // 2 + 1, 2, columns // 2 + 1, 2, 16).transpose(0, 1, 3, 2, 4, 5)
    corners = np.column_stack([3 + shape[1] * np.arange(count), np.full(count, 5)])
    around = np.pad(images.reshape(-1, shape[2]), ((3, 2), (5, 1)), constant_values=255)
    found = FirstLayer(weights, biases, factors).blocks(around, corners, *shape[1:])
    np.testing.assert_array_equal(found, blocks.reshape(found.shape))


def test_the_blocks_of_the_head_are_heatmaps_where_crops_lie() -> None:
    values = np.random.default_rng(6).normal(size=(2, 3, 5, 12)).astype(np.float32)
    pixels = values.reshape(2, 3, 5, 2, 2, 3).transpose(0, 5, 1, 3, 2, 4).reshape(2, 3, 6, 10)
    heatmap, vectors = np.zeros((20, 24), np.float32), np.zeros((2, 20, 24), np.float32)
    flat, corners = values.reshape(-1, 12), np.array([(8, 4), (20, 28)])
    place_heatmaps_kernel(np.exp(flat), flat, corners, 3, 5, heatmap, vectors)
    for n, (top, left) in enumerate(corners // 2):
        part = np.s_[top : top + 6, left : left + 10]
        np.testing.assert_array_equal(heatmap[part], np.exp(pixels[n, 0]))
        np.testing.assert_array_equal(vectors[:, *part], pixels[n, 1:])
    assert np.count_nonzero(heatmap) == 2 * 60
    assert np.count_nonzero(vectors) == 4 * 60


@pytest.mark.usefixtures("exact")
@pytest.mark.parametrize("topology", [TOPOLOGY, FORMER_TOPOLOGY])
def test_a_network_of_random_weights_is_near_to_floating_point(topology: Topology) -> None:
    rng = np.random.default_rng(3)
    layers = convolutions(topology)
    weights = {
        name: (rng.normal(size=layer.shape) / np.sqrt(layer.shape[0] * layer.shape[1])).astype(np.float32)
        for name, layer in layers.items()
    }
    biases = {name: rng.normal(0, 0.1, layer.channels_out).astype(np.float32) for name, layer in layers.items()}
    network = Network(weights, biases, topology)
    eight = replace(network, ranges=calibrate(network, [cars(1)], crops=16))
    (wanted, _), (found, _) = forward(network, cars()[None]), forward(eight, cars()[None])
    assert np.abs(wanted - found).max() < 0.1 * np.ptp(wanted) + 0.01


@pytest.mark.usefixtures("exact")
def test_a_crop_gives_the_same_alone_and_among_others() -> None:
    network = shipped().network
    eight = replace(network, ranges=calibrate(network, [cars(1)], crops=16))
    images = np.stack([cars(k, (96, 96)) for k in range(5)])
    together, _ = forward(eight, images)
    np.testing.assert_array_equal(together, np.concatenate([forward(eight, one[None])[0] for one in images]))


def test_of_long_crops_of_one_size_each_is_predicted() -> None:
    """They are longer than a tile, and several would fit into a batch."""
    network = shipped_detector().network  # type: ignore[attr-defined]
    image = np.random.default_rng(4).integers(0, 256, (64, 2112), dtype=np.uint8)
    crops = np.array([(0, 0, 24, 2056), (32, 16, 24, 2056)])
    together = predict_crops(network, image, crops)
    for y, x, height, width in crops:
        alone = predict_crops(network, image, np.array([(y, x, height, width)]))
        part = slice(y // 2, (y + height) // 2), slice(x // 2, (x + width) // 2)
        np.testing.assert_array_equal(together[0][part], alone[0][part])
        assert alone[0][part].any()
        np.testing.assert_array_equal(together[1][:, *part], alone[1][:, *part])


def test_crops_of_an_image_are_predicted_as_if_alone() -> None:
    network, image = shipped().network, cars(2, (120, 160))
    crops = np.array([(0, 0, 48, 40), (0, 40, 48, 40), (48, 8, 64, 104), (8, 80, 40, 48)])
    probability, orientation = np.zeros((60, 80), np.float32), np.zeros((2, 60, 80), np.float32)
    for y, x, height, width in crops:
        part = slice(y // 2, (y + height) // 2), slice(x // 2, (x + width) // 2)
        alone = forward(network, image[None, y : y + height, x : x + width])
        probability[part], orientation[:, *part] = alone[0][0], alone[1][0]
    found = predict_crops(network, image, crops)
    np.testing.assert_allclose(found[0], probability, atol=1e-5)
    np.testing.assert_allclose(found[1], orientation, atol=1e-5)
    assert not found[0][:, 64:].any()


def test_ranges_are_of_the_flight_and_the_setting_and_come_back_from_the_file(tmp_path) -> None:  # type: ignore[no-untyped-def]
    detector = shipped()
    eight = detector.for_flight([cars(1)], CnnConfig())
    again = detector.for_flight([cars(1)], CnnConfig())
    assert eight.record.activation_ranges == again.record.activation_ranges
    assert eight.record.activation_ranges != detector.for_flight([cars(2)], CnnConfig()).record.activation_ranges
    eight.save(tmp_path / "detector.json")
    loaded = load_detector(tmp_path / "detector.json")
    assert isinstance(loaded, CnnDetector)
    assert loaded.network.ranges == eight.record.activation_ranges
    assert eight.for_flight([cars(1)], CnnConfig(precision="float32")).network.ranges is None


@pytest.mark.parametrize("size", [1, 15, 700, 50_000, 400_001])
@pytest.mark.parametrize("cut", [False, True])
def test_the_tails_are_those_of_all_values(size: int, cut: bool) -> None:
    values = np.random.default_rng(size).normal(size=size).astype(np.float32)
    values = np.maximum(values, 0) if cut else values
    np.testing.assert_allclose(quantization._tails(values), np.percentile(values, (0.01, 99.99)), rtol=1e-5)


def test_small_images_are_calibrated_on_smaller_crops_and_smaller_ones_refused() -> None:
    network = shipped().network
    assert calibrate(network, [cars(1, (60, 90))], crops=4)
    with pytest.raises(ValueError, match="expected 96 or more"):
        calibrate(network, [np.zeros((4, 90), np.uint8)], crops=4)


def test_a_processor_that_saturates_takes_floating_point_and_says_so(monkeypatch) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setattr(quantization, "is_exact", lambda: False)
    monkeypatch.setattr("velfield.detection.cnn.detector.is_exact", lambda: False)
    monkeypatch.setattr(networks, "_limitations_reported", False)
    detector = shipped().for_flight([cars(1)], CnnConfig())
    assert detector.limitations == [networks.INEXACT]
    with pytest.warns(RuntimeWarning, match="VNNI"):
        found, _ = forward(detector.network, cars()[None])
    np.testing.assert_array_equal(found, forward(shipped().network, cars()[None])[0])


def test_the_model_holds_bytes() -> None:
    network = shipped().network
    model = quantized_to_onnx(network, calibrate(network, [cars(1)], crops=4))
    assert len(model) < len(networks.network_to_onnx(network))
