"""The network in integers of 8 bits: activations unsigned, weights signed with a scale a channel.

On processors that multiply bytes (VNNI of x86, dot products of ARM) it takes 0.52 to 0.62 of the time. The range of an
activation is measured on crops of the flight at hand (`calibrate`), without the outermost ten-thousandth at either end,
whose place the rest of the values would pay for with their precision. The graph is that of `model.network_to_onnx` with
pairs of QuantizeLinear and DequantizeLinear (QDQ), which onnxruntime fuses; the head stays in floating point.

onnxruntime is slow at byte convolutions of one channel and at strided convolutions of large images, and it moves every
pixel of the first layer and of the heatmap four times. So the first layer is computed here (`FirstLayer`), in the same
whole numbers, and passed on in blocks of 2 x 2 pixels, of which the second layer is a plain convolution; and the
heatmap is read as the head leaves it, one block of 2 x 2 pixels per row.

Older x86 processors add products of bytes in 16 bits, which saturates. Whether this one is exact is tested, not looked
up (`is_exact`): elsewhere the network runs in floating point, with a warning.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import onnxruntime as ort
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from schemas.arrays import Float32Array, FloatArray, GreyImage, IntArray
from velfield.detection.cnn.network import (
    STRIDE,
    TOPOLOGY,
    Conv,
    GraphBuilder,
    Network,
    Predict,
    Ranges,
    Topology,
    convolutions,
    onnx_kernel,
    open_session,
    predict_by,
    serialize,
)
from velfield.parallel import parallel_map

_TAIL_PERCENT = 0.01
_LEVELS = 255
_CROP_PX, _CROPS_AT_ONCE = 96, 32
_ROW = 256
"""Values of which one extreme is kept to find the tails: a tenth of the time of sorting all."""
LANES = 16
"""Channels of the first layer."""
_BLOCKS, _OUTPUTS = "blocks", ("values", "probability")
"""The input of the network after its first layer, and what it gives."""


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
    """The network as an ONNX model in 8 bits, with the inputs and outputs of `network.network_to_onnx`."""
    graph = _QuantizedGraph(network, ranges)
    return graph.finish(graph.layers(network.topology, "image"))


def open_quantized(network: Network, ranges: Ranges) -> Predict:
    """The network in 8 bits on the processor, as `Network.predict`; layers other than `TOPOLOGY` as one ONNX model."""
    if network.topology != TOPOLOGY:
        return predict_by(open_session(quantized_to_onnx(network, ranges), "cpu"))
    graph = _BlockGraph(network, ranges)
    first = graph.first_layer()
    session = open_session(graph.finish(graph.layers(network.topology, _BLOCKS, first=1)), "cpu")
    return BlockPredict(first, session)


@dataclass(frozen=True)
class FirstLayer:
    """A strided convolution of a kernel of 4 x 4 taps, with a ReLU, of grey levels in whole numbers.

    Attributes
    ----------
    weights, biases : (16, LANES) and (LANES,) whole numbers in single precision, by tap and channel out.
    factors : (LANES,) levels of the output a unit.
    """

    weights: Float32Array
    biases: Float32Array
    factors: Float32Array

    def blocks(self, image: GreyImage, corners: IntArray, height: int, width: int) -> GreyImage:
        """Levels of the output of crops of an image, sizes multiples of 4: (n, h / 4 + 1, w / 4 + 1, 4 LANES) uint8.

        The output is at half the resolution, with a border of one pixel of zeros, one block of 2 x 2 pixels per row.

        Parameters
        ----------
        corners
            (n, 2) first row and column of each crop.
        """
        return np.asarray(first_layer_kernel(image, corners, height, width, self.weights, self.biases, self.factors))


@dataclass(frozen=True)
class BlockPredict:
    """The network of `TOPOLOGY` in 8 bits: its first layer, and what follows in onnxruntime.

    It reads crops where they lie in an image, and writes their heatmaps to where they lie in that of the image: to cut
    crops out and to put heatmaps in took as long as the first layer.
    """

    first: FirstLayer
    session: ort.InferenceSession

    def __call__(self, images: GreyImage) -> tuple[Float32Array, Float32Array]:
        """Heatmaps and orientation vectors of images (n, h, w)."""
        count, height, width = images.shape
        rows = height // STRIDE
        heatmap = np.empty((count * rows, width // STRIDE), np.float32)
        vectors = np.empty((2, *heatmap.shape), np.float32)
        corners = np.zeros((count, 2), np.int64)
        corners[:, 0] = height * np.arange(count)
        flat = np.ascontiguousarray(images).reshape(-1, width)
        self.fill_crops(flat, corners, height, width, heatmap, vectors)
        by_image = vectors.reshape(2, count, rows, -1).transpose(1, 0, 2, 3)
        return heatmap.reshape(count, rows, -1), np.ascontiguousarray(by_image)

    def fill_crops(
        self,
        image: GreyImage,
        corners: IntArray,
        height: int,
        width: int,
        probability: Float32Array,
        orientation: Float32Array,
    ) -> None:
        """Predict crops of one size, to where they lie in the heatmap (h / 2, w / 2) and the orientation vectors
        (2, h / 2, w / 2) of the image; ``corners`` (n, 2) are multiples of 4."""
        values, chances = self.session.run(_OUTPUTS, {_BLOCKS: self.first.blocks(image, corners, height, width)})
        place_heatmaps_kernel(chances, values, corners, height // 4, width // 4, probability, orientation)


@intrinsic
def _convolve_row(_context, rows, starts, weights, biases, factors, count, target, first):  # type: ignore[no-untyped-def]
    """Levels of ``count`` pixels of one row of the first layer, to one half of a row of blocks.

    numba keeps the sums of the channels in memory, and asks after each pixel whether the weights are what it wrote:
    here both stay in registers. Whole numbers: the order of the sums does not matter.
    """
    signature = types.void(rows, starts, weights, biases, factors, count, target, first)
    number, lanes = ir.IntType(64), ir.VectorType(ir.FloatType(), LANES)

    def generate(context: Any, build: Any, _signature: Any, arguments: Any) -> Any:
        values, places, taps, added, scale, out = (
            cgutils.create_struct_proxy(kind)(context, build, arguments[k]).data
            for kind, k in ((rows, 0), (starts, 1), (weights, 2), (biases, 3), (factors, 4), (target, 6))
        )

        def vector(start: Any, k: int) -> Any:
            at = build.bitcast(build.gep(start, [ir.Constant(number, k * LANES)]), lanes.as_pointer())
            loaded = build.load(at)
            loaded.align = 4
            return loaded

        def spread(value: Any) -> Any:
            one = build.insert_element(ir.Constant(lanes, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
            every = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
            return build.shuffle_vector(one, ir.Constant(lanes, ir.Undefined), every)

        kernel = [vector(taps, k) for k in range(16)]
        bias, factor = vector(added, 0), vector(scale, 0)
        begins = [build.load(build.gep(places, [ir.Constant(number, k)])) for k in range(4)]
        none, most = (ir.Constant(lanes, [float(level)] * LANES) for level in (0, _LEVELS))
        rint, fma = (
            cgutils.get_or_insert_function(build.module, ir.FunctionType(lanes, [lanes] * n), f"llvm.{name}.v16f32")
            for name, n in (("rint", 1), ("fma", 3))
        )
        with cgutils.for_range_slice(build, ir.Constant(number, 0), arguments[5], ir.Constant(number, 1), number) as (
            pixel,
            _,
        ):
            column = build.mul(pixel, ir.Constant(number, 2))
            # By one sum each row of taps: sixteen that wait for one another take 1.8 times as long.
            sums = [bias, none, none, none]
            for k in range(16):
                place = build.add(begins[k // 4], build.add(column, ir.Constant(number, k % 4)))
                sums[k // 4] = build.call(
                    fma, [spread(build.load(build.gep(values, [place]))), kernel[k], sums[k // 4]]
                )
            total = build.fadd(build.fadd(sums[0], sums[1]), build.fadd(sums[2], sums[3]))
            total = build.select(build.fcmp_ordered(">", total, none), total, none)
            level = build.call(rint, [build.fmul(total, factor)])
            level = build.select(build.fcmp_ordered("<", level, most), level, most)
            levels = build.trunc(
                build.fptosi(level, ir.VectorType(ir.IntType(32), LANES)), ir.VectorType(ir.IntType(8), LANES)
            )
            shifted = build.add(pixel, ir.Constant(number, 1))
            block = build.mul(build.lshr(shifted, ir.Constant(number, 1)), ir.Constant(number, 4 * LANES))
            within = build.mul(build.and_(shifted, ir.Constant(number, 1)), ir.Constant(number, LANES))
            at = build.gep(out, [build.add(arguments[7], build.add(block, within))])
            build.store(levels, build.bitcast(at, levels.type.as_pointer())).align = 1
        return context.get_dummy_value()

    return signature, generate


@njit(cache=True, nogil=True)
def first_layer_kernel(image, corners, height, width, weights, biases, factors):  # type: ignore[no-untyped-def]
    """Blocks as of `FirstLayer.blocks`."""
    count = len(corners)
    out = np.empty((count, height // 4 + 1, width // 4 + 1, 4 * LANES), np.uint8)
    flat = out.reshape(-1)
    # Of the rows that a row of the output reads, the last four of the crop, with a pixel of zeros at either end.
    rows = np.zeros((4, width + 2), np.float32)
    flat_rows, starts = rows.reshape(-1), np.empty(4, np.int64)
    for n in range(count):
        top, left = corners[n]
        _clear_border(out[n])
        rows[0] = np.float32(0)
        filled = 1
        for y in range(height // 2):
            while filled < 2 * y + 4:
                row = rows[filled % 4]
                if filled <= height:
                    source = image[top + filled - 1, left : left + width]
                    for x in range(width):
                        row[x + 1] = np.float32(source[x])
                else:
                    row[:] = np.float32(0)
                filled += 1
            for k in range(4):
                starts[k] = (2 * y + k) % 4 * (width + 2)
            block = (n * out.shape[1] + (y + 1) // 2) * out.shape[2] * 4 * LANES
            _convolve_row(
                flat_rows, starts, weights, biases, factors, np.int64(width // 2), flat,
                np.int64(block + (y + 1) % 2 * 2 * LANES),
            )  # fmt: skip
    return out


@njit(cache=True, nogil=True)
def _clear_border(blocks):  # type: ignore[no-untyped-def]
    """Zeros to the pixels about those of the output: the upper ones of the first row of blocks, and so on."""
    blocks[0, :, : 2 * LANES], blocks[-1, :, 2 * LANES :] = 0, 0
    for row in range(len(blocks)):
        for half in range(2):
            blocks[row, 0, 2 * half * LANES : (2 * half + 1) * LANES] = 0
            blocks[row, -1, (2 * half + 1) * LANES : (2 * half + 2) * LANES] = 0


@njit(cache=True, nogil=True)
def place_heatmaps_kernel(  # type: ignore[no-untyped-def]
    chances, values, corners, rows, columns, probability, orientation
):
    """Write heatmaps and orientation vectors to where they lie, from blocks of 2 x 2 pixels of 3 channels.

    The blocks (n rows columns, 12) are of crops of an image with these corners (n, 2), in order.
    """
    for n in range(len(corners)):
        top, left = corners[n, 0] // 2, corners[n, 1] // 2
        for y in range(rows):
            first = (n * rows + y) * columns
            for side in range(2):
                at = top + 2 * y + side
                heat = probability[at, left : left + 2 * columns]
                cosine = orientation[0, at, left : left + 2 * columns]
                sine = orientation[1, at, left : left + 2 * columns]
                for x in range(columns):
                    for k in range(2):
                        channel = 6 * side + 3 * k
                        heat[2 * x + k] = chances[first + x, channel]
                        cosine[2 * x + k] = values[first + x, channel + 1]
                        sine[2 * x + k] = values[first + x, channel + 2]


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
        scale, zero = self.levels(name)
        scale_and_zero = self._constants(name, scale, zero)
        if self._unscaled is None:
            quantized = self.node("QuantizeLinear", [value, *scale_and_zero])
        else:
            factors = (self._unscaled / scale).astype(np.float32)[:, None, None]
            levels = self.node("Mul", [value, self.constant(f"{name}.factors", factors)])
            quantized = self.node("QuantizeLinear", [levels, *self._constants(f"{name}.levels", np.float32(1), zero)])
            self._unscaled = None
        return self._dequantize(quantized, scale_and_zero, scale)

    def levels(self, name: str) -> tuple[np.float32, int]:
        """Scale of an activation (real units per level), and the level that stands for zero."""
        low, high = (float(end) for end in self._ranges[name])
        low, high = min(low, 0.0), max(high, 0.0)
        scale = np.float32(max((high - low) / _LEVELS, 1e-8))
        return scale, int(np.clip(round(-low / float(scale)), 0, _LEVELS))

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
        weights, scales, bias, bias_scales = self.whole_numbers(layer, self.kernel(layer, value, block), value)
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

    def kernel(self, layer: Conv, value: str, block: int) -> Float32Array:
        """Weights of the convolution of a value: (out, in, height, width)."""
        return onnx_kernel(self.network.weights[layer.name], layer.kernel, block).astype(np.float32)

    def whole_numbers(
        self, layer: Conv, kernel: Float32Array, value: str
    ) -> tuple[NDArray[np.int8], Float32Array, FloatArray, Float32Array]:
        """Weights as whole numbers and what one is worth, by channel out; biases likewise."""
        scales = np.maximum(np.abs(kernel).max(axis=(1, 2, 3)) / 127, 1e-8).astype(np.float32)
        weights = np.rint(kernel / scales[:, None, None, None]).astype(np.int8)
        bias_scales = (scales * self._scale[value]).astype(np.float32)
        bias = np.rint(self.network.biases[layer.name] / bias_scales.astype(np.float64))
        return weights, scales, bias, bias_scales

    def _conv_of_image(
        self, layer: Conv, weights: NDArray[np.int8], bias: FloatArray, scales: Float32Array, block: int
    ) -> str:
        """The same whole numbers in single precision, which holds them exactly, unscaled.

        onnxruntime convolves floats of one channel in a quarter of the time.
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
        name = f"blocks_{len(self.nodes)}"
        shape = self.twice_the_size(pixels, name)
        blocks = self.node("Reshape", [pixels, self.constant(name, np.array([0, 0, 0, 2, 2, -1]))])
        pixels = self.node("Reshape", [self.node("Transpose", [blocks], perm=[0, 1, 3, 2, 4, 5]), shape])
        return self.node("Transpose", [pixels], perm=[0, 3, 1, 2])

    def twice_the_size(self, pixels: str, name: str) -> str:
        """Shape of rows of channels (n, h, w, c) at twice the resolution."""
        return self.derived_shape(pixels, name, [1, 2, 2, 0], [0, 0, 0, -1])

    def derived_shape(self, value: str, name: str, factors: list[int], summands: list[int]) -> str:
        """A shape computed from that of a value."""
        shape = self.node("Shape", [value])
        for operator, numbers in (("Mul", factors), ("Add", summands)):
            shape = self.node(operator, [shape, self.constant(f"{name}.{operator}", np.array(numbers))])
        return shape


