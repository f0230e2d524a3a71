"""Links blobs over three frames under a constant-velocity model, and groups those that move together."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from schemas.arrays import FloatArray, IntArray, Mask
from velfield.detection.motion.blobs import BlobPixels, Blobs

MAX_LENGTHS_PER_S = 34.5 / 4.0
"""The paper's 78 mph in car lengths of 4 m: a speed limit that needs no ground sample distance."""
_MIN_DISPLACEMENT_LENGTHS = 0.35
_MAX_AREA_RATIO = 1.8
_TOLERANCE_LENGTHS, _TOLERANCE_FRACTION = 0.15, 0.08
"""Allowed change of the displacement between frames: of a car's length, plus a fraction of the displacement."""
_MAX_GAP_ALONG_LENGTHS = 0.4  # a windscreen between roof and bonnet; bumpers are farther apart
_MAX_GAP_TO_SHADOW_LENGTHS = 0.6  # a bonnet as grey as the road between white roof and black shadow
_MAX_GAP_ACROSS_LENGTHS = 0.15


@dataclass(frozen=True)
class Links:
    """Links of the blobs of the middle frame.

    Attributes
    ----------
    linked : bool (n,)
        Whether the blob has a match before and one after, at the same velocity.
    velocity : float64 (n, 2)
        Over the three frames, px/s; NaN where not linked.
    """

    linked: Mask
    velocity: FloatArray


@dataclass(frozen=True)
class BlobGroups:
    """Blobs of one frame, and which of them belong to one moving object.

    Attributes
    ----------
    blobs, pixels, links : Blobs, BlobPixels, Links
    group : int64 (n,)
        Group of each blob, -1 where it is not linked.
    count : int
        Number of groups.
    """

    blobs: Blobs
    pixels: BlobPixels
    links: Links
    group: IntArray
    count: int

    @property
    def velocity(self) -> FloatArray:
        """Mean velocity of each group, weighted by area, px/s, (count, 2)."""
        inside = self.group >= 0
        which, area = self.group[inside], self.blobs.area[inside]
        weighted = area[:, None] * self.links.velocity[inside]
        sums = [np.bincount(which, weights=weighted[:, k], minlength=self.count) for k in (0, 1)]
        total = np.bincount(which, weights=area, minlength=self.count)
        return np.asarray(np.stack(sums, axis=1) / np.maximum(total, 1e-9)[:, None], np.float64)

    @property
    def bright(self) -> IntArray:
        """Group of each blob brighter than the background, -1 for the others."""
        return np.where(self.blobs.contrast > 0, self.group, -1)

    @property
    def dark(self) -> IntArray:
        """Group of each blob darker than the background, -1 for the others."""
        return np.where(self.blobs.contrast < 0, self.group, -1)


def link_blobs(
    before: Blobs,
    middle: Blobs,
    after: Blobs,
    *,
    interval_before_s: float,
    interval_after_s: float,
    car_length_px: float,
) -> Links:
    """Match the middle frame's blobs to those before and after, of similar area and the same sign, at one velocity.

    Of several matches the one of lowest cost is taken.

    Parameters
    ----------
    before, middle, after : Blobs
        Blobs of three consecutive frames.
    interval_before_s, interval_after_s : float
        True intervals between them, s.
    car_length_px : float
        A car's typical length, working px: speed limit and tolerances scale with it.
    """
    n = len(middle)
    velocity = np.full((n, 2), np.nan)
    cost = np.full(n, np.inf)
    i_before, h = _candidates(middle, before, MAX_LENGTHS_PER_S * interval_before_s * car_length_px)
    i_after, j = _candidates(middle, after, MAX_LENGTHS_PER_S * interval_after_s * car_length_px)
    p, q = _join_on_equal(i_before, i_after, n)
    i, h, j = i_before[p], h[p], j[q]
    v_in = (_xy(middle)[i] - _xy(before)[h]) / interval_before_s
    v_out = (_xy(after)[j] - _xy(middle)[i]) / interval_after_s
    interval = 0.5 * (interval_before_s + interval_after_s)
    total = _xy(after)[j] - _xy(before)[h]
    displacement = np.hypot(*total.T)
    mismatch = np.hypot(*(v_out - v_in).T) * interval
    log_ratio = np.abs(np.log(before.area[h] / middle.area[i])) + np.abs(np.log(after.area[j] / middle.area[i]))
    tolerance = _TOLERANCE_LENGTHS * car_length_px + _TOLERANCE_FRACTION * 0.5 * displacement
    good = (mismatch < tolerance) & (displacement > _MIN_DISPLACEMENT_LENGTHS * car_length_px)
    match_cost = mismatch / tolerance + log_ratio
    order = np.argsort(-match_cost[good], kind="stable")  # the lowest cost is written last
    cost[i[good][order]] = match_cost[good][order]
    velocity[i[good][order]] = (total / (interval_before_s + interval_after_s))[good][order]
    return Links(np.isfinite(cost), velocity)


