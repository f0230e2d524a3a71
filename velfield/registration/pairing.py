"""Matched points between frames spread over a flight: what the lens is refined by.

Every frame is matched with every other. Of the pairs that agree on a homography, those are kept that see their common
ground at the most different places of the picture: a lens tells itself there alone.
"""

from collections.abc import Sequence
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, GreyImage
from schemas.flight import RegistrationConfig
from velfield.camera.lens import HarrisLens, Lens, pinhole
from velfield.camera.overlap import Overlap
from velfield.registration.keypoints import KeyPoints, detect_key_points
from velfield.registration.matching import Pairs, match_everywhere

_LARGEST_PX = 250_000
"""SIFT is fast on pictures of so many pixels and finds enough there."""
_KEY_POINTS = 800
_SOUGHT_BY = 300
"""Of these, the strongest: enough to see which pairs are worth matching in full."""
_MOST_PAIRS, _MOST_A_FRAME = 24, 6
_MOST_MATCHES, _LEAST_MATCHES, _LEAST_AGREEING = 200, 40, 20
_ERROR_SHARE = 0.012
"""Of the diagonal: a lens not yet known keeps matches of the picture's edge away from a homography by as much."""
_TRIAL = 0.05


def matched_pairs(frames: Sequence[GreyImage], lens: Lens) -> Overlap | None:
    """The pairs that tell most of the lens, with up to 200 matches spread over each; None where no two frames match.

    Parameters
    ----------
    frames
        (h, w) uint8, all of one size.
    lens
        The lens so far; matches follow a homography under it, generously.
    """
    shape = (frames[0].shape[0], frames[0].shape[1])
    points = [_key_points(frame) for frame in frames]
    straight = [lens.undistort_points(found.xy) for found in points]

    def matched(i: int, j: int, count: int) -> tuple[Pairs, float]:
        """Matches of the first ``count`` points that agree, and how much they tell of the lens."""
        matches = match_everywhere(points[i].descriptors[:count], points[j].descriptors[:count])
        kept, told = _agreeing(straight[i][matches[:, 0]], straight[j][matches[:, 1]], shape)
        return matches[kept], told

    sought = [(matched(i, j, _SOUGHT_BY)[1], i, j) for i, j in combinations(range(len(frames)), 2)]
    pairs = []
    for _, i, j in _most_telling([pair for pair in sought if pair[0] > 0], len(frames)):
        matches = matched(i, j, _KEY_POINTS)[0]
        if len(matches) >= _LEAST_MATCHES:
            matches = matches[np.argsort(matches[:, 0])][:_MOST_MATCHES]
            pairs.append((i, j, points[i].xy[matches[:, 0]], points[j].xy[matches[:, 1]]))
    return _padded(pairs, shape) if pairs else None


def _key_points(frame: GreyImage) -> KeyPoints:
    scale = min(1.0, float(np.sqrt(_LARGEST_PX / frame.size)))
    return detect_key_points(frame, RegistrationConfig(key_point_scale=scale), count=_KEY_POINTS)


def _agreeing(source: FloatArray, target: FloatArray, shape: tuple[int, int]) -> tuple[NDArray[np.bool_], float]:
    """Which matches follow a homography, and how many px a little distortion would take them off one (RMS)."""
    nothing = np.zeros(len(source), dtype=bool)
    if len(source) < _LEAST_AGREEING:
        return nothing, 0.0
    limit = _ERROR_SHARE * float(np.hypot(*shape))
    matrix, inliers = cv2.findHomography(source, target, cv2.USAC_MAGSAC, limit, maxIters=2000, confidence=0.999)
    if matrix is None or inliers.sum() < _LEAST_AGREEING:
        return nothing, 0.0
    kept = inliers.ravel() > 0
    hole = pinhole(shape)
    bent = HarrisLens(_TRIAL, hole.centre_x_px, hole.centre_y_px, hole.half_diagonal_px)
    seen = bent.distort_points(source[kept])
    wanted = bent.distort_points(cv2.perspectiveTransform(source[kept][:, None], matrix)[:, 0])
    fitted, _ = cv2.findHomography(seen, wanted, 0)
    if fitted is None:
        return nothing, 0.0
    off = cv2.perspectiveTransform(seen[:, None], fitted)[:, 0] - wanted
    return kept, float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def _most_telling(pairs: Sequence[tuple[float, int, int]], frames: int) -> list[tuple[float, int, int]]:
    """The pairs (told, i, j) to keep, in order: none of the frames decides alone."""
    uses = np.zeros(frames, dtype=int)
    chosen: list[tuple[float, int, int]] = []
    for told, i, j in sorted(pairs, key=lambda pair: -pair[0]):
        if len(chosen) < _MOST_PAIRS and max(uses[i], uses[j]) < _MOST_A_FRAME:
            uses[[i, j]] += 1
            chosen.append((told, i, j))
    return sorted(chosen, key=lambda pair: pair[1:])


def _padded(pairs: Sequence[tuple[int, int, FloatArray, FloatArray]], shape: tuple[int, int]) -> Overlap:
    """Every pair to one length; padding repeats the first match."""
    most = max(len(xy) for _, _, xy, _ in pairs)
    places = [np.where(np.arange(most) < len(xy), np.arange(most), 0) for _, _, xy, _ in pairs]
    return Overlap(
        shape,
        np.array([(i, j) for i, j, _, _ in pairs]),
        np.stack([xy_i[at] for (_, _, xy_i, _), at in zip(pairs, places, strict=True)]),
        np.stack([xy_j[at] for (_, _, _, xy_j), at in zip(pairs, places, strict=True)]),
        np.stack([np.arange(most) < len(xy) for _, _, xy, _ in pairs]),
    )
