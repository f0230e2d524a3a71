"""Gates on links between two detections and on pairs of links (paper: tracking), in physical units.

Every gate is a physical limit times the true interval plus ``jitter_sigmas`` standard deviations of the tested
quantity under detection jitter alone. Jitter does not shrink with the interval: at 25 frames a second and half a pixel
of it, the paper's acceleration gate alone would reject 99 % of the true tracklets, and 96 % of the parked cars would
"move".

A rejected candidate is counted once, at the first gate that it fails (`GateLog`).

Limits of the gates in base pixels and seconds, and the counts of candidates that each gate rejects.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from schemas.arrays import FloatArray, IntArray, Mask
from schemas.flight import TrackingConfig, assumed_gsd_m
from velfield.compiled import kernel


@dataclass(frozen=True)
class Limits:
    """The gates of a flight in base pixels, seconds and radians.

    Attributes
    ----------
    max_speed_px_per_s, stationary_speed_px_per_s, max_acceleration_px_per_s2
        Physical limits, base px.
    max_turn_rad, max_axis_offset_rad
        Angles between the two segments, and between motion and the car's axis.
    jitter_px, jitter_sigmas
        Standard deviation of a detection's position, base px, and by how many of them gates are widened.
    max_interval_s
        Longest interval between two frames of a window.
    """

    max_speed_px_per_s: float
    stationary_speed_px_per_s: float
    max_acceleration_px_per_s2: float
    max_turn_rad: float
    max_axis_offset_rad: float
    jitter_px: float
    jitter_sigmas: float
    max_interval_s: float

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


@dataclass
class GateLog(Mapping[str, int]):
    """Counts by gate; logs of disjoint sets of windows add up to the log of their union.

    Links of every pair of consecutive frames: ``links_tried`` (within twice the reach), of which rejected by
    ``speed``, ``axis``, and, with ``linking = pairwise``, ``appearance`` (not the mutual best in appearance). Pairs of
    links of every window: ``pairs_tried``, of which rejected by ``turn``, ``acceleration``, ``not_best`` (a pair
    through one of the same detections is cheaper) or ``confidence`` (the best, but ambiguous). Windows: ``windows``,
    ``frames_not_registered``, ``gaps_too_long``. Accepted: ``tracklets``, and ``moving_candidates``, those that weak
    candidates are part of; and of the links of both, two each, ``links_refined`` and ``links_not_refined``
    (displacement not from the crops).
    """

    counts: dict[str, int] = field(default_factory=dict)

    def add(self, gate: str, count: int) -> None:
        """Add to the count of one gate."""
        self.counts[gate] = self.counts.get(gate, 0) + int(count)

    def __add__(self, other: "GateLog") -> "GateLog":
        total = GateLog(dict(self.counts))
        for gate, count in other.items():
            total.add(gate, count)
        return total

    def __getitem__(self, gate: str) -> int:
        return self.counts.get(gate, 0)

    def __iter__(self) -> Iterator[str]:
        return iter(self.counts)

    def __len__(self) -> int:
        return len(self.counts)


DEFAULT_AXIS_SD_RAD = 0.1
"""Standard deviation of an axis given without one: the structure tensor's (median error 3.4-5 degrees)."""
MIN_AXIS_SD_RAD = 0.05
"""Lower bound of an axis's standard deviation: cars slip, turn and lean, so motion does not follow the axis exactly."""


@dataclass(frozen=True)
class DetectionStates:
    """Positions and axes of the detections of one frame, with their standard deviations.

    Attributes
    ----------
    x_px, y_px
        (n,) base px.
    axis_rad, axis_sd_rad
        (n,) axial, [0, pi); NaN: unknown, and not tested.
    sd_px
        Standard deviation of a position along x or y, base px.
    time_s
        Time of the frame.
    """

    x_px: FloatArray
    y_px: FloatArray
    axis_rad: FloatArray
    axis_sd_rad: FloatArray
    sd_px: float
    time_s: float

    def take(self, rows: IntArray) -> "DetectionStates":
        """States of the given detections, in this order; a row may occur more than once."""
        columns = {name: getattr(self, name)[rows] for name in ("x_px", "y_px", "axis_rad", "axis_sd_rad")}
        return replace(self, **columns)


@dataclass(frozen=True)
class Links:
    """Candidate links between two consecutive frames, sorted by the earlier detection.

    Attributes
    ----------
    first, second
        (m,) indices of the detections in the earlier and the later frame.
    axis_cost
        (m,) half the squared sideways displacement in standard deviations.
    interval_s
        Time from the earlier to the later frame.
    rejected
        Counts: tried, by speed, by axis.
    """

    first: IntArray
    second: IntArray
    axis_cost: FloatArray
    interval_s: float
    rejected: tuple[int, int, int]


