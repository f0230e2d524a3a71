"""Inference of the network: heatmaps of images of any size, and of crops, by onnxruntime.

On a processor it is run in 8 bits where the flight's ranges are known and the processor has them exactly, else in
floating point. On a GPU it is run in floating point and on images of one size: cuDNN plans its convolutions again for
each size, which takes 20 to 110 ms, and frames are searched by crops of some 60 sizes.
"""

import warnings
from typing import Any, TypeAlias

import cv2
import numpy as np
import onnxruntime as ort

from schemas.arrays import ByteArray, Float32Array, GreyImage, IntArray
from velfield.compiled import kernel
from velfield.detection.cnn.graph import network_to_onnx
from velfield.detection.cnn.network import ALIGNMENT, SIZE_LAYER, SIZE_STRIDE, STRIDE, Network
from velfield.detection.cnn.quantization import INEXACT, Ranges, is_exact, quantized_to_onnx
from velfield.detection.runtime import (
    STARTING,
    check_device,
    current_device,
    limitations_are_reported,
    on_cuda,
    open_session,
    uses_cuda,
)
from velfield.errors import DeviceWarning

_TILE_PX, HALO_PX = 2048, 96
"""Larger images are processed in tiles, each with a halo wider than the reach of the receptive field."""
_GPU_TILE_PX = 1024
"""Side of the tiles of all images on a GPU, whose halo lies on every side."""
BORDER_PX = 16
"""An image is continued so far by reflection, for cars at its edge."""
_BATCH_PX = 500_000
"""Pixels of the crops that the network is run on at once: more no longer stays in the processor's cache."""

Heatmaps: TypeAlias = tuple[Float32Array, Float32Array, Float32Array]
"""Probability of a car's centre, cosine and sine of twice its orientation, and its sizes as of `SIZE_LAYER`."""


class Predictor:
    """A network where it is run: on the device of `use_device`, in a session that is opened when first needed.

    Parameters
    ----------
    ranges
        Ranges of its activations: with them it is run in 8 bits on a processor.
    """

    def __init__(self, network: Network, ranges: Ranges | None = None) -> None:
        self.network, self.ranges = network, ranges
        self._session: ort.InferenceSession | None = None

    @property
    def session(self) -> ort.InferenceSession:
        """The network in onnxruntime, opened by one thread for all."""
        with STARTING:
            if self._session is None:
                self._session = self._open()
            return self._session

    def _open(self) -> ort.InferenceSession:
        check_device(current_device())
        if uses_cuda(current_device()):
            session = open_session(network_to_onnx(self.network), current_device())
            # Of a session that a full GPU refused the processor would be slow: it has 8 bits.
            if on_cuda(session) or self.ranges is None:
                return session
        if self.ranges is not None:
            if is_exact():
                return open_session(quantized_to_onnx(self.network, self.ranges), "cpu")
            if not limitations_are_reported():
                warnings.warn(INEXACT, DeviceWarning, stacklevel=4)
        return open_session(network_to_onnx(self.network), "cpu")

    def __call__(self, images: GreyImage) -> Heatmaps:
        """Heatmaps (n, h / 2, w / 2), vectors (n, 2, h / 2, w / 2) and sizes (n, 4, h / 4, w / 4) of images (n, h, w),
        multiples of `ALIGNMENT`; sizes are NaN of a network that does not measure."""
        probability, orientation, *size = self.session.run(None, {"image": np.ascontiguousarray(images[:, None])})
        if not size:
            count, height, width = images.shape
            shape = count, SIZE_LAYER.channels_out, height // SIZE_STRIDE, width // SIZE_STRIDE
            size = [np.full(shape, np.nan, np.float32)]
        return probability[:, 0], orientation, size[0]

    def __getstate__(self) -> dict[str, Any]:
        """Without the session, which no other process can use."""
        return self.__dict__ | {"_session": None}


