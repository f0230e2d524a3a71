"""Training labels for free: cars told from all else by their motion in registered frames.

The strategy. What differs from the temporal median by more than the noise is a region, bright or dark. A region that
has partners of like size before and after at one velocity is linked; regions that touch and go together are one thing;
its rectangle along the heading, less its shadow, is a car's if it has a car's size and moves along its long axis. All
else that differs is an *ignore* region: neither car nor background. What stands is in the median and shows no
difference, so a frame labelled so is never *complete*: what looks like a car there may well be one.

The flight is asked how far it may be trusted. Chance links are counted by linking frames in an order that no vehicle
can follow; roofs that shift against the ground (parallax) move across their long axis as often as along it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.arrays import FloatArray, IntArray
from schemas.flight import DetectionConfig, TrackingConfig
from velfield.detection.motion.blobs import Blobs
from velfield.detection.motion.boxes import (
    MAX_AXIS_OFFSET_RAD,
    Bodies,
    goes_lengthwise,
    of_car_size,
    shadow_vector,
    without_shadow,
)
from velfield.detection.motion.difference import MotionBackground, MotionFrame, motion_background
from velfield.detection.motion.triplets import (
    Differences,
    Triplet,
    count_decoys,
    estimate_car_length,
    middles_of,
    triplet_of,
)
from velfield.errors import InputError

__all__ = [
    "FrameLabels",
    "MotionBackground",
    "MotionFrame",
    "MotionLabels",
    "choose_frames",
    "labels_from_motion",
    "motion_background",
    "working_scale",
]


MIN_LABELS, MIN_VEHICLES = 30, 5
"""Fewer labels, or labels of fewer vehicles, do not train a detector."""
FEW_VEHICLES = 15
"""Fewer vehicles than this train a detector that misses what looks otherwise; said, but not refused."""
MIN_PURITY = 0.8
"""Labels less pure than this are not to be trusted."""
MIN_COHERENCE = 0.6
"""Less than this share of what moves goes along its length: roofs move, not cars."""
_REMEDY = "mark the cars of one frame and give them with --labels"
_OFF_AXIS_RAD = float(np.radians(30.0))


@dataclass(frozen=True)
class FrameLabels:
    """What motion says of one frame.

    Attributes
    ----------
    cars : float64 (n, 5)
        x, y, orientation (axial, [0, pi)), length, width of the confirmed cars, working px.
    heading_rad, speed_px_per_s : float64 (n,)
        Their motion.
    ignore : float64 (k, 3)
        x, y, radius of what differs from the background but is not confirmed: neither car nor background.
    labelled : bool
        Whether the frame had a neighbour on either side, so that its cars could be confirmed.
    """

    cars: FloatArray
    heading_rad: FloatArray
    speed_px_per_s: FloatArray
    ignore: FloatArray
    labelled: bool


@dataclass(frozen=True)
class MotionLabels:
    """Labels of all frames, and how good they are.

    Attributes
    ----------
    frames : tuple of FrameLabels
        One for each frame that was given, in their order.
    count : int
        Confirmed cars, all frames together.
    vehicles : int
        Of these, how many are the first sight of a vehicle: how many different ones there are.
    purity : float
        Estimated share of `count` that are cars, by chance links and by motion across the long axis.
    coherence : float
        Share of the car-sized things that move which go along their long axis; about 1 for cars, less for parallax.
    car_length_px : float
        A car's usual length: as given, or estimated from what moves.
    shadow_px : float64 (2,)
        Where shadows lie and how far they reach beyond a car; (0, 0) where none was seen.
    usable : bool
        Whether there are enough, and pure enough, to train a detector.
    warnings : tuple of str
        What stands against the labels, one line each, with what to do.
    """

    frames: tuple[FrameLabels, ...]
    count: int
    vehicles: int
    purity: float
    coherence: float
    car_length_px: float
    shadow_px: FloatArray
    usable: bool
    warnings: tuple[str, ...]


def labels_from_motion(
    frames: Sequence[MotionFrame],
    background: MotionBackground | None = None,
    *,
    car_length_px: float | None = None,
    max_interval_s: float = TrackingConfig().max_interval_s,
) -> MotionLabels:
    """Cars that move over three registered frames, and what is to be left out of training.

    Parameters
    ----------
    frames : sequence of MotionFrame
        In time order, on one grid. Bursts of three or more will do (`choose_frames`).
    background : MotionBackground, optional
        Temporal median of the flight; from these frames where none is given.
    car_length_px : float, optional
        A car's usual length on this grid; estimated from what moves where it is not known.
    max_interval_s : float
        Frames farther apart than this are not neighbours.

    Returns
    -------
    MotionLabels
        Not usable, with a warning that says what to do, where too little moves or parallax spoils it.

    Raises
    ------
    InputError
        Fewer than three frames, of several shapes, or not in time order.
    """
    times = np.array([frame.time_s for frame in frames])
    if len(frames) < 3 or np.any(np.diff(times) <= 0):
        raise InputError(
            f"labels from motion need 3 registered frames or more in time order, found {len(frames)}: mark one frame"
        )
    ground = motion_background(frames) if background is None else background
    signed = Differences(frames, ground)
    length = estimate_car_length(signed, times, max_interval_s) if car_length_px is None else car_length_px
    if not np.isfinite(length):
        return _nothing(len(frames))
    regions = [signed.regions(k, length) for k in range(len(frames))]
    middles = middles_of(times, max_interval_s)
    triplets = [triplet_of(regions, times, (k - 1, k, k + 1), length) for k in middles]
    shadow = shadow_vector(np.concatenate([np.empty((0, 5)), *(triplet.shadows for triplet in triplets)]))
    labels = [_unlabelled(blobs, length) for blobs, _ in regions]
    for triplet in triplets:
        labels[triplet.middle] = _frame_labels(triplet, regions[triplet.middle][0], shadow, length)
    return _judged(labels, triplets, count_decoys(regions, times, middles, shadow, length), times, shadow, length)


def choose_frames(times_s: FloatArray, *, bursts: int = 16, all_below: int = 48) -> IntArray:
    """Frames to take labels from: all of a short flight, else bursts of three spread evenly over it.

    Parameters
    ----------
    times_s : float64 (n,)
        Times of the registered frames, s.
    bursts : int
        Bursts taken from a long flight.
    all_below : int
        A flight of fewer frames is taken whole.

    Returns
    -------
    int64 (m,)
        Indices into `times_s`, ascending.
    """
    n = len(times_s)
    if n < max(all_below, 3 * bursts + 1):
        return np.arange(n)
    starts = np.linspace(0, n - 3, bursts).round().astype(np.int64)
    return np.unique((starts[:, None] + np.arange(3)).ravel())


def working_scale(
    config: DetectionConfig, gsd_m: float | None, labels: MotionLabels | None = None, *, labels_scale: float = 1.0
) -> float:
    """Working pixels a base pixel: what makes a car `working_car_length_px` long.

    Parameters
    ----------
    config : DetectionConfig
    gsd_m : float or None
        Metres a base pixel, where known: it decides.
    labels : MotionLabels, optional
        Where the ground sample distance is not known: their cars' length decides.
    labels_scale : float
        Pixels of the grid that the labels were found on, a base pixel.

    Raises
    ------
    InputError
        Neither is known.
    """
    if gsd_m is not None:
        return config.working_car_length_px * gsd_m / config.car_length_m
    if labels is None or not np.isfinite(labels.car_length_px):
        raise InputError(
            "a car's size is not known: found neither --gsd-m nor cars that move; give --gsd-m or --labels"
        )
    return config.working_car_length_px * labels_scale / labels.car_length_px


def _frame_labels(triplet: Triplet, blobs: Blobs, shadow: FloatArray, length: float) -> FrameLabels:
    """Confirmed cars of a frame, and circles over all else that differs."""
    bodies = without_shadow(triplet.bodies, shadow)
    confirmed = of_car_size(bodies, car_length_px=length) & goes_lengthwise(bodies)
    cars, rest = bodies.take(confirmed), triplet.bodies.take(~confirmed)
    table = np.stack([cars.x, cars.y, np.mod(cars.heading_rad, np.pi), cars.length, cars.width], axis=1)
    loose = blobs.take(~triplet.links.linked)
    circles = [
        _circles(rest.x, rest.y, rest.heading_rad, rest.length, rest.width),
        _away_from(_circles(loose.x, loose.y, loose.axis_rad, loose.length, loose.width), table, length),
    ]
    return FrameLabels(table, cars.heading_rad, cars.speed, np.concatenate(circles), True)


def _unlabelled(blobs: Blobs, length: float) -> FrameLabels:
    """A frame without neighbours: all that differs is left out."""
    empty = np.empty(0)
    circles = _circles(blobs.x, blobs.y, blobs.axis_rad, blobs.length, blobs.width)
    return FrameLabels(np.empty((0, 5)), empty, empty, circles, False)


def _circles(x: FloatArray, y: FloatArray, axis: FloatArray, length: FloatArray, width: FloatArray) -> FloatArray:
    """Circles that cover rectangles: one for a square, a row of them for a bus."""
    number = np.maximum(1, np.ceil(length / np.maximum(width, 2.0))).astype(np.int64)
    which = np.repeat(np.arange(len(x)), number)
    within = np.arange(len(which)) - np.repeat(np.cumsum(number) - number, number)
    along = ((within + 0.5) / number[which] - 0.5) * length[which]
    radius = np.hypot(width[which], length[which] / number[which]) / 2 + 1
    return np.stack([x[which] + np.cos(axis[which]) * along, y[which] + np.sin(axis[which]) * along, radius], axis=1)


def _away_from(circles: FloatArray, cars: FloatArray, length: float) -> FloatArray:
    """Circles that are not a confirmed car's own odds and ends."""
    if not len(cars) or not len(circles):
        return circles
    gap = np.hypot(circles[:, None, 0] - cars[None, :, 0], circles[:, None, 1] - cars[None, :, 1])
    return np.asarray(circles[gap.min(axis=1) > 0.5 * length], np.float64)


