"""Coarse inter-sensor registration: homographies accurate to some tens of pixels, without a prior.

Paper: SIFT at quarter resolution and RANSAC. SIFT is invariant to rotation and scale, but not to another season,
another sensor's tones or a negative. So its homography is one candidate, and an exhaustive search over rotations and
scales by template matching gives others. The grid stage (`control`) and its verification decide between them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from schemas.arrays import ByteArray, Float32Array, FloatArray, GreyImage
from schemas.flight import RegistrationConfig
from velfield.camera.lens import Lens
from velfield.registration.intersensor.modality import MODALITIES, Modality, Transform
from velfield.registration.keypoints import Keypoints, detect_keypoints, is_plausible, match_descriptors
from velfield.registration.transforms import HomographyTransform, frame_corners

MIN_INLIERS = 10
"""Fewer SIFT inliers may be due to chance."""

_MIN_SIFT_SIDE_PX = 700.0
_SIFT_FEATURES = 4000
_INLIER_PX = 4.0
_SEARCH_SIDE_PX = 640.0
_MIN_TEMPLATE_HALF_PX = 12
_TEMPLATE_FRACTION = 0.7  # of half the frame's shorter side: the central part that the search compares


@dataclass(frozen=True)
class CoarseCandidate:
    """A candidate: ``matrix`` (3, 3) undistorted frame px -> base px, the method that found it, and its score."""

    matrix: FloatArray
    method: str
    modality: Modality
    score: float
    is_blind: bool = False
    """Whether it is the best of all rotations and scales, and nothing else speaks for it."""


@dataclass(frozen=True)
class SiftHomography:
    """Number of SIFT matches and inliers of one homography; ``matrix`` is None if there are too few."""

    matrix: FloatArray | None
    matches: int
    inliers: int


def scaling_matrix(scale: float) -> FloatArray:
    """(3, 3) from an image's pixels to those of the image resized by ``scale``; integers are pixel centres."""
    shift = 0.5 * scale - 0.5
    return np.array([[scale, 0.0, shift], [0.0, scale, shift], [0.0, 0.0, 1.0]])


def downscale(grey: GreyImage, scale: float) -> GreyImage:
    """The image area-averaged to ``scale``; unchanged from scale 1 on."""
    if scale >= 1.0:
        return grey
    size = max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale))
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def sift_scale(shape: tuple[int, ...], scale: float) -> float:
    """The scale for SIFT: ``scale``, but larger for images that would become too small."""
    return float(min(1.0, max(scale, _MIN_SIFT_SIDE_PX / max(shape))))


def sift_keypoints(grey: GreyImage, scale: float) -> Keypoints:
    """SIFT keypoints of an image (h, w) uint8, detected at a scale; small images are kept larger."""
    config = RegistrationConfig(keypoint_scale=sift_scale(grey.shape, scale))
    return detect_keypoints(grey, config, count=_SIFT_FEATURES)


def estimate_sift_homography(
    image: GreyImage, of_base: Keypoints, lens: Lens, *, scale: float, mirrored: bool = False
) -> SiftHomography:
    """Homography of the SIFT matches between a frame (h, w) uint8 and the base image, by MAGSAC: undistorted px to
    base px. The frame's keypoints are detected at a ``scale``.

    With ``mirrored`` the frame is flipped left to right first: to recognise a flipped base image, never to register to
    it.
    """
    if mirrored:
        image = np.ascontiguousarray(image[:, ::-1])
    of_image = sift_keypoints(image, scale)
    pairs = match_descriptors(_root(of_image.descriptors), _root(of_base.descriptors))
    source, target = lens.undistort_points(of_image.xy[pairs[:, 0]]), of_base.xy[pairs[:, 1]]
    finite = np.isfinite(source).all(axis=1)
    source, target = source[finite], target[finite]
    if len(source) < MIN_INLIERS:
        return SiftHomography(None, len(source), 0)
    matrix, mask = cv2.findHomography(source, target, cv2.USAC_MAGSAC, _INLIER_PX, maxIters=20_000, confidence=0.9999)
    inliers = 0 if mask is None else int(mask.sum())
    corners = frame_corners(image.shape[1], image.shape[0])
    found = matrix is not None and inliers >= MIN_INLIERS and is_plausible(HomographyTransform(matrix), corners)
    return SiftHomography(np.asarray(matrix) if found else None, len(source), inliers)


def _root(descriptors: ByteArray) -> Float32Array:
    """RootSIFT: more matches hold between two sensors."""
    sums = np.maximum(descriptors.sum(axis=1, keepdims=True), 1.0)
    return np.asarray(np.sqrt(descriptors / sums), np.float32)


def similarity_matrix(scale: float, rotation_rad: float, source: FloatArray, target: FloatArray) -> FloatArray:
    """(3, 3) similarity: rotation from +x towards +y and scale, mapping ``source`` (2,) to ``target`` (2,)."""
    cosine, sine = scale * np.cos(rotation_rad), scale * np.sin(rotation_rad)
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    matrix = np.eye(3)
    matrix[:2, :2] = rotation
    matrix[:2, 2] = np.asarray(target) - rotation @ np.asarray(source)
    return matrix


