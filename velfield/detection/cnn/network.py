"""The network's layers, its weights, and how it is run.

A small fully convolutional encoder-decoder: the encoder halves the resolution three times, two residual blocks follow
at an eighth of it, and the decoder returns by depth-to-space with a skip connection, as in a U-Net. `TOPOLOGY` is the
one definition of the layers: training, the ONNX graph and the detector file derive from it.

Inference is onnxruntime's, with one thread: frames are what is spread over the processors. A detector file holds the
network as ONNX, but only the weights are read from it, and the graph is built again from the topology: a file cannot
bring operators of its own.
"""

import re
import sys
import warnings
from base64 import b64decode, b64encode
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass
from functools import cache, cached_property
from textwrap import shorten
from threading import RLock, get_ident
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeAlias, TypeVar

import numpy as np
import onnx
import onnxruntime as ort
from onnx import TensorProto, helper, numpy_helper

from schemas.arrays import Float32Array, GreyImage
from schemas.detector import LayerRecord
from schemas.flight import Device
from velfield.errors import DeviceWarning, InputError

if TYPE_CHECKING:
    from velfield.detection.cnn.canvas import Canvases


@dataclass(frozen=True)
class Conv:
    """A convolution with bias, by default with a ReLU after it.

    A kernel of 1 or 3 keeps the resolution; one of 4 halves it (stride 2, one pixel of padding). Where there is a ReLU,
    training from scratch normalises its input by batch; the trained normalisation is folded into weights and bias.
    """

    name: str
    kernel: Literal[1, 3, 4]
    channels_in: int
    channels_out: int
    relu: bool = True

    @property
    def stride(self) -> int:
        """2 of a kernel of 4, else 1."""
        return 2 if self.kernel == 4 else 1

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of the weights: kernel taps, channels in, channels out."""
        return self.kernel**2, self.channels_in, self.channels_out


@dataclass(frozen=True)
class SpaceToDepth:
    """Half the resolution, four times the channels."""


@dataclass(frozen=True)
class DepthToSpace:
    """Twice the resolution, a quarter of the channels."""


@dataclass(frozen=True)
class Residual:
    """Adds the output of its layers to their input, optionally with a ReLU after the sum."""

    layers: tuple["Layer", ...]
    relu: bool = False


Layer: TypeAlias = Conv | SpaceToDepth | DepthToSpace | Residual
Topology: TypeAlias = tuple[Layer, ...]

_LOWEST_LEVEL: Topology = (
    Residual(
        (
            SpaceToDepth(),
            Conv("down2", 1, 128, 48),
            Residual((Conv("res1_0", 3, 48, 48), Conv("res1_1", 3, 48, 48))),
            Residual((Conv("res2_0", 3, 48, 48), Conv("res2_1", 3, 48, 48))),
            Conv("up1", 1, 48, 128, relu=False),
            DepthToSpace(),
        ),
        relu=True,
    ),
    Conv("dec1", 3, 32, 32),
)
"""Half the resolution and back, with a skip connection; then the first convolution of the decoder."""
TOPOLOGY: Topology = (
    Conv("stem", 4, 1, 16),
    Conv("down1", 4, 16, 32),
    Conv("enc1", 3, 32, 32),
    *_LOWEST_LEVEL,
    Conv("head", 1, 32, 12, relu=False),
    DepthToSpace(),
)
"""No layer works at full resolution: 15.9 GMAC a frame of 2560 x 1920 where `FORMER_TOPOLOGY` takes 66.6."""
FORMER_TOPOLOGY: Topology = (
    Conv("stem", 3, 1, 16),
    SpaceToDepth(),
    Conv("down1", 1, 64, 32),
    Conv("enc1_0", 3, 32, 32),
    Conv("enc1_1", 3, 32, 32),
    *_LOWEST_LEVEL,
    Conv("head", 1, 32, 3, relu=False),
)
"""That of the detectors of version 0.1, whose files are read."""
TOPOLOGIES: tuple[Topology, ...] = (TOPOLOGY, FORMER_TOPOLOGY)
"""Topologies that a detector file may hold."""
STRIDE = 2
"""Working px a pixel of the heatmap."""
_OPSET, _IR_VERSION = 17, 9
"""Versions of the ONNX files that are written: onnxruntime reads them since 1.15."""


def convolutions(layers: Topology) -> dict[str, Conv]:
    """The layers that have weights, by name, from input to output."""
    found: dict[str, Conv] = {}
    for layer in layers:
        if isinstance(layer, Conv):
            found[layer.name] = layer
        elif isinstance(layer, Residual):
            found |= convolutions(layer.layers)
    return found


def _alignment(layers: Topology) -> int:
    """Height and width of an image must be multiples of this: two to the number of halvings."""
    scale = worst = 1
    for layer in layers:
        if isinstance(layer, SpaceToDepth):
            scale *= 2
        elif isinstance(layer, Conv):
            scale *= layer.stride
        elif isinstance(layer, DepthToSpace):
            scale //= 2
        elif isinstance(layer, Residual):
            worst = max(worst, scale * _alignment(layer.layers))
        worst = max(worst, scale)
    return worst


_T = TypeVar("_T")
_STARTING = RLock()
"""Held while a GPU is tried and sessions are opened: several threads at once would each do so."""


class _Once(Generic[_T]):
    """A cached property that one thread makes for all: `functools.cached_property` has no lock from Python 3.12 on."""

    def __init__(self, make: Callable[[Any], _T]) -> None:
        self.make, self.name, self.__doc__ = make, make.__name__, make.__doc__

    def __get__(self, owner: Any, kind: type[Any]) -> _T:
        if owner is None:  # of the class, as what reads docstrings asks for it
            return self  # type: ignore[return-value]
        with _STARTING:
            known = vars(owner)
            if self.name not in known:
                known[self.name] = self.make(owner)
            found: _T = known[self.name]
            return found


Ranges: TypeAlias = Mapping[str, tuple[float, float]]
"""Least and largest value of each activation, by its name in the graph."""


@dataclass(frozen=True)
class Network:
    """Weights of a trained network.

    Attributes
    ----------
    weights : by layer, float32 (kernel taps, channels in, channels out).
    biases : by layer, float32 (channels out,).
    topology : its layers.
    ranges : of its activations; with them it is run in 8 bits on a processor (`velfield.detection.cnn.quantization`).
    """

    weights: Mapping[str, Float32Array]
    biases: Mapping[str, Float32Array]
    topology: Topology = TOPOLOGY
    ranges: Ranges | None = None

    @cached_property
    def alignment(self) -> int:
        """Height and width of an image must be multiples of this."""
        return _alignment(self.topology)

    @_Once
    def predict(self) -> "Predict":
        """The network in onnxruntime, on the device of `use_device`; in 8 bits on a processor that has them exactly."""
        if self.canvases is not None:
            return self.canvases.predict
        check_device(_device)
        if self.ranges is not None:
            from velfield.detection.cnn.quantization import is_exact, open_quantized

            if is_exact():
                return open_quantized(self, self.ranges)
            if not _limitations_reported:
                warnings.warn(INEXACT, DeviceWarning, stacklevel=3)
        return predict_by(open_session(network_to_onnx(self), "cpu"))

    @_Once
    def canvases(self) -> "Canvases | None":
        """On a GPU, what runs the network on images of few sizes; else none, and images may have any size."""
        if not uses_cuda(_device):
            return None
        from velfield.detection.cnn.canvas import Canvases

        found = Canvases(self, _device)
        # Of a session that a full GPU refused the processor would be slow: it has 8 bits.
        return found if all(_CUDA in session.get_providers() for session in found.sessions.values()) else None

    def __getstate__(self) -> dict[str, Any]:
        """Without the sessions, which no other process can use."""
        return {name: value for name, value in self.__dict__.items() if name not in ("predict", "canvases")}


Predict: TypeAlias = Callable[[GreyImage], tuple[Float32Array, Float32Array]]
"""Function of images (n, h, w): heatmap (n, h / 2, w / 2) and orientation vectors (n, 2, h / 2, w / 2)."""


def predict_by(session: ort.InferenceSession) -> Predict:
    """Predictions by a session of a model with the inputs and outputs of `network_to_onnx`."""

    def predict(images: GreyImage) -> tuple[Float32Array, Float32Array]:
        probability, orientation = session.run(None, {"image": np.ascontiguousarray(images[:, None])})
        return probability[:, 0], orientation

    return predict


_CUDA, _CPU = "CUDAExecutionProvider", "CPUExecutionProvider"
_WARNINGS, _ERRORS, _FATAL = 2, 3, 4
"""onnxruntime's levels of severity. A session's warnings are about how its graph was exported, many lines in each
process; without a session, its warnings and errors are shown."""
_device: Device = "auto"
_limitations_reported = False


def use_device(device: Device) -> None:
    """Set where the networks of this process are run that have not been run yet.

    Its caller reports `Detector.limitations`, which are not warned of any more: each process would repeat them.
    """
    global _device, _limitations_reported
    _device, _limitations_reported = device, True


def current_device() -> Device:
    """The device that `use_device` has set."""
    return _device


def uses_cuda(device: Device) -> bool:
    """Whether networks run on a GPU; without `use_device`, warn once a process where CUDA does not start."""
    if device == "auto" and not _limitations_reported:
        _warn_of_cuda()
    return device != "cpu" and _cuda_fault() is None


def device_limitations(device: Device) -> list[str]:
    """Why networks run on the processor, where onnxruntime has CUDA and the processor was not asked for."""
    fault = _cuda_fault() if device == "auto" and _CUDA in ort.get_available_providers() else None
    if fault is None:
        return []
    return [f"found {fault}, {_EXPECTED}: the network runs on the processor; {_REMEDY}"]


_EXPECTED = "expected CUDA, cuDNN and an NVIDIA GPU"
_REMEDY = "pip install velfield[cuda] as docs/scale.md says, or use --device cpu"


@cache
def _warn_of_cuda() -> None:
    for text in device_limitations("auto"):
        warnings.warn(text, DeviceWarning, stacklevel=3)


def _cuda_fault() -> str | None:
    """Reason why networks cannot run on a GPU, None if they can: tried once per process."""
    with _STARTING:
        return _find_cuda_fault()


class _Captured:
    """Standard output whose lines of this thread are kept; those of others are passed on."""

    def __init__(self) -> None:
        self.printed, self._thread, self._stdout = "", get_ident(), sys.stdout

    def write(self, text: str) -> int:
        if get_ident() != self._thread:
            return self._stdout.write(text)
        self.printed += text
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stdout, name)


_CAUSE = re.compile(r"CUDA failure [^;]*|Failed to load [^\n]*")
"""In what onnxruntime says: without a driver a line of 600 characters, most of them C++."""


@cache
def _find_cuda_fault() -> str | None:
    """By a convolution.

    The package says only what it was compiled for. Without CUDA's libraries its sessions have no CUDA, without a driver
    none is made, and without cuDNN they fail at the first convolution.
    """
    offered = ort.get_available_providers()
    if _CUDA not in offered:
        return f"onnxruntime with {', '.join(offered)}"
    output: Any = _Captured()
    ort.set_default_logger_severity(_FATAL)
    try:
        if hasattr(ort, "preload_dlls"):  # from 1.21 on: those that pip installed, which no loader looks for
            with redirect_stdout(output):  # it prints which libraries it misses
                ort.preload_dlls()
        session = _cuda_session(_probe())
        session.run(None, {"image": np.zeros((1, 1, 8, 8), np.float32)})
        if _CUDA in session.get_providers():
            return None
        why, messages = next(iter(output.printed.strip().splitlines()), "no GPU, or no driver of it"), output.printed
    except Exception as error:  # onnxruntime's own kinds have no common base
        why, messages = str(error).strip().rpartition(" : ")[2], f"{output.printed}\n{error}"
    finally:
        ort.set_default_logger_severity(_WARNINGS)
    cause = _CAUSE.search(messages)
    return f"onnxruntime with CUDA that does not start ({shorten(cause[0] if cause else why, 200)})"


def _cuda_session(model: bytes) -> ort.InferenceSession:
    """A session on a GPU; an error where none starts: onnxruntime's own fallback prints five lines on it."""
    return ort.InferenceSession(model, _session_options(), providers=_providers(gpu=True), enable_fallback=0)


