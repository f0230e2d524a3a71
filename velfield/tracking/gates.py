"""Gates on links between two detections and on pairs of links (paper: tracking), in physical units.

Every gate is a physical limit times the true interval plus ``jitter_sigmas`` standard deviations of the tested
quantity under detection jitter alone. Jitter does not shrink with the interval: at 25 frames a second and half a pixel
of it, the paper's acceleration gate alone would reject 99 % of the true tracklets, and 96 % of the parked cars would
"move".

A rejected candidate is counted once, at the first gate that it fails (`GateLog`).

Limits of the gates in base pixels and seconds, and the counts of candidates that each gate rejects.
"""

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from schemas.arrays import FloatArray, IntArray, Mask
from schemas.flight import TrackingConfig, assumed_gsd_m


@dataclass(frozen=True)
class Limits:
    """The gates of a flight in base pixels, seconds and radians."""

    max_speed_px_per_s: float
    stationary_speed_px_per_s: float
    max_acceleration_px_per_s2: float
    """Physical limits, base px."""
    max_turn_rad: float
    max_axis_offset_rad: float
    """Angles between the two segments, and between motion and the car's axis."""
    jitter_px: float
    jitter_sigmas: float
    """Standard deviation of a detection's position, base px, and by how many of them gates are widened."""
    max_interval_s: float
    """Longest interval between two frames of a window."""

    @classmethod
    def from_config(cls, config: TrackingConfig, gsd_m: float | None) -> "Limits":
        """Limits in base pixels. Without a ground sample distance they are the paper's in pixels (150 px/s, 5 px/s,
        100 px/s^2).

        Examples
        --------
        >>> Limits.from_config(TrackingConfig(), None).max_speed_px_per_s
        150.0
        """
        metres = assumed_gsd_m(gsd_m)
        return cls(
            max_speed_px_per_s=config.max_speed_m_per_s / metres,
            stationary_speed_px_per_s=config.stationary_speed_m_per_s / metres,
            max_acceleration_px_per_s2=config.max_acceleration_m_per_s2 / metres,
            max_turn_rad=config.max_turn_rad,
            max_axis_offset_rad=config.max_axis_offset_rad,
            jitter_px=config.jitter_px,
            jitter_sigmas=config.jitter_sigmas,
            max_interval_s=config.max_interval_s,
        )

    def position_sd_px(self, residual_px: float) -> float:
        """Standard deviation of a detection's position along x or y: the detector's and registration's, base px."""
        return float(np.hypot(self.jitter_px, residual_px))


class GateLog(Counter[str]):
    """Counts by gate; those of disjoint sets of windows add up to those of their union.

    Links of every pair of consecutive frames: ``links_tried`` (within twice the reach), of which rejected by
    ``speed``, ``axis``, and, with ``linking = pairwise``, ``appearance`` (not the mutual best in appearance). Pairs of
    links of every window: ``pairs_tried``, of which rejected by ``turn``, ``acceleration``, ``not_best`` (a pair
    through one of the same detections is cheaper) or ``confidence`` (the best, but ambiguous). Windows: ``windows``,
    ``frames_not_registered``, ``gaps_too_long``. Accepted: ``tracklets``, and ``moving_candidates``, those that weak
    candidates are part of; and of the links of both, two each, ``links_refined`` and ``links_not_refined``
    (displacement not from the crops).
    """


DEFAULT_AXIS_SD_RAD = 0.1
"""Standard deviation of an axis given without one: the structure tensor's (median error 3.4-5 degrees)."""
MIN_AXIS_SD_RAD = 0.05
"""Lower bound of an axis's standard deviation: cars slip, turn and lean, so motion does not follow the axis exactly."""
TYPICAL_ACCELERATION_FRACTION = 0.1
"""Standard deviation of a car's acceleration as a fraction of the gate's limit: 2.3 m/s^2 of 23."""


