"""Three frames at a time: what moves in the middle one, chance links, and a car's length where it is not known."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, IntArray
from velfield.detection.motion.blobs import Blobs, Pixels, find_blobs
from velfield.detection.motion.boxes import (
    Bodies,
    bodies_of,
    goes_lengthwise,
    of_car_size,
    shadow_samples,
    shadow_vector,
    without_shadow,
)
from velfield.detection.motion.difference import MotionBackground, MotionFrame, noise_sigma, signed_motion
from velfield.detection.motion.links import Links, group_linked, link_three

Regions = tuple[Blobs, Pixels]

_GUESSES_PX = np.geomspace(6.0, 60.0, 9)
_GUESS_TRIPLETS = 4
_COARSE_LENGTH_PX = 10.0


@dataclass(frozen=True)
class Triplet:
    """Things that moved in the middle one of three frames."""

    middle: int
    bodies: Bodies
    links: Links
    shadows: FloatArray


class Differences:
    """Signed difference and noise of each frame, computed when first asked for and kept."""

    def __init__(self, frames: Sequence[MotionFrame], background: MotionBackground) -> None:
        self._frames = frames
        self._background = background
        self._kept: dict[int, tuple[NDArray[np.float16], float]] = {}

    def regions(self, index: int, car_length_px: float, *, shrink: int = 1) -> Regions:
        """Regions of one frame, for a car of this length; on a grid `shrink` times coarser where told."""
        if index not in self._kept:
            frame = self._frames[index]
            signed = signed_motion(frame.image, frame.valid, self._background)
            noise = noise_sigma(frame.image, frame.valid, self._background)
            self._kept[index] = signed.astype(np.float16), noise
        signed16, noise = self._kept[index]
        signed = signed16.astype(np.float32)
        if shrink > 1:
            signed = np.asarray(cv2.resize(signed, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA))
        return find_blobs(signed, noise=noise, car_length_px=car_length_px / shrink)


def estimate_car_length(signed: Differences, times: FloatArray, max_interval_s: float) -> float:
    """Length at which most things are confirmed and are themselves of that length, px; NaN where nothing is.

    Each guess sets speed limit, tolerances and sizes; the guess that agrees best with what it finds is refined by it.
    """
    middles = middles_of(times, max_interval_s)
    if not len(middles):
        return float("nan")
    chosen = middles[np.unique(np.linspace(0, len(middles) - 1, _GUESS_TRIPLETS).round().astype(int))]
    found = [_confirmed_lengths(signed, times, chosen, guess) for guess in _GUESSES_PX]
    best = int(np.argmax([len(lengths) for lengths in found]))
    if not len(found[best]):
        return float("nan")
    length = float(np.median(found[best]))
    for _ in range(2):
        again = _confirmed_lengths(signed, times, chosen, length)
        length = float(np.median(again)) if len(again) else length
    return length


def _confirmed_lengths(signed: Differences, times: FloatArray, middles: IntArray, car_length_px: float) -> FloatArray:
    """Lengths of the things that one guess confirms; a large guess is tried on a coarser grid, which is quicker."""
    shrink = max(1, int(car_length_px / _COARSE_LENGTH_PX))
    indices = np.unique(middles[:, None] + np.array([-1, 0, 1]))
    regions = {int(k): signed.regions(int(k), car_length_px, shrink=shrink) for k in indices}
    length = car_length_px / shrink
    triplets = [triplet_of(regions, times, (k - 1, k, k + 1), length) for k in middles]
    shadow = shadow_vector(np.concatenate([triplet.shadows for triplet in triplets]))
    lengths = [cars_of(without_shadow(triplet.bodies, shadow), length).length for triplet in triplets]
    return np.concatenate(lengths) * shrink


def middles_of(times: FloatArray, max_interval_s: float) -> IntArray:
    """Frames that have a neighbour on either side."""
    near = np.diff(times) <= max_interval_s
    return np.flatnonzero(near[:-1] & near[1:]) + 1


def triplet_of(
    regions: Sequence[Regions] | dict[int, Regions],
    times: FloatArray,
    order: tuple[int, int, int],
    car_length_px: float,
    intervals_s: tuple[float, float] | None = None,
) -> Triplet:
    """Link three frames and gather what goes together; `intervals_s` stands in for the true ones in a decoy."""
    (before, _), (middle, pixels), (after, _) = (regions[k] for k in order)
    first, second = intervals_s or (times[order[1]] - times[order[0]], times[order[2]] - times[order[1]])
    links = link_three(
        before, middle, after, interval_before_s=first, interval_after_s=second, car_length_px=car_length_px
    )
    groups = group_linked(middle, pixels, links, interval_s=(first + second) / 2, car_length_px=car_length_px)
    bodies = bodies_of(groups, car_length_px=car_length_px)
    return Triplet(order[1], bodies, links, shadow_samples(groups, car_length_px=car_length_px))


def cars_of(bodies: Bodies, car_length_px: float) -> Bodies:
    return bodies.take(of_car_size(bodies, car_length_px=car_length_px) & goes_lengthwise(bodies))


def count_decoys(
    regions: Sequence[Regions], times: FloatArray, middles: IntArray, shadow: FloatArray, length: float
) -> int:
    """Cars confirmed when frames are linked in an order that no vehicle can follow: later, earlier, between."""
    found = 0
    for k in middles:
        intervals = (float(times[k] - times[k - 1]), float(times[k + 1] - times[k]))
        decoy = triplet_of(regions, times, (k + 1, k - 1, k), length, intervals)
        found += len(cars_of(without_shadow(decoy.bodies, shadow), length))
    return found
