"""Moving objects of three consecutive frames, the number of false links, and the typical length of a car."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, IntArray
from velfield.detection.motion.blobs import BlobPixels, Blobs, extract_blobs
from velfield.detection.motion.boxes import (
    MovingObjects,
    fit_boxes,
    fit_shadow_vector,
    has_car_size,
    moves_along_axis,
    remove_shadow,
    sample_shadows,
)
from velfield.detection.motion.difference import MotionBackground, MotionFrame, estimate_noise, signed_difference
from velfield.detection.motion.links import Links, group_blobs, link_blobs

FrameBlobs = tuple[Blobs, BlobPixels]

_CANDIDATE_LENGTHS_PX = np.geomspace(6.0, 60.0, 9)
_LENGTH_TRIPLETS, _REFINEMENTS = 4, 2
_COARSE_LENGTH_PX = 10.0
"""The grid is coarsened so that a car of a candidate length is no longer than about twice this."""


@dataclass(frozen=True)
class Triplet:
    """Moving objects of the middle one of three frames.

    Attributes
    ----------
    middle : int
        Index of that frame.
    objects : MovingObjects
        Shadow included.
    links : Links
        Of its blobs.
    shadows : float64 (k, 5)
        From `sample_shadows`.
    """

    middle: int
    objects: MovingObjects
    links: Links
    shadows: FloatArray


class DifferenceCache:
    """Signed difference and noise of each frame, computed on first use and kept at half precision."""

    def __init__(self, frames: Sequence[MotionFrame], background: MotionBackground) -> None:
        self._frames = frames
        self._background = background
        self._cache: dict[int, tuple[NDArray[np.float16], float]] = {}

    def blobs(self, index: int, car_length_px: float, *, shrink: int = 1) -> FrameBlobs:
        """Blobs of one frame, for cars of this length; optionally on a grid ``shrink`` times coarser."""
        if index not in self._cache:
            frame = self._frames[index]
            signed = signed_difference(frame.image, frame.valid, self._background)
            noise = estimate_noise(frame.image, frame.valid, self._background)
            self._cache[index] = signed.astype(np.float16), noise
        signed16, noise = self._cache[index]
        signed = signed16.astype(np.float32)
        if shrink > 1:
            signed = np.asarray(cv2.resize(signed, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA))
        return extract_blobs(signed, noise=noise, car_length_px=car_length_px / shrink)


def estimate_car_length(differences: DifferenceCache, times: FloatArray, max_interval_s: float) -> float:
    """Typical length of a car, px: the candidate that confirms most cars, refined; NaN where none confirms any.

    A candidate sets the speed limit, the tolerances and the accepted sizes. The best one is replaced by the median
    length of the cars that it confirms, twice.
    """
    middles = interior_frames(times, max_interval_s)
    if not len(middles):
        return float("nan")
    chosen = middles[np.unique(np.linspace(0, len(middles) - 1, _LENGTH_TRIPLETS).round().astype(int))]
    confirmed = [_confirmed_lengths(differences, times, chosen, length) for length in _CANDIDATE_LENGTHS_PX]
    best = int(np.argmax([len(lengths) for lengths in confirmed]))
    if not len(confirmed[best]):
        return float("nan")
    length = float(np.median(confirmed[best]))
    for _ in range(_REFINEMENTS):
        lengths = _confirmed_lengths(differences, times, chosen, length)
        length = float(np.median(lengths)) if len(lengths) else length
    return length


def _confirmed_lengths(
    differences: DifferenceCache, times: FloatArray, middles: IntArray, car_length_px: float
) -> FloatArray:
    """Lengths of the cars confirmed at a candidate length; long ones are tried on a coarser grid, which is faster."""
    shrink = max(1, int(car_length_px / _COARSE_LENGTH_PX))
    indices = np.unique(middles[:, None] + np.array([-1, 0, 1]))
    blobs = {int(k): differences.blobs(int(k), car_length_px, shrink=shrink) for k in indices}
    length = car_length_px / shrink
    triplets = [link_triplet(blobs, times, (k - 1, k, k + 1), length) for k in middles]
    shadow = fit_shadow_vector(np.concatenate([triplet.shadows for triplet in triplets]))
    lengths = [select_cars(remove_shadow(triplet.objects, shadow), length).length for triplet in triplets]
    return np.concatenate(lengths) * shrink


def interior_frames(times: FloatArray, max_interval_s: float) -> IntArray:
    """Indices of the frames that have a neighbour in time on either side."""
    near = np.diff(times) <= max_interval_s
    return np.flatnonzero(near[:-1] & near[1:]) + 1


def link_triplet(
    blobs: Sequence[FrameBlobs] | dict[int, FrameBlobs],
    times: FloatArray,
    order: tuple[int, int, int],
    car_length_px: float,
    intervals_s: tuple[float, float] | None = None,
) -> Triplet:
    """Link the blobs of three frames, group them and fit boxes.

    Parameters
    ----------
    blobs
        By frame.
    times
        (n,) of the frames, s.
    order
        Frames taken as the first, the middle and the last one.
    car_length_px
        A car's typical length, working px.
    intervals_s
        Intervals in place of those between the three frames.
    """
    (before, _), (middle, pixels), (after, _) = (blobs[k] for k in order)
    first, second = intervals_s or (times[order[1]] - times[order[0]], times[order[2]] - times[order[1]])
    links = link_blobs(
        before, middle, after, interval_before_s=first, interval_after_s=second, car_length_px=car_length_px
    )
    groups = group_blobs(middle, pixels, links, interval_s=(first + second) / 2, car_length_px=car_length_px)
    objects = fit_boxes(groups, car_length_px=car_length_px)
    return Triplet(order[1], objects, links, sample_shadows(groups, car_length_px=car_length_px))


def select_cars(objects: MovingObjects, car_length_px: float) -> MovingObjects:
    """The objects of a car's size that move along their axis."""
    return objects.select(has_car_size(objects, car_length_px=car_length_px) & moves_along_axis(objects))


def count_false_links(
    blobs: Sequence[FrameBlobs], times: FloatArray, middles: IntArray, shadow: FloatArray, length: float
) -> int:
    """Cars confirmed by chance: a permutation null, with frames in an order that no vehicle can follow.

    The frame after is taken as the first, the frame before as the middle one, and the middle one as the last.
    """
    count = 0
    for k in middles:
        intervals = (float(times[k] - times[k - 1]), float(times[k + 1] - times[k]))
        permuted = link_triplet(blobs, times, (k + 1, k - 1, k), length, intervals)
        count += len(select_cars(remove_shadow(permuted.objects, shadow), length))
    return count
