"""Whether the camera looks down: the horizon of the ground plane, from the directions of lines.

Streets, kerbs and roofs keep to few directions. Seen from above, lines of one direction are parallel; seen at an angle
they converge, and a rectification makes them parallel again: the perspective under which the angles of the lines have
the least entropy gives the horizon, its distance from the image's middle the tilt. As for the lens, no line needs to
be assigned to a family.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from schemas.arrays import FloatArray, GreyImage, IntArray
from velfield.camera.edges import Arcs, detect_and_pool_arcs
from velfield.camera.entropy import entropy_nats, linear_bin_weights
from velfield.camera.lens import Lens

MIN_GAIN_NATS = 0.1
"""Smallest decrease of the entropy for which a tilt is reported: from above it reaches 0.02, at 45 degrees 0.15 and
more."""
MIN_CONVERGENCE = 0.33
"""Smallest convergence of which a tilt is reported, 1 / half-diagonal: 33 degrees, where the far side of the image has
half the scale of the near one. Crossings of streets at other than right angles give up to 28 degrees from above."""
MIN_TURN = 0.2
"""As much against a base image, whose lines need not be guessed at: 22 degrees."""
MIN_ARCS = 150
"""On fewer, as of a crossing of curved kerbs, the entropy may fall to the end of the range."""
_ANGLE_BINS = 90
_MAX_CONVERGENCE = 0.7
_END = 0.97 * _MAX_CONVERGENCE  # of the range: no minimum
_GRID = (0.15, 0.3, 0.45, 0.6)
_DIRECTIONS = 16
_MIN_DEPTH = 0.15
_MAX_POINTS = 20_000
FOCAL_HALF_DIAGONALS = 2.0
"""Focal length of a usual drone camera, half-diagonals: 1.25 widths of a frame of 4 : 3."""


@dataclass(frozen=True)
class Tilt:
    """Perspective of the ground plane."""

    convergence: tuple[float, float]
    """(2,) the horizon is where ``1 + convergence @ x = 0``, x in half-diagonals from the image's middle."""
    gain_nats: float
    """Decrease of the entropy of the lines' angles by its rectification."""

    @property
    def degrees(self) -> float:
        """Angle between the camera's axis and the vertical, for a usual focal length."""
        return float(np.degrees(np.arctan(FOCAL_HALF_DIAGONALS * np.hypot(*self.convergence))))

    @property
    def is_oblique(self) -> bool:
        """Whether the camera looks at the ground at an angle too large for a map."""
        size = float(np.hypot(*self.convergence))
        return self.gain_nats >= MIN_GAIN_NATS and MIN_CONVERGENCE <= size < _END


def tilt_of_frames(frames: Sequence[GreyImage], lens: Lens) -> Tilt | None:
    """Estimate the perspective of the ground from frames (h, w) uint8 of one camera; None: they show too few lines."""
    shape = (frames[0].shape[0], frames[0].shape[1])
    return estimate_tilt(detect_and_pool_arcs(frames, max_points=_MAX_POINTS), lens, shape)


def estimate_tilt(arcs: Arcs, lens: Lens, shape: tuple[int, int]) -> Tilt | None:
    """Estimate the perspective of the ground from the arcs of frames of (height, width); None: too few arcs."""
    if len(arcs.length_px) < MIN_ARCS:
        return None
    height, width = shape
    half_diagonal_px = 0.5 * float(np.hypot(width, height))
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    xy = (lens.undistort_points(arcs.xy) - middle) / half_diagonal_px
    tangents = lens.undistort_tangents(arcs.xy, arcs.tangents)
    good = np.isfinite(xy).all(axis=1) & np.isfinite(tangents).all(axis=1)
    xy, tangents, frame = xy[good], tangents[good], arcs.frame[arcs.arc[good]]

    def entropy(convergence: FloatArray) -> float:
        return _angle_entropy(xy, tangents, frame, convergence)

    angles = np.arange(_DIRECTIONS) * 2.0 * np.pi / _DIRECTIONS
    grid = [np.zeros(2), *(size * np.array([np.cos(a), np.sin(a)]) for size in _GRID for a in angles)]
    values = [entropy(one) for one in grid]
    start = grid[int(np.argmin(values))]
    simplex = start + np.array([[0.0, 0.0], [0.06, 0.0], [0.0, 0.06]])
    found = minimize(entropy, start, method="Nelder-Mead", options={"initial_simplex": simplex, "maxfev": 60})
    return Tilt((float(found.x[0]), float(found.x[1])), float(values[0] - found.fun))


def _angle_entropy(xy: FloatArray, tangents: FloatArray, frame: IntArray, convergence: FloatArray) -> float:
    """Mean entropy over the frames of the angles of lines rectified by a convergence; infinite beyond the limit.

    The image is turned about its middle only, so that the rectification neither widens nor narrows angles there.
    """
    if np.hypot(*convergence) > _MAX_CONVERGENCE:
        return float("inf")
    depth = 1.0 + xy @ convergence
    inside = depth > _MIN_DEPTH
    direction = tangents * depth[:, None] - xy * (tangents @ convergence)[:, None]
    direction = _stretch(direction, convergence)
    angle = np.mod(np.arctan2(direction[:, 1], direction[:, 0]), np.pi) / np.pi * _ANGLE_BINS
    entropies = []
    for one in np.unique(frame):
        chosen = inside & (frame == one)
        if chosen.sum() < 0.5 * (frame == one).sum():
            return float("inf")
        entropies.append(_entropy(angle[chosen]))
    return float(np.mean(entropies))


def _stretch(direction: FloatArray, convergence: FloatArray) -> FloatArray:
    """Directions in the plane of the ground: along the tilt it is foreshortened by the cosine of the tilt."""
    size = float(np.hypot(*convergence))
    if size < 1e-9:
        return direction
    along = convergence / size
    cosine = np.cos(np.arctan(FOCAL_HALF_DIAGONALS * size))
    return np.asarray(direction + (1.0 / cosine - 1.0) * (direction @ along)[:, None] * along)


def _entropy(position: FloatArray) -> float:
    """Entropy, nats, of positions in the bins of a circle, linearly binned and smoothed."""
    low, upper = linear_bin_weights(position, 1.0)
    counts = np.bincount(np.mod(low, _ANGLE_BINS), 1.0 - upper, _ANGLE_BINS)
    counts = counts + np.bincount(np.mod(low + 1, _ANGLE_BINS), upper, _ANGLE_BINS)
    smooth = 0.5 * counts + 0.25 * (np.roll(counts, 1) + np.roll(counts, -1))
    return entropy_nats(smooth)