def _probe() -> bytes:
    """A convolution, as an ONNX model."""
    image, out = (helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 1, 8, 8]) for name in ("image", "out"))
    kernel = numpy_helper.from_array(np.ones((1, 1, 3, 3), np.float32), "kernel")
    node = helper.make_node("Conv", ["image", "kernel"], ["out"], pads=[1] * 4)
    return serialize(helper.make_graph([node], "probe", [image], [out], [kernel]))


INEXACT = (
    "this processor saturates sums of products of 8 bits (it has no VNNI): the network runs in floating point, which "
    "takes up to twice as long"
)


def check_device(device: Device) -> None:
    """Raise InputError where onnxruntime cannot use a device."""
    fault = _cuda_fault() if device == "cuda" else None
    if fault is not None:
        raise InputError(f"--device cuda: found {fault}, {_EXPECTED}; {_REMEDY}")


def open_session(model: bytes, device: Device) -> ort.InferenceSession:
    """A model in onnxruntime: on one thread of the processor, so that the order of its sums never changes, or on a GPU.

    Raises
    ------
    InputError
        ``device`` is cuda, and onnxruntime cannot use it.
    """
    check_device(device)
    gpu = uses_cuda(device)
    session = None
    if gpu:
        with suppress(Exception):  # onnxruntime's own kinds; a faulty model fails on the processor too
            session = _cuda_session(model)
    if session is None:
        session = ort.InferenceSession(model, _session_options(), providers=_providers(gpu=False))
    if gpu and _CUDA not in session.get_providers():  # though another did: its memory is full
        found = f"a GPU on which no further session starts, {_EXPECTED}"
        if device == "cuda":
            raise InputError(f"--device cuda: found {found}; free its memory, or use --device cpu")
        warnings.warn(
            "GPU unavailable, no further session starts on it: using the CPU; free the GPU's memory",
            DeviceWarning,
            stacklevel=2,
        )
    return session


