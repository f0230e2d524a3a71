"""The network as an ONNX model, in a detector file and for onnxruntime.

A detector file holds the network as ONNX, but only the weights are read from it, and the graph is built again from the
topology: a file cannot bring operators of its own.
"""

from base64 import b64decode, b64encode
from collections.abc import Sequence
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from schemas.arrays import Float32Array
from velfield.detection.cnn.network import (
    LAYERS,
    SIZE_LAYER,
    SIZE_SOURCE,
    TOPOLOGY,
    Conv,
    DepthToSpace,
    Network,
    Residual,
    SpaceToDepth,
    Topology,
    convolutions,
)
from velfield.detection.runtime import serialize
from velfield.errors import InputError


def network_to_onnx(network: Network) -> bytes:
    """The network as an ONNX model with weights at half precision, which is what a detector file keeps.

    Input ``image``: (n, 1, h, w) uint8 grey, h and w multiples of `ALIGNMENT`. Outputs: ``probability``
    (n, 1, h / 2, w / 2) of a car's centre, ``orientation`` (n, 2, h / 2, w / 2), cosine and sine of twice the
    orientation, and ``size`` (n, 4, h / 4, w / 4), as of `SIZE_LAYER`, if the network has that layer. It is computed
    with at single precision.
    """
    return serialize(network_graph(network, half=True))


def network_graph(network: Network, *, half: bool = False, with_features: bool = False) -> onnx.GraphProto:
    """The graph of `network_to_onnx`; weights at single precision unless at ``half``. ``with_features``: one more
    output, ``features`` (n, channels, h / 4, w / 4), from which `SIZE_LAYER` reads the sizes."""
    graph = _GraphBuilder(network, half=half)
    grey = graph.node("Cast", ["image"], to=TensorProto.FLOAT)
    out = graph.layers(TOPOLOGY, graph.node("Mul", [grey, graph.constant("scale", np.array(1 / 255, np.float32))]))
    for name, first, end in (("probability", 0, 1), ("orientation", 1, 3)):
        ends = [graph.constant(f"{name}_{k}", np.array([place])) for k, place in enumerate((first, end, 1))]
        if name == "probability":
            graph.node("Sigmoid", [graph.node("Slice", [out, *ends])], output=name)
        else:
            graph.node("Slice", [out, *ends], output=name)
    sizes: dict[str, list[str | int]] = {
        "image": ["n", 1, "h", "w"],
        "probability": ["n", 1, "h / 2", "w / 2"],
        "orientation": ["n", 2, "h / 2", "w / 2"],
    }
    if network.measures:
        graph.conv(SIZE_LAYER, graph.features)
        sizes[SIZE_LAYER.name] = ["n", SIZE_LAYER.channels_out, "h / 4", "w / 4"]
    if with_features:
        sizes[graph.node("Identity", [graph.features], output="features")] = [
            "n",
            SIZE_LAYER.channels_in,
            "h / 4",
            "w / 4",
        ]
    image, *outputs = (
        helper.make_tensor_value_info(name, TensorProto.UINT8 if name == "image" else TensorProto.FLOAT, size)
        for name, size in sizes.items()
    )
    return helper.make_graph(graph.nodes, "velfield-cnn", [image], outputs, graph.constants)


