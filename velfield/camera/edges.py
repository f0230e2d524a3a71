"""Edge points below the pixel, and the smooth arcs they form.

The plumb line wants directions that are good to a fraction of a degree. The gradient of one pixel is not; so edge
points are linked into chains, chains are cut where they are no smooth arc, and the direction at a point is that of the
parabola through its arc. An arc bent more than a lens bends lines is no image of a straight line and is dropped here; a
gently curved kerb is not, and is left to the robust fit.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from schemas.arrays import FloatArray, GreyImage, IntArray

_FEWEST_POINTS, _MOST_POINTS = 10, 24  # kept of an arc


@dataclass(frozen=True)
class Arcs:
    """Points of smooth arcs: ``xy`` (n, 2) raw px, unit ``tangents`` (n, 2), ``arc`` (n,) number of the arc, ascending.

    ``frame`` (arcs,) is the frame of each arc and ``length_px`` (arcs,) its chord.
    """

    xy: FloatArray
    tangents: FloatArray
    arc: IntArray
    frame: IntArray
    length_px: FloatArray

    def only(self, arcs: NDArray[np.bool_]) -> "Arcs":
        """The arcs of a mask (arcs,), numbered anew."""
        points = arcs[self.arc]
        number = np.cumsum(arcs) - 1
        return Arcs(
            self.xy[points], self.tangents[points], number[self.arc[points]], self.frame[arcs], self.length_px[arcs]
        )

    def every(self, stride: int) -> "Arcs":
        """Each ``stride``-th point."""
        step = slice(None, None, stride)
        return Arcs(self.xy[step], self.tangents[step], self.arc[step], self.frame, self.length_px)


@njit(cache=True, nogil=True)
def _edge_points(smooth, min_gradient):  # type: ignore[no-untyped-def]  # numba
    """Maxima of the gradient along its own direction: place (x, y) below the pixel and unit gradient, raster order."""
    height, width = smooth.shape
    gradient = np.zeros((height, width), dtype=np.float32)
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            gx = smooth[y, x + 1] - smooth[y, x - 1]
            gy = smooth[y + 1, x] - smooth[y - 1, x]
            gradient[y, x] = 0.5 * np.sqrt(gx * gx + gy * gy)
    place = np.full((height, width), -1, dtype=np.int32)
    points = np.empty((height * width // 4, 4), dtype=np.float32)
    count = 0
    for y in range(2, height - 2):
        for x in range(2, width - 2):
            middle = gradient[y, x]
            if middle < min_gradient:
                continue
            ux = 0.5 * (smooth[y, x + 1] - smooth[y, x - 1]) / middle
            uy = 0.5 * (smooth[y + 1, x] - smooth[y - 1, x]) / middle
            ahead = _between(gradient, x + ux, y + uy)
            behind = _between(gradient, x - ux, y - uy)
            if middle <= behind or middle < ahead or count >= points.shape[0]:
                continue
            offset = 0.5 * (behind - ahead) / (behind - 2.0 * middle + ahead)
            points[count, 0] = x + offset * ux
            points[count, 1] = y + offset * uy
            points[count, 2] = ux
            points[count, 3] = uy
            place[y, x] = count
            count += 1
    return points[:count].copy(), place


@njit(cache=True, nogil=True)
def _between(values, x, y):  # type: ignore[no-untyped-def]  # numba
    """Bilinear value at (x, y), which lies within the picture."""
    x0 = int(x)
    y0 = int(y)
    fx = x - x0
    fy = y - y0
    upper = values[y0, x0] * (1 - fx) + values[y0, x0 + 1] * fx
    lower = values[y0 + 1, x0] * (1 - fx) + values[y0 + 1, x0 + 1] * fx
    return upper * (1 - fy) + lower * fy


@njit(cache=True, nogil=True)
def _next_point(points, place, taken, current, tx, ty, reach, min_cosine):  # type: ignore[no-untyped-def]  # numba
    """The free point ahead that continues the chain best, or -1."""
    height, width = place.shape
    px, py = points[current, 0], points[current, 1]
    column, row = int(px + 0.5), int(py + 0.5)
    best = -1
    best_score = 1e9
    for y in range(max(row - reach, 0), min(row + reach + 1, height)):
        for x in range(max(column - reach, 0), min(column + reach + 1, width)):
            other = place[y, x]
            if other < 0 or taken[other]:
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


@njit(cache=True, nogil=True)
def _link(points, place, min_points, min_cosine):  # type: ignore[no-untyped-def]  # numba
    """Chains of edge points, each followed both ways from its first: numbers of points, and where each chain starts."""
    count = points.shape[0]
    taken = np.zeros(count, dtype=np.bool_)
    order = np.empty(count, dtype=np.int64)
    starts = [0]
    used = 0
    ahead_of = np.empty(count, dtype=np.int64)
    for seed in range(count):
        if taken[seed]:
            continue
        taken[seed] = True
        begin = used
        for way in (-1.0, 1.0):
            current = seed
            steps = 0
            while True:
                tx, ty = -way * points[current, 3], way * points[current, 2]
                following = _next_point(points, place, taken, current, tx, ty, 1, min_cosine)
                if following < 0:
                    following = _next_point(points, place, taken, current, tx, ty, 2, min_cosine)
                if following < 0:
                    break
                taken[following] = True
                ahead_of[steps] = following
                steps += 1
                current = following
            if way < 0:
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


@njit(cache=True, nogil=True)
def _parabola(points, order, begin, end, out):  # type: ignore[no-untyped-def]  # numba
    """Least-squares parabola over the chord of a stretch of chain; writes the residuals; returns axes and terms."""
    first, last = order[begin], order[end - 1]
    ox, oy = points[first, 0], points[first, 1]
    tx, ty = points[last, 0] - ox, points[last, 1] - oy
    chord = max(np.sqrt(tx * tx + ty * ty), 1e-6)
    tx, ty = tx / chord, ty / chord
    moments = np.zeros((3, 3))
    right = np.zeros(3)
    for i in range(begin, end):
        dx, dy = points[order[i], 0] - ox, points[order[i], 1] - oy
        s = (dx * tx + dy * ty) / chord
        d = dy * tx - dx * ty
        powers = (1.0, s, s * s)
        for a in range(3):
            right[a] += powers[a] * d
            for b in range(3):
                moments[a, b] += powers[a] * powers[b]
    for a in range(3):
        moments[a, a] += 1e-9
    terms = np.linalg.solve(moments, right)
    for i in range(begin, end):
        dx, dy = points[order[i], 0] - ox, points[order[i], 1] - oy
        s = (dx * tx + dy * ty) / chord
        out[i] = dy * tx - dx * ty - (terms[0] + terms[1] * s + terms[2] * s * s)
    return ox, oy, tx, ty, chord, terms


@njit(cache=True, nogil=True)
def _arcs(points, order, starts, min_length, tolerance, max_curvature):  # type: ignore[no-untyped-def]  # numba
    """Cut chains until a parabola fits each piece; keep long pieces that bend little: (x, y, tx, ty, arc), chords."""
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
            ox, oy, tx, ty, chord, terms = _parabola(points, order, begin, end, residual)
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
                slope = (terms[1] + 2.0 * terms[2] * s) / chord
                norm = np.sqrt(1.0 + slope * slope)
                rows[used, 0], rows[used, 1] = px, py
                rows[used, 2], rows[used, 3] = (tx - slope * ty) / norm, (ty + slope * tx) / norm
                rows[used, 4] = len(chords)
                used += 1
            chords.append(chord)
    return rows[:used].copy(), np.array(chords)


def find_arcs(
    grey: GreyImage,
    *,
    frame: int,
    smoothing_px: float = 1.2,
    edge_share: float = 0.25,
    min_gradient: float = 1.2,
    tolerance_px: float = 1.0,
    min_length_px: float,
    max_curvature_per_px: float,
) -> Arcs:
    """Smooth arcs of edge points of one frame.

    Parameters
    ----------
    grey
        (h, w) uint8.
    frame
        Number given to the arcs' frame.
    smoothing_px
        Gaussian blur before the gradient.
    edge_share
        Only the steepest share of the pixels may be edge; a city is all texture.
    min_gradient
        Grey values a pixel; below this nothing is an edge.
    tolerance_px
        Largest distance of a point from its arc's parabola.
    min_length_px
        Shortest arc, px of chord.
    max_curvature_per_px
        Most bent arc, 1 / px: what the strongest lens considered makes of a straight line.
    """
    # In whole grey values a faint edge is lost among steps.
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), smoothing_px)
    sample = smooth[::4, ::4]
    steepness = np.hypot(np.diff(sample, axis=0)[:, :-1], np.diff(sample, axis=1)[:-1]) / 4.0
    threshold = max(min_gradient, float(np.quantile(steepness, 1.0 - edge_share)))
    points, place = _edge_points(smooth, np.float32(threshold))
    order, starts = _link(points, place, int(0.7 * min_length_px), np.cos(np.radians(25.0)))
    rows, chords = _arcs(points, order, starts, min_length_px, tolerance_px, max_curvature_per_px)
    return Arcs(
        xy=np.ascontiguousarray(rows[:, :2]),
        tangents=np.ascontiguousarray(rows[:, 2:4]),
        arc=rows[:, 4].astype(np.int64),
        frame=np.full(chords.size, frame, dtype=np.int64),
        length_px=np.asarray(chords, dtype=np.float64),
    )


def pool_arcs(parts: list[Arcs], *, max_points: int) -> Arcs:
    """Arcs of several frames as one set, as points that are means of pieces of their arc, the longest arcs where all
    would be too many.

    Parameters
    ----------
    parts
        Arcs of each frame.
    max_points
        Points kept, all frames together. A long arc tells more by its length, not by its number of points, whose noise
        neighbours share: so each arc is cut into the same number of pieces, 10 to 24, the fewer the more arcs there
        are. A piece's mean has less noise than any of its points, and its bow is the same all along an arc.
    """
    offsets = np.cumsum([0, *(part.length_px.size for part in parts)])
    arc = np.concatenate([part.arc + offset for part, offset in zip(parts, offsets, strict=False)])
    length_px = np.concatenate([part.length_px for part in parts])
    frame = np.concatenate([part.frame for part in parts])
    count = length_px.size
    points_per_arc = int(np.clip(max_points // max(count, 1), _FEWEST_POINTS, _MOST_POINTS))
    sizes = np.bincount(arc, minlength=count)
    within = np.arange(arc.size) - (np.cumsum(sizes) - sizes)[arc]
    pieces = np.minimum(sizes, points_per_arc)
    piece = (np.cumsum(pieces) - pieces)[arc] + within * pieces[arc] // sizes[arc]
    xy = _means(np.concatenate([part.xy for part in parts]), piece)
    tangents = _means(np.concatenate([part.tangents for part in parts]), piece)
    tangents /= np.hypot(tangents[:, :1], tangents[:, 1:])
    longest = np.argsort(-length_px, kind="stable")
    kept = np.zeros(count, dtype=bool)
    kept[longest[: max_points // points_per_arc]] = True
    return Arcs(xy, tangents, np.repeat(np.arange(count), pieces), frame, length_px).only(kept)


def _means(values: FloatArray, group: IntArray) -> FloatArray:
    """Mean of the values (n, 2) of each group, (groups, 2); no group is empty."""
    size = np.bincount(group)
    return np.stack([np.bincount(group, weights=values[:, k]) / size for k in (0, 1)], axis=1)
