"""How fast cars are found: each fast way beside a plain one in the same run. Ratios are to be read, not times."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from schemas.detector import CascadeConfig
from velfield.bench.scenes import simulated_image
from velfield.detection.boosting import BoostedSums, random_pool
from velfield.detection.cascade.classifier import Look, offset_grid
from velfield.detection.cascade.detector import CascadeDetector
from velfield.detection.cascade.feature_image import picture_of
from velfield.detection.cnn.convolution import PaddedBatchLayout, conv2d
from velfield.detection.detect import detect_frame
from velfield.detection.detector import Detector
from velfield.detection.paper.response import GREY_BITS, MARGIN_PX, MAX_AREA_PX, continued, dense_response
from velfield.synthetic import small_flight

_TURNS = np.radians(np.arange(0.0, 180.0, 15.0))
_DENSE_ROUNDS = 200
_NUMPY_ROUNDS = 10
_TILE_PX = 8
_LEARNT_FROM = 978
"""Seed of the city; `city` shows that of seed 77."""


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
"""Its convolutions: px a cell of what comes out, neighbours, channels in and out."""


@dataclass(frozen=True)
class Speed:
    """One comparison: the fast way and its peer, s for the same work."""

    what: str
    peer: str
    seconds: float
    peer_seconds: float

    def text(self) -> str:
        """For people, a line."""
        ours, theirs = 1e3 * self.seconds, 1e3 * self.peer_seconds
        return f"{self.what}: {ours:.0f} ms; {self.peer}: {theirs:.0f} ms; {theirs / ours:.3g} times"


def plain_response(image: NDArray[np.uint8], sums: BoostedSums, grey_bits: int = GREY_BITS) -> NDArray[np.float32]:
    """The dense response by numpy slices, a rectangle at a time: the reference of `sampled_response`."""
    padded = continued(image, grey_bits).astype(np.int32)
    integral = np.pad(padded, ((1, 0), (1, 0))).cumsum(0, dtype=np.int32).cumsum(1, dtype=np.int32)
    height, width = image.shape
    out = np.zeros(image.shape, np.float32)

    def corner(y: int, x: int) -> NDArray[np.int32]:
        return integral[MARGIN_PX + y : MARGIN_PX + y + height, MARGIN_PX + x : MARGIN_PX + x + width]

    for f in range(len(sums)):
        total = np.zeros(image.shape, np.int32)
        for sign, x0, y0, x1, y1 in sums.rectangles[sums.starts[f] : sums.starts[f + 1]]:
            total += sign * (corner(y1, x1) - corner(y0, x1) - corner(y1, x0) + corner(y0, x0))
        out += np.where(total > sums.thresholds[f], sums.leaves[f, 1], sums.leaves[f, 0])
    return out


def row_response(image: NDArray[np.uint8], sums: BoostedSums, grey_bits: int = GREY_BITS) -> NDArray[np.float32]:
    """The same at every pixel, whole rows at a time over one integral picture of int32: the plain vectorised peer."""
    integral = cv2.integral(continued(image, grey_bits), sdepth=cv2.CV_32S)
    out = np.zeros(image.shape, np.float32)
    _rows(np.ascontiguousarray(integral), sums.rectangles, sums.starts, sums.thresholds, sums.leaves, out)
    return out


@njit(cache=True, nogil=True)
def _rows(integral, rectangles, starts, thresholds, leaves, out):  # type: ignore[no-untyped-def]
    height, width = out.shape
    row = np.empty(width, np.int32)
    for y in range(height):
        said = out[y]
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
            threshold, below, above = thresholds[f], leaves[f, 0], leaves[f, 1]
            for x in range(width):
                said[x] += above if row[x] > threshold else below


def random_sums(rounds: int, *, seed: int = 1, max_area_px: int | None = MAX_AREA_PX) -> BoostedSums:
    """Rounds of the paper's shape, not learnt: only their cost counts."""
    rng = np.random.default_rng(seed)
    pool = random_pool(
        rounds,
        channels=1,
        sigma_xy_px=(10.0, 10.0),
        reach_xy_px=(40, 40),
        max_rectangles=5,
        rng=rng,
        max_area_px=max_area_px,
    )
    leaves = rng.normal(0, 1, (rounds, 2)).astype(np.float32)
    return BoostedSums(pool.table, pool.starts, pool.channels, np.zeros(rounds, np.float32), leaves)


def city(width: int, height: int) -> NDArray[np.uint8]:
    """A frame of a simulated city, repeated to the size."""
    frame = small_flight(frames=1, seed=77).frame(0)
    times = -(-height // frame.shape[0]), -(-width // frame.shape[1])
    return np.ascontiguousarray(np.tile(frame, times)[:height, :width])


def response_speed(image: NDArray[np.uint8]) -> tuple[Speed, Speed]:
    """The paper's dense response against whole rows of int32 at every pixel; and numpy, whose rounds are fewer and
    scaled up."""
    sums, few = random_sums(_DENSE_ROUNDS), random_sums(_NUMPY_ROUNDS)
    what = f"dense response, {_DENSE_ROUNDS} rounds"
    fast = _fastest(lambda: dense_response(image, sums), 3)
    rows = _fastest(lambda: row_response(image, sums), 2)
    share = len(sums.rectangles) / len(few.rectangles)
    slow = _fastest(lambda: plain_response(image, few), 1) * share
    return Speed(what, "whole rows of int32", fast, rows), Speed(what, "numpy", fast, slow)


def train_on_one_frame() -> CascadeDetector:
    """A detector of the usual size, trained on one labelled frame of another simulated city."""
    return CascadeDetector.train([simulated_image(_LEARNT_FROM)], CascadeConfig())


def network_speed(image: NDArray[np.uint8], detector: Detector) -> Speed:
    """The network, places that it likes looked at again, beside convolutions of YOLOv8n's sizes on such a frame."""
    fast = _fastest(lambda: detect_frame(image, None, detector), 2)
    peer = 0.0
    for step, taps, into, out in YOLOV8N:
        layout = PaddedBatchLayout(1, image.shape[0] // step, image.shape[1] // step)
        values, weights = np.ones((layout.rows, into), np.float32), np.ones((taps, into, out), np.float32)
        peer += _fastest(partial(conv2d, values, weights, layout), 1)
    return Speed("the network, shipped", "convolutions of YOLOv8n's sizes", fast, peer)


def cascade_speed(image: NDArray[np.uint8], detector: CascadeDetector, name: str, *, crop_px: int = 96) -> Speed:
    """Both steps against the second step's classifier at every pixel and turn, of a crop, scaled up.

    The surer a detector is, the fewer places it looks at twice.
    """
    fast = _fastest(lambda: detect_frame(image, None, detector), 2)
    look = Look(picture_of(image), detector.sums, detector.record.contrast_floor)
    spots = np.arange(0, crop_px, _TILE_PX) + _TILE_PX / 2
    tiles = np.stack(np.meshgrid(spots, spots), axis=-1).reshape(-1, 2).astype(np.float64)
    half = offset_grid(_TILE_PX // 2, _TILE_PX // 2)
    offsets = half[(half > -_TILE_PX // 2).all(axis=1)]
    slow = _fastest(lambda: look.scores(tiles, np.zeros(len(tiles)), np.asarray(_TURNS, np.float64), offsets), 1)
    slow *= image.size / crop_px**2
    rounds = len(detector.record.rounds)
    return Speed(f"both steps, {name}, {rounds} rounds", f"dense over pixels and {len(_TURNS)} turns", fast, slow)


def _fastest(work: Callable[[], object], repeats: int) -> float:
    """The least of some runs, s of processor time; one before them compiles."""
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times)
