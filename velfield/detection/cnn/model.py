"""The network that detects cars, and a frame's detections from it.

A small fully convolutional encoder-decoder. From a grey image it predicts, at half the resolution, a heatmap of car
centres and the orientation of the car at each pixel as (cos 2a, sin 2a). The encoder halves the resolution three times,
two residual blocks follow at an eighth of it, and the decoder returns by depth-to-space with a skip connection, as in a
U-Net. `TOPOLOGY` is the one definition of the layers: training, the ONNX graph and the detector
file derive from it.

Inference is onnxruntime's, with one thread: frames are what is spread over the processors. A detector file holds the
network as ONNX, but only the weights are read from it, and the graph is built again from the topology: a file cannot
bring operators of its own.

Peaks of the heatmap are candidates at sub-pixel positions. Those between two probabilities that the detector file gives
are scored again on two crops, one rotated to the predicted orientation and one across it, and the outputs are averaged
(test-time augmentation). Non-maximum suppression is left to the caller.

A detector adapted to a flight by self-training adds a score bonus where the frame differs from the background.
"""

from base64 import b64decode, b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, TypeAlias

import cv2
import numpy as np
import onnx
import onnxruntime as ort
from onnx import TensorProto, helper, numpy_helper

from schemas.arrays import Float32Array, FloatArray, GreyImage, Mask
from schemas.detector import LayerRecord, MotionRecord
from schemas.flight import Device
from velfield.detection.cnn.peaks import SMOOTHING_SIGMA, are_mostly_visible, find_peaks
from velfield.detection.detector import Crop
from velfield.detection.orientation import sample_nearest
from velfield.errors import InputError


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
        """Of the weights: kernel taps, channels in, channels out."""
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
"""Those that a detector file may hold."""
STRIDE = 2
"""Working px a pixel of the heatmap."""
_TILE_PX, HALO_PX = 2048, 64
"""Larger images are processed in tiles, each with a halo wider than the reach of the receptive field."""
BORDER_PX = 16
"""An image is continued so far by reflection, for cars at its edge: F1 0.837 in place of 0.833 on the minsk clip, cars
that the edge cuts included; with 64 px 0.836."""
_BATCH_PX = 500_000
"""Of the crops that the network is run on at once: more no longer stays in the processor's cache."""
_BORDER = cv2.BORDER_REFLECT_101
_OPSET, _IR_VERSION = 17, 9
"""Of the ONNX files: what onnxruntime has read since 1.15."""


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
    """What the height and the width of an image must be multiples of: two to the number of halvings."""
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


@dataclass(frozen=True)
class Network:
    """Weights of a trained network.

    Attributes
    ----------
    weights : by layer, float32 (kernel taps, channels in, channels out).
    biases : by layer, float32 (channels out,).
    topology : its layers.
    """

    weights: Mapping[str, Float32Array]
    biases: Mapping[str, Float32Array]
    topology: Topology = TOPOLOGY

    @cached_property
    def alignment(self) -> int:
        """What the height and the width of an image must be multiples of."""
        return _alignment(self.topology)

    @cached_property
    def session(self) -> ort.InferenceSession:
        """The network in onnxruntime, on the device of `use_device`."""
        return open_session(network_to_onnx(self), _device)

    def __getstate__(self) -> dict[str, Any]:
        """Without the session, which no other process can use."""
        return {name: value for name, value in self.__dict__.items() if name != "session"}


_CUDA, _CPU = "CUDAExecutionProvider", "CPUExecutionProvider"
_device: Device = "auto"


def use_device(device: Device) -> None:
    """Set where the networks of this process are run that have not been run yet."""
    global _device
    _device = device


def current_device() -> Device:
    """What `use_device` set."""
    return _device


def check_device(device: Device) -> None:
    """Raise InputError where onnxruntime cannot use a device."""
    if device == "cuda" and _CUDA not in ort.get_available_providers():
        raise InputError(_no_cuda(f"onnxruntime with {', '.join(ort.get_available_providers())}"))