@dataclass(frozen=True)
class DetectionStates:
    """Positions and axes of the detections of one frame, with their standard deviations."""

    x_px: FloatArray
    y_px: FloatArray
    """(n,) base px."""
    axis_rad: FloatArray
    axis_sd_rad: FloatArray
    """(n,) axial, [0, pi); NaN: unknown, and not tested."""
    sd_px: float
    """Standard deviation of a position along x or y, base px."""
    time_s: float
    """Time of the frame."""

    def take(self, rows: IntArray) -> "DetectionStates":
        """States of the given detections, in this order; a row may occur more than once."""
        columns = {name: getattr(self, name)[rows] for name in ("x_px", "y_px", "axis_rad", "axis_sd_rad")}
        return replace(self, **columns)


@dataclass(frozen=True)
class Links:
    """Candidate links between two consecutive frames, sorted by the earlier detection."""

    first: IntArray
    second: IntArray
    """(m,) indices of the detections in the earlier and the later frame."""
    axis_cost: FloatArray
    """(m,) half the squared sideways displacement in standard deviations."""
    interval_s: float
    """Time from the earlier to the later frame."""
    rejected: tuple[int, int, int]
    """Counts: tried, by speed, by axis."""


def gate_links(before: DetectionStates, after: DetectionStates, limits: Limits) -> Links:
    """Candidate links: all pairs of detections of two frames that pass the gates on speed and axis.

    ``before``, ``after``: detections of the earlier and of the later frame.
    """
    interval = after.time_s - before.time_s
    noise = float(np.hypot(before.sd_px, after.sd_px))
    widening = limits.jitter_sigmas * noise
    reach = limits.max_speed_px_per_s * interval + widening
    order = np.argsort(after.y_px, kind="stable")  # detections within reach lie in a band of rows: binary search
    rows = after.y_px[order]
    low = np.searchsorted(rows, before.y_px - 2 * reach, side="left")
    high = np.searchsorted(rows, before.y_px + 2 * reach, side="right")
    first, position = _expand(low, high)
    second = order[position]
    dx, dy = after.x_px[second] - before.x_px[first], after.y_px[second] - before.y_px[first]
    length = np.hypot(dx, dy)
    tried, near = int(np.sum(length <= 2 * reach)), length <= reach
    first, second, dx, dy = first[near], second[near], dx[near], dy[near]
    slow = limits.stationary_speed_px_per_s * interval + widening
    fits_before, cost_before = _axis_test(dx, dy, before, first, slow, noise, limits)
    fits_after, cost_after = _axis_test(dx, dy, after, second, slow, noise, limits)
    fits = np.flatnonzero(fits_before & fits_after)
    ranked = fits[np.lexsort((second[fits], first[fits]))]
    counts = (tried, tried - len(first), len(first) - len(fits))
    return Links(first[ranked], second[ranked], 0.5 * (cost_before + cost_after)[ranked], interval, counts)


def _expand(low: IntArray, high: IntArray) -> tuple[IntArray, IntArray]:
    """The numbers from ``low`` (n,) up to ``high`` (n,), one range after the other: the range of each, and they."""
    count = high - low
    owner = np.repeat(np.arange(len(low)), count)
    return owner, np.arange(len(owner)) + (low - np.cumsum(count) + count)[owner]


def _axis_test(
    dx: FloatArray,
    dy: FloatArray,
    states: DetectionStates,
    rows: IntArray,
    slow: float,
    noise: float,
    limits: Limits,
) -> tuple[Mask, FloatArray]:
    """Whether motions (m,) are along the axes of detections ``rows`` (m,), and half the squared sideways component in
    standard deviations."""
    axis, sd = states.axis_rad[rows], states.axis_sd_rad[rows]
    sd = np.where(np.isnan(sd), DEFAULT_AXIS_SD_RAD, np.maximum(sd, MIN_AXIS_SD_RAD))
    length = np.hypot(dx, dy)
    along, sideways = abs(dx * np.cos(axis) + dy * np.sin(axis)), abs(dy * np.cos(axis) - dx * np.sin(axis))
    cost = 0.5 * sideways**2 / (noise**2 + (length * sd) ** 2)
    widening = limits.jitter_sigmas * np.hypot(sd, noise / np.maximum(length, 1e-9))
    fits = (length <= slow) | (np.arctan2(sideways, along) <= limits.max_axis_offset_rad + widening)
    unknown = np.isnan(axis)
    return fits | unknown, np.where(unknown, 0.0, cost)


