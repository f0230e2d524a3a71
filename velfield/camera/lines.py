"""Straight lines of the scene: groups of collinear arcs, and the distances of their points from the fitted line.

Arcs that continue each other once undistorted (the sides of a row of chessboard squares, the dashes of a lane marking)
are one line. The line parameters are solved for in closed form at each trial lens, so that only the lens's three to
five parameters remain.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from schemas.arrays import FloatArray, IntArray, Mask
from velfield.camera.edges import Arcs
from velfield.camera.lens import Lens


@dataclass(frozen=True)
class LineSet:
    """Points of straight lines: raw ``xy`` and unit ``tangents`` (n, 2), ``line`` (n,) number; ``frame`` (lines,)."""

    xy: FloatArray
    tangents: FloatArray
    line: IntArray
    frame: IntArray

    @property
    def count(self) -> int:
        """Number of lines."""
        return int(self.frame.size)

    def select(self, lines: Mask) -> "LineSet":
        """The lines of a mask (lines,), renumbered."""
        points = lines[self.line]
        number = np.cumsum(lines) - 1
        return LineSet(self.xy[points], self.tangents[points], number[self.line[points]], self.frame[lines])


def fit_lines(xy: FloatArray, line: IntArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Mean (count, 2) and unit direction (count, 2) of the total-least-squares line of each group of points."""
    size = np.maximum(np.bincount(line, minlength=count), 1)
    mean = np.stack([np.bincount(line, weights=xy[:, k], minlength=count) / size for k in (0, 1)], axis=1)
    centred = xy - mean[line]
    xx = np.bincount(line, weights=centred[:, 0] ** 2, minlength=count)
    yy = np.bincount(line, weights=centred[:, 1] ** 2, minlength=count)
    xy_moment = np.bincount(line, weights=centred[:, 0] * centred[:, 1], minlength=count)
    angle = 0.5 * np.arctan2(2.0 * xy_moment, xx - yy)
    return mean, np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _fit_segments(xy: FloatArray, line: IntArray, count: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """As `fit_lines`, and where each group begins and ends along its line, from its mean (count,)."""
    mean, direction = fit_lines(xy, line, count)
    along = np.sum((xy - mean[line]) * direction[line], axis=1)
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(low, line, along)
    np.maximum.at(high, line, along)
    return mean, direction, low, high


def line_residuals(lines: LineSet, lens: Lens) -> FloatArray:
    """Signed distance of each point from its straight line, (n,) raw px; NaN outside the lens's domain.

    Distances in the undistorted image are divided by the local stretch: no lens gains by shrinking the image.
    """
    xy = lens.undistort_points(lines.xy)
    mean, direction = fit_lines(xy, lines.line, lines.count)
    normal = np.stack([-direction[:, 1], direction[:, 0]], axis=1)[lines.line]
    across = lens.undistort_tangents(lines.xy, np.stack([-lines.tangents[:, 1], lines.tangents[:, 0]], axis=1))
    stretch = np.abs(np.sum(normal * across, axis=1))
    return np.asarray(np.sum((xy - mean[lines.line]) * normal, axis=1) / np.maximum(stretch, 0.1))


def line_rms(lines: LineSet, residuals: FloatArray) -> FloatArray:
    """RMS residual of each line, (lines,) px."""
    size = np.maximum(np.bincount(lines.line, minlength=lines.count), 1)
    return np.asarray(np.sqrt(np.bincount(lines.line, weights=residuals**2, minlength=lines.count) / size))


def merge_collinear_arcs(
    arcs: Arcs, lens: Lens, *, tolerance_px: float, max_angle_rad: float, min_length_px: float
) -> LineSet:
    """Group arcs that are collinear under a lens; shorter lines are dropped.

    ``tolerance_px`` limits the distance of the shorter arc's ends from the extended line of the longer one.
    """
    xy = lens.undistort_points(arcs.xy)
    inside = np.bincount(arcs.arc, weights=~np.isfinite(xy[:, 0]), minlength=arcs.length_px.size) == 0
    arcs, xy = arcs.select(inside), xy[inside[arcs.arc]]
    count = int(arcs.length_px.size)
    mean, direction, low, high = _fit_segments(xy, arcs.arc, count)
    pairs = [
        _collinear_pairs(np.flatnonzero(arcs.frame == frame), mean, direction, low, high, tolerance_px, max_angle_rad)
        for frame in np.unique(arcs.frame)
    ]
    first, second = (np.concatenate([pair[k] for pair in pairs]) for k in (0, 1))
    graph = coo_array((np.ones(first.size), (first, second)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    line = label[arcs.arc].astype(np.int64)
    frame = np.zeros(label.max() + 1, dtype=np.int64)
    frame[label] = arcs.frame
    merged = LineSet(arcs.xy, arcs.tangents, line, frame)
    return merged.select(chord_lengths(merged) >= min_length_px)


def _collinear_pairs(
    arcs: IntArray,
    mean: FloatArray,
    direction: FloatArray,
    low: FloatArray,
    high: FloatArray,
    tolerance_px: float,
    max_angle_rad: float,
) -> tuple[IntArray, IntArray]:
    """Pairs (longer, shorter) of one frame's arcs that are collinear, with a gap shorter than the longer one."""
    ends = np.stack([mean[arcs] + low[arcs, None] * direction[arcs], mean[arcs] + high[arcs, None] * direction[arcs]])
    offset = ends[:, None] - mean[arcs][None, :, None]  # (end, longer, shorter, 2)
    away = np.abs(
        offset[..., 0] * -direction[arcs][None, :, None, 1] + offset[..., 1] * direction[arcs][None, :, None, 0]
    )
    along = np.sum(offset * direction[arcs][None, :, None], axis=-1)
    length = (high - low)[arcs]
    gap = np.maximum(along.min(axis=0) - high[arcs, None], low[arcs, None] - along.max(axis=0))
    cosine = np.abs(direction[arcs] @ direction[arcs].T)
    near = (gap < length[:, None]) & (gap > -0.2 * length[None, :]) & (length[:, None] >= length[None, :])
    # A short arc's direction is accurate to about a pixel over its length only.
    collinear = (away.max(axis=0) < tolerance_px) & (cosine > np.cos(max_angle_rad))
    longer, shorter = np.nonzero(near & collinear & ~np.eye(arcs.size, dtype=bool))
    return arcs[longer], arcs[shorter]


def chord_lengths(lines: LineSet) -> FloatArray:
    """Extent of each line along its direction, raw px."""
    _, _, low, high = _fit_segments(lines.xy, lines.line, lines.count)
    return high - low
