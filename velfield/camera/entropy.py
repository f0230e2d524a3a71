"""How straight the lines of the scene are under a lens: the entropy of their Hough histogram.

Paper: camera calibration by the plumb line. Edge points are undistorted together with their tangents; points of one
straight line then share one angle and one distance from the origin, and the histogram of both is peaked: its entropy is
least for the lens that makes lines straight. The angle alone gives a wide valley (the search's start), the angle with
the distance a sharp one.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from velfield.camera.edges import Arcs
from velfield.camera.lens import Lens


def _soft_bins(values: FloatArray, width: float) -> tuple[NDArray[np.int64], FloatArray]:
    """Each value's lower bin and its share in the next: the entropy must not jump as a value crosses a border."""
    position = values / width
    lower = np.floor(position)
    return lower.astype(np.int64), position - lower


def _entropy_nats(weights: NDArray[np.floating | np.integer]) -> float:
    shares = weights[weights > 0] / weights.sum()
    return float(-np.sum(shares * np.log(shares)))


def hough_entropy(arcs: Arcs, lens: Lens, *, angle_bins: int, distance_bin_px: float | None = None) -> float:
    """Entropy, in nats, of the histogram of line angle, or of angle and distance, of undistorted edge points.

    Parameters
    ----------
    arcs
        Edge points with tangents; each frame has a histogram of its own.
    lens
        The lens that is tried.
    angle_bins
        Bins over half a turn.
    distance_bin_px
        Bin of the distance from the frame's middle, undistorted px at the centre's scale; None: angle alone.

    Returns
    -------
    float
        Infinity where a point falls outside the lens's domain. A lens that stretches the picture spreads the distances
        over more bins without bending a line; the mean logarithm of the stretch is taken off again.
    """
    xy = lens.undistort_points(arcs.xy)
    tangents = lens.undistort_tangents(arcs.xy, arcs.tangents)
    if not np.all(np.isfinite(xy)):
        return float("inf")
    angle = np.mod(np.arctan2(tangents[:, 1], tangents[:, 0]), np.pi)
    frame = arcs.frame[arcs.arc]
    low, share = _soft_bins(angle, np.pi / angle_bins)
    angle_keys = [np.mod(low, angle_bins), np.mod(low + 1, angle_bins)]
    angle_shares = [1.0 - share, share]
    if distance_bin_px is None:
        keys = np.concatenate([frame * angle_bins + key for key in angle_keys])
        return _entropy_nats(np.bincount(keys, weights=np.concatenate(angle_shares)))
    return _joint_entropy(arcs, xy, tangents, angle_keys, angle_shares, angle_bins, distance_bin_px)


def _joint_entropy(
    arcs: Arcs,
    xy: FloatArray,
    tangents: FloatArray,
    angle_keys: Sequence[NDArray[np.int64]],
    angle_shares: Sequence[FloatArray],
    angle_bins: int,
    distance_bin_px: float,
) -> float:
    """Entropy of (frame, angle, distance), less the mean log of the stretch across the line."""
    unit = tangents / np.linalg.norm(tangents, axis=1, keepdims=True)
    normal = np.stack([-unit[:, 1], unit[:, 0]], axis=1)
    normal *= np.where(normal[:, 1:] < 0, -1.0, 1.0)
    origin = arcs.xy.mean(axis=0)
    distance = np.sum((xy - origin) * normal, axis=1)
    low, share = _soft_bins(distance, distance_bin_px)
    keys, weights = [], []
    frame = arcs.frame[arcs.arc]
    for angle_key, angle_share in zip(angle_keys, angle_shares, strict=True):
        for distance_key, distance_share in ((low, 1.0 - share), (low + 1, share)):
            keys.append((frame * angle_bins + angle_key) * 65536 + distance_key + 32768)
            weights.append(angle_share * distance_share)
    _, inverse = np.unique(np.concatenate(keys), return_inverse=True)
    entropy = _entropy_nats(np.bincount(inverse, weights=np.concatenate(weights)))
    area = _log_area_stretch(arcs, xy, tangents)
    return entropy - area


def _log_area_stretch(arcs: Arcs, xy: FloatArray, tangents: FloatArray) -> float:
    """Mean logarithm of the stretch across the lines, from the arcs' own points: distances between lines grow by it."""
    radius_raw = np.linalg.norm(arcs.xy - arcs.xy.mean(axis=0), axis=1)
    radius = np.linalg.norm(xy - arcs.xy.mean(axis=0), axis=1)
    ratio = np.where(radius_raw > 1.0, radius / np.maximum(radius_raw, 1.0), 1.0)
    return float(np.mean(np.log(np.maximum(ratio, 1e-6))))