class _GraphBuilder:
    """Nodes and constants of an ONNX graph; every value has a name of its own. ``features`` is the output of
    `SIZE_SOURCE`."""

    def __init__(self, network: Network, *, half: bool) -> None:
        self.network, self.half = network, half
        self.blocks = _blocks(TOPOLOGY) | {SIZE_LAYER.name: 1}
        self.features = ""
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, name: str, values: "np.ndarray[Any, Any]") -> str:
        self.constants.append(numpy_helper.from_array(values, name))
        return name

    def node(self, operator: str, inputs: Sequence[str], *, output: str | None = None, **attributes: Any) -> str:
        """Add a node; its name is that of its output."""
        output = output or f"value_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, list(inputs), [output], name=output, **attributes))
        return output

    def layers(self, layers: Topology, value: str) -> str:
        """Output of a sequence of layers. Space-to-depth and the convolution after it are one strided convolution."""
        for layer in layers:
            if isinstance(layer, Conv):
                value = self.conv(layer, value)
            elif isinstance(layer, DepthToSpace):
                value = self.node("DepthToSpace", [value], blocksize=2, mode="DCR")
            elif isinstance(layer, Residual):
                value = self.node("Add", [self.layers(layer.layers, value), value])
            if isinstance(layer, Conv | Residual) and layer.relu:
                value = self.node("Relu", [value])
            if isinstance(layer, Conv) and layer.name == SIZE_SOURCE:
                self.features = value
        return value

    def conv(self, layer: Conv, value: str) -> str:
        """Output of a convolution, which is named as the layer."""
        block = self.blocks[layer.name]
        kernel = onnx_kernel(self.network.weights[layer.name], layer.kernel, block)
        inputs = [value]
        for part, values in (("weight", kernel), ("bias", self.network.biases[layer.name])):
            stored = self.constant(f"{layer.name}.{part}", values.astype(np.float16 if self.half else np.float32))
            inputs.append(self.node("Cast", [stored], to=TensorProto.FLOAT) if self.half else stored)
        pad = 1 if layer.stride == 2 else block * (layer.kernel // 2)
        return self.node("Conv", inputs, output=layer.name, strides=[block * layer.stride] * 2, pads=[pad] * 4)


def onnx_kernel(weights: Float32Array, kernel: int, block: int) -> Float32Array:
    """Weights (taps, block^2 c, out) on blocks moved into the channels, as a kernel (out, c, block k, block k)."""
    channels_out = weights.shape[2]
    taps = weights.reshape(kernel, kernel, block, block, -1, channels_out).transpose(5, 4, 0, 2, 1, 3)
    return np.ascontiguousarray(taps.reshape(channels_out, -1, kernel * block, kernel * block))


def weights_from_onnx(values: Float32Array, kernel: int, block: int) -> Float32Array:
    """Inverse of `onnx_kernel`."""
    channels_out, channels = values.shape[:2]
    taps = values.reshape(channels_out, channels, kernel, block, kernel, block).transpose(2, 4, 3, 5, 1, 0)
    return np.ascontiguousarray(taps.reshape(kernel * kernel, block * block * channels, channels_out))


def _blocks(layers: Topology) -> dict[str, int]:
    """Side of the blocks that are moved into the channels just before each convolution."""
    found: dict[str, int] = {}
    block = 1
    for layer in layers:
        if isinstance(layer, SpaceToDepth):
            block *= 2
            continue
        if isinstance(layer, Conv):
            found[layer.name] = block
        elif isinstance(layer, Residual):
            found |= _blocks(layer.layers)
        block = 1
    return found


def network_from_onnx(data: bytes) -> Network:
    """Read the weights of an ONNX model that `network_to_onnx` wrote.

    One that version 1.1 or an earlier one wrote has no layer of sizes.

    Raises
    ------
    InputError
        Not such a model, or not of the layers of this version.
    """
    try:
        model = onnx.ModelProto.FromString(data)
        tensors = {tensor.name: tensor for tensor in model.graph.initializer}
        outside = any(tensor.data_location == TensorProto.EXTERNAL for tensor in tensors.values())
        # A tensor that claims more than its bytes hold is refused by numpy, not allocated.
        found = {} if outside else {name: numpy_helper.to_array(tensor) for name, tensor in tensors.items()}
    except Exception as error:  # protobuf and numpy each raise their own
        raise InputError(
            f"found a network that is no ONNX model ({type(error).__name__}), expected one as velfield writes it; "
            "train the detector again"
        ) from None
    sized = any(name.startswith(f"{SIZE_LAYER.name}.") for name in found)
    layers, blocks = LAYERS if sized else convolutions(TOPOLOGY), _blocks(TOPOLOGY) | {SIZE_LAYER.name: 1}
    shapes = {f"{name}.weight": _onnx_shape(layer, blocks[name]) for name, layer in layers.items()}
    shapes |= {f"{name}.bias": (layer.channels_out,) for name, layer in layers.items()}
    if any(name not in found or found[name].shape != shape for name, shape in shapes.items()):
        raise InputError(
            f"found a network of {len(found)} arrays that is not of this version of velfield; train the detector again"
        )
    values = {name: found[name].astype(np.float32) for name in shapes}
    if not all(np.isfinite(value).all() for value in values.values()):
        raise InputError("found a network with weights that are not finite, expected numbers; train the detector again")
    weights = {n: weights_from_onnx(values[f"{n}.weight"], layer.kernel, blocks[n]) for n, layer in layers.items()}
    return Network(weights, {n: values[f"{n}.bias"] for n in layers})


def _onnx_shape(layer: Conv, block: int) -> tuple[int, ...]:
    side = layer.kernel * block
    return layer.channels_out, layer.channels_in // block**2, side, side


def network_from_record(onnx_base64: str) -> Network:
    """Unpack the network of a detector file."""
    return network_from_onnx(b64decode(onnx_base64))


def network_to_record(network: Network) -> str:
    """Pack a network for a detector file: ONNX in base64."""
    return b64encode(network_to_onnx(network)).decode()
