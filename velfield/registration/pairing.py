"""Matched frame pairs spread over a flight: the input of the multi-view lens estimate.

All pairs of frames are matched. Of those that follow a homography, the pairs are kept that constrain the lens most:
those that see the same ground at different distances from the image centre. Their matches, found on reduced frames, are
located again at full size by Lucas-Kanade: a camera that hardly moves shows the lens by hundredths of a pixel.
The lens need not be known: the threshold of a homography leaves room for its distortion, so the pairs are matched while
the plumb line is fitted.
"""

from collections.abc import Sequence
from itertools import combinations

import cv2
import numpy as np

from schemas.arrays import Float32Array, FloatArray, GreyImage, Mask
from schemas.flight import RegistrationConfig
from velfield.camera.frame_pairs import FramePairs
from velfield.camera.lens import HarrisLens, pinhole
from velfield.parallel import parallel_map
from velfield.registration.keypoints import Keypoints, Pairs, detect_keypoints, match_descriptors

_MAX_IMAGE_PX = 250_000
"""Images are downscaled to this size: SIFT is fast there and finds enough keypoints."""
_N_KEYPOINTS = 800
_N_SCREENING_KEYPOINTS = 300
"""The strongest of them, by which pairs are screened before they are matched in full."""
_MAX_PAIRS, _MAX_PAIRS_PER_FRAME = 24, 6
_MAX_MATCHES, _MIN_MATCHES, _MIN_INLIERS = 200, 40, 20
_THRESHOLD_FRACTION = 0.012
"""Inlier threshold of the homography over the image diagonal: wide enough for the distortion of an unknown lens."""
_TRIAL_DISTORTION = 0.05
_MIN_DETERMINANT = 1e-6
_WINDOW_PX, _WINDOW_LEVELS, _PATCH_PX = 21, 1, 64
"""Window of the alignment and levels above full size; the patches hold the window at half size, and what it moves."""
_MAX_ROUND_TRIP_PX = 0.2
"""Largest distance between a point and where it lies after alignment into the other frame and back."""
_MAX_CORRECTION_PX = 1.5
"""Largest correction of a match by its alignment, px of the reduced frame."""


def match_frame_pairs(frames: Sequence[GreyImage]) -> FramePairs | None:
    """The most informative pairs of frames (h, w) uint8, each with up to 200 matches; None if no two frames match."""
    shape = (frames[0].shape[0], frames[0].shape[1])
    keypoints = parallel_map(_detect, frames)

    def match(i: int, j: int, count: int) -> tuple[Pairs, float]:
        """Inlier matches of the first ``count`` keypoints, and their sensitivity to the distortion."""
        matches = match_descriptors(keypoints[i].descriptors[:count], keypoints[j].descriptors[:count])
        inliers, sensitivity_px = _find_inliers(keypoints[i].xy[matches[:, 0]], keypoints[j].xy[matches[:, 1]], shape)
        return matches[inliers], sensitivity_px

    def align(pair: tuple[float, int, int]) -> tuple[int, int, FloatArray, FloatArray] | None:
        _, i, j = pair
        matches = match(i, j, _N_KEYPOINTS)[0]
        if len(matches) < _MIN_MATCHES:
            return None
        ends = matches[np.argsort(matches[:, 0])][:_MAX_MATCHES].T
        return i, j, *align_matches(frames[i], frames[j], keypoints[i].xy[ends[0]], keypoints[j].xy[ends[1]])

    both = list(combinations(range(len(frames)), 2))
    sensitivity_px = parallel_map(lambda pair: match(*pair, _N_SCREENING_KEYPOINTS)[1], both)
    screened = [(found, *pair) for found, pair in zip(sensitivity_px, both, strict=True) if found > 0]
    aligned = [
        pair for pair in parallel_map(align, select_informative_pairs(screened, len(frames))) if pair is not None
    ]
    return _pad(aligned, shape) if aligned else None


