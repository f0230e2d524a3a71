"""Speed of the network, beside another one's convolutions in the same run: read the ratio, not the times."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from velfield.detection.cnn.network import TOPOLOGY, DepthToSpace, Residual, SpaceToDepth, Topology
from velfield.detection.detect import detect_frame
from velfield.detection.interface import Detector
from velfield.synthetic.cases import small_flight


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


def city(width: int, height: int) -> NDArray[np.uint8]:
    """A frame of a simulated city, repeated to the size."""
    frame = small_flight(frames=1, seed=77).frame(0)
    times = -(-height // frame.shape[0]), -(-width // frame.shape[1])
    return np.ascontiguousarray(np.tile(frame, times)[:height, :width])


def cnn_speed(image: NDArray[np.uint8], detector: Detector) -> Speed:
    """The CNN, beside convolutions of YOLOv8n's sizes on such a frame."""
    fast = fastest_s(lambda: detect_frame(image, None, detector), 2)
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


def matmul_gflops() -> float:
    """Speed of this machine in a product of float32 matrices, GFLOP/s; of one core where BLAS is limited to one thread.

    The faster of numpy's and onnxruntime's, which need not use the same instructions: where numpy's BLAS was held to
    those of an older processor, the network did more than its peak.
    """
    size, side = 1024, 64
    a = np.ones((size, size), np.float32)
    by_numpy = 2.0 * size**3 / fastest_s(lambda: a @ a, 7)
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
    return fastest_s(partial(session.run, None, {"x": image}), repeats)


def fastest_s(work: Callable[[], object], repeats: int) -> float:
    """The fastest of some runs, s of processor time; one before them compiles."""
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times)
