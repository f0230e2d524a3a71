"""Blobs linked over three frames: what goes on at one velocity is one thing that moves."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from schemas.arrays import FloatArray, IntArray
from velfield.detection.motion.blobs import Blobs, Pixels

MAX_LENGTHS_PER_S = 34.5 / 4.0
"""The paper's 78 mph in car lengths of 4 m: a speed limit that needs no ground sample distance."""
_MIN_LENGTHS_MOVED = 0.35
_MAX_AREA_RATIO = 1.8
_MISMATCH_LENGTHS = 0.15
_MISMATCH_SHARE = 0.08
_GAP_ALONG_LENGTHS = 0.4  # a windscreen between roof and bonnet; bumpers are farther apart
_GAP_TO_SHADOW_LENGTHS = 0.6  # a bonnet as grey as the road between white roof and black shadow
_GAP_ACROSS_LENGTHS = 0.15


@dataclass(frozen=True)
class Links:
    """What became of each region of the middle frame.

    Attributes
    ----------
    linked : bool (n,)
        Whether it has a partner before and one after at the same velocity.
    velocity : float64 (n, 2)
        Over the three frames, px/s; NaN where not linked.
    """

    linked: NDArray[np.bool_]
    velocity: FloatArray


@dataclass(frozen=True)
class Groups:
    """Regions of one frame, and which of them go together.

    Attributes
    ----------
    blobs, pixels, links : Blobs, Pixels, Links
    group : int64 (n,)
        Group of each region, -1 where it is not linked.
    count : int
        Number of groups.
    """

    blobs: Blobs
    pixels: Pixels
    links: Links
    group: IntArray
    count: int

    @property
    def velocity(self) -> FloatArray:
        """Mean velocity of each group, weighted by area, px/s, (count, 2)."""
        inside = self.group >= 0
        which, area = self.group[inside], self.blobs.area[inside]
        moved = area[:, None] * self.links.velocity[inside]
        sums = [np.bincount(which, weights=moved[:, k], minlength=self.count) for k in (0, 1)]
        whole = np.bincount(which, weights=area, minlength=self.count)
        return np.asarray(np.stack(sums, axis=1) / np.maximum(whole, 1e-9)[:, None], np.float64)

    @property
    def bright(self) -> IntArray:
        """Group of each region that is brighter than the background, -1 for the others."""
        return np.where(self.blobs.contrast > 0, self.group, -1)

    @property
    def dark(self) -> IntArray:
        """Group of each region that is darker than the background, -1 for the others."""
        return np.where(self.blobs.contrast < 0, self.group, -1)


def link_three(
    before: Blobs,
    middle: Blobs,
    after: Blobs,
    *,
    interval_before_s: float,
    interval_after_s: float,
    car_length_px: float,
) -> Links:
    """Partners of the middle frame's regions before and after, of like size and sign, at one velocity.

    Parameters
    ----------
    before, middle, after : Blobs
        Regions of three consecutive frames.
    interval_before_s, interval_after_s : float
        True intervals between them, s.
    car_length_px : float
        A car's usual length, working px: speed limit and tolerances scale with it.
    """
    n = len(middle)
    velocity = np.full((n, 2), np.nan)
    cost = np.full(n, np.inf)
    i_before, h = _candidates(middle, before, MAX_LENGTHS_PER_S * interval_before_s * car_length_px)
    i_after, j = _candidates(middle, after, MAX_LENGTHS_PER_S * interval_after_s * car_length_px)
    first = _pairs_of_equal(i_before, i_after, n)
    i, h, j = i_before[first[0]], h[first[0]], j[first[1]]
    v_in = (_xy(middle)[i] - _xy(before)[h]) / interval_before_s
    v_out = (_xy(after)[j] - _xy(middle)[i]) / interval_after_s
    interval = 0.5 * (interval_before_s + interval_after_s)
    total = _xy(after)[j] - _xy(before)[h]
    moved = np.hypot(*total.T)
    mismatch = np.hypot(*(v_out - v_in).T) * interval
    ratio = np.abs(np.log(before.area[h] / middle.area[i])) + np.abs(np.log(after.area[j] / middle.area[i]))
    allowed = _MISMATCH_LENGTHS * car_length_px + _MISMATCH_SHARE * 0.5 * moved
    good = (mismatch < allowed) & (moved > _MIN_LENGTHS_MOVED * car_length_px)
    score = mismatch / allowed + ratio
    order = np.argsort(-score[good], kind="stable")  # the best is written last
    cost[i[good][order]] = score[good][order]
    velocity[i[good][order]] = (total / (interval_before_s + interval_after_s))[good][order]
    return Links(np.isfinite(cost), velocity)


