"""The network in integers of 8 bits: activations unsigned, weights signed with a scale a channel.

On processors that multiply bytes (VNNI of x86, dot products of ARM) it takes 0.52 to 0.62 of the time. The range of an
activation is measured on crops of the flight at hand (`calibrate`), without the outermost ten-thousandth at either end,
whose place the rest of the values would pay for with their precision. The graph is that of `model.network_to_onnx` with
pairs of QuantizeLinear and DequantizeLinear (QDQ), which onnxruntime fuses; the head stays in floating point, and the
first convolution takes the same whole numbers in it.

Older x86 processors add products of bytes in 16 bits, which saturates. Whether this one is exact is tested, not looked
up (`is_exact`): elsewhere the network runs in floating point, with a warning.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from schemas.arrays import Float32Array, FloatArray, GreyImage
from velfield.detection.cnn.network import (
    Conv,
    GraphBuilder,
    Network,
    Ranges,
    convolutions,
    onnx_kernel,
    open_session,
    serialize,
)
from velfield.parallel import parallel_map

_TAIL_PERCENT = 0.01
_LEVELS = 255
_CROP_PX, _CROPS_AT_ONCE = 96, 32
_ROW = 256
"""Values of which one extreme is kept to find the tails: a tenth of the time of sorting all."""


def calibrate(
    network: Network, images: Sequence[GreyImage], *, crops: int = 384, seed: int = 0
) -> dict[str, tuple[float, float]]:
    """Ranges of the activations on random crops of images (h, w).

    Raises
    ------
    ValueError
        An image is smaller than a crop.
    """
    rng = np.random.default_rng(seed)
    unit = network.alignment
    side = min(_CROP_PX, *(size // unit * unit for image in images for size in image.shape))
    if side < unit:
        raise ValueError(f"found an image of fewer than {unit} px, expected {_CROP_PX} or more either way")
    pixels = []
    for k in range(crops):
        image = images[k % len(images)]
        y, x = (int(rng.integers(0, size - side + 1)) for size in image.shape)
        pixels.append(image[y : y + side, x : x + side])
    graph = _ObservedGraph(network)
    out = graph.layers(network.topology, graph.normalised_image())
    names, values = list(graph.observed), list(graph.observed.values())
    session = open_session(graph.finish(out, observed=values), "cpu")

    def ends_of_batch(start: int) -> list[tuple[float, float]]:
        batch = np.stack(pixels[start : start + _CROPS_AT_ONCE])[:, None]
        return [_tails(found) for found in session.run(values, {"image": batch})]

    ends = np.array(parallel_map(ends_of_batch, range(0, len(pixels), _CROPS_AT_ONCE)))
    return {name: (float(ends[:, k, 0].min()), float(ends[:, k, 1].max())) for k, name in enumerate(names)}


def _tails(values: Float32Array) -> tuple[float, float]:
    """The quantiles `_TAIL_PERCENT` from either end, as of `numpy.percentile`.

    The lowest values of a row each: where that many lie below a bound, the rest of the image cannot be among them.
    """
    flat = values.reshape(-1)
    position = _TAIL_PERCENT / 100 * (flat.size - 1)
    below, fraction = int(position), position % 1
    rows = flat[: flat.size // _ROW * _ROW].reshape(-1, _ROW)
    tails = []
    for sign, extremes in ((1, rows.min(axis=1)), (-1, -rows.max(axis=1))):
        kept = flat
        if below + 2 <= len(extremes):
            bound = np.partition(extremes, below + 1)[below + 1]
            if bound == extremes.min():  # as after a ReLU, where most values are zero
                tails.append(sign * float(bound))
                continue
            kept = flat[flat <= bound] if sign > 0 else flat[flat >= -bound]
        after = min(below + 1, len(kept) - 1)
        lowest = np.partition(sign * kept, (below, after)).astype(float)
        tails.append(sign * float(lowest[below] + fraction * (lowest[after] - lowest[below])))
    return tails[0], tails[1]


def quantized_to_onnx(network: Network, ranges: Ranges) -> bytes:
    """The network as an ONNX model in 8 bits, with the inputs and outputs of `model.network_to_onnx`."""
    graph = _QuantizedGraph(network, ranges)
    return graph.finish(graph.layers(network.topology, "image"))


class _ObservedGraph(GraphBuilder):
    """A graph in floating point whose activations are outputs as well."""

    def __init__(self, network: Network) -> None:
        super().__init__(network)
        self.observed: dict[str, str] = {}

    def activation(self, value: str, name: str) -> str:
        self.observed[name] = value
        return value


class _QuantizedGraph(GraphBuilder):
    """A graph in which every activation but the head's is quantized."""

    def __init__(self, network: Network, ranges: Ranges) -> None:
        super().__init__(network)
        self._ranges = ranges
        self._scale: dict[str, np.float32] = {"image": np.float32(1 / _LEVELS)}  # grey in [0, 1]
        self._unscaled: Float32Array | None = None
        self._head = list(convolutions(network.topology))[-1]

    def activation(self, value: str, name: str) -> str:
        low, high = (float(end) for end in self._ranges[name])
        low, high = min(low, 0.0), max(high, 0.0)
        scale = np.float32(max((high - low) / _LEVELS, 1e-8))
        zero = int(np.clip(round(-low / float(scale)), 0, _LEVELS))
        scale_and_zero = self._constants(name, scale, zero)
        if self._unscaled is None:
            quantized = self.node("QuantizeLinear", [value, *scale_and_zero])
        else:
            factors = (self._unscaled / scale).astype(np.float32)[:, None, None]
            levels = self.node("Mul", [value, self.constant(f"{name}.factors", factors)])
            quantized = self.node("QuantizeLinear", [levels, *self._constants(f"{name}.levels", np.float32(1), zero)])
            self._unscaled = None
        return self._dequantize(quantized, scale_and_zero, scale)

    def _constants(self, name: str, scale: np.float32, zero: int) -> list[str]:
        scale_name = self.constant(f"{name}.scale", np.array(scale))
        return [scale_name, self.constant(f"{name}.zero", np.array(zero, np.uint8))]

    def _dequantize(self, value: str, scale_and_zero: list[str], scale: np.float32) -> str:
        restored = self.node("DequantizeLinear", [value, *scale_and_zero])
        self._scale[restored] = scale
        return restored

    def conv(self, layer: Conv, value: str, block: int) -> str:
        if layer.name == self._head:
            return super().conv(layer, value, block)
        kernel = onnx_kernel(self.network.weights[layer.name], layer.kernel, block).astype(np.float32)
        scales = np.maximum(np.abs(kernel).max(axis=(1, 2, 3)) / 127, 1e-8).astype(np.float32)
        weights = np.rint(kernel / scales[:, None, None, None]).astype(np.int8)
        bias_scales = (scales * self._scale[value]).astype(np.float32)
        bias = np.rint(self.network.biases[layer.name] / bias_scales.astype(np.float64))
        if value == "image":
            return self._conv_of_image(layer, weights, bias, bias_scales, block)
        limit = 2**31 - 1
        names = []
        for name, values, factors in (
            ("weight", weights, scales),
            ("bias", np.clip(bias, -limit, limit).astype(np.int32), bias_scales),
        ):
            parts = (("", values), (".scale", factors), (".zero", np.zeros(len(factors), values.dtype)))
            inputs = [self.constant(f"{layer.name}.{name}{end}", part) for end, part in parts]
            names.append(self.node("DequantizeLinear", inputs, axis=0))
        return self.convolve(layer, [value, *names], block)

    def _conv_of_image(
        self, layer: Conv, weights: NDArray[np.int8], bias: FloatArray, scales: Float32Array, block: int
    ) -> str:
        """The same whole numbers in single precision, which holds them exactly, unscaled.

        Of one channel onnxruntime convolves floats in a quarter of the time.
        """
        grey = self.node("Cast", ["image"], to=TensorProto.FLOAT)
        names = [
            self.constant(f"{layer.name}.{name}", values.astype(np.float32))
            for name, values in (("weight", weights), ("bias", bias))
        ]
        self._unscaled = scales
        return self.convolve(layer, [grey, *names], block)

    def depth_to_space(self, value: str) -> str:
        """By rows of channels, as they lie in the convolutions of bytes: onnxruntime's operator moves byte by byte."""
        pixels = self.node("Transpose", [value], perm=[0, 2, 3, 1])
        name, shape = f"blocks_{len(self.nodes)}", self.node("Shape", [pixels])
        for operator, factors in (("Mul", [1, 2, 2, 0]), ("Add", [0, 0, 0, -1])):
            shape = self.node(operator, [shape, self.constant(f"{name}.{operator}", np.array(factors))])
        blocks = self.node("Reshape", [pixels, self.constant(name, np.array([0, 0, 0, 2, 2, -1]))])
        pixels = self.node("Reshape", [self.node("Transpose", [blocks], perm=[0, 1, 3, 2, 4, 5]), shape])
        return self.node("Transpose", [pixels], perm=[0, 3, 1, 2])


