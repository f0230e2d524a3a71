"""Subpixel edge points, linked into smooth arcs.

The plumb line needs tangent directions accurate to a fraction of a degree, which the gradient of one pixel is not. So
edge points are linked into chains, chains are split until a parabola fits each piece, and the tangent at a point is
that of the parabola. Arcs of a higher curvature than a lens can cause are dropped; gently curved kerbs remain and are
left to the robust fit.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import Float32Array, FloatArray, GreyImage, IntArray, Mask
from velfield.compiled import compiled, kernel
from velfield.parallel import parallel_map

_ARC_FRACTION, _MIN_ARC_PX = 0.012, 24.0  # of the diagonal: the shortest arc
_MAX_CURVATURE = 4.0  # over the diagonal
_MIN_POINTS_PER_ARC, _MAX_POINTS_PER_ARC = 10, 24  # after pooling


@dataclass(frozen=True)
class Arcs:
    """Points of smooth arcs: ``xy`` (n, 2) raw px, unit ``tangents`` (n, 2), ``arc`` (n,) index of the arc, ascending.

    ``frame`` (arcs,) is the frame of each arc and ``length_px`` (arcs,) its chord length.
    """

    xy: FloatArray
    tangents: FloatArray
    arc: IntArray
    frame: IntArray
    length_px: FloatArray

    def select(self, arcs: Mask) -> "Arcs":
        """The arcs of a mask (arcs,), renumbered."""
        points = arcs[self.arc]
        number = np.cumsum(arcs) - 1
        return Arcs(
            self.xy[points], self.tangents[points], number[self.arc[points]], self.frame[arcs], self.length_px[arcs]
        )

    def subsample(self, stride: int) -> "Arcs":
        """Every ``stride``-th point."""
        step = slice(None, None, stride)
        return Arcs(self.xy[step], self.tangents[step], self.arc[step], self.frame, self.length_px)


@kernel
def _edge_points(smooth: Float32Array, min_gradient: np.float32) -> tuple[Float32Array, NDArray[np.int32]]:
    """Non-maximum suppression of the gradient: subpixel (x, y) and unit gradient, in raster order; index image."""
    height, width = smooth.shape
    gradient = np.zeros((height, width), dtype=np.float32)
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            gx = smooth[y, x + 1] - smooth[y, x - 1]
            gy = smooth[y + 1, x] - smooth[y - 1, x]
            gradient[y, x] = 0.5 * np.sqrt(gx * gx + gy * gy)
    index = np.full((height, width), -1, dtype=np.int32)
    points = np.empty((height * width // 4, 4), dtype=np.float32)
    count = 0
    for y in range(2, height - 2):
        for x in range(2, width - 2):
            middle = gradient[y, x]
            if middle < min_gradient:
                continue
            ux = 0.5 * (smooth[y, x + 1] - smooth[y, x - 1]) / middle
            uy = 0.5 * (smooth[y + 1, x] - smooth[y - 1, x]) / middle
            ahead = _bilinear(gradient, x + ux, y + uy)
            behind = _bilinear(gradient, x - ux, y - uy)
            if middle <= behind or middle < ahead or count >= points.shape[0]:
                continue
            offset = 0.5 * (behind - ahead) / (behind - 2.0 * middle + ahead)
            points[count, 0] = x + offset * ux
            points[count, 1] = y + offset * uy
            points[count, 2] = ux
            points[count, 3] = uy
            index[y, x] = count
            count += 1
    return points[:count].copy(), index


@kernel
def _bilinear(values: Float32Array, x: float, y: float) -> float:
    """Bilinear value at (x, y), inside the image."""
    x0 = int(x)
    y0 = int(y)
    fx = x - x0
    fy = y - y0
    upper = values[y0, x0] * (1 - fx) + values[y0, x0 + 1] * fx
    lower = values[y0 + 1, x0] * (1 - fx) + values[y0 + 1, x0 + 1] * fx
    return float(upper * (1 - fy) + lower * fy)


@kernel
def _find_next(points, index, used_points, current, tx, ty, reach, min_cosine) -> int:  # type: ignore[no-untyped-def]  # numba
    """The unused point that continues the chain best, or -1."""
    height, width = index.shape
    px, py = points[current, 0], points[current, 1]
    column, row = int(px + 0.5), int(py + 0.5)
    best = -1
    best_score = 1e9
    for y in range(max(row - reach, 0), min(row + reach + 1, height)):
        for x in range(max(column - reach, 0), min(column + reach + 1, width)):
            other = index[y, x]
            if other < 0 or used_points[other]:
                continue
            dx, dy = points[other, 0] - px, points[other, 1] - py
            ahead = dx * tx + dy * ty
            aside = abs(dx * ty - dy * tx)
            if ahead < 0.3 or aside > 0.6 * ahead:
                continue
            if points[current, 2] * points[other, 2] + points[current, 3] * points[other, 3] < min_cosine:
                continue
            score = ahead + 2.0 * aside
            if score < best_score:
                best, best_score = other, score
    return best


@kernel
def _link_chains(
    points: Float32Array, index: NDArray[np.int32], min_points: int, min_cosine: float
) -> tuple[IntArray, IntArray]:
    """Link edge points into chains, in both directions from a seed: point indices, and the start of each chain."""
    count = points.shape[0]
    used_points = np.zeros(count, dtype=np.bool_)
    order = np.empty(count, dtype=np.int64)
    starts = [0]
    used = 0
    ahead_of = np.empty(count, dtype=np.int64)
    for seed in range(count):
        if used_points[seed]:
            continue
        used_points[seed] = True
        begin = used
        for sign in (-1.0, 1.0):
            current = seed
            steps = 0
            while True:
                tx, ty = -sign * points[current, 3], sign * points[current, 2]
                successor = _find_next(points, index, used_points, current, tx, ty, 1, min_cosine)
                if successor < 0:
                    successor = _find_next(points, index, used_points, current, tx, ty, 2, min_cosine)
                if successor < 0:
                    break
                used_points[successor] = True
                ahead_of[steps] = successor
                steps += 1
                current = successor
            if sign < 0:
                for step in range(steps):
                    order[used] = ahead_of[steps - 1 - step]
                    used += 1
                order[used] = seed
                used += 1
            else:
                for step in range(steps):
                    order[used] = ahead_of[step]
                    used += 1
        if used - begin < min_points:
            used = begin
        else:
            starts.append(used)
    return order[:used].copy(), np.array(starts)


@compiled(error_model="numpy")
def _fit_parabola(
    points: Float32Array, order: IntArray, begin: int, end: int, out: FloatArray
) -> tuple[float, float, float, float, float, tuple[float, float, float]]:
    """Least-squares parabola over the chord of a piece of chain; writes the residuals, returns axes and terms."""
    first, last = order[begin], order[end - 1]
    ox, oy = points[first, 0], points[first, 1]
    tx, ty = points[last, 0] - ox, points[last, 1] - oy
    chord = max(np.sqrt(tx * tx + ty * ty), 1e-6)
    tx, ty = tx / chord, ty / chord
    n = s2 = s4 = 1e-9
    s1 = s3 = r0 = r1 = r2 = 0.0  # sums of s**k, and of s**k d
    for i in range(begin, end):
        dx, dy = points[order[i], 0] - ox, points[order[i], 1] - oy
        s = (dx * tx + dy * ty) / chord
        d = dy * tx - dx * ty
        n += 1.0
        s1 += s
        s2 += s**2
        s3 += s**3
        s4 += s**4
        r0 += d
        r1 += s * d
        r2 += s**2 * d
    # Elimination by hand: numba takes seconds to compile numpy's solver.
    a, b = s1 / n, s2 / n
    m11, m12, m22 = s2 - a * s1, s3 - a * s2, s4 - b * s2
    q1, q2 = r1 - a * r0, r2 - b * r0
    c = m12 / m11
    t2 = (q2 - c * q1) / (m22 - c * m12)
    t1 = (q1 - m12 * t2) / m11
    terms = (r0 - s1 * t1 - s2 * t2) / n, t1, t2
    for i in range(begin, end):
        dx, dy = points[order[i], 0] - ox, points[order[i], 1] - oy
        s = (dx * tx + dy * ty) / chord
        out[i] = dy * tx - dx * ty - (terms[0] + terms[1] * s + terms[2] * s * s)
    return ox, oy, tx, ty, chord, terms


@kernel
def _split_into_arcs(
    points: Float32Array, order: IntArray, starts: IntArray, min_length: float, tolerance: float, max_curvature: float
) -> tuple[FloatArray, FloatArray]:
    """Split chains until a parabola fits each piece; keep long, slightly curved ones: (x, y, tx, ty, arc), chords."""
    rows = np.empty((order.size, 5))
    chords = []  # type: ignore[var-annotated]  # numba infers it
    residual = np.zeros(order.size)
    used = 0
    for chain in range(starts.size - 1):
        stack = [(starts[chain], starts[chain + 1])]
        while len(stack) > 0:
            begin, end = stack.pop()
            if end - begin < min_length * 0.7:
                continue
            ox, oy, tx, ty, chord, terms = _fit_parabola(points, order, begin, end, residual)
            worst = begin
            for i in range(begin, end):
                if abs(residual[i]) > abs(residual[worst]):
                    worst = i
            if abs(residual[worst]) > tolerance or chord < 0.7 * (end - begin):
                middle = min(max(worst, begin + 3), end - 3)
                if chord < 0.7 * (end - begin):
                    middle = (begin + end) // 2
                stack.append((begin, middle))
                stack.append((middle, end))
                continue
            if chord < min_length or abs(2.0 * terms[2]) / chord**2 > max_curvature + 2.0 / chord**2:
                continue
            for i in range(begin, end):
                px, py = points[order[i], 0], points[order[i], 1]
                s = ((px - ox) * tx + (py - oy) * ty) / chord
                derivative = (terms[1] + 2.0 * terms[2] * s) / chord
                norm = np.sqrt(1.0 + derivative * derivative)
                rows[used, 0], rows[used, 1] = px, py
                rows[used, 2], rows[used, 3] = (tx - derivative * ty) / norm, (ty + derivative * tx) / norm
                rows[used, 4] = len(chords)
                used += 1
            chords.append(chord)
    return rows[:used].copy(), np.array(chords)


def detect_arcs(
    grey: GreyImage,
    *,
    frame: int,
    smoothing_px: float = 1.2,
    edge_fraction: float = 0.25,
    min_gradient: float = 1.2,
    tolerance_px: float = 1.0,
    min_length_px: float,
    max_curvature_per_px: float,
) -> Arcs:
    """Detect smooth arcs of edge points in one frame (h, w) uint8.

    Parameters
    ----------
    smoothing_px
        Sigma of the Gaussian blur before the gradient.
    edge_fraction
        Fraction of the pixels, those of largest gradient, that may be edges: cities are textured everywhere.
    min_gradient
        Smallest gradient of an edge, grey levels per pixel.
    tolerance_px
        Largest distance of a point from its arc's parabola.
    min_length_px
        Shortest arc, px of chord.
    max_curvature_per_px
        Largest curvature, 1 / px: that of a straight line under the strongest lens considered.
    """
    # Blurred as float: rounding to integers would quantise faint edges.
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), smoothing_px)
    sample = smooth[::4, ::4]
    magnitude = np.hypot(np.diff(sample, axis=0)[:, :-1], np.diff(sample, axis=1)[:-1]) / 4.0
    threshold = max(min_gradient, float(np.quantile(magnitude, 1.0 - edge_fraction)))
    points, index = _edge_points(smooth, np.float32(threshold))
    order, starts = _link_chains(points, index, int(0.7 * min_length_px), np.cos(np.radians(25.0)))
    rows, chords = _split_into_arcs(points, order, starts, min_length_px, tolerance_px, max_curvature_per_px)
    return Arcs(
        xy=np.ascontiguousarray(rows[:, :2]),
        tangents=np.ascontiguousarray(rows[:, 2:4]),
        arc=rows[:, 4].astype(np.int64),
        frame=np.full(chords.size, frame, dtype=np.int64),
        length_px=np.asarray(chords, dtype=np.float64),
    )


def detect_and_pool_arcs(frames: Sequence[GreyImage], *, max_points: int) -> Arcs:
    """Arcs of frames of one size, numbered in their order, with at most ``max_points`` points (`pool_arcs`)."""
    diagonal_px = float(np.hypot(*frames[0].shape))
    limits = {
        "min_length_px": max(_MIN_ARC_PX, _ARC_FRACTION * diagonal_px),
        "max_curvature_per_px": _MAX_CURVATURE / diagonal_px,
    }
    parts = parallel_map(lambda one: detect_arcs(one[1], frame=one[0], **limits), enumerate(frames))
    return pool_arcs(parts, max_points=max_points)


def pool_arcs(parts: list[Arcs], *, max_points: int) -> Arcs:
    """Pool the arcs of several frames, each reduced to means of its points; only the longest if there are too many.

    The information of an arc grows with its length, not with its number of points, whose errors are correlated: so each
    arc is divided into the same number of pieces, 10 to 24, fewer the more arcs there are, and each piece is replaced
    by its mean.
    """
    offsets = np.cumsum([0, *(part.length_px.size for part in parts)])
    arc = np.concatenate([part.arc + offset for part, offset in zip(parts, offsets, strict=False)])
    length_px = np.concatenate([part.length_px for part in parts])
    frame = np.concatenate([part.frame for part in parts])
    count = length_px.size
    points_per_arc = int(np.clip(max_points // max(count, 1), _MIN_POINTS_PER_ARC, _MAX_POINTS_PER_ARC))
    sizes = np.bincount(arc, minlength=count)
    within = np.arange(arc.size) - (np.cumsum(sizes) - sizes)[arc]
    pieces = np.minimum(sizes, points_per_arc)
    piece = (np.cumsum(pieces) - pieces)[arc] + within * pieces[arc] // sizes[arc]
    xy = _group_means(np.concatenate([part.xy for part in parts]), piece)
    tangents = _group_means(np.concatenate([part.tangents for part in parts]), piece)
    tangents /= np.hypot(tangents[:, :1], tangents[:, 1:])
    longest = np.argsort(-length_px, kind="stable")
    kept = np.zeros(count, dtype=bool)
    kept[longest[: max_points // points_per_arc]] = True
    return Arcs(xy, tangents, np.repeat(np.arange(count), pieces), frame, length_px).select(kept)


def _group_means(values: FloatArray, group: IntArray) -> FloatArray:
    """Mean of the values (n, 2) of each group, (groups, 2); groups must not be empty."""
    size = np.bincount(group)
    return np.stack([np.bincount(group, weights=values[:, k]) / size for k in (0, 1)], axis=1)
