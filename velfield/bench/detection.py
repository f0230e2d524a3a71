"""Speed of the detectors, each beside a plain implementation in the same run: read the ratios, not the times."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from velfield.compiled import kernel
from velfield.detection.cnn.network import TOPOLOGY, DepthToSpace, Residual, SpaceToDepth, Topology
from velfield.detection.detect import detect_frame
from velfield.detection.interface import Detector
from velfield.paper.boosting import draw_feature_pool
from velfield.paper.response import GREY_BITS, MARGIN_PX, MAX_AREA_PX, dense_response, quantise_and_pad
from velfield.paper.stumps import BoostedStumps
from velfield.synthetic import small_flight

_DENSE_ROUNDS = 200
_NUMPY_ROUNDS = 10


def _c2f(step: int, into: int, out: int, repeats: int) -> list[tuple[int, int, int, int]]:
    half = out // 2
    inner = [(step, 9, half, half)] * (2 * repeats)
    return [(step, 1, into, out), *inner, (step, 1, (2 + repeats) * half, out)]


def _head(step: int, into: int) -> list[tuple[int, int, int, int]]:
    box = [(step, 9, into, 64), (step, 9, 64, 64), (step, 1, 64, 64)]
    return [*box, (step, 9, into, 80), (step, 9, 80, 80), (step, 1, 80, 80)]


YOLOV8N = (
    *((2, 9, 3, 16), (4, 9, 16, 32), *_c2f(4, 32, 32, 1), (8, 9, 32, 64), *_c2f(8, 64, 64, 2)),
    *((16, 9, 64, 128), *_c2f(16, 128, 128, 2), (32, 9, 128, 256), *_c2f(32, 256, 256, 1)),
    *((32, 1, 256, 128), (32, 1, 512, 256), *_c2f(16, 384, 128, 1), *_c2f(8, 192, 64, 1)),
    *((16, 9, 64, 64), *_c2f(16, 192, 128, 1), (32, 9, 128, 128), *_c2f(32, 384, 256, 1)),
    *(*_head(8, 64), *_head(16, 128), *_head(32, 256)),
)
"""Its convolutions: stride of the output, kernel taps, channels in and out."""


@dataclass(frozen=True)
class Speed:
    """One comparison: ours and its peer, s for the same work."""

    what: str
    peer: str
    seconds: float
    peer_seconds: float

    def text(self) -> str:
        """A line for people."""
        ours, theirs = 1e3 * self.seconds, 1e3 * self.peer_seconds
        return f"{self.what}: {ours:.0f} ms; {self.peer}: {theirs:.0f} ms; {theirs / ours:.3g} times"


def plain_response(image: NDArray[np.uint8], stumps: BoostedStumps, grey_bits: int = GREY_BITS) -> NDArray[np.float32]:
    """The dense response by numpy slices, a rectangle at a time: the reference of `response_at_even_pixels`."""
    padded = quantise_and_pad(image, grey_bits).astype(np.int32)
    integral = np.pad(padded, ((1, 0), (1, 0))).cumsum(0, dtype=np.int32).cumsum(1, dtype=np.int32)
    height, width = image.shape
    out = np.zeros(image.shape, np.float32)

    def corner(y: int, x: int) -> NDArray[np.int32]:
        return integral[MARGIN_PX + y : MARGIN_PX + y + height, MARGIN_PX + x : MARGIN_PX + x + width]

    for f in range(len(stumps)):
        total = np.zeros(image.shape, np.int32)
        for sign, x0, y0, x1, y1 in stumps.rectangles[stumps.starts[f] : stumps.starts[f + 1]]:
            total += sign * (corner(y1, x1) - corner(y0, x1) - corner(y1, x0) + corner(y0, x0))
        out += np.where(total > stumps.thresholds[f], stumps.leaves[f, 1], stumps.leaves[f, 0])
    return out


def row_response(image: NDArray[np.uint8], stumps: BoostedStumps, grey_bits: int = GREY_BITS) -> NDArray[np.float32]:
    """The same at every pixel, whole rows at a time over one integral image of int32: the plain vectorised peer."""
    integral = cv2.integral(quantise_and_pad(image, grey_bits), sdepth=cv2.CV_32S)
    out = np.zeros(image.shape, np.float32)
    _rows(np.ascontiguousarray(integral), stumps.rectangles, stumps.starts, stumps.thresholds, stumps.leaves, out)
    return out


@kernel
def _rows(integral, rectangles, starts, thresholds, leaves, out) -> None:  # type: ignore[no-untyped-def]
    height, width = out.shape
    row = np.empty(width, np.int32)
    for y in range(height):
        response = out[y]
        for f in range(len(thresholds)):
            row[:] = 0
            for r in range(starts[f], starts[f + 1]):
                top = integral[y + MARGIN_PX + rectangles[r, 2]]
                bottom = integral[y + MARGIN_PX + rectangles[r, 4]]
                left, right = MARGIN_PX + rectangles[r, 1], MARGIN_PX + rectangles[r, 3]
                a, b = bottom[right : right + width], bottom[left : left + width]
                c, d = top[right : right + width], top[left : left + width]
                if rectangles[r, 0] > 0:
                    for x in range(width):
                        row[x] += a[x] - b[x] - c[x] + d[x]
                else:
                    for x in range(width):
                        row[x] -= a[x] - b[x] - c[x] + d[x]
            threshold, low, high = thresholds[f], leaves[f, 0], leaves[f, 1]
            for x in range(width):
                response[x] += high if row[x] > threshold else low


def random_stumps(rounds: int, *, seed: int = 1, max_area_px: int | None = MAX_AREA_PX) -> BoostedStumps:
    """A classifier of the paper's shape, untrained: only its cost counts."""
    rng = np.random.default_rng(seed)
    pool = draw_feature_pool(
        rounds,
        channels=1,
        sigma_xy_px=(10.0, 10.0),
        reach_xy_px=(40, 40),
        max_rectangles=5,
        rng=rng,
        max_area_px=max_area_px,
    )
    leaves = rng.normal(0, 1, (rounds, 2)).astype(np.float32)
    return BoostedStumps(pool.table, pool.starts, pool.channels, np.zeros(rounds, np.float32), leaves)