def _session_options() -> ort.SessionOptions:
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = _ERRORS
    return options


def _providers(*, gpu: bool) -> list[Any]:
    """Execution providers that a session requests, first choice first.

    With TF32's shorter mantissa scores would differ visibly. Trying all of cuDNN's ways (EXHAUSTIVE) takes five times
    as long at each new size, and finds none that is faster.
    """
    cuda = (_CUDA, {"use_tf32": "0", "cudnn_conv_algo_search": "HEURISTIC"})
    return [cuda, _CPU] if gpu else [_CPU]


def network_to_onnx(network: Network) -> bytes:
    """The network as an ONNX model.

    Input ``image``: (n, 1, h, w) uint8 grey, h and w multiples of `Network.alignment`. Outputs: ``probability``
    (n, 1, h / 2, w / 2) of a car's centre and ``orientation`` (n, 2, h / 2, w / 2), cosine and sine of twice the
    orientation. Weights are stored at half precision, which is what a detector file keeps, and computed with at single.
    """
    graph = GraphBuilder(network)
    return graph.finish(graph.layers(network.topology, graph.normalised_image()))


def serialize(graph: onnx.GraphProto) -> bytes:
    """A model of a graph, as a file holds it."""
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR_VERSION, producer_name="velfield"
    )
    return bytes(model.SerializeToString())