def open_session(model: bytes, device: Device) -> ort.InferenceSession:
    """A model in onnxruntime: on one thread of the processor, so that the order of its sums never changes, or on a GPU.

    Raises
    ------
    InputError
        ``device`` is cuda, and onnxruntime cannot use it.
    """
    check_device(device)
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    providers: list[Any] = [_CPU]
    if device != "cpu" and _CUDA in ort.get_available_providers():
        providers.insert(0, (_CUDA, {"use_tf32": "0"}))  # with its shorter mantissa scores would differ visibly
    session = ort.InferenceSession(model, options, providers=providers)
    if device == "cuda" and _CUDA not in session.get_providers():
        raise InputError(_no_cuda("a GPU that onnxruntime could not start"))
    return session


def _no_cuda(found: str) -> str:
    return f"--device cuda: found {found}, expected CUDA; pip install velfield[cuda], or use --device cpu"


def network_to_onnx(network: Network) -> bytes:
    """The network as an ONNX model.

    Input ``image``: (n, 1, h, w) uint8 grey, h and w multiples of `Network.alignment`. Outputs: ``probability``
    (n, 1, h / 2, w / 2) of a car's centre and ``orientation`` (n, 2, h / 2, w / 2), cosine and sine of twice the
    orientation. Weights are stored at half precision, which is what a detector file keeps, and computed with at single.
    """
    graph = _GraphBuilder(network)
    scale = graph.constant("scale", np.array(1 / 255, np.float32))
    grey = graph.node("Cast", ["image"], to=TensorProto.FLOAT)
    out = graph.layers(network.topology, graph.node("Mul", [grey, scale]))
    logit = graph.node("Slice", [out, *(graph.constant(f"logit_{k}", np.array([v])) for k, v in enumerate((0, 1, 1)))])
    graph.node("Sigmoid", [logit], output="probability")
    ends = [graph.constant(f"orientation_{k}", np.array([v])) for k, v in enumerate((1, 3, 1))]
    graph.node("Slice", [out, *ends], output="orientation")
    size: list[str | int] = ["n", 1, "h", "w"]
    image = helper.make_tensor_value_info("image", TensorProto.UINT8, size)
    outputs = []
    for name, channels in (("probability", 1), ("orientation", 2)):
        halved: list[str | int] = ["n", channels, "h / 2", "w / 2"]
        outputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, halved))
    made = helper.make_graph(graph.nodes, "velfield-cnn", [image], outputs, graph.constants)
    model = helper.make_model(
        made, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR_VERSION, producer_name="velfield"
    )
    return bytes(model.SerializeToString())


