"""Entropy of the Hough histogram of undistorted edge points: the paper's measure of straightness under a lens.

Paper: camera calibration by the plumb line. Edge points are undistorted together with their tangents. Points of one
straight line then have the same angle and the same distance from the origin, so the histogram is peaked: its entropy
is minimal for the lens that makes lines straight. The angle alone has a wide basin of attraction, angle and distance
together a sharp minimum.
"""

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, IntArray
from velfield.camera.edges import Arcs
from velfield.camera.lens import Lens


def linear_bin_weights(values: FloatArray, width: float) -> tuple[IntArray, FloatArray]:
    """Lower bin of each value and the weight of the next bin (linear binning): the entropy is continuous."""
    position = values / width
    lower = np.floor(position)
    return lower.astype(np.int64), position - lower


def entropy_nats(weights: NDArray[np.floating | np.integer]) -> float:
    """Entropy of a distribution of these weights, nats."""
    probability = weights[weights > 0] / weights.sum()
    return float(-np.sum(probability * np.log(probability)))


def hough_entropy(arcs: Arcs, lens: Lens, *, angle_bins: int, distance_bin_px: float) -> float:
    """Entropy, in nats, of the histogram of the angle and distance of lines through undistorted edge points.

    Each frame has its own histogram, of ``angle_bins`` over half a turn and of distances from the centroid of the
    points, undistorted px. Infinity if a point is outside the lens's domain. A lens that stretches the image spreads
    the distances over more bins without bending a line; the mean logarithm of the stretch is subtracted.
    """
    xy = lens.undistort_points(arcs.xy)
    tangents = lens.undistort_tangents(arcs.xy, arcs.tangents)
    if not np.all(np.isfinite(xy)):
        return float("inf")
    angle = np.mod(np.arctan2(tangents[:, 1], tangents[:, 0]), np.pi)
    low, upper = linear_bin_weights(angle, np.pi / angle_bins)
    angle_keys = [np.mod(low, angle_bins), np.mod(low + 1, angle_bins)]
    angle_weights = [1.0 - upper, upper]
    unit = tangents / np.linalg.norm(tangents, axis=1, keepdims=True)
    normal = np.stack([-unit[:, 1], unit[:, 0]], axis=1)
    normal *= np.where(normal[:, 1:] < 0, -1.0, 1.0)
    origin = arcs.xy.mean(axis=0)
    distance = np.sum((xy - origin) * normal, axis=1)
    low, upper = linear_bin_weights(distance, distance_bin_px)
    keys, weights = [], []
    frame = arcs.frame[arcs.arc]
    for angle_key, angle_weight in zip(angle_keys, angle_weights, strict=True):
        for distance_key, distance_weight in ((low, 1.0 - upper), (low + 1, upper)):
            keys.append((frame * angle_bins + angle_key) * 65536 + distance_key + 32768)
            weights.append(angle_weight * distance_weight)
    _, inverse = np.unique(np.concatenate(keys), return_inverse=True)
    entropy = entropy_nats(np.bincount(inverse, weights=np.concatenate(weights)))
    return entropy - _mean_log_stretch(arcs, xy)


def _mean_log_stretch(arcs: Arcs, xy: FloatArray) -> float:
    """Mean logarithm of the radial stretch at the points: distances between lines grow by about that factor."""
    radius_raw = np.linalg.norm(arcs.xy - arcs.xy.mean(axis=0), axis=1)
    radius = np.linalg.norm(xy - arcs.xy.mean(axis=0), axis=1)
    ratio = np.where(radius_raw > 1.0, radius / np.maximum(radius_raw, 1.0), 1.0)
    return float(np.mean(np.log(np.maximum(ratio, 1e-6))))