class GraphBuilder:
    """Nodes and constants of an ONNX graph; every value has a name of its own."""

    def __init__(self, network: Network) -> None:
        self.network = network
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, name: str, values: "np.ndarray[Any, Any]") -> str:
        self.constants.append(numpy_helper.from_array(values, name))
        return name

    def node(self, operator: str, inputs: Sequence[str], *, output: str | None = None, **attributes: Any) -> str:
        output = output or f"value_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, list(inputs), [output], **attributes))
        return output

    def normalised_image(self) -> str:
        """The input, grey in [0, 1]."""
        grey = self.node("Cast", ["image"], to=TensorProto.FLOAT)
        return self.node("Mul", [grey, self.constant("scale", np.array(1 / 255, np.float32))])

    def finish(self, out: str, observed: Sequence[str] = ()) -> bytes:
        """The model, of the network's last output; its outputs are those of `network_to_onnx` and some others."""
        ends = [self.constant(f"logit_{k}", np.array([v])) for k, v in enumerate((0, 1, 1))]
        self.node("Sigmoid", [self.node("Slice", [out, *ends])], output="probability")
        ends = [self.constant(f"orientation_{k}", np.array([v])) for k, v in enumerate((1, 3, 1))]
        self.node("Slice", [out, *ends], output="orientation")
        size: list[str | int] = ["n", 1, "h", "w"]
        image = helper.make_tensor_value_info("image", TensorProto.UINT8, size)
        outputs = []
        for name, channels in (("probability", 1), ("orientation", 2)):
            halved: list[str | int] = ["n", channels, "h / 2", "w / 2"]
            outputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, halved))
        outputs += [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in observed]
        return serialize(helper.make_graph(self.nodes, "velfield-cnn", [image], outputs, self.constants))

    def layers(self, layers: Topology, value: str, prefix: str = "", *, first: int = 0) -> str:
        """Output of a sequence of layers, from the ``first`` of them on.

        Space-to-depth and the convolution after it are one strided convolution.
        """
        block = 1
        head = not prefix and list(convolutions(layers))[-1]
        for number, layer in enumerate(layers[first:], first):
            name = f"{prefix}{number}"
            if isinstance(layer, SpaceToDepth):
                block *= 2
                continue
            if isinstance(layer, Conv):
                value = self.conv(layer, value, block)
            elif isinstance(layer, DepthToSpace):
                assert block == 1, "blocks are moved into the channels of a convolution only"
                value = self.depth_to_space(value)
            else:
                value = self.node("Add", [self.layers(layer.layers, value, f"{name}."), value])
            block = 1
            if isinstance(layer, Conv | Residual) and layer.relu:
                value = self.node("Relu", [value])
            if isinstance(layer, Conv) and layer.name == head:
                return self._unpack_heatmap(layers[number + 1 :], value)
            value = self.activation(value, name)
        return value

    def _unpack_heatmap(self, layers: Topology, value: str) -> str:
        """The layers after the head: blocks of channels moved into pixels."""
        for layer in layers:
            assert isinstance(layer, DepthToSpace), "only the heatmap is unpacked after the head"
            value = self.node("DepthToSpace", [value], blocksize=2, mode="DCR")
        return value

    def depth_to_space(self, value: str) -> str:
        """Channels (y, x, c) moved into blocks of 2 x 2 pixels."""
        return self.node("DepthToSpace", [value], blocksize=2, mode="DCR")

    def activation(self, value: str, name: str) -> str:
        """The value as the next layer reads it; subclasses quantize it. ``name``: its place in the topology."""
        return value

    def conv(self, layer: Conv, value: str, block: int) -> str:
        """Output of a convolution."""
        kernel = onnx_kernel(self.network.weights[layer.name], layer.kernel, block)
        names = []
        for name, values in (
            (f"{layer.name}.weight", kernel),
            (f"{layer.name}.bias", self.network.biases[layer.name]),
        ):
            half = self.constant(name, values.astype(np.float16))
            names.append(self.node("Cast", [half], to=TensorProto.FLOAT))
        return self.convolve(layer, [value, *names], block)

    def convolve(self, layer: Conv, inputs: Sequence[str], block: int) -> str:
        """The convolution itself, of a value, weights and biases."""
        pad = 1 if layer.stride == 2 else block * (layer.kernel // 2)
        return self.node("Conv", inputs, strides=[block * layer.stride] * 2, pads=[pad] * 4)


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

    Raises
    ------
    InputError
        Not such a model, or not of a topology that this version knows.
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
    for topology in TOPOLOGIES:
        layers, blocks = convolutions(topology), _blocks(topology)
        shapes = {name: _onnx_shape(layer, blocks[name]) for name, layer in layers.items()}
        if all(f"{n}.weight" in found and found[f"{n}.weight"].shape == shape for n, shape in shapes.items()) and all(
            f"{n}.bias" in found and found[f"{n}.bias"].shape == (layer.channels_out,) for n, layer in layers.items()
        ):
            break
    else:
        raise InputError(
            f"found a network of {len(found)} arrays that is not of this version of velfield; train the detector again"
        )
    values = {name: found[name].astype(np.float32) for name in (f"{n}.{k}" for n in layers for k in ("weight", "bias"))}
    if not all(np.isfinite(value).all() for value in values.values()):
        raise InputError("found a network with weights that are not finite, expected numbers; train the detector again")
    weights = {n: weights_from_onnx(values[f"{n}.weight"], layer.kernel, blocks[n]) for n, layer in layers.items()}
    return Network(weights, {n: values[f"{n}.bias"] for n in layers}, topology)


def _onnx_shape(layer: Conv, block: int) -> tuple[int, int, int, int]:
    side = layer.kernel * block
    return layer.channels_out, layer.channels_in // block**2, side, side


def network_from_record(onnx_base64: str) -> Network:
    """Unpack the network of a detector file."""
    return network_from_onnx(b64decode(onnx_base64))


def network_to_record(network: Network) -> str:
    """Pack a network for a detector file: ONNX in base64."""
    return b64encode(network_to_onnx(network)).decode()


def network_from_layers(record: Mapping[str, LayerRecord]) -> Network:
    """Unpack the layers of a detector file of format version 1.

    Raises
    ------
    InputError
        The layers are not those of `FORMER_TOPOLOGY`.
    """
    found = {name: layer.shape for name, layer in record.items()}
    expected = {name: conv.shape for name, conv in convolutions(FORMER_TOPOLOGY).items()}
    if found != expected:
        odd = next(name for name in [*expected, *found] if found.get(name) != expected.get(name))
        raise InputError(
            f"found a network whose layer {odd} is {found.get(odd)}, expected {expected.get(odd)}; it is of "
            "another version of velfield: train it again"
        )
    weights, biases = {}, {}
    for name, shape in expected.items():
        values = np.frombuffer(b64decode(record[name].weights_f16), "<f2").astype(np.float32)
        weights[name], biases[name] = values[: -shape[2]].reshape(shape), values[-shape[2] :]
    return Network(weights, biases, FORMER_TOPOLOGY)
