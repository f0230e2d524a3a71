"""Straight lines of the scene: arcs that one straight line explains, and how far their points lie from it.

The entropy says which lens; this says it to a hundredth of a pixel. Arcs that continue each other once undistorted (the
sides of a row of chessboard squares, the dashes of a lane) are one line. A line's own place is solved for at each trial
lens, so the fit has only the lens's three to five parameters.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from schemas.arrays import FloatArray, IntArray
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

    def only(self, lines: NDArray[np.bool_]) -> "LineSet":
        """The lines of a mask (lines,), numbered anew."""
        points = lines[self.line]
        number = np.cumsum(lines) - 1
        return LineSet(self.xy[points], self.tangents[points], number[self.line[points]], self.frame[lines])


def fitted_lines(xy: FloatArray, line: IntArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Mean (count, 2) and unit direction (count, 2) of the least-squares line of each group of points."""
    size = np.maximum(np.bincount(line, minlength=count), 1)
    mean = np.stack([np.bincount(line, weights=xy[:, k], minlength=count) / size for k in (0, 1)], axis=1)
    centred = xy - mean[line]
    xx = np.bincount(line, weights=centred[:, 0] ** 2, minlength=count)
    yy = np.bincount(line, weights=centred[:, 1] ** 2, minlength=count)
    xy_moment = np.bincount(line, weights=centred[:, 0] * centred[:, 1], minlength=count)
    angle = 0.5 * np.arctan2(2.0 * xy_moment, xx - yy)
    return mean, np.stack([np.cos(angle), np.sin(angle)], axis=1)


def line_residuals(lines: LineSet, lens: Lens) -> FloatArray:
    """Distance of each point from its own straight line, (n,) raw px, signed; NaN outside the lens's domain.

    The distance is taken in the undistorted picture and divided by the stretch there: no lens gains by shrinking.
    """
    xy = lens.undistort_points(lines.xy)
    mean, direction = fitted_lines(xy, lines.line, lines.count)
    normal = np.stack([-direction[:, 1], direction[:, 0]], axis=1)[lines.line]
    across = lens.undistort_tangents(lines.xy, np.stack([-lines.tangents[:, 1], lines.tangents[:, 0]], axis=1))
    stretch = np.abs(np.sum(normal * across, axis=1))
    return np.asarray(np.sum((xy - mean[lines.line]) * normal, axis=1) / np.maximum(stretch, 0.1))


def line_rms(lines: LineSet, residuals: FloatArray) -> FloatArray:
    """RMS residual of each line, (lines,) px."""
    size = np.maximum(np.bincount(lines.line, minlength=lines.count), 1)
    return np.asarray(np.sqrt(np.bincount(lines.line, weights=residuals**2, minlength=lines.count) / size))


def join_arcs(arcs: Arcs, lens: Lens, *, tolerance_px: float, max_turn_rad: float, min_length_px: float) -> LineSet:
    """Group arcs that one straight line explains under a lens.

    Parameters
    ----------
    arcs
        Arcs of all frames.
    lens
        The lens under which they are to be straight.
    tolerance_px
        How far the ends of the shorter arc may lie from the longer one's line, extended.
    max_turn_rad
        Largest angle between two arcs of a line.
    min_length_px
        Shorter lines are left out.
    """
    xy = lens.undistort_points(arcs.xy)
    count = int(arcs.length_px.size)
    outside = np.bincount(arcs.arc, weights=~np.isfinite(xy[:, 0]), minlength=count) > 0
    if outside.any():
        return join_arcs(
            arcs.only(~outside), lens, tolerance_px=tolerance_px, max_turn_rad=max_turn_rad, min_length_px=min_length_px
        )
    mean, direction = fitted_lines(xy, arcs.arc, count)
    along = np.sum((xy - mean[arcs.arc]) * direction[arcs.arc], axis=1)
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(low, arcs.arc, along)
    np.maximum.at(high, arcs.arc, along)
    pairs = [
        _joinable(np.flatnonzero(arcs.frame == frame), mean, direction, low, high, tolerance_px, max_turn_rad)
        for frame in np.unique(arcs.frame)
    ]
    first, second = (np.concatenate([pair[k] for pair in pairs]) for k in (0, 1))
    graph = coo_array((np.ones(first.size), (first, second)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    line = label[arcs.arc].astype(np.int64)
    frame = np.zeros(label.max() + 1, dtype=np.int64)
    frame[label] = arcs.frame
    joined = LineSet(arcs.xy, arcs.tangents, line, frame)
    return joined.only(chords(joined) >= min_length_px)


def _joinable(
    arcs: IntArray,
    mean: FloatArray,
    direction: FloatArray,
    low: FloatArray,
    high: FloatArray,
    tolerance_px: float,
    max_turn_rad: float,
) -> tuple[IntArray, IntArray]:
    """Pairs (longer, shorter) of one frame's arcs that lie on one line, one ending near where the other begins."""
    ends = np.stack([mean[arcs] + low[arcs, None] * direction[arcs], mean[arcs] + high[arcs, None] * direction[arcs]])
    offset = ends[:, None] - mean[arcs][None, :, None]  # (end, longer, shorter, 2)
    away = np.abs(
        offset[..., 0] * -direction[arcs][None, :, None, 1] + offset[..., 1] * direction[arcs][None, :, None, 0]
    )
    along = np.sum(offset * direction[arcs][None, :, None], axis=-1)
    length = (high - low)[arcs]
    gap = np.maximum(along.min(axis=0) - high[arcs, None], low[arcs, None] - along.max(axis=0))
    turn = np.abs(direction[arcs] @ direction[arcs].T)
    near = (gap < length[:, None]) & (gap > -0.2 * length[None, :]) & (length[:, None] >= length[None, :])
    # A short arc's direction is known to a pixel over its length, no better.
    straight = (away.max(axis=0) < tolerance_px) & (turn > np.cos(max_turn_rad))
    longer, shorter = np.nonzero(near & straight & ~np.eye(arcs.size, dtype=bool))
    return arcs[longer], arcs[shorter]


def chords(lines: LineSet) -> FloatArray:
    """Extent of each line along itself, raw px."""
    mean, direction = fitted_lines(lines.xy, lines.line, lines.count)
    along = np.sum((lines.xy - mean[lines.line]) * direction[lines.line], axis=1)
    low, high = np.full(lines.count, np.inf), np.full(lines.count, -np.inf)
    np.minimum.at(low, lines.line, along)
    np.maximum.at(high, lines.line, along)
    return np.asarray(high - low)
