"""Car parks, found by their parked vehicles, and the traffic through them: who enters one and leaves it without a stop.

Parked vehicles within 14 m of each other are of one area. Those that stand along the traffic beside them are at a
kerb and of none; so is a single row: an area is 10 m wide or more.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial import cKDTree

from schemas.arrays import FloatArray, IntArray, Mask
from velfield.analysis.intervals import Estimate, estimate_mean, estimate_rate, estimate_share
from velfield.analysis.lanes.junctions import buffered_hull, inside_hull
from velfield.analysis.trajectories import PathSamples

_NEAR_M, _MIN_PARKED, _MIN_WIDTH_M = 14.0, 6, 10.0
"""Between rows of parked vehicles is an aisle and half a vehicle on either side: 11 to 13 m."""
_MARGIN_M = 2.0
_BESIDE_M, _PARALLEL_RAD = 8.0, np.radians(30)
_MIN_PATH_M = 15
"""Who drives less within the area only cuts its corner."""
_STOP_S = 3.0
"""Longer than this from one sample to the next, 1 m on, is a stop."""


@dataclass(frozen=True)
class CarPark:
    """An area with parked vehicles."""

    hull_m: FloatArray
    """(n, 2) its corners."""
    parked: int
    """Parked vehicles in it."""
    entered: int
    through: int
    """Vehicles seen to drive in, and of these the ones seen to leave again without a stop."""
    through_share: Estimate | None
    through_veh_per_h: Estimate | None
    time_s: Estimate | None
    """Their share of those that enter; vehicles an hour; time that they spend inside."""
    tracks: IntArray
    """Numbers of their tracks."""


def find_car_parks(
    parked_m: FloatArray, axis_rad: FloatArray, samples: PathSamples, duration_s: float
) -> list[CarPark]:
    """Car parks and their through traffic, the largest first.

    Parameters
    ----------
    parked_m
        (n, 2) positions of parked vehicles.
    axis_rad
        (n,) their axial orientation, NaN where it is not known.
    samples
        Points along the tracks of moving vehicles, 1 m apart.
    """
    parked_m = parked_m[~_at_kerb(parked_m, axis_rad, samples)]
    if len(parked_m) < _MIN_PARKED:
        return []
    label = fcluster(linkage(parked_m, "single"), _NEAR_M, "distance")
    out = []
    for area in np.unique(label):
        xy = parked_m[label == area]
        if len(xy) >= _MIN_PARKED and min(cv2.minAreaRect(xy.astype(np.float32))[1]) >= _MIN_WIDTH_M:
            out.append(_observe(buffered_hull(xy, _MARGIN_M), len(xy), samples, duration_s))
    return sorted(out, key=lambda park: -park.parked)


def _at_kerb(parked_m: FloatArray, axis_rad: FloatArray, samples: PathSamples) -> Mask:
    """Whether each parked vehicle (n,) stands along the traffic that is nearest to it."""
    if not len(parked_m) or not len(samples):
        return np.zeros(len(parked_m), bool)
    distance, nearest = cKDTree(samples.xy_m).query(parked_m, distance_upper_bound=_BESIDE_M)
    direction = samples.direction_rad[np.minimum(nearest, len(samples) - 1)]
    turn = np.abs(np.angle(np.exp(2j * (axis_rad - direction)))) / 2
    return np.asarray(np.isfinite(distance) & (turn < _PARALLEL_RAD))


def _observe(hull: FloatArray, parked: int, samples: PathSamples, duration_s: float) -> CarPark:
    inside = np.flatnonzero(inside_hull(samples.xy_m, hull))
    breaks = np.flatnonzero((np.diff(inside) > 1) | (np.diff(samples.track[inside]) != 0)) + 1
    first, last = (
        (inside[np.r_[0, breaks]], inside[np.r_[breaks - 1, len(inside) - 1]]) if len(inside) else (inside,) * 2
    )
    track, n = samples.track, len(samples)
    enters = (first > 0) & (track[np.maximum(first - 1, 0)] == track[first])
    leaves = (last + 1 < n) & (track[np.minimum(last + 1, n - 1)] == track[last])
    far = last - first >= _MIN_PATH_M
    steps = np.r_[0.0, np.diff(samples.time_s)]
    stops = np.array([(steps[a + 1 : b + 1] > _STOP_S).any() for a, b in zip(first, last, strict=True)], bool)
    entered = np.unique(track[first[enters & far]])
    rows = np.flatnonzero(enters & leaves & far & ~stops)
    through = np.unique(track[first[rows]])
    return CarPark(
        hull,
        parked,
        len(entered),
        len(through),
        estimate_share(float(len(through)), len(entered)),
        estimate_rate(np.array([len(through)]), duration_s / 3600),
        estimate_mean(samples.time_s[last[rows]] - samples.time_s[first[rows]], samples.time_s[first[rows]]),
        through,
    )
