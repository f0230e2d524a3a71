"""The network in integers of 8 bits, by onnxruntime's own quantiser.

Activations are unsigned, weights have a scale a channel.
On processors that multiply bytes (VNNI of x86, dot products of ARM) it takes about half of the time. The range of an
activation is measured on crops of the flight at hand (`calibrate`), without the outermost ten-thousandth at either end,
whose place the rest of the values would pay for with their precision. The first layer, of one channel, which
onnxruntime convolves slowly in bytes, and the head stay in floating point.

Older x86 processors add products of bytes in 16 bits, which saturates. Whether this one is exact is tested, not looked
up (`is_exact`): elsewhere the network runs in floating point, with a warning.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, TypeAlias

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from onnxruntime.quantization import CalibrationMethod, QDQQuantizer, QuantType
from onnxruntime.quantization.calibrate import TensorsData

from schemas.arrays import GreyImage
from velfield.detection.cnn.graph import network_graph
from velfield.detection.cnn.network import ALIGNMENT, TOPOLOGY, Network, convolutions
from velfield.detection.runtime import open_session, serialize
from velfield.parallel import parallel_map

Ranges: TypeAlias = Mapping[str, tuple[float, float]]
"""Least and largest value of each activation, by its name in the graph."""
INEXACT = (
    "this processor saturates sums of products of 8 bits (it has no VNNI): the network runs in floating point, which "
    "takes up to twice as long"
)
_TAIL_PERCENT = 0.01
_CROP_PX, _CROPS_AT_ONCE = 96, 32
_OPERATORS = ["Conv", "Relu", "Add", "DepthToSpace"]
_IN_FLOATING_POINT = [list(convolutions(TOPOLOGY))[k] for k in (0, -1)]


def calibrate(
    network: Network, images: Sequence[GreyImage], *, crops: int = 64, seed: int = 0
) -> dict[str, tuple[float, float]]:
    """Ranges of the activations on random crops of images (h, w).

    Raises
    ------
    ValueError
        An image is smaller than a crop.
    """
    rng = np.random.default_rng(seed)
    side = min(_CROP_PX, *(size // ALIGNMENT * ALIGNMENT for image in images for size in image.shape))
    if side < ALIGNMENT:
        raise ValueError(f"found an image of fewer than {ALIGNMENT} px, expected {_CROP_PX} or more either way")
    pixels = []
    for k in range(crops):
        image = images[k % len(images)]
        y, x = (int(rng.integers(0, size - side + 1)) for size in image.shape)
        pixels.append(image[y : y + side, x : x + side])
    graph = network_graph(network)
    names = [node.output[0] for node in graph.node if node.op_type in _OPERATORS]
    known = {one.name for one in graph.output}
    others = [name for name in names if name not in known]
    graph.output.extend(helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in others)
    session = open_session(serialize(graph), "cpu")

    def ends_of_batch(start: int) -> list[NDArray[np.floating]]:
        batch = np.stack(pixels[start : start + _CROPS_AT_ONCE])[:, None]
        found = session.run(names, {"image": batch})
        return [np.percentile(values, (_TAIL_PERCENT, 100 - _TAIL_PERCENT)) for values in found]

    ends = np.array(parallel_map(ends_of_batch, range(0, len(pixels), _CROPS_AT_ONCE)))
    return {name: (float(ends[:, k, 0].min()), float(ends[:, k, 1].max())) for k, name in enumerate(names)}


def quantized_to_onnx(network: Network, ranges: Ranges) -> bytes:
    """The network as an ONNX model in 8 bits (QDQ), with the inputs and outputs of `graph.network_to_onnx`."""
    ends = {name: tuple(np.float32(end) for end in (min(low, 0), max(high, 0))) for name, (low, high) in ranges.items()}
    quantizer = QDQQuantizer(
        onnx.ModelProto.FromString(serialize(network_graph(network))),
        per_channel=True,
        reduce_range=False,
        weight_qType=QuantType.QInt8,
        activation_qType=QuantType.QUInt8,
        tensors_range=TensorsData(CalibrationMethod.MinMax, ends),
        nodes_to_quantize=[],
        nodes_to_exclude=_IN_FLOATING_POINT,
        op_types_to_quantize=_OPERATORS,
        extra_options={},
    )
    quantizer.quantize_model()
    return bytes(quantizer.model.model.SerializeToString())


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