def city(width: int, height: int) -> NDArray[np.uint8]:
    """A frame of a simulated city, repeated to the size."""
    frame = small_flight(frames=1, seed=77).frame(0)
    times = -(-height // frame.shape[0]), -(-width // frame.shape[1])
    return np.ascontiguousarray(np.tile(frame, times)[:height, :width])


def response_speed(image: NDArray[np.uint8]) -> tuple[Speed, Speed]:
    """The paper's dense response against whole rows of int32 at every pixel; and numpy, whose rounds are fewer and
    scaled up."""
    stumps, few = random_stumps(_DENSE_ROUNDS), random_stumps(_NUMPY_ROUNDS)
    what = f"dense response, {_DENSE_ROUNDS} rounds"
    fast = _fastest(lambda: dense_response(image, stumps), 3)
    rows = _fastest(lambda: row_response(image, stumps), 2)
    ratio = len(stumps.rectangles) / len(few.rectangles)
    slow = _fastest(lambda: plain_response(image, few), 1) * ratio
    return Speed(what, "whole rows of int32", fast, rows), Speed(what, "numpy", fast, slow)


def cnn_speed(image: NDArray[np.uint8], detector: Detector) -> Speed:
    """The CNN, beside convolutions of YOLOv8n's sizes on such a frame."""
    fast = _fastest(lambda: detect_frame(image, None, detector), 2)
    peer = 0.0
    for step, taps, into, out in YOLOV8N:
        peer += _convolution_seconds((image.shape[0] // step, image.shape[1] // step), taps, into, out)
    return Speed("the shipped CNN", "convolutions of YOLOv8n's sizes in onnxruntime", fast, peer)


def network_gflop(width: int, height: int) -> float:
    """Arithmetic of the shipped network on a frame, GFLOP (two a multiplication and addition), margins aside."""

    def flop(layers: Topology, scale: float) -> tuple[float, float]:
        total = 0.0
        for layer in layers:
            if isinstance(layer, SpaceToDepth):
                scale /= 2
            elif isinstance(layer, DepthToSpace):
                scale *= 2
            elif isinstance(layer, Residual):
                total += flop(layer.layers, scale)[0]
            else:
                scale /= layer.stride
                total += 2.0 * np.prod(layer.shape) * scale**2
        return float(total), scale

    return flop(TOPOLOGY, 1.0)[0] * width * height / 1e9


def matmul_gflops(size: int = 1024, side: int = 64) -> float:
    """Speed of this machine in a product of float32 matrices, GFLOP/s; of one core where BLAS is limited to one thread.

    The faster of numpy's and onnxruntime's, which need not use the same instructions: where numpy's BLAS was held to
    those of an older processor, the network did more than its peak.
    """
    a = np.ones((size, size), np.float32)
    by_numpy = 2.0 * size**3 / _fastest(lambda: a @ a, 7)
    channels = size // 2
    by_engine = 2.0 * (channels * side) ** 2 / _convolution_seconds((side, side), 1, channels, channels, repeats=7)
    return max(by_numpy, by_engine) / 1e9


def _convolution_seconds(size: tuple[int, int], taps: int, into: int, out: int, *, repeats: int = 2) -> float:
    """Time of one convolution (stride 1, of the output's size) in onnxruntime, on one thread as ours."""
    side = 3 if taps == 9 else 1
    kernel = numpy_helper.from_array(np.full((out, into, side, side), 0.01, np.float32), "kernel")
    ends = [helper.make_tensor_value_info(n, TensorProto.FLOAT, [1, c, *size]) for n, c in (("x", into), ("y", out))]
    node = helper.make_node("Conv", ["x", "kernel"], ["y"], pads=[side // 2] * 4)
    graph = helper.make_graph([node], "convolution", ends[:1], ends[1:], [kernel])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = ort.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    image = np.ones((1, into, *size), np.float32)
    return _fastest(partial(session.run, None, {"x": image}), repeats)


def _fastest(work: Callable[[], object], repeats: int) -> float:
    """The fastest of some runs, s of processor time; one before them compiles."""
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times)