def group_blobs(
    blobs: Blobs, pixels: BlobPixels, links: Links, *, interval_s: float, car_length_px: float
) -> BlobGroups:
    """Group blobs that are adjacent and move at one velocity: a car's roof, its bonnet, its shadow.

    Parameters
    ----------
    blobs, pixels, links : Blobs, BlobPixels, Links
        Blobs of a frame, their pixels, their links over three frames.
    interval_s : float
        Time between the frames, s.
    car_length_px : float
        A car's typical length, working px.
    """
    chosen = np.flatnonzero(links.linked)
    group = np.full(len(blobs), -1, np.int64)
    if not len(chosen):
        return BlobGroups(blobs, pixels, links, group, 0)
    xy, velocity = _xy(blobs)[chosen], links.velocity[chosen]
    pairs = KDTree(xy).query_pairs(2.0 * car_length_px, output_type="ndarray")
    a, b = pairs[:, 0], pairs[:, 1]
    difference = np.hypot(*(velocity[a] - velocity[b]).T) * interval_s
    displacement = np.hypot(*(velocity[a] + velocity[b]).T) / 2 * interval_s
    same = difference < _TOLERANCE_LENGTHS * car_length_px + _TOLERANCE_FRACTION * displacement
    heading = np.arctan2(*(velocity[a] + velocity[b]).T[::-1])
    along, across = _gaps(blobs.select(chosen[a]), blobs.select(chosen[b]), heading)
    opposite = np.sign(blobs.contrast[chosen[a]]) != np.sign(blobs.contrast[chosen[b]])
    max_gap = np.where(opposite, _MAX_GAP_TO_SHADOW_LENGTHS, _MAX_GAP_ALONG_LENGTHS) * car_length_px
    adjacent = same & (along < max_gap) & (across < _MAX_GAP_ACROSS_LENGTHS * car_length_px)
    graph = coo_array((np.ones(adjacent.sum()), (a[adjacent], b[adjacent])), shape=(len(chosen), len(chosen)))
    count, which = connected_components(graph, directed=False)
    group[chosen] = which
    return BlobGroups(blobs, pixels, links, group, int(count))


def _xy(blobs: Blobs) -> FloatArray:
    return np.stack([blobs.x, blobs.y], axis=1)


def _candidates(middle: Blobs, other: Blobs, radius: float) -> tuple[IntArray, IntArray]:
    """Pairs (index in middle, index in other) within a radius, of the same sign and similar area."""
    if not len(middle) or not len(other):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    near = KDTree(_xy(middle)).sparse_distance_matrix(KDTree(_xy(other)), radius, output_type="coo_matrix")
    i, j = near.row.astype(np.int64), near.col.astype(np.int64)
    similar = np.sign(middle.contrast[i]) == np.sign(other.contrast[j])
    similar &= np.abs(np.log(middle.area[i] / other.area[j])) < np.log(_MAX_AREA_RATIO)
    return i[similar], j[similar]


def _join_on_equal(left: IntArray, right: IntArray, n: int) -> tuple[IntArray, IntArray]:
    """Inner join: all pairs of indices (p, q) with left[p] == right[q]; values are below n."""
    order = np.argsort(right, kind="stable")
    starts = np.searchsorted(right[order], np.arange(n + 1))
    counts = starts[left + 1] - starts[left] if len(left) else np.empty(0, np.int64)
    p = np.repeat(np.arange(len(left)), counts)
    within = np.arange(len(p)) - np.repeat(np.cumsum(counts) - counts, counts)
    return p, order[np.repeat(starts[left], counts) + within] if len(p) else p


def _gaps(a: Blobs, b: Blobs, heading: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gaps between rectangles aligned with the heading, along and across it, px; negative where they overlap."""
    dx, dy = b.x - a.x, b.y - a.y
    c, s = np.cos(heading), np.sin(heading)
    along = np.abs(c * dx + s * dy) - (a.extent_along(heading) + b.extent_along(heading)) / 2
    side = heading + np.pi / 2
    across = np.abs(c * dy - s * dx) - (a.extent_along(side) + b.extent_along(side)) / 2
    return along, across
