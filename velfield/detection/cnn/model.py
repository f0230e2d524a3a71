"""The network that detects cars: a small fully convolutional encoder-decoder.

From a grey image it predicts, at half the resolution, a heatmap of car centres and the orientation of the car at each
pixel as (cos 2a, sin 2a). The encoder halves the resolution twice by space-to-depth and a 1 x 1 convolution, two
residual blocks follow at a quarter of the resolution, and the decoder returns to a half by depth-to-space with a skip
connection, as in a U-Net. 126,000 parameters; the receptive field is about three car lengths.

`TOPOLOGY` is the one definition of the layers: inference, training and the detector file derive from it.
"""

from base64 import b64decode, b64encode
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import cv2
import numpy as np

from schemas.arrays import Float32Array, GreyImage
from schemas.detector import LayerRecord
from velfield.detection.cnn.convolution import PaddedBatchLayout, conv2d, depth_to_space, space_to_depth
from velfield.errors import InputError


@dataclass(frozen=True)
class Conv:
    """A convolution with bias, by default with a ReLU after it.

    Where there is a ReLU, training from scratch normalises its input by batch; the trained normalisation is folded into
    weights and bias.
    """

    name: str
    kernel: Literal[1, 3]
    channels_in: int
    channels_out: int
    relu: bool = True

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

TOPOLOGY: tuple[Layer, ...] = (
    Conv("stem", 3, 1, 16),
    SpaceToDepth(),
    Conv("down1", 1, 64, 32),
    Conv("enc1_0", 3, 32, 32),
    Conv("enc1_1", 3, 32, 32),
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
    Conv("head", 1, 32, 3, relu=False),
)


def _convolutions(layers: Sequence[Layer]) -> Iterator[Conv]:
    for layer in layers:
        if isinstance(layer, Conv):
            yield layer
        elif isinstance(layer, Residual):
            yield from _convolutions(layer.layers)


CONVOLUTIONS: dict[str, Conv] = {conv.name: conv for conv in _convolutions(TOPOLOGY)}
"""The layers that have weights, by name, from input to output."""
STRIDE = 2
"""Working px a pixel of the heatmap."""
_TILE_PX, _HALO_PX = 768, 32
"""Large images are processed in tiles, each with a halo wider than the reach of the receptive field."""


@dataclass(frozen=True)
class Network:
    """Weights of a trained network.

    Attributes
    ----------
    weights : by layer, float32 (kernel taps, channels in, channels out).
    biases : by layer, float32 (channels out,).
    """

    weights: Mapping[str, Float32Array]
    biases: Mapping[str, Float32Array]


def network_from_record(record: Mapping[str, LayerRecord]) -> Network:
    """Unpack the layers of a detector file.

    Raises
    ------
    InputError
        The layers are not those of `TOPOLOGY`.
    """
    expected = {name: conv.shape for name, conv in CONVOLUTIONS.items()}
    found = {name: layer.shape for name, layer in record.items()}
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
    return Network(weights, biases)


def network_to_record(network: Network) -> dict[str, LayerRecord]:
    """Pack the layers for a detector file, at half precision."""
    record = {}
    for name, conv in CONVOLUTIONS.items():
        values = np.concatenate([network.weights[name].ravel(), network.biases[name]]).astype("<f2")
        record[name] = LayerRecord(shape=conv.shape, weights_f16=b64encode(values.tobytes()).decode())
    return record


def forward(network: Network, images: Float32Array) -> Float32Array:
    """Logits and orientation vectors of a batch of images.

    Parameters
    ----------
    images
        (n, h, w) float32, grey in [0, 1]; height and width are multiples of four.

    Returns
    -------
    (n, h / 2, w / 2, 3): the logit of a car's centre, cosine and sine of twice its orientation.
    """
    layout = PaddedBatchLayout(*images.shape)
    out, layout = _apply(TOPOLOGY, network, layout.pack(images[..., None]), layout)
    return np.ascontiguousarray(layout.interior_view(out))


def _apply(
    layers: Sequence[Layer], network: Network, values: Float32Array, layout: PaddedBatchLayout
) -> tuple[Float32Array, PaddedBatchLayout]:
    for layer in layers:
        if isinstance(layer, Conv):
            values = conv2d(values, network.weights[layer.name], layout)
            values += network.biases[layer.name]
            layout.zero_border(values)
        elif isinstance(layer, SpaceToDepth):
            values, layout = space_to_depth(values, layout), layout.halved()
        elif isinstance(layer, DepthToSpace):
            layout = layout.doubled()
            values = depth_to_space(values, layout)
        else:
            branch, _ = _apply(layer.layers, network, values, layout)
            branch += values
            values = branch
        if isinstance(layer, Conv | Residual) and layer.relu:
            np.maximum(values, 0, out=values)
    return values, layout


def predict_heatmap(network: Network, image: GreyImage) -> tuple[Float32Array, Float32Array]:
    """Probability and orientation of a car at each pixel of the heatmap, by tiled inference.

    Parameters
    ----------
    image
        (h, w) uint8 of any size.

    Returns
    -------
    (h / 2, w / 2) probability and (h / 2, w / 2, 2) orientation vector, sizes rounded up; heatmap pixel (x, y) is
    centred at (2 x + 0.5, 2 y + 0.5) of the image.
    """
    height, width = image.shape
    rows, columns = -(-height // _TILE_PX), -(-width // _TILE_PX)
    tile_h, tile_w = 4 * -(-height // (4 * rows)), 4 * -(-width // (4 * columns))
    excess = rows * tile_h - height, columns * tile_w - width
    padded = cv2.copyMakeBorder(
        image, _HALO_PX, _HALO_PX + excess[0], _HALO_PX, _HALO_PX + excess[1], cv2.BORDER_REFLECT_101
    )
    logits = np.empty((rows * tile_h // STRIDE, columns * tile_w // STRIDE, 3), np.float32)
    margin = _HALO_PX // STRIDE
    for y in range(0, rows * tile_h, tile_h):
        for x in range(0, columns * tile_w, tile_w):
            tile = padded[y : y + tile_h + 2 * _HALO_PX, x : x + tile_w + 2 * _HALO_PX]
            out = forward(network, (tile / np.float32(255))[None])[0]
            part = slice(y // STRIDE, (y + tile_h) // STRIDE), slice(x // STRIDE, (x + tile_w) // STRIDE)
            logits[part] = out[margin : margin + tile_h // STRIDE, margin : margin + tile_w // STRIDE]
    logits = logits[: -(-height // STRIDE), : -(-width // STRIDE)]
    return np.asarray(1 / (1 + np.exp(-logits[..., 0])), np.float32), logits[..., 1:]