def _judged(
    labels: list[FrameLabels],
    triplets: list[Triplet],
    decoys: int,
    times: FloatArray,
    shadow: FloatArray,
    length: float,
) -> MotionLabels:
    """The labels with their purity, coherence and what stands against them."""
    sized = [_sized(triplet, shadow, length) for triplet in triplets]
    count = sum(len(part.cars) for part in labels)
    moving = sum(len(part) for part in sized)
    across = sum(int((part.has_axis & (part.axis_offset_rad > _OFF_AXIS_RAD)).sum()) for part in sized)
    by_axis = across * MAX_AXIS_OFFSET_RAD / (np.pi / 2 - _OFF_AXIS_RAD)
    purity = max(0.0, 1 - (decoys + by_axis) / count) if count else 0.0
    coherence = count / moving if moving else 0.0
    vehicles = _vehicles(labels, times, length)
    objection = _objection(count, vehicles, purity, coherence)
    warnings = (objection,) if objection else _doubts(vehicles)
    return MotionLabels(tuple(labels), count, vehicles, purity, coherence, length, shadow, not objection, warnings)


def _nothing(n: int) -> MotionLabels:
    """Where nothing at all was confirmed, a car's length stays unknown."""
    empty = FrameLabels(np.empty((0, 5)), np.empty(0), np.empty(0), np.empty((0, 3)), False)
    return MotionLabels((empty,) * n, 0, 0, 0.0, 0.0, float("nan"), np.zeros(2), False, (_objection(0, 0, 0.0, 0.0),))