def gate_links(before: DetectionStates, after: DetectionStates, limits: Limits) -> Links:
    """Candidate links: all pairs of detections of two frames that pass the gates on speed and axis.

    Parameters
    ----------
    before, after
        Detections of the earlier and of the later frame.
    limits
        Limits of the gates.

    Returns
    -------
    Links
        Sorted by the earlier detection, then the later one.
    """
    interval = after.time_s - before.time_s
    noise = float(np.hypot(before.sd_px, after.sd_px))
    widening = limits.jitter_sigmas * noise
    reach = limits.max_speed_px_per_s * interval + widening
    order = np.argsort(after.y_px, kind="stable")  # detections within reach lie in a band of rows: binary search
    rows = after.y_px[order]
    low = np.searchsorted(rows, before.y_px - 2 * reach, side="left")
    high = np.searchsorted(rows, before.y_px + 2 * reach, side="right")
    first, second, cost, rejected = _links(
        before.x_px,
        before.y_px,
        before.axis_rad,
        before.axis_sd_rad,
        after.x_px,
        after.y_px,
        after.axis_rad,
        after.axis_sd_rad,
        order,
        low,
        high,
        reach,
        limits.stationary_speed_px_per_s * interval + widening,
        limits.max_axis_offset_rad,
        noise,
        limits.jitter_sigmas,
    )
    ranked = np.lexsort((second, first))
    counts = (int(rejected[0]), int(rejected[1]), int(rejected[2]))
    return Links(first[ranked], second[ranked], cost[ranked], interval, counts)


@kernel
def _axis_offset(dx: float, dy: float, axis: float) -> float:
    """Angle between a motion and an axis, [0, pi/2]."""
    along = abs(dx * np.cos(axis) + dy * np.sin(axis))
    across = abs(dy * np.cos(axis) - dx * np.sin(axis))
    return float(np.arctan2(across, along))


@kernel
def _axis_test(
    dx: float, dy: float, axis: float, axis_sd: float, slow: float, max_offset: float, noise: float, sigmas: float
) -> tuple[bool, float]:
    """Whether motion is along a detection's axis, and half the squared sideways component in standard deviations."""
    if np.isnan(axis):
        return True, 0.0
    sd = DEFAULT_AXIS_SD_RAD if np.isnan(axis_sd) else max(axis_sd, MIN_AXIS_SD_RAD)
    length = np.hypot(dx, dy)
    offset = _axis_offset(dx, dy, axis)
    sideways = length * np.sin(offset)
    cost = 0.5 * sideways**2 / (noise**2 + (length * sd) ** 2)
    if length <= slow:
        return True, cost
    return offset <= max_offset + sigmas * np.hypot(sd, noise / length), cost


@kernel
def _links(  # type: ignore[no-untyped-def]
    x0, y0, a0, s0, x1, y1, a1, s1, order, low, high, reach, slow, max_offset, noise, sigmas
) -> tuple[IntArray, IntArray, FloatArray, IntArray]:
    """Pairs within reach whose motion is along both axes; counts of the pairs tried and rejected."""
    capacity = np.sum(high - low)
    first = np.empty(capacity, np.int64)
    second = np.empty(capacity, np.int64)
    cost = np.empty(capacity, np.float64)
    rejected = np.zeros(3, np.int64)
    n = 0
    for i in range(x0.size):
        for position in range(low[i], high[i]):
            j = order[position]
            dx = x1[j] - x0[i]
            dy = y1[j] - y0[i]
            length = np.hypot(dx, dy)
            if length > 2 * reach:
                continue
            rejected[0] += 1
            if length > reach:
                rejected[1] += 1
                continue
            fits_0, cost_0 = _axis_test(dx, dy, a0[i], s0[i], slow, max_offset, noise, sigmas)
            fits_1, cost_1 = _axis_test(dx, dy, a1[j], s1[j], slow, max_offset, noise, sigmas)
            if not (fits_0 and fits_1):
                rejected[2] += 1
                continue
            first[n] = i
            second[n] = j
            cost[n] = 0.5 * (cost_0 + cost_1)
            n += 1
    return first[:n], second[:n], cost[:n], rejected


@dataclass(frozen=True)
class LinkPairs:
    """Pairs of links that share their middle detection and pass the gates on turn and acceleration.

    Attributes
    ----------
    link_01, link_12
        (m,) indices of the links.
    motion_cost
        (m,) half the squared deviation from constant velocity, in standard deviations.
    rejected
        Counts: tried, by turn, by acceleration.
    """

    link_01: IntArray
    link_12: IntArray
    motion_cost: FloatArray
    rejected: tuple[int, int, int]


