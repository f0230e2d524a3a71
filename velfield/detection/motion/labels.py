"""Training labels from motion: moving vehicles in registered frames, without manual annotation.

Foreground blobs (background subtraction) are linked over three frames under a constant-velocity model and grouped; the
oriented box of a group, less its shadow, is labelled a car if it has a car's size and moves along its long axis. Other
foreground becomes an *ignore* region, neither car nor background. Stationary cars are part of the background, so these
labels are never *complete*.

The precision of the labels is estimated from the flight itself: chance links by a permutation null (see
`count_false_links`), and parallax of roofs, which move across their long axis as often as along it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.arrays import FloatArray, IntArray
from schemas.detector import DetectorConfig
from schemas.flight import TrackingConfig
from velfield.detection.motion.blobs import Blobs
from velfield.detection.motion.boxes import (
    MAX_AXIS_OFFSET_RAD,
    MovingObjects,
    fit_shadow_vector,
    has_car_size,
    moves_along_axis,
    remove_shadow,
)
from velfield.detection.motion.difference import MotionBackground, MotionFrame, motion_background
from velfield.detection.motion.triplets import (
    DifferenceCache,
    Triplet,
    count_false_links,
    estimate_car_length,
    interior_frames,
    link_triplet,
)
from velfield.errors import InputError
from velfield.parallel import parallel_map

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
"""With fewer vehicles than this a warning is given: the detector may miss cars of other appearance."""
MIN_PRECISION = 0.8
"""Labels of lower estimated precision are not used."""
MIN_AXIAL_FRACTION = 0.6
"""Where a lower fraction of the moving objects moves along its axis, they are roofs (parallax), not cars."""
_REMEDY = "label the cars of one frame and give them with --labels"
_OFF_AXIS_RAD = float(np.radians(30.0))


@dataclass(frozen=True)
class FrameLabels:
    """Labels of one frame.

    Attributes
    ----------
    cars : float64 (n, 5)
        x, y, orientation (axial, [0, pi)), length, width of the cars, working px.
    heading_rad, speed_px_per_s : float64 (n,)
        Their motion.
    ignore : float64 (k, 3)
        x, y, radius of circles over other foreground: neither car nor background.
    labelled : bool
        Whether the frame has a neighbour on either side, without which no car is confirmed.
    """

    cars: FloatArray
    heading_rad: FloatArray
    speed_px_per_s: FloatArray
    ignore: FloatArray
    labelled: bool


@dataclass(frozen=True)
class MotionLabels:
    """Labels of all frames, and their estimated quality.

    Attributes
    ----------
    frames : tuple of FrameLabels
        One for each given frame, in their order.
    count : int
        Labelled cars of all frames.
    vehicles : int
        Number of different vehicles: labels without a predecessor in the frame before.
    precision_estimate : float
        Estimated fraction of `count` that are cars, from false links and motion across the long axis.
    axial_motion_fraction : float
        Fraction of the car-sized moving objects that move along their long axis: about 1 for cars, less for parallax.
    car_length_px : float
        A car's typical length: as given, or estimated.
    shadow_px : float64 (2,)
        Shadow vector beyond a car; (0, 0) where there is none.
    usable : bool
        Whether the labels are enough, and precise enough, to train a detector.
    warnings : tuple of str
        Problems of the labels, one line each, with the remedy.
    """

    frames: tuple[FrameLabels, ...]
    count: int
    vehicles: int
    precision_estimate: float
    axial_motion_fraction: float
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
    """Label moving cars, and foreground to be ignored in training.

    Parameters
    ----------
    frames : sequence of MotionFrame
        In time order, on one grid. Bursts of three or more suffice (`choose_frames`).
    background : MotionBackground, optional
        Temporal median of the flight; computed from these frames by default.
    car_length_px : float, optional
        A car's typical length on this grid; estimated by default.
    max_interval_s : float
        Frames farther apart than this are not neighbours.

    Returns
    -------
    MotionLabels
        Not usable, with a warning and a remedy, where too little moves or parallax dominates.

    Raises
    ------
    InputError
        Fewer than three frames, of several shapes, or not in time order.
    """
    times = np.array([frame.time_s for frame in frames])
    if len(frames) < 3 or np.any(np.diff(times) <= 0):
        raise InputError(
            f"labels from motion need 3 registered frames or more in time order, found {len(frames)}: label one frame"
        )
    median = motion_background(frames) if background is None else background
    differences = DifferenceCache(frames, median)
    length = estimate_car_length(differences, times, max_interval_s) if car_length_px is None else car_length_px
    if not np.isfinite(length):
        return _no_labels(len(frames))
    blobs = parallel_map(lambda k: differences.blobs(k, length), range(len(frames)))
    middles = interior_frames(times, max_interval_s)
    triplets = [link_triplet(blobs, times, (k - 1, k, k + 1), length) for k in middles]
    shadow = fit_shadow_vector(np.concatenate([np.empty((0, 5)), *(triplet.shadows for triplet in triplets)]))
    labels = [_ignore_all(frame_blobs) for frame_blobs, _ in blobs]
    for triplet in triplets:
        labels[triplet.middle] = _label_frame(triplet, blobs[triplet.middle][0], shadow, length)
    false_links = count_false_links(blobs, times, middles, shadow, length)
    return _assess(labels, triplets, false_links, times, shadow, length)


def choose_frames(times_s: FloatArray, *, bursts: int = 16, all_below: int = 48) -> IntArray:
    """Choose the frames to label: all of a short flight, else bursts of three spread evenly over it.

    Parameters
    ----------
    times_s : float64 (n,)
        Times of the registered frames, s.
    bursts : int
        Number of bursts from a long flight.
    all_below : int
        All frames of a flight of fewer are taken.

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
    config: DetectorConfig, gsd_m: float | None, labels: MotionLabels | None = None, *, labels_scale: float = 1.0
) -> float:
    """Scale of the working grid, working pixels a base pixel, at which a car is `working_car_length_px` long.

    Parameters
    ----------
    config : DetectorConfig
    gsd_m : float or None
        Ground sample distance of the base image, m; has precedence.
    labels : MotionLabels, optional
        Their estimated length of a car is used where the ground sample distance is unknown.
    labels_scale : float
        Scale of the grid of these labels, pixels a base pixel.

    Raises
    ------
    InputError
        Neither is given.
    """
    if gsd_m is not None:
        return config.working_car_length_px * gsd_m / config.car_length_m
    if labels is None or not np.isfinite(labels.car_length_px):
        raise InputError("a car's size is not known: found neither --gsd-m nor moving cars; give --gsd-m or --labels")
    return config.working_car_length_px * labels_scale / labels.car_length_px