def _sized(triplet: Triplet, shadow: FloatArray, length: float) -> Bodies:
    bodies = without_shadow(triplet.bodies, shadow)
    return bodies.take(of_car_size(bodies, car_length_px=length))


def _vehicles(labels: list[FrameLabels], times: FloatArray, length: float) -> int:
    """Labels that no label of the frame before foretold: first sights."""
    first = 0
    for k, part in enumerate(labels):
        before = labels[k - 1] if k else part
        if k == 0 or not len(before.cars) or not len(part.cars):
            first += len(part.cars)
            continue
        step = (times[k] - times[k - 1]) * before.speed_px_per_s
        foretold = before.cars[:, :2] + step[:, None] * np.stack(
            [np.cos(before.heading_rad), np.sin(before.heading_rad)], axis=1
        )
        gap = np.hypot(*(part.cars[:, None, :2] - foretold[None]).transpose(2, 0, 1))
        first += int((gap.min(axis=1) > 0.5 * length).sum())
    return first


def _objection(count: int, vehicles: int, purity: float, coherence: float) -> str:
    """Why the labels cannot train a detector, and what to do; empty where they can."""
    if count and coherence < MIN_COHERENCE:
        return (
            f"labels from motion are not to be trusted: only {coherence:.0%} of what moves goes along its length "
            f"({MIN_COHERENCE:.0%} wanted), so roofs shift against the ground (parallax); {_REMEDY}"
        )
    if vehicles < MIN_VEHICLES or count < MIN_LABELS:
        return (
            f"too few cars move to learn from: {count} labels of {vehicles} vehicles confirmed, {MIN_LABELS} of "
            f"{MIN_VEHICLES} wanted; {_REMEDY}"
        )
    if purity < MIN_PURITY:
        return f"labels from motion are not pure enough: {purity:.0%} estimated, {MIN_PURITY:.0%} wanted; {_REMEDY}"
    return ""


def _doubts(vehicles: int) -> tuple[str, ...]:
    """What is to be said of labels that can be used all the same."""
    if vehicles >= FEW_VEHICLES:
        return ()
    return (f"only {vehicles} vehicles moved to learn from, so cars that look otherwise may be missed; {_REMEDY}",)
