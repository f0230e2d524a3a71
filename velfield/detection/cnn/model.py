"""A small convolutional network that tells cars, and their axes, on places it has not seen.

It looks at the whole working picture at once: at every second pixel how much a car's middle lies there, and twice the
angle of its axis as a vector.
"""

from base64 import b64decode, b64encode
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from schemas.arrays import Float32Array, GreyImage
from schemas.detector import LayerRecord
from velfield.detection.cnn.convolution import Layout, convolved, gathered, spread
from velfield.errors import InputError

STRIDE = 2
"""Working px a cell of what the network says."""
LAYERS: dict[str, tuple[int, int, int]] = {
    "grain": (9, 1, 16),
    "edges": (1, 64, 32),
    "corners_0": (9, 32, 32),
    "corners_1": (9, 32, 32),
    "parts": (1, 128, 48),
    "body_0": (9, 48, 48),
    "body_1": (9, 48, 48),
    "body_2": (9, 48, 48),
    "body_3": (9, 48, 48),
    "back": (1, 48, 128),
    "middle": (9, 32, 32),
    "told": (1, 32, 3),
}
"""Each layer's neighbours (1 or 9), channels in and channels out."""
CORNERS = ("corners_0", "corners_1")
BODIES = (("body_0", "body_1"), ("body_2", "body_3"))
"""Pairs of layers that add to what went into them."""
_TILE_PX, _REACH_PX = 768, 32
"""A picture is looked at in tiles, each with so much around it: more than any answer depends on."""


@dataclass(frozen=True)
class Network:
    """Weights in use.

    Attributes
    ----------
    weights : of each layer, float32 (neighbours, channels in, channels out).
    biases : of each layer, float32 (channels out,).
    """

    weights: Mapping[str, Float32Array]
    biases: Mapping[str, Float32Array]

    def layer(self, name: str, values: Float32Array, layout: Layout) -> Float32Array:
        """A layer's sums with its bias, zero in the border."""
        out = convolved(values, self.weights[name], layout)
        out += self.biases[name]
        layout.clear_border(out)
        return out

    def rectified(self, name: str, values: Float32Array, layout: Layout) -> Float32Array:
        """The same, what is below zero set to it."""
        out = self.layer(name, values, layout)
        np.maximum(out, 0, out=out)
        return out


def network_of(record: Mapping[str, LayerRecord]) -> Network:
    """Of a detector file.

    Raises
    ------
    InputError
        Layers that are not this network's.
    """
    shapes = {name: layer.shape for name, layer in record.items()}
    if shapes != LAYERS:
        odd = next(name for name in [*LAYERS, *shapes] if shapes.get(name) != LAYERS.get(name))
        raise InputError(
            f"found a network whose layer {odd} is {shapes.get(odd)}, expected {LAYERS.get(odd)}; it is of "
            "another version of velfield: train anew"
        )
    weights, biases = {}, {}
    for name, (neighbours, into, out) in LAYERS.items():
        numbers = np.frombuffer(b64decode(record[name].numbers), "<f2").astype(np.float32)
        weights[name], biases[name] = numbers[:-out].reshape(neighbours, into, out), numbers[-out:]
    return Network(weights, biases)


def record_of_network(network: Network) -> dict[str, LayerRecord]:
    """For a detector file, at half precision."""
    record = {}
    for name, shape in LAYERS.items():
        numbers = np.concatenate([network.weights[name].ravel(), network.biases[name]]).astype("<f2")
        record[name] = LayerRecord(shape=shape, numbers=b64encode(numbers.tobytes()).decode())
    return record


def said_of(network: Network, pictures: Float32Array) -> Float32Array:
    """What the network says of pictures.

    Parameters
    ----------
    pictures
        (n, h, w) float32, grey of 0 to 1; height and width are multiples of four.

    Returns
    -------
    (n, h / 2, w / 2, 3): the log odds of a car's middle, and the cosine and sine of twice its axis.
    """
    whole = Layout(*pictures.shape)
    half = whole.halved()
    quarter = half.halved()
    grain = network.rectified("grain", whole.laid_out(pictures[..., None]), whole)
    corners = network.rectified("edges", gathered(grain, whole), half)
    for name in CORNERS:
        corners = network.rectified(name, corners, half)
    body = network.rectified("parts", gathered(corners, half), quarter)
    for first, second in BODIES:
        body += network.rectified(second, network.rectified(first, body, quarter), quarter)
    joined = spread(network.layer("back", body, quarter), half)
    joined += corners
    np.maximum(joined, 0, out=joined)
    return np.ascontiguousarray(half.inner(network.layer("told", network.rectified("middle", joined, half), half)))


def odds_map(network: Network, image: GreyImage) -> tuple[Float32Array, Float32Array]:
    """How likely a car's middle is, and twice its axis, over a picture (h, w).

    Returns
    -------
    (h / 2, w / 2) probability and (h / 2, w / 2, 2), rounded up; a cell's middle is at (2 x + .5, 2 y + .5).
    """
    height, width = image.shape
    rows, columns = -(-height // _TILE_PX), -(-width // _TILE_PX)
    tile_h, tile_w = 4 * -(-height // (4 * rows)), 4 * -(-width // (4 * columns))
    beyond = rows * tile_h - height, columns * tile_w - width
    around = cv2.copyMakeBorder(
        image, _REACH_PX, _REACH_PX + beyond[0], _REACH_PX, _REACH_PX + beyond[1], cv2.BORDER_REFLECT_101
    )
    said = np.empty((rows * tile_h // STRIDE, columns * tile_w // STRIDE, 3), np.float32)
    margin = _REACH_PX // STRIDE
    for y in range(0, rows * tile_h, tile_h):
        for x in range(0, columns * tile_w, tile_w):
            tile = around[y : y + tile_h + 2 * _REACH_PX, x : x + tile_w + 2 * _REACH_PX]
            answer = said_of(network, (tile / np.float32(255))[None])[0]
            place = slice(y // STRIDE, (y + tile_h) // STRIDE), slice(x // STRIDE, (x + tile_w) // STRIDE)
            said[place] = answer[margin : margin + tile_h // STRIDE, margin : margin + tile_w // STRIDE]
    said = said[: -(-height // STRIDE), : -(-width // STRIDE)]
    return np.asarray(1 / (1 + np.exp(-said[..., 0])), np.float32), said[..., 1:]
