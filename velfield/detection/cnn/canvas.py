"""The network on canvases of two sizes, for a GPU, where cuDNN plans its convolutions again for each size of an image.

onnxruntime keeps the plans for the size that it saw last, and frames are searched by crops of some 60 sizes: with 20 to
110 ms a change, planning would take nearly all of the time. So crops lie on a canvas with a gap between them, and what
lies there is set to zero before each convolution that reaches over, as zero padding is: each crop is predicted as if it
were alone, on a processor to the same bits. A crop larger than a canvas is cut into tiles with a halo.

Which values are set to zero follows from the topology (`reading_scales`), so that any is run alike.
"""

from collections.abc import Sequence
from functools import cache
from typing import assert_never

import numpy as np
import onnx
from numba import njit
from onnx import TensorProto, helper

from schemas.arrays import Float32Array, GreyImage, IntArray
from schemas.flight import Device
from velfield.detection.cnn.model import HALO_PX
from velfield.detection.cnn.network import (
    STRIDE,
    Conv,
    DepthToSpace,
    GraphBuilder,
    Network,
    Residual,
    SpaceToDepth,
    Topology,
    open_session,
)
from velfield.detection.mosaic import shelve_kernel

_SIDES_PX = 320, 1152
"""Most frames' crops lie on one canvas of the larger; few small ones, as in test-time augmentation, on the smaller."""


def reading_scales(layers: Topology, scale: int = 1) -> dict[str, int]:
    """Pixels of the image a pixel of what each convolution reads, by its name; before space-to-depth, if there is one.

    Examples
    --------
    >>> reading_scales((Conv("a", 4, 1, 8), SpaceToDepth(), Conv("b", 1, 32, 8), Conv("c", 3, 8, 8)))
    {'a': 1, 'b': 2, 'c': 4}
    """
    found: dict[str, int] = {}
    block = 1
    for layer in layers:
        if isinstance(layer, SpaceToDepth):
            block *= 2
        elif isinstance(layer, Conv):
            found[layer.name] = scale
            scale, block = scale * block * layer.stride, 1
        elif isinstance(layer, DepthToSpace):
            scale //= 2
        elif isinstance(layer, Residual):
            found |= reading_scales(layer.layers, scale)
        else:
            assert_never(layer)
    return found