@cache
def is_exact() -> bool:
    """Whether this processor adds products of bytes without saturation: tested by a convolution of large sums."""
    channels, level = 16, 200
    total = 255 * 127 * 9 * channels
    values: dict[str, NDArray[Any]] = {
        "one": np.array(1, np.float32),
        "low": np.array(0, np.uint8),
        "weight": np.full((8, channels, 3, 3), 127, np.int8),
        "zero": np.array(0, np.int8),
        "step": np.array(total / level, np.float32),
    }
    nodes = [
        helper.make_node("DequantizeLinear", ["image", "one", "low"], ["x"]),
        helper.make_node("DequantizeLinear", ["weight", "one", "zero"], ["w"]),
        helper.make_node("Conv", ["x", "w"], ["sum"], pads=[1] * 4),
        helper.make_node("QuantizeLinear", ["sum", "step", "low"], ["level"]),
    ]
    image = helper.make_tensor_value_info("image", TensorProto.UINT8, [1, channels, 8, 8])
    found = helper.make_tensor_value_info("level", TensorProto.UINT8, [1, 8, 8, 8])
    constants = [numpy_helper.from_array(array, name) for name, array in values.items()]
    session = open_session(serialize(helper.make_graph(nodes, "probe", [image], [found], constants)), "cpu")
    (levels,) = session.run(None, {"image": np.full((1, channels, 8, 8), 255, np.uint8)})
    return bool((levels[0, :, 4, 4] == level).all())