def predict_heatmap(predict: Predictor, image: GreyImage, *, border_px: int = BORDER_PX) -> Heatmaps:
    """Probability and orientation of a car at each pixel of the heatmap, and its sizes, by tiled inference.

    Parameters
    ----------
    image
        (h, w) uint8 of any size.
    border_px
        How far it is continued by reflection; 0 of a crop that has context already. On a GPU always by `HALO_PX`.

    Returns
    -------
    (h / 2, w / 2) probability, (2, h / 2, w / 2) orientation vector and (4, h / 4, w / 4) sizes, all rounded up;
    heatmap pixel (x, y) is centred at (2 x + 0.5, 2 y + 0.5) of the image, a pixel of the sizes at 4 x + 1.5.
    """
    gpu = on_cuda(predict.session)
    border_px, unit = (HALO_PX, _GPU_TILE_PX) if gpu else (border_px, ALIGNMENT)
    whole = [unit * -(-size // unit) for size in image.shape]
    side = [unit if gpu else unit * -(-size // (unit * -(-size // _TILE_PX))) for size in whole]
    end = [border_px + size - given for size, given in zip(whole, image.shape, strict=True)]
    padded = cv2.copyMakeBorder(image, border_px, end[0], border_px, end[1], cv2.BORDER_REFLECT_101)
    probability = np.empty((whole[0] // STRIDE, whole[1] // STRIDE), np.float32)
    orientation = np.empty((2, *probability.shape), np.float32)
    sizes = np.empty((SIZE_LAYER.channels_out, whole[0] // SIZE_STRIDE, whole[1] // SIZE_STRIDE), np.float32)
    for y in range(0, whole[0], side[0]):
        for x in range(0, whole[1], side[1]):
            # Beside other tiles the halo, at the image's edge its border: so tiles do not show.
            top, left = max(0, y + border_px - HALO_PX), max(0, x + border_px - HALO_PX)
            tile = padded[top : y + border_px + side[0] + HALO_PX, left : x + border_px + side[1] + HALO_PX]
            heatmaps, vectors, of_tile = predict(tile[None])
            down, right = y + border_px - top, x + border_px - left
            rows, columns = min(side[0], whole[0] - y), min(side[1], whole[1] - x)
            inner, part = _window(down, right, rows, columns, STRIDE), _window(y, x, rows, columns, STRIDE)
            probability[part], orientation[:, *part] = heatmaps[0][inner], vectors[0][:, *inner]
            inner, part = _window(down, right, rows, columns, SIZE_STRIDE), _window(y, x, rows, columns, SIZE_STRIDE)
            sizes[:, *part] = of_tile[0][:, *inner]
    height, width = image.shape
    inside, at_sizes = (_window(0, 0, height, width, stride) for stride in (STRIDE, SIZE_STRIDE))
    return probability[inside], orientation[:, *inside], sizes[:, *at_sizes]


def _window(top: int, left: int, rows: int, columns: int, stride: int) -> tuple[slice, slice]:
    """Part of a map of a pixel for every ``stride`` of an image: its window, ends rounded up."""
    return (
        slice(top // stride, -(-(top + rows) // stride)),
        slice(left // stride, -(-(left + columns) // stride)),
    )


def predict_crops(predict: Predictor, image: GreyImage, crops: IntArray) -> Heatmaps:
    """The same of crops of an image, each predicted as if it were alone, those of one size at once; on a GPU of the
    whole image.

    Parameters
    ----------
    image
        (h, w) uint8, even.
    crops
        (n, 4) first row, first column, height and width; disjoint, at multiples of `ALIGNMENT` and of such sizes.

    Returns
    -------
    As of `predict_heatmap`; on a processor zero where no crop is.
    """
    if on_cuda(predict.session):
        return predict_heatmap(predict, image)
    probability = np.zeros((image.shape[0] // STRIDE, image.shape[1] // STRIDE), np.float32)
    orientation = np.zeros((2, *probability.shape), np.float32)
    sizes = np.zeros((SIZE_LAYER.channels_out, *(-(-side // SIZE_STRIDE) for side in image.shape)), np.float32)
    for height, width in np.unique(crops[:, 2:], axis=0).tolist():
        corners = crops[(crops[:, 2:] == (height, width)).all(axis=1), :2]
        tiled = max(height, width) > _TILE_PX
        at_once = 1 if tiled else max(1, _BATCH_PX // (height * width))
        for start in range(0, len(corners), at_once):
            some = corners[start : start + at_once]
            pixels = _cut_kernel(image, some, height, width)
            if tiled:
                heatmaps, vectors, of_crops = (part[None] for part in predict_heatmap(predict, pixels[0], border_px=0))
            else:
                heatmaps, vectors, of_crops = predict(pixels)
            _place_kernel(heatmaps[:, None], some // STRIDE, probability[None])
            _place_kernel(vectors, some // STRIDE, orientation)
            _place_kernel(of_crops, some // SIZE_STRIDE, sizes)
    return probability, orientation, sizes


@kernel
def _cut_kernel(image: ByteArray, corners: IntArray, height: int, width: int) -> ByteArray:
    """Crops (n, height, width) with these corners (n, 2): y, x."""
    out = np.empty((len(corners), height, width), np.uint8)
    for n in range(len(corners)):
        top, left = corners[n]
        for row in range(height):
            source, target = image[top + row], out[n, row]
            for x in range(np.uint64(width)):
                target[x] = source[np.uint64(left) + x]
    return out


@kernel
def _place_kernel(maps: Float32Array, corners: IntArray, out: Float32Array) -> None:
    """Write maps (n, channels, h, w) of crops where these lie (n, 2): y, x; ``out`` (channels, H, W)."""
    channels, height, width = maps.shape[1:]
    for n in range(len(corners)):
        top, left = corners[n]
        for channel in range(channels):
            for row in range(height):
                source, target = maps[n, channel, row], out[channel, top + row]
                for x in range(np.uint64(width)):  # one by one: numba compiles an assigned slice for seconds
                    target[np.uint64(left) + x] = source[x]
