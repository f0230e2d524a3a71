"""What a link between two detections, and a pair of links, may look like: the paper's gates in physical terms.

Every gate is a physical limit times the true interval plus ``jitter_sigmas`` standard deviations of what jitter alone
does to the tested quantity. Jitter does not shrink with the interval: at 25 frames a second and half a pixel of it,
the paper's acceleration gate taken alone would drop 99 % of the true tracklets, and 96 % of the parked cars would
"move".

A rejected candidate is counted once, under the first gate it fails (`velfield.tracking.limits.GateLog`).
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from schemas.arrays import FloatArray, IntArray
from velfield.tracking.limits import Limits

DEFAULT_AXIS_SD_RAD = 0.1
"""Standard deviation of an axis that came without one: what the structure tensor reaches (median error 3.4-5
degrees)."""
MIN_AXIS_SD_RAD = 0.05
"""No axis is believed better than this: cars slip, turn and lean."""


@dataclass(frozen=True)
class Places:
    """Where the detections of one frame are, as the gates read them.

    Attributes
    ----------
    x_px, y_px
        (n,) base px.
    axis_rad, axis_sd_rad
        (n,) axial, [0, pi); NaN where the axis is not known, and then it is not tested.
    sd_px
        Standard deviation of a place along one axis, base px.
    time_s
        Time of the frame.
    """

    x_px: FloatArray
    y_px: FloatArray
    axis_rad: FloatArray
    axis_sd_rad: FloatArray
    sd_px: float
    time_s: float


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


def gated_links(before: Places, after: Places, limits: Limits) -> Links:
    """Every pair of detections of two frames that one car could be, by speed and axis.

    Parameters
    ----------
    before, after
        Detections of the earlier and of the later frame.
    limits
        The gates.

    Returns
    -------
    Links
        Sorted by the earlier detection, then the later one.
    """
    interval = after.time_s - before.time_s
    noise = float(np.hypot(before.sd_px, after.sd_px))
    widening = limits.jitter_sigmas * noise
    reach = limits.max_speed_px_per_s * interval + widening
    order = np.argsort(after.y_px, kind="stable")  # the reach is a band of rows: two binary searches bound it
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
        limits.slow_px_per_s * interval + widening,
        limits.max_axis_offset_rad,
        noise,
        limits.jitter_sigmas,
    )
    ranked = np.lexsort((second, first))
    counts = (int(rejected[0]), int(rejected[1]), int(rejected[2]))
    return Links(first[ranked], second[ranked], cost[ranked], interval, counts)


@njit(cache=True, nogil=True)
def _axis_offset(dx, dy, axis):  # type: ignore[no-untyped-def]
    """Angle between a motion and an axis, [0, pi/2]."""
    along = abs(dx * np.cos(axis) + dy * np.sin(axis))
    across = abs(dy * np.cos(axis) - dx * np.sin(axis))
    return np.arctan2(across, along)


@njit(cache=True, nogil=True)
def _axis_test(dx, dy, axis, axis_sd, slow, max_offset, noise, sigmas):  # type: ignore[no-untyped-def]
    """Whether motion follows one detection's axis, and half its squared sideways part in standard deviations."""
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


@njit(cache=True, nogil=True)
def _links(x0, y0, a0, s0, x1, y1, a1, s1, order, low, high, reach, slow, max_offset, noise, sigmas):  # type: ignore[no-untyped-def]
    """Pairs within reach whose motion follows both axes; counts of the pairs tried and rejected."""
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
        (m,) half the squared departure from constant velocity, in standard deviations.
    rejected
        Counts: tried, by turn, by acceleration.
    """

    link_01: IntArray
    link_12: IntArray
    motion_cost: FloatArray
    rejected: tuple[int, int, int]


def gated_pairs(places: tuple[Places, Places, Places], before: Links, after: Links, limits: Limits) -> LinkPairs:
    """Every pair of consecutive links that one car could make, by turn and acceleration.

    Parameters
    ----------
    places
        Detections of the three frames of the window.
    before, after
        Links from the first frame to the middle one, and from the middle one to the last.
    limits
        The gates.
    """
    begins = np.searchsorted(after.first, np.arange(places[1].x_px.size + 1))
    link_01, link_12, cost, rejected = _pairs(
        places[0].x_px,
        places[0].y_px,
        places[1].x_px,
        places[1].y_px,
        places[2].x_px,
        places[2].y_px,
        before.first,
        before.second,
        after.second,
        begins,
        np.array([before.interval_s, after.interval_s]),
        np.array([p.sd_px for p in places]),
        np.array(
            [
                limits.max_turn_rad,
                limits.slow_px_per_s,
                limits.max_acceleration_px_per_s2,
                limits.jitter_sigmas,
                USUAL_ACCELERATION * limits.max_acceleration_px_per_s2,
            ]
        ),
    )
    return LinkPairs(link_01, link_12, cost, (int(rejected[0]), int(rejected[1]), int(rejected[2])))


USUAL_ACCELERATION = 0.1
"""Standard deviation of a car's acceleration as a share of the gate: 2.3 m/s^2 of 23."""


@njit(cache=True, nogil=True)
def _turn_passes(ax, ay, bx, by, dt, sd, limit):  # type: ignore[no-untyped-def]
    """Whether two segments turn by no more than the limit; slow ones have no direction and pass."""
    length_a = np.hypot(ax, ay)
    length_b = np.hypot(bx, by)
    sigmas = limit[3]
    if length_a <= limit[1] * dt[0] + sigmas * np.hypot(sd[0], sd[1]):
        return True
    if length_b <= limit[1] * dt[1] + sigmas * np.hypot(sd[1], sd[2]):
        return True
    # The middle place moves both directions against each other, so its share is larger than the outer ones'.
    noise = np.sqrt((sd[0] / length_a) ** 2 + (sd[1] * (1 / length_a + 1 / length_b)) ** 2 + (sd[2] / length_b) ** 2)
    turn = abs(np.arctan2(ax * by - ay * bx, ax * bx + ay * by))
    return turn <= limit[0] + sigmas * noise


@njit(cache=True, nogil=True)
def _pairs(x0, y0, x1, y1, x2, y2, a_of, b_of, c_of, begins, dt, sd, limit):  # type: ignore[no-untyped-def]
    """Pairs of links that share their middle detection; counts of the pairs tried and rejected."""
    capacity = 0
    for i in range(b_of.size):
        capacity += begins[b_of[i] + 1] - begins[b_of[i]]
    link_01 = np.empty(capacity, np.int64)
    link_12 = np.empty(capacity, np.int64)
    cost = np.empty(capacity, np.float64)
    rejected = np.zeros(3, np.int64)
    ratio = dt[1] / dt[0]
    # The last place against the one that constant velocity predicts: a change of velocity acts over half of both
    # intervals.
    lever = dt[1] * 0.5 * (dt[0] + dt[1])
    noise = np.sqrt(sd[2] ** 2 + ((1 + ratio) * sd[1]) ** 2 + (ratio * sd[0]) ** 2)
    max_miss = limit[2] * lever + limit[3] * noise
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
            miss = np.hypot(bx - ratio * ax, by - ratio * ay)
            if miss > max_miss:
                rejected[2] += 1
                continue
            link_01[n] = i
            link_12[n] = j
            cost[n] = 0.5 * miss**2 / variance
            n += 1
    return link_01[:n], link_12[:n], cost[:n], rejected