def _label_frame(triplet: Triplet, blobs: Blobs, shadow: FloatArray, length: float) -> FrameLabels:
    """Cars of a frame, and circles over all other foreground."""
    objects = remove_shadow(triplet.objects, shadow)
    confirmed = has_car_size(objects, car_length_px=length) & moves_along_axis(objects)
    cars, rest = objects.select(confirmed), triplet.objects.select(~confirmed)
    table = np.stack([cars.x, cars.y, np.mod(cars.heading_rad, np.pi), cars.length, cars.width], axis=1)
    unlinked = blobs.select(~triplet.links.linked)
    circles = [
        _cover(rest.x, rest.y, rest.heading_rad, rest.length, rest.width),
        _away_from_cars(
            _cover(unlinked.x, unlinked.y, unlinked.axis_rad, unlinked.length, unlinked.width), table, length
        ),
    ]
    return FrameLabels(table, cars.heading_rad, cars.speed, np.concatenate(circles), True)


def _ignore_all(blobs: Blobs) -> FrameLabels:
    """Labels of a frame without neighbours: all foreground is ignored."""
    empty = np.empty(0)
    circles = _cover(blobs.x, blobs.y, blobs.axis_rad, blobs.length, blobs.width)
    return FrameLabels(np.empty((0, 5)), empty, empty, circles, False)


def _cover(x: FloatArray, y: FloatArray, axis: FloatArray, length: FloatArray, width: FloatArray) -> FloatArray:
    """Circles (k, 3) that cover oriented boxes: one for a square, a row of them for a bus."""
    number = np.maximum(1, np.ceil(length / np.maximum(width, 2.0))).astype(np.int64)
    which = np.repeat(np.arange(len(x)), number)
    position = np.arange(len(which)) - np.repeat(np.cumsum(number) - number, number)
    along = ((position + 0.5) / number[which] - 0.5) * length[which]
    radius = np.hypot(width[which], length[which] / number[which]) / 2 + 1
    return np.stack([x[which] + np.cos(axis[which]) * along, y[which] + np.sin(axis[which]) * along, radius], axis=1)