@dataclass(frozen=True)
class LinkPairs:
    """Pairs of links that share their middle detection and pass the gates on turn and acceleration."""

    link_01: IntArray
    link_12: IntArray
    """(m,) indices of the links."""
    motion_cost: FloatArray
    """(m,) half the squared deviation from constant velocity, in standard deviations."""
    rejected: tuple[int, int, int]
    """Counts: tried, by turn, by acceleration."""


def gate_link_pairs(
    states: tuple[DetectionStates, DetectionStates, DetectionStates], before: Links, after: Links, limits: Limits
) -> LinkPairs:
    """All pairs of consecutive links that pass the gates on turn and acceleration.

    ``states``: detections of the three frames. ``before``, ``after``: links from the first frame to the middle one, and
    from the middle one to the last.
    """
    begins = np.searchsorted(after.first, np.arange(states[1].x_px.size + 1))
    link_01, link_12 = _expand(begins[before.second], begins[before.second + 1])
    first, middle, last = before.first[link_01], before.second[link_01], after.second[link_12]
    ax, ay = states[1].x_px[middle] - states[0].x_px[first], states[1].y_px[middle] - states[0].y_px[first]
    bx, by = states[2].x_px[last] - states[1].x_px[middle], states[2].y_px[last] - states[1].y_px[middle]
    dt, sd = (before.interval_s, after.interval_s), np.array([one.sd_px for one in states])
    goes_on = _turn_passes((ax, ay), (bx, by), dt, sd, limits)
    # Deviation of the last position from constant velocity's prediction; an acceleration displaces it by `lever` times
    # its value.
    ratio, lever = dt[1] / dt[0], dt[1] * 0.5 * (dt[0] + dt[1])
    noise = float(np.linalg.norm(sd * (ratio, 1 + ratio, 1)))
    deviation = np.hypot(bx - ratio * ax, by - ratio * ay)
    steady = deviation <= limits.max_acceleration_px_per_s2 * lever + limits.jitter_sigmas * noise
    variance = noise**2 + (TYPICAL_ACCELERATION_FRACTION * limits.max_acceleration_px_per_s2 * lever) ** 2
    kept = np.flatnonzero(goes_on & steady)
    counts = (len(ax), int(np.sum(~goes_on)), int(np.sum(goes_on & ~steady)))
    return LinkPairs(link_01[kept], link_12[kept], 0.5 * deviation[kept] ** 2 / variance, counts)


def triples_pass(states: tuple[DetectionStates, DetectionStates, DetectionStates], limits: Limits) -> Mask:
    """(n,) whether each of n chosen triples, row i of all three states, passes every gate of a tracklet."""
    before, after = gate_links(states[0], states[1], limits), gate_links(states[1], states[2], limits)
    pairs = gate_link_pairs(states, before, after, limits)
    first, middle = before.first[pairs.link_01], before.second[pairs.link_01]
    passes = np.zeros(states[0].x_px.size, np.bool_)
    passes[first[(first == middle) & (middle == after.second[pairs.link_12])]] = True
    return passes


def _turn_passes(
    a: tuple[FloatArray, FloatArray],
    b: tuple[FloatArray, FloatArray],
    dt: tuple[float, float],
    sd: FloatArray,
    limits: Limits,
) -> Mask:
    """Whether the direction changes by no more than the limit between two segments (x and y, (m,) each); slow ones have
    none and pass."""
    length_a, length_b, sigmas = np.hypot(*a), np.hypot(*b), limits.jitter_sigmas
    slow = length_a <= limits.stationary_speed_px_per_s * dt[0] + sigmas * np.hypot(sd[0], sd[1])
    slow |= length_b <= limits.stationary_speed_px_per_s * dt[1] + sigmas * np.hypot(sd[1], sd[2])
    # An error of the middle position changes both directions, in opposite senses.
    per_a, per_b = 1 / np.maximum(length_a, 1e-9), 1 / np.maximum(length_b, 1e-9)
    noise = np.sqrt((sd[0] * per_a) ** 2 + (sd[1] * (per_a + per_b)) ** 2 + (sd[2] * per_b) ** 2)
    turn = abs(np.arctan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1]))
    return np.asarray(slow | (turn <= limits.max_turn_rad + sigmas * noise))