class _BlockGraph(_QuantizedGraph):
    """The quantized graph of `TOPOLOGY`, from the levels of the first layer in blocks to the head's blocks."""

    _blocks = ""
    """The value that they are."""

    def first_layer(self) -> FirstLayer:
        """The first convolution, which runs before the graph; its output is the input of the graph."""
        layer = convolutions(self.network.topology)["stem"]
        weights, _, bias, scales = self.whole_numbers(layer, self.kernel(layer, "image", 1), "image")
        scale, zero = self.levels("0")
        assert zero == 0, "there is a ReLU after the first layer"
        taps = np.ascontiguousarray(weights.reshape(layer.channels_out, -1).T, np.float32)
        return FirstLayer(taps, bias.astype(np.float32), (scales / scale).astype(np.float32))

    def conv(self, layer: Conv, value: str, block: int) -> str:
        if layer.name == self._head:
            # Rows of channels, as they lie in the convolutions of bytes.
            pixels = self.node("Transpose", [value], perm=[0, 2, 3, 1])
            rows = self.node("Reshape", [pixels, self.constant("rows", np.array([-1, layer.channels_in]))])
            names = [
                self.constant(f"{layer.name}.{name}", values.astype(np.float16).astype(np.float32))
                for name, values in (
                    ("weight", self.network.weights[layer.name][0]),
                    ("bias", self.network.biases[layer.name]),
                )
            ]
            return self.node("Gemm", [rows, *names], output=_OUTPUTS[0])
        if value == _BLOCKS:
            # A kernel of 4 x 4 pixels and a stride of 2 is one of 2 x 2 blocks.
            scale, zero = self.levels("0")
            pixels = self.node("Transpose", [value], perm=[0, 3, 1, 2])
            self._blocks = self._dequantize(pixels, self._constants("0", scale, zero), scale)
            return super().conv(layer, self._blocks, block)
        return super().conv(layer, value, block)

    def kernel(self, layer: Conv, value: str, block: int) -> Float32Array:
        kernel = super().kernel(layer, value, block)
        if value != self._blocks:
            return kernel
        blocks = kernel.reshape(len(kernel), -1, 2, 2, 2, 2).transpose(0, 3, 5, 1, 2, 4)
        return np.ascontiguousarray(blocks.reshape(len(kernel), -1, 2, 2))

    def convolve(self, layer: Conv, inputs: Sequence[str], block: int) -> str:
        return self.node("Conv", inputs) if inputs[0] == self._blocks else super().convolve(layer, inputs, block)

    def twice_the_size(self, pixels: str, name: str) -> str:
        # That of the blocks that came in: onnxruntime would turn the value into floats to ask for its shape.
        return self.derived_shape(_BLOCKS, name, [1, 1, 1, 0], [0, -1, -1, -1])

    def _unpack_heatmap(self, layers: Topology, value: str) -> str:
        return value

    def finish(self, out: str, observed: Sequence[str] = ()) -> bytes:
        self.node("Sigmoid", [out], output=_OUTPUTS[1])
        blocks = helper.make_tensor_value_info(_BLOCKS, TensorProto.UINT8, ["n", "h / 4 + 1", "w / 4 + 1", 4 * LANES])
        outputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n h w / 16", 12]) for name in _OUTPUTS]
        return serialize(helper.make_graph(self.nodes, "velfield-cnn", [blocks], outputs, self.constants))


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