def search_similarity(
    image: GreyImage,
    base: GreyImage,
    lens: Lens,
    *,
    scales: Sequence[float],
    rotations_rad: Sequence[float],
    initial: FloatArray | None = None,
    template_half_px: int = 40,
) -> list[CoarseCandidate]:
    """Search over scales and rotations: match the frame's centre as a template in the base image, both downscaled.

    Candidates are base px per frame px, and rotation from +x towards +y; with ``initial`` (3, 3), undistorted frame px
    -> base px, they are applied before it, about the frame's centre. Half the side of the template, downscaled px,
    determines the downscaling. Returned are the best of each modality, highest correlation first; none if no template
    fits into the base image.
    """
    height, width = image.shape
    centre = lens.undistort_points(np.array([[(width - 1) / 2, (height - 1) / 2]]))[0]
    best: dict[str, CoarseCandidate] = {}
    for scale in scales:
        small: _ReducedBase | None = None
        for rotation in rotations_rad:
            to_base = similarity_matrix(scale, rotation, centre, np.zeros(2))
            if initial is not None:
                to_base = initial @ similarity_matrix(scale, rotation, centre, centre)
                to_base = similarity_matrix(1.0, 0.0, _map_point(to_base, centre), np.zeros(2)) @ to_base
            small = small or _reduce_base(base, to_base, centre, template_half_px, min(height, width))
            template = _cut_template(image, lens, scaling_matrix(small.scale) @ to_base, centre, small.half)
            for modality, score, x, y in _best_offsets(template, small):
                if modality.name not in best or score > best[modality.name].score:
                    # The template's central pixel shows the frame's centre.
                    position = (np.array([x + small.half, y + small.half]) + 0.5) / small.scale - 0.5
                    matrix = similarity_matrix(1.0, 0.0, np.zeros(2), position) @ to_base
                    best[modality.name] = CoarseCandidate(matrix, "search", modality, score)
    return sorted(best.values(), key=lambda candidate: -candidate.score)


@dataclass(frozen=True)
class _ReducedBase:
    """The base image downscaled for a search, by each transform of the modalities; the template's half side in it."""

    grey: GreyImage
    by_transform: Mapping[Transform, GreyImage]
    scale: float
    half: int


def _reduce_base(
    base: GreyImage, to_base: FloatArray, centre: FloatArray, template_half_px: int, side_px: int
) -> _ReducedBase:
    """Downscale the base image until the frame's template has the requested size, or further if it is large."""
    stretch = float(np.linalg.norm(_map_point(to_base, centre + np.array([1.0, 0.0])) - _map_point(to_base, centre)))
    half_side = _TEMPLATE_FRACTION * 0.5 * side_px * stretch
    scale = min(1.0, template_half_px / half_side, _SEARCH_SIDE_PX / max(base.shape))
    grey = downscale(base, scale)
    by_transform = {modality.transform: modality.transform(grey) for modality in MODALITIES.values()}
    return _ReducedBase(grey, by_transform, scale, max(int(half_side * scale), 1))


def _map_point(matrix: FloatArray, point: FloatArray) -> FloatArray:
    return np.asarray(HomographyTransform(matrix)(point[None])[0])


def _cut_template(image: GreyImage, lens: Lens, to_small: FloatArray, centre: FloatArray, half: int) -> GreyImage:
    """The frame's central square resampled to the downscaled base image's pixels."""
    mapped_centre = _map_point(to_small, centre)
    stretch = float(np.linalg.norm(_map_point(to_small, centre + np.array([1.0, 0.0])) - mapped_centre))
    grid = np.stack(np.meshgrid(np.arange(-half, half + 1), np.arange(-half, half + 1)), axis=-1).reshape(-1, 2)
    raw = lens.distort_points(HomographyTransform(to_small).inverse(grid + mapped_centre))
    scale = min(1.0, stretch)
    raw_small = ((raw + 0.5) * scale - 0.5).reshape(2 * half + 1, 2 * half + 1, 2).astype(np.float32)
    return np.asarray(cv2.remap(downscale(image, scale), raw_small, None, cv2.INTER_LINEAR), dtype=np.uint8)


def _best_offsets(template: GreyImage, base: _ReducedBase) -> list[tuple[Modality, float, int, int]]:
    """The highest correlation of the template with the downscaled base image in each modality, and its offset (x, y).

    Modalities of one transform share its correlation and differ in sign.
    """
    too_large = min(np.subtract(base.grey.shape, template.shape)) < 0
    if base.half < _MIN_TEMPLATE_HALF_PX or too_large or template.std() < 1.0:
        return []
    correlation = {
        transform: np.nan_to_num(
            cv2.matchTemplate(image, transform(template), cv2.TM_CCOEFF_NORMED), posinf=0.0, neginf=0.0
        )
        for transform, image in base.by_transform.items()
    }
    offsets = []
    for modality in MODALITIES.values():
        _, score, _, (x, y) = cv2.minMaxLoc(modality.sign * correlation[modality.transform])
        offsets.append((modality, score, x, y))
    return offsets