def align_matches(
    frame_i: GreyImage, frame_j: GreyImage, xy_i: FloatArray, xy_j: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The matches (n, 2) of a frame pair that Lucas-Kanade confirms at full size, with its positions in frame j.

    Frame j is warped about the matches by their homography first, so that the windows differ by a shift. All matches,
    unchanged, where it confirms fewer than 40.
    """
    matrix, _ = cv2.findHomography(xy_j, xy_i, 0)
    if matrix is None or abs(np.linalg.det(matrix)) < _MIN_DETERMINANT:
        return xy_i, xy_j
    # One patch a match, all below each other in one picture: alignment at full size would work through whole frames.
    corners = np.rint(xy_i).astype(np.int64) - _PATCH_PX // 2
    columns, rows = (corners[:, k, None] + np.arange(_PATCH_PX) for k in (0, 1))
    places = np.empty((len(corners), _PATCH_PX, _PATCH_PX, 2), np.float32)
    places[..., 0], places[..., 1] = columns[:, None], rows[:, :, None]
    places_j = cv2.perspectiveTransform(places.reshape(-1, _PATCH_PX, 2), np.linalg.inv(matrix))
    height, width = frame_i.shape
    patches_i = frame_i[rows.clip(0, height - 1)[:, :, None], columns.clip(0, width - 1)[:, None]]
    patches_i = patches_i.reshape(-1, _PATCH_PX)
    patches_j = cv2.remap(frame_j, places_j, None, cv2.INTER_CUBIC)
    origins = corners[:, None] - np.arange(len(xy_i))[:, None, None] * [0, _PATCH_PX]
    start = (xy_i[:, None] - origins).astype(np.float32)
    guess = (cv2.perspectiveTransform(xy_j[:, None], matrix) - origins).astype(np.float32)
    moved, found = _follow(patches_i, patches_j, start, guess)
    back, found_back = _follow(patches_j, patches_i, moved, start)
    corrected = np.hypot(*(moved - guess)[:, 0].T) < _MAX_CORRECTION_PX / _image_scale(frame_i)
    kept = found & found_back & corrected & (np.hypot(*(back - start)[:, 0].T) < _MAX_ROUND_TRIP_PX)
    if kept.sum() < _MIN_MATCHES:
        return xy_i, xy_j
    there = cv2.perspectiveTransform((moved + origins)[kept].astype(np.float64), np.linalg.inv(matrix))[:, 0]
    return xy_i[kept], np.asarray(there)


def _follow(source: GreyImage, target: GreyImage, xy: Float32Array, guess: Float32Array) -> tuple[Float32Array, Mask]:
    """Positions (n, 1, 2) in the target by pyramidal Lucas-Kanade, and which were found (n,)."""
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        source,
        target,
        xy,
        guess.copy(),
        winSize=(_WINDOW_PX, _WINDOW_PX),
        maxLevel=_WINDOW_LEVELS,
        criteria=(cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 30, 0.003),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(moved, np.float32), found.ravel() > 0


def _image_scale(frame: GreyImage) -> float:
    return min(1.0, float(np.sqrt(_MAX_IMAGE_PX / frame.size)))


def _detect(frame: GreyImage) -> Keypoints:
    return detect_keypoints(frame, RegistrationConfig(keypoint_scale=_image_scale(frame)), count=_N_KEYPOINTS)


def _find_inliers(source: FloatArray, target: FloatArray, shape: tuple[int, int]) -> tuple[Mask, float]:
    """Inliers of a homography (n,), and their sensitivity to the lens: RMS px off any homography per small distortion.

    The matches are distorted by a trial lens and a homography is fitted again: what it leaves is what the pair can
    measure of a distortion.
    """
    none = np.zeros(len(source), dtype=bool)
    if len(source) < _MIN_INLIERS:
        return none, 0.0
    threshold_px = _THRESHOLD_FRACTION * float(np.hypot(*shape))
    matrix, mask = cv2.findHomography(source, target, cv2.USAC_MAGSAC, threshold_px, maxIters=2000, confidence=0.999)
    if matrix is None or mask.sum() < _MIN_INLIERS:
        return none, 0.0
    inliers = mask.ravel() > 0
    hole = pinhole(shape)
    trial = HarrisLens(_TRIAL_DISTORTION, hole.centre_x_px, hole.centre_y_px, hole.half_diagonal_px)
    distorted = trial.distort_points(source[inliers])
    distorted_target = trial.distort_points(cv2.perspectiveTransform(source[inliers][:, None], matrix)[:, 0])
    refitted, _ = cv2.findHomography(distorted, distorted_target, 0)
    if refitted is None:
        return none, 0.0
    residuals = cv2.perspectiveTransform(distorted[:, None], refitted)[:, 0] - distorted_target
    return inliers, float(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))


def select_informative_pairs(pairs: Sequence[tuple[float, int, int]], frames: int) -> list[tuple[float, int, int]]:
    """The most sensitive of pairs (sensitivity px, i, j), at most 6 with any one frame, in the order of i and j."""
    uses = np.zeros(frames, dtype=int)
    selected: list[tuple[float, int, int]] = []
    for sensitivity_px, i, j in sorted(pairs, key=lambda pair: -pair[0]):
        if len(selected) < _MAX_PAIRS and max(uses[i], uses[j]) < _MAX_PAIRS_PER_FRAME:
            uses[[i, j]] += 1
            selected.append((sensitivity_px, i, j))
    return sorted(selected, key=lambda pair: pair[1:])


def _pad(pairs: Sequence[tuple[int, int, FloatArray, FloatArray]], shape: tuple[int, int]) -> FramePairs:
    """All pairs padded to the same length by repeating their first match."""
    length = max(len(xy) for _, _, xy, _ in pairs)
    indices = [np.where(np.arange(length) < len(xy), np.arange(length), 0) for _, _, xy, _ in pairs]
    return FramePairs(
        shape,
        np.array([(i, j) for i, j, _, _ in pairs]),
        np.stack([xy_i[at] for (_, _, xy_i, _), at in zip(pairs, indices, strict=True)]),
        np.stack([xy_j[at] for (_, _, _, xy_j), at in zip(pairs, indices, strict=True)]),
        np.stack([np.arange(length) < len(xy) for _, _, xy, _ in pairs]),
    )