def group_linked(blobs: Blobs, pixels: Pixels, links: Links, *, interval_s: float, car_length_px: float) -> Groups:
    """Regions that touch, or nearly, and go at one velocity: a car's body, its windscreen's far side, its shadow.

    Parameters
    ----------
    blobs, pixels, links : Blobs, Pixels, Links
        Regions of a frame, their pixels, their links over three frames.
    interval_s : float
        Time between the frames, s.
    car_length_px : float
        A car's usual length, working px.
    """
    chosen = np.flatnonzero(links.linked)
    group = np.full(len(blobs), -1, np.int64)
    if not len(chosen):
        return Groups(blobs, pixels, links, group, 0)
    xy, velocity = _xy(blobs)[chosen], links.velocity[chosen]
    pairs = KDTree(xy).query_pairs(2.0 * car_length_px, output_type="ndarray")
    a, b = pairs[:, 0], pairs[:, 1]
    step = np.hypot(*(velocity[a] - velocity[b]).T) * interval_s
    speed = np.hypot(*(velocity[a] + velocity[b]).T) / 2 * interval_s
    same = step < _MISMATCH_LENGTHS * car_length_px + _MISMATCH_SHARE * speed
    heading = np.arctan2(*(velocity[a] + velocity[b]).T[::-1])
    along, across = _gaps(blobs.take(chosen[a]), blobs.take(chosen[b]), heading)
    other_sign = np.sign(blobs.contrast[chosen[a]]) != np.sign(blobs.contrast[chosen[b]])
    allowed = np.where(other_sign, _GAP_TO_SHADOW_LENGTHS, _GAP_ALONG_LENGTHS) * car_length_px
    joined = same & (along < allowed) & (across < _GAP_ACROSS_LENGTHS * car_length_px)
    graph = coo_array((np.ones(joined.sum()), (a[joined], b[joined])), shape=(len(chosen), len(chosen)))
    count, which = connected_components(graph, directed=False)
    group[chosen] = which
    return Groups(blobs, pixels, links, group, int(count))


def _xy(blobs: Blobs) -> FloatArray:
    return np.stack([blobs.x, blobs.y], axis=1)


def _candidates(middle: Blobs, other: Blobs, radius: float) -> tuple[IntArray, IntArray]:
    """Pairs (index in middle, index in other) within a radius, of one sign and like area."""
    if not len(middle) or not len(other):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    near = KDTree(_xy(middle)).sparse_distance_matrix(KDTree(_xy(other)), radius, output_type="coo_matrix")
    i, j = near.row.astype(np.int64), near.col.astype(np.int64)
    like = np.sign(middle.contrast[i]) == np.sign(other.contrast[j])
    like &= np.abs(np.log(middle.area[i] / other.area[j])) < np.log(_MAX_AREA_RATIO)
    return i[like], j[like]


def _pairs_of_equal(left: IntArray, right: IntArray, n: int) -> tuple[IntArray, IntArray]:
    """All pairs of positions (p, q) with left[p] == right[q]."""
    order = np.argsort(right, kind="stable")
    starts = np.searchsorted(right[order], np.arange(n + 1))
    counts = starts[left + 1] - starts[left] if len(left) else np.empty(0, np.int64)
    p = np.repeat(np.arange(len(left)), counts)
    within = np.arange(len(p)) - np.repeat(np.cumsum(counts) - counts, counts)
    return p, order[np.repeat(starts[left], counts) + within] if len(p) else p


def _gaps(a: Blobs, b: Blobs, heading: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gaps between rectangles that lie along the heading: along it and across it, px; negative where they overlap."""
    dx, dy = b.x - a.x, b.y - a.y
    c, s = np.cos(heading), np.sin(heading)
    along = np.abs(c * dx + s * dy) - (a.extent_along(heading) + b.extent_along(heading)) / 2
    side = heading + np.pi / 2
    across = np.abs(c * dy - s * dx) - (a.extent_along(side) + b.extent_along(side)) / 2
    return along, across