class _GraphBuilder:
    """Nodes and constants of an ONNX graph; every value has a name of its own."""

    def __init__(self, network: Network) -> None:
        self._network = network
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, name: str, values: "np.ndarray[Any, Any]") -> str:
        self.constants.append(numpy_helper.from_array(values, name))
        return name

    def node(self, operator: str, inputs: Sequence[str], *, output: str | None = None, **attributes: Any) -> str:
        output = output or f"value_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, list(inputs), [output], **attributes))
        return output

    def layers(self, layers: Topology, value: str) -> str:
        """Output of a sequence of layers. Space-to-depth and the convolution after it are one strided convolution."""
        block = 1
        for layer in layers:
            if isinstance(layer, SpaceToDepth):
                block *= 2
                continue
            if isinstance(layer, Conv):
                value = self._conv(layer, value, block)
            elif isinstance(layer, DepthToSpace):
                assert block == 1, "blocks are moved into the channels of a convolution only"
                value = self.node("DepthToSpace", [value], blocksize=2, mode="DCR")
            else:
                value = self.node("Add", [self.layers(layer.layers, value), value])
            block = 1
            if isinstance(layer, Conv | Residual) and layer.relu:
                value = self.node("Relu", [value])
        return value

    def _conv(self, layer: Conv, value: str, block: int) -> str:
        kernel = onnx_kernel(self._network.weights[layer.name], layer.kernel, block)
        names = []
        for name, values in (
            (f"{layer.name}.weight", kernel),
            (f"{layer.name}.bias", self._network.biases[layer.name]),
        ):
            half = self.constant(name, values.astype(np.float16))
            names.append(self.node("Cast", [half], to=TensorProto.FLOAT))
        pad = 1 if layer.stride == 2 else block * (layer.kernel // 2)
        return self.node("Conv", [value, *names], strides=[block * layer.stride] * 2, pads=[pad] * 4)


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


def forward(network: Network, images: GreyImage) -> tuple[Float32Array, Float32Array]:
    """Heatmap and orientation vectors of a batch of images.

    Parameters
    ----------
    images
        (n, h, w) uint8; height and width are multiples of `Network.alignment`.

    Returns
    -------
    (n, h / 2, w / 2) probability of a car's centre; (n, 2, h / 2, w / 2) cosine and sine of twice its orientation.
    """
    probability, orientation = network.session.run(None, {"image": np.ascontiguousarray(images[:, None])})
    return probability[:, 0], orientation


def predict_heatmap(
    network: Network, image: GreyImage, *, border_px: int = BORDER_PX
) -> tuple[Float32Array, Float32Array]:
    """Probability and orientation of a car at each pixel of the heatmap, by tiled inference.

    Parameters
    ----------
    image
        (h, w) uint8 of any size.
    border_px
        How far it is continued by reflection; 0 of a crop that has context already.

    Returns
    -------
    (h / 2, w / 2) probability and (2, h / 2, w / 2) orientation vector, sizes rounded up; heatmap pixel (x, y) is
    centred at (2 x + 0.5, 2 y + 0.5) of the image.
    """
    (height, width), unit = image.shape, network.alignment
    whole = unit * -(-height // unit), unit * -(-width // unit)
    side = [unit * -(-size // (unit * -(-size // _TILE_PX))) for size in whole]
    end = [border_px + size - given for size, given in zip(whole, image.shape, strict=True)]
    padded = cv2.copyMakeBorder(image, border_px, end[0], border_px, end[1], _BORDER) if any(end) else image
    if len(range(0, whole[0], side[0])) == len(range(0, whole[1], side[1])) == 1 and not border_px:
        of_image = forward(network, padded[None])
        return of_image[0][0][: -(-height // STRIDE), : -(-width // STRIDE)], of_image[1][0]
    probability = np.empty((whole[0] // STRIDE, whole[1] // STRIDE), np.float32)
    orientation = np.empty((2, *probability.shape), np.float32)
    for y in range(0, whole[0], side[0]):
        for x in range(0, whole[1], side[1]):
            # Beside other tiles the halo, at the image's edge its border: so tiles do not show.
            top, left = max(0, y + border_px - HALO_PX), max(0, x + border_px - HALO_PX)
            tile = padded[top : y + border_px + side[0] + HALO_PX, left : x + border_px + side[1] + HALO_PX]
            of_tile = forward(network, tile[None])
            rows, columns = (min(size, far - near) for size, far, near in zip(side, whole, (y, x), strict=True))
            down, right = (y + border_px - top) // STRIDE, (x + border_px - left) // STRIDE
            inner = slice(down, down + rows // STRIDE), slice(right, right + columns // STRIDE)
            part = slice(y // STRIDE, (y + rows) // STRIDE), slice(x // STRIDE, (x + columns) // STRIDE)
            probability[part], orientation[:, *part] = of_tile[0][0][inner], of_tile[1][0][:, *inner]
    size = -(-height // STRIDE), -(-width // STRIDE)
    return probability[: size[0], : size[1]], orientation[:, : size[0], : size[1]]


def predict_crops(network: Network, image: GreyImage, crops: Sequence[Crop]) -> tuple[Float32Array, Float32Array]:
    """The same of crops of an image, each predicted as if it were alone; those of one size in one call.

    Parameters
    ----------
    image
        (h, w) uint8, even.
    crops
        Disjoint, at multiples of `Network.alignment` and of such sizes.

    Returns
    -------
    As of `predict_heatmap`; zero where no crop is.
    """
    probability = np.zeros((image.shape[0] // STRIDE, image.shape[1] // STRIDE), np.float32)
    orientation = np.zeros((2, *probability.shape), np.float32)
    by_size: dict[tuple[int, int], list[Crop]] = {}
    for crop in crops:
        by_size.setdefault(crop[2:], []).append(crop)
    for (height, width), alike in by_size.items():
        at_once = max(1, _BATCH_PX // (height * width))
        for start in range(0, len(alike), at_once):
            batch = alike[start : start + at_once]
            pixels = np.stack([image[y : y + height, x : x + width] for y, x, _, _ in batch])
            if len(batch) == 1:
                heatmap, vector = predict_heatmap(network, pixels[0], border_px=0)
                heatmaps, vectors = heatmap[None], vector[None]
            else:
                heatmaps, vectors = forward(network, pixels)
            for k, (y, x, _, _) in enumerate(batch):
                part = slice(y // STRIDE, (y + height) // STRIDE), slice(x // STRIDE, (x + width) // STRIDE)
                probability[part], orientation[:, *part] = heatmaps[k], vectors[k]
    return probability, orientation


SCORE_OFFSET = 0.35
"""Probability predicted where a candidate is as often a car as not: around centres the loss lets the network predict
less than it should. Scores are probabilities less this."""
_MIN_PEAK_PROBABILITY = 0.2
MIN_SCORE = _MIN_PEAK_PROBABILITY - SCORE_OFFSET
"""Hardly any detection scores lower."""
NO_TTA = 1.0, 1.0
"""No test-time augmentation (TTA), as in the shipped detector: on unseen images it scored cars no better (F1 0.900 in
place of 0.907 on the minsk clip), at three times the cost."""
FULL_TTA = 0.0, 1.0
"""TTA of all candidates, where the distribution of the scores counts: self-training compares that of
stationary cars to that of moving ones, which it was trained on. Otherwise it found 0.16 of the stationary cars on a
simulated flight in place of 0.69."""
_CROP_PX = 48
_CENTRE = _CROP_PX // (2 * STRIDE)
"""Row and column of the heatmap of a crop where the candidate's centre is."""
_ROTATIONS = np.radians([0.0, 90.0])
"""Relative to the predicted orientation. Four rotations, or shifted crops as well, detected no more cars on the minsk
clip at up to three times the cost."""
_CANDIDATES_PER_BATCH = 8


def detect_cars(
    network: Network,
    image: GreyImage,
    valid: Mask | None,
    tta_range: tuple[float, float] = NO_TTA,
    *,
    border_px: int = BORDER_PX,
    crops: Sequence[Crop] | None = None,
) -> FloatArray:
    """Detect cars in a frame, or in an image of crops; a car may be detected several times, see `nms_oriented`.

    Returns
    -------
    (n, 5): x, y in working px, orientation (axial, [0, pi)), score (probability - `SCORE_OFFSET`), standard deviation
    of the orientation, rad.
    """
    if crops is None:
        probability, orientation = predict_heatmap(network, image, border_px=border_px)
    else:
        probability, orientation = predict_crops(network, image, crops)
    peaks = find_peaks(probability, orientation, valid, stride=STRIDE, min_probability=_MIN_PEAK_PROBABILITY)
    if not len(peaks):
        return np.empty((0, 5))
    xy, vector, score = peaks[:, :2], peaks[:, 2:4].copy(), peaks[:, 4].copy()
    unsure = np.flatnonzero((score > tta_range[0]) & (score < tta_range[1]))
    if len(unsure):
        axis = 0.5 * np.arctan2(vector[unsure, 1], vector[unsure, 0])
        probabilities, vectors = _predict_rotated_crops(network, image, xy[unsure], axis)
        score[unsure] = probabilities.mean(axis=1)
        sum_of_weights = np.maximum(probabilities.sum(axis=1), 1e-9)[:, None]
        vector[unsure] = (vectors * probabilities[..., None]).sum(axis=1) / sum_of_weights
    resultant = np.clip(np.hypot(vector[:, 0], vector[:, 1]), 1e-3, 1 - 1e-3)
    axis = np.mod(0.5 * np.arctan2(vector[:, 1], vector[:, 0]), np.pi)
    detections = np.column_stack([xy, axis, score - SCORE_OFFSET, 0.5 * np.sqrt(-2 * np.log(resultant))])
    return detections[are_mostly_visible(detections, image.shape, valid)]


def background_difference_at(
    image: GreyImage, background: GreyImage, xy: FloatArray, car_length_px: float
) -> FloatArray:
    """Mean absolute difference of a frame to the background around (n, 2) positions, grey levels.

    The mean is weighted by a Gaussian with a standard deviation of a fifth of a car's length.
    """
    difference = cv2.absdiff(image, background).astype(np.float32)
    return sample_nearest(cv2.GaussianBlur(difference, (0, 0), car_length_px / 5), xy)


def motion_score_bonus(motion: MotionRecord, difference: FloatArray) -> FloatArray:
    """Score added to detections by their difference to the background: a linear ramp, clipped at both ends."""
    ramp = motion.bonus_ramp_end - motion.bonus_ramp_start
    fraction = (difference - motion.bonus_ramp_start) / ramp
    return motion.max_score_bonus * np.clip(fraction, 0.0, 1.0)


def _predict_rotated_crops(
    network: Network, image: GreyImage, xy: FloatArray, axis: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Test-time augmentation: probability (n, 2) and orientation vector (n, 2, 2) on crops along and across the axis.

    Orientation vectors are rotated back into the image.
    """
    rotations = axis[:, None] + _ROTATIONS
    offsets = np.arange(_CROP_PX) - (_CENTRE * STRIDE + (STRIDE - 1) / 2)
    v, u = np.meshgrid(offsets, offsets, indexing="ij")
    probability, vectors = np.empty(rotations.shape), np.empty((*rotations.shape, 2))
    for start in range(0, len(xy), _CANDIDATES_PER_BATCH):
        part = slice(start, start + _CANDIDATES_PER_BATCH)
        c, s = np.cos(rotations[part])[..., None, None], np.sin(rotations[part])[..., None, None]
        map_x, map_y = xy[part, 0, None, None, None] + u * c - v * s, xy[part, 1, None, None, None] + u * s + v * c
        flat = (-1, _CROP_PX)
        maps = map_x.reshape(flat).astype(np.float32), map_y.reshape(flat).astype(np.float32)
        crops = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=_BORDER)
        heatmaps, of_crops = forward(network, crops.reshape(-1, _CROP_PX, _CROP_PX))
        probability[part], vectors[part] = _read_centre(heatmaps, of_crops, rotations[part])
    return probability, vectors


def _read_centre(heatmaps: Float32Array, vectors: Float32Array, rotations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Highest smoothed probability within a pixel of the crops' centre, and the orientation vector at the centre."""
    window = heatmaps[:, _CENTRE - 3 : _CENTRE + 4, _CENTRE - 3 : _CENTRE + 4].astype(np.float64)
    kernel = cv2.getGaussianKernel(5, SMOOTHING_SIGMA)[:, 0]
    rows = sum(kernel[k] * window[:, k : k + 3] for k in range(5))
    smooth = sum(kernel[k] * rows[:, :, k : k + 3] for k in range(5))
    probability = np.asarray(smooth).max(axis=(1, 2)).reshape(rotations.shape)
    vector = vectors[:, :, _CENTRE, _CENTRE].astype(np.float64).reshape(*rotations.shape, 2)
    c, s = np.cos(2 * rotations), np.sin(2 * rotations)
    return probability, np.stack([vector[..., 0] * c - vector[..., 1] * s, vector[..., 0] * s + vector[..., 1] * c], -1)