def gate_link_pairs(
    states: tuple[DetectionStates, DetectionStates, DetectionStates], before: Links, after: Links, limits: Limits
) -> LinkPairs:
    """All pairs of consecutive links that pass the gates on turn and acceleration.

    Parameters
    ----------
    states
        Detections of the three frames of the window.
    before, after
        Links from the first frame to the middle one, and from the middle one to the last.
    limits
        Limits of the gates.
    """
    begins = np.searchsorted(after.first, np.arange(states[1].x_px.size + 1))
    link_01, link_12, cost, rejected = _pairs(
        states[0].x_px,
        states[0].y_px,
        states[1].x_px,
        states[1].y_px,
        states[2].x_px,
        states[2].y_px,
        before.first,
        before.second,
        after.second,
        begins,
        np.array([before.interval_s, after.interval_s]),
        np.array([p.sd_px for p in states]),
        np.array(
            [
                limits.max_turn_rad,
                limits.stationary_speed_px_per_s,
                limits.max_acceleration_px_per_s2,
                limits.jitter_sigmas,
                TYPICAL_ACCELERATION_FRACTION * limits.max_acceleration_px_per_s2,
            ]
        ),
    )
    return LinkPairs(link_01, link_12, cost, (int(rejected[0]), int(rejected[1]), int(rejected[2])))


def triples_pass(states: tuple[DetectionStates, DetectionStates, DetectionStates], limits: Limits) -> Mask:
    """(n,) whether each of n chosen triples, row i of all three states, passes every gate of a tracklet."""
    before, after = gate_links(states[0], states[1], limits), gate_links(states[1], states[2], limits)
    pairs = gate_link_pairs(states, before, after, limits)
    first, middle = before.first[pairs.link_01], before.second[pairs.link_01]
    passes = np.zeros(states[0].x_px.size, np.bool_)
    passes[first[(first == middle) & (middle == after.second[pairs.link_12])]] = True
    return passes


TYPICAL_ACCELERATION_FRACTION = 0.1
"""Standard deviation of a car's acceleration as a fraction of the gate's limit: 2.3 m/s^2 of 23."""


@kernel
def _turn_passes(ax: float, ay: float, bx: float, by: float, dt: FloatArray, sd: FloatArray, limit: FloatArray) -> bool:
    """Whether the direction changes by no more than the limit between two segments; slow ones have none and pass."""
    length_a = np.hypot(ax, ay)
    length_b = np.hypot(bx, by)
    sigmas = limit[3]
    if length_a <= limit[1] * dt[0] + sigmas * np.hypot(sd[0], sd[1]):
        return True
    if length_b <= limit[1] * dt[1] + sigmas * np.hypot(sd[1], sd[2]):
        return True
    # An error of the middle position changes both directions, in opposite senses.
    noise = np.sqrt((sd[0] / length_a) ** 2 + (sd[1] * (1 / length_a + 1 / length_b)) ** 2 + (sd[2] / length_b) ** 2)
    turn = abs(np.arctan2(ax * by - ay * bx, ax * bx + ay * by))
    return bool(turn <= limit[0] + sigmas * noise)


@kernel
def _pairs(  # type: ignore[no-untyped-def]
    x0, y0, x1, y1, x2, y2, a_of, b_of, c_of, begins, dt, sd, limit
) -> tuple[IntArray, IntArray, FloatArray, IntArray]:
    """Pairs of links that share their middle detection; counts of the pairs tried and rejected."""
    capacity = 0
    for i in range(b_of.size):
        capacity += begins[b_of[i] + 1] - begins[b_of[i]]
    link_01 = np.empty(capacity, np.int64)
    link_12 = np.empty(capacity, np.int64)
    cost = np.empty(capacity, np.float64)
    rejected = np.zeros(3, np.int64)
    ratio = dt[1] / dt[0]
    # Deviation of the last position from constant velocity's prediction; an acceleration displaces it by `lever` times
    # its value.
    lever = dt[1] * 0.5 * (dt[0] + dt[1])
    noise = np.sqrt(sd[2] ** 2 + ((1 + ratio) * sd[1]) ** 2 + (ratio * sd[0]) ** 2)
    max_deviation = limit[2] * lever + limit[3] * noise
    variance = noise**2 + (limit[4] * lever) ** 2
    n = 0
    for i in range(b_of.size):
        a, b = a_of[i], b_of[i]
        ax, ay = x1[b] - x0[a], y1[b] - y0[a]
        for j in range(begins[b], begins[b + 1]):
            c = c_of[j]
            bx, by = x2[c] - x1[b], y2[c] - y1[b]
            rejected[0] += 1
            if not _turn_passes(ax, ay, bx, by, dt, sd, limit):
                rejected[1] += 1
                continue
            deviation = np.hypot(bx - ratio * ax, by - ratio * ay)
            if deviation > max_deviation:
                rejected[2] += 1
                continue
            link_01[n] = i
            link_12[n] = j
            cost[n] = 0.5 * deviation**2 / variance
            n += 1
    return link_01[:n], link_12[:n], cost[:n], rejected