def _away_from_cars(circles: FloatArray, cars: FloatArray, length: float) -> FloatArray:
    """Circles farther than half a length from every labelled car: nearer ones are its own parts."""
    if not len(cars) or not len(circles):
        return circles
    gap = np.hypot(circles[:, None, 0] - cars[None, :, 0], circles[:, None, 1] - cars[None, :, 1])
    return np.asarray(circles[gap.min(axis=1) > 0.5 * length], np.float64)


def _assess(
    labels: list[FrameLabels],
    triplets: list[Triplet],
    false_links: int,
    times: FloatArray,
    shadow: FloatArray,
    length: float,
) -> MotionLabels:
    """The labels with their estimated quality."""
    car_sized = [_car_sized(triplet, shadow, length) for triplet in triplets]
    count = sum(len(part.cars) for part in labels)
    moving = sum(len(part) for part in car_sized)
    across = sum(int((part.has_axis & (part.axis_offset_rad > _OFF_AXIS_RAD)).sum()) for part in car_sized)
    false_by_axis = across * MAX_AXIS_OFFSET_RAD / (np.pi / 2 - _OFF_AXIS_RAD)
    precision = max(0.0, 1 - (false_links + false_by_axis) / count) if count else 0.0
    axial = count / moving if moving else 0.0
    vehicles = _count_vehicles(labels, times, length)
    rejection = _rejection(count, vehicles, precision, axial)
    warnings = (rejection,) if rejection else _caveats(vehicles)
    return MotionLabels(tuple(labels), count, vehicles, precision, axial, length, shadow, not rejection, warnings)


def _no_labels(n: int) -> MotionLabels:
    """No car was confirmed at any candidate length, so that a car's length remains unknown."""
    empty = FrameLabels(np.empty((0, 5)), np.empty(0), np.empty(0), np.empty((0, 3)), False)
    return MotionLabels((empty,) * n, 0, 0, 0.0, 0.0, float("nan"), np.zeros(2), False, (_rejection(0, 0, 0.0, 0.0),))


def _car_sized(triplet: Triplet, shadow: FloatArray, length: float) -> MovingObjects:
    objects = remove_shadow(triplet.objects, shadow)
    return objects.select(has_car_size(objects, car_length_px=length))


def _count_vehicles(labels: list[FrameLabels], times: FloatArray, length: float) -> int:
    """Number of labels that no label of the frame before predicts: first appearances."""
    first = 0
    for k, part in enumerate(labels):
        before = labels[k - 1] if k else part
        if k == 0 or not len(before.cars) or not len(part.cars):
            first += len(part.cars)
            continue
        step = (times[k] - times[k - 1]) * before.speed_px_per_s
        predicted = before.cars[:, :2] + step[:, None] * np.stack(
            [np.cos(before.heading_rad), np.sin(before.heading_rad)], axis=1
        )
        gap = np.hypot(*(part.cars[:, None, :2] - predicted[None]).transpose(2, 0, 1))
        first += int((gap.min(axis=1) > 0.5 * length).sum())
    return first


def _rejection(count: int, vehicles: int, precision: float, axial: float) -> str:
    """Why the labels cannot train a detector, and the remedy; empty where they can."""
    if count and axial < MIN_AXIAL_FRACTION:
        return (
            f"labels from motion are unreliable: only {axial:.0%} of the moving objects move along their long axis "
            f"({MIN_AXIAL_FRACTION:.0%} required), so roofs shift by parallax; {_REMEDY}"
        )
    if vehicles < MIN_VEHICLES or count < MIN_LABELS:
        return (
            f"too few cars move to train a detector: found {count} labels of {vehicles} vehicles, expected "
            f"{MIN_LABELS} of {MIN_VEHICLES}; {_REMEDY}"
        )
    if precision < MIN_PRECISION:
        return (
            f"labels from motion are unreliable: estimated precision {precision:.0%}, {MIN_PRECISION:.0%} required; "
            f"{_REMEDY}"
        )
    return ""


def _caveats(vehicles: int) -> tuple[str, ...]:
    """Warnings about usable labels."""
    if vehicles >= FEW_VEHICLES:
        return ()
    return (f"trained on only {vehicles} moving vehicles: cars of other appearance may be missed; {_REMEDY}",)