class _MaskedGraph(GraphBuilder):
    """The network's graph with one more input, ``mask``: (n, 1, h / unit, w / unit) uint8, 1 where an image is.

    The unit is `Network.alignment`. The input ``image`` has to be zero where the mask is.
    """

    def __init__(self, network: Network) -> None:
        super().__init__(network)
        self.scales = reading_scales(network.topology)
        self.masks: dict[int, str] = {}
        self.image = self.normalised_image()

    def model(self) -> bytes:
        model = onnx.ModelProto.FromString(self.finish(self.layers(self.network.topology, self.image)))
        size: list[str | int] = ["n", 1, "h / unit", "w / unit"]
        model.graph.input.append(helper.make_tensor_value_info("mask", TensorProto.UINT8, size))
        return bytes(model.SerializeToString())

    def convolve(self, layer: Conv, inputs: Sequence[str], block: int) -> str:
        """The convolution of what it reads, zero between the images where it reaches over."""
        value, *rest = inputs
        if layer.kernel > 1 and value != self.image:
            value = self.node("Mul", [value, self.mask(self.scales[layer.name])])
        return super().convolve(layer, [value, *rest], block)

    def mask(self, scale: int) -> str:
        """The mask with a pixel for every ``scale`` of the image."""
        unit = self.network.alignment
        if not self.masks:
            self.masks[unit] = self.node("Cast", ["mask"], to=TensorProto.FLOAT)
        if scale not in self.masks:
            factors = self.constant(f"mask_{scale}", np.array([1, 1, unit / scale, unit / scale], np.float32))
            by_corner = {"coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
            self.masks[scale] = self.node("Resize", [self.masks[unit], "", factors], mode="nearest", **by_corner)
        return self.masks[scale]


class Canvases:
    """A network whose sessions see images of ``sides_px`` only, so that each keeps its plans.

    Parameters
    ----------
    sides_px
        Multiples of `Network.alignment`; the largest more than two halos of a tile.
    """

    def __init__(self, network: Network, device: Device, sides_px: Sequence[int] = _SIDES_PX) -> None:
        self.unit = network.alignment
        if any(side % self.unit for side in sides_px) or max(sides_px) <= 2 * HALO_PX:
            raise ValueError(f"found canvases of {sides_px} px, expected multiples of {self.unit} above {2 * HALO_PX}")
        model = _MaskedGraph(network).model()
        self.sessions = {side: open_session(model, device) for side in sorted(sides_px)}

    def predict(self, images: GreyImage) -> tuple[Float32Array, Float32Array]:
        """As `Network.predict`."""
        count, height, width = images.shape
        crops = np.array([(k * height, 0, height, width) for k in range(count)], np.int64).reshape(-1, 4)
        probability, orientation = self.predict_crops(images.reshape(count * height, width), crops)
        shape = count, height // STRIDE, width // STRIDE
        return probability.reshape(shape), orientation.reshape(2, *shape).transpose(1, 0, 2, 3)

    def predict_crops(self, image: GreyImage, crops: IntArray) -> tuple[Float32Array, Float32Array]:
        """As `model.predict_crops`."""
        probability = np.zeros((image.shape[0] // STRIDE, image.shape[1] // STRIDE), np.float32)
        orientation = np.zeros((2, *probability.shape), np.float32)
        pieces = cut_into_pieces(crops, max(self.sessions), self.unit)
        side, places = self._lay_out(pieces)
        image, session = np.ascontiguousarray(image), self.sessions[side]
        for canvas in range(places[:, 0].max(initial=-1) + 1):
            pixels = np.zeros((side, side), np.uint8)
            mask = np.zeros((side // self.unit, side // self.unit), np.uint8)
            fill_kernel(image, pieces, places, canvas, self.unit, pixels, mask)
            heatmaps, vectors = session.run(None, {"image": pixels[None, None], "mask": mask[None, None]})
            place_kernel(heatmaps[0, 0], vectors[0], pieces, places, canvas, probability, orientation)
        return probability, orientation

    def _lay_out(self, pieces: IntArray) -> tuple[int, IntArray]:
        """Side of the canvases, the smallest of which one is enough or else the largest; places on them."""
        largest = pieces[:, 2:4].max(initial=0)
        for side in self.sessions:
            if largest <= side:
                places = pack(pieces, side, self.unit)
                if not places[:, 0].any():
                    break
        return side, places


def cut_into_pieces(crops: IntArray, side_px: int, unit: int) -> IntArray:
    """Crops, those larger than a canvas in tiles with halos, which do not reach over the crop.

    Returns
    -------
    (n, 8) px: top, left, height and width in the image; how much is halo at the top, left, bottom and right.
    """
    pieces = [
        (top + y, left + x, rows, columns, above, before, below, after)
        for top, left, height, width in crops.tolist()
        for y, rows, above, below in _tile_spans(height, side_px, unit)
        for x, columns, before, after in _tile_spans(width, side_px, unit)
    ]
    return np.array(pieces, np.int64).reshape(-1, 8)


@cache
def _tile_spans(size: int, side_px: int, unit: int) -> tuple[tuple[int, int, int, int], ...]:
    """Tiles of one axis of a crop: start, size, and how much of it is halo at either end."""
    if size <= side_px:
        return ((0, size, 0, 0),)
    count = -(-size // (side_px - 2 * HALO_PX))
    step = unit * -(-size // (unit * count))
    spans = []
    for start in range(0, size, step):
        end = min(size, start + step)
        first, last = max(0, start - HALO_PX), min(size, end + HALO_PX)
        spans.append((first, last - first, start - first, last - end))
    return tuple(spans)


def pack(pieces: IntArray, side_px: int, gap_px: int) -> IntArray:
    """Canvas, y and x (n, 3) of pieces (n, 8), on shelves from high to low, with a gap between them.

    A gap of a pixel of the lowest level is enough, and none at a canvas's edges: no kernel reaches farther at once.
    """
    order = np.lexsort((pieces[:, 3], -pieces[:, 2]))
    places = np.empty((len(pieces), 3), np.int64)
    places[order, 0], places[order, 1:] = shelve_kernel(pieces[order, 2:4], side_px, gap_px)
    return places


@njit(nogil=True, inline="always")
def _copy_row(source, begin, target, to, count):  # type: ignore[no-untyped-def]
    """Unsigned indices: slices, or signed ones, which may count from the end, take ten times as long."""
    for k in range(np.uint64(count)):
        target[np.uint64(to) + k] = source[np.uint64(begin) + k]


@njit(cache=True, nogil=True)
def fill_kernel(image, pieces, places, canvas, unit, pixels, mask):  # type: ignore[no-untyped-def]
    """Copy what an image has of pieces onto one canvas (side, side) of zeros, and set the mask where they lie."""
    for n in range(len(pieces)):
        if places[n, 0] == canvas:
            top, left, height, width = pieces[n, 0], pieces[n, 1], pieces[n, 2], pieces[n, 3]
            y, x = places[n, 1], places[n, 2]
            for row in range(height):
                _copy_row(image[top + row], left, pixels[y + row], x, width)
            mask[y // unit : (y + height) // unit, x // unit : (x + width) // unit] = 1


@njit(cache=True, nogil=True)
def place_kernel(heatmap, vector, pieces, places, canvas, probability, orientation):  # type: ignore[no-untyped-def]
    """Write what was predicted on one canvas where its pieces lie in the image, without their halos."""
    for n in range(len(pieces)):
        if places[n, 0] == canvas:
            above, before, below, after = pieces[n, 4], pieces[n, 5], pieces[n, 6], pieces[n, 7]
            y, x = (places[n, 1] + above) // STRIDE, (places[n, 2] + before) // STRIDE
            top, left = (pieces[n, 0] + above) // STRIDE, (pieces[n, 1] + before) // STRIDE
            width = (pieces[n, 3] - before - after) // STRIDE
            for row in range((pieces[n, 2] - above - below) // STRIDE):
                _copy_row(heatmap[y + row], x, probability[top + row], left, width)
                for k in range(2):
                    _copy_row(vector[k, y + row], x, orientation[k, top + row], left, width)
