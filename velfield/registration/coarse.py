"""The coarse stage of inter-sensor registration: a homography good to some tens of pixels, from nothing.

Paper: SIFT at quarter size and RANSAC. SIFT knows any rotation and scale but not another season, another sensor's
tones or a negative; so what it finds is one candidate, and a search over rotations and scales by correlation of whole
pictures gives others. The grid stage that follows says which is right.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, GreyImage
from velfield.camera.lens import Lens
from velfield.registration.correlation import Look, seen_as

LEAST_INLIERS = 10
"""Fewer agreeing SIFT matches than this are chance."""

_SIFT_LEAST_SIDE_PX = 700.0
_SIFT_FEATURES = 4000
_RATIO = 0.85
_INLIER_PX = 4.0
_SEARCH_SIDE_PX = 640.0
_LEAST_HALF_PX = 12
_DISK_SHARE = 0.7  # of half the shorter side: the part of the frame that a search compares


@dataclass(frozen=True)
class Coarse:
    """A candidate: ``matrix`` (3, 3) undistorted frame px -> base px, how it was found, and its score."""

    matrix: FloatArray
    how: str
    look: Look
    score: float


@dataclass(frozen=True)
class SiftAgreement:
    """How many SIFT matches there were and how many one homography explains; ``matrix`` None where too few."""

    matrix: FloatArray | None
    matches: int
    inliers: int


def scaling(scale: float) -> FloatArray:
    """(3, 3) from a picture's pixels to those of the picture reduced by ``scale``; pixel (0, 0) is a centre."""
    shift = 0.5 * scale - 0.5
    return np.array([[scale, 0.0, shift], [0.0, scale, shift], [0.0, 0.0, 1.0]])


def reduced(grey: GreyImage, scale: float) -> GreyImage:
    """The picture at ``scale``, averaged over areas."""
    if scale >= 1.0:
        return grey
    size = max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale))
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def coarse_scale(shape: tuple[int, ...], wanted: float) -> float:
    """The reduction for SIFT: as wanted, but a small picture is not made smaller than SIFT can use.

    Examples
    --------
    >>> coarse_scale((1920, 2560), 0.25) > 0.25, coarse_scale((392, 370), 0.25)
    (True, 1.0)
    """
    return float(min(1.0, max(wanted, _SIFT_LEAST_SIDE_PX / max(shape))))


def _key_points(grey: GreyImage, scale: float) -> tuple[FloatArray, NDArray[np.float32]]:
    """Places (n, 2), px of the full picture, and root-SIFT descriptors (n, 128)."""
    sift = cv2.SIFT.create(nfeatures=_SIFT_FEATURES, contrastThreshold=0.02)
    key_points, descriptors = sift.detectAndCompute(reduced(grey, scale), None)
    if descriptors is None or len(key_points) < 2:
        return np.zeros((0, 2)), np.zeros((0, 128), dtype=np.float32)
    small = np.array([point.pt for point in key_points], dtype=np.float64)
    total = np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-6)
    return (small + 0.5) / scale - 0.5, np.sqrt(descriptors / total).astype(np.float32)


def sift_agreement(
    image: GreyImage, base: GreyImage, lens: Lens, *, wanted_scale: float, mirrored: bool = False
) -> SiftAgreement:
    """SIFT matches between a frame and the base image, and the homography that most of them follow.

    Parameters
    ----------
    image, base
        (h, w) uint8.
    lens
        Undistorts the frame's key points; the homography takes undistorted px to base px.
    wanted_scale
        Reduction of both pictures, kept from making small ones too small.
    mirrored
        Mirror the frame left to right first: to tell the user of a flipped base image, never to register by.
    """
    if mirrored:
        image = np.ascontiguousarray(image[:, ::-1])
    xy, descriptors = _key_points(image, coarse_scale(image.shape, wanted_scale))
    base_xy, base_descriptors = _key_points(base, coarse_scale(base.shape, wanted_scale))
    if min(len(xy), len(base_xy)) < LEAST_INLIERS:
        return SiftAgreement(None, min(len(xy), len(base_xy)), 0)
    source, target = _mutual_matches(lens.undistort_points(xy), descriptors, base_xy, base_descriptors)
    if len(source) < LEAST_INLIERS:
        return SiftAgreement(None, len(source), 0)
    matrix, kept = cv2.findHomography(source, target, cv2.USAC_MAGSAC, _INLIER_PX, maxIters=20_000, confidence=0.9999)
    inliers = 0 if kept is None else int(kept.sum())
    plausible = matrix is not None and inliers >= LEAST_INLIERS and _plausible(matrix, image.shape)
    return SiftAgreement(np.asarray(matrix) if plausible else None, len(source), inliers)


def _mutual_matches(
    xy: FloatArray, descriptors: NDArray[np.float32], base_xy: FloatArray, base_descriptors: NDArray[np.float32]
) -> tuple[FloatArray, FloatArray]:
    """Pairs of points whose descriptors are each other's nearest, and clearly so one way."""
    likeness = descriptors @ base_descriptors.T
    best = likeness.argmax(axis=1)
    mutual = likeness.argmax(axis=0)[best] == np.arange(len(xy))
    top = np.partition(likeness, -2, axis=1)[:, -2:]
    distance = np.sqrt(np.maximum(2.0 - 2.0 * np.sort(top, axis=1), 0.0))
    clear = distance[:, 1] < _RATIO * distance[:, 0]
    chosen = mutual & clear & np.isfinite(xy).all(axis=1)
    return xy[chosen], base_xy[best[chosen]]


def _plausible(matrix: FloatArray, shape: tuple[int, ...]) -> bool:
    """Whether a homography keeps the frame's handedness and shape about, as a camera looking down does."""
    height, width = shape[:2]
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float64)
    mapped = np.column_stack([corners, np.ones(4)]) @ matrix.T
    if np.any(mapped[:, 2] * mapped[0, 2] <= 0):
        return False
    xy = mapped[:, :2] / mapped[:, 2:]
    sides = np.roll(xy, -1, axis=0) - xy
    turn = sides[:, 0] * np.roll(sides, -1, axis=0)[:, 1] - sides[:, 1] * np.roll(sides, -1, axis=0)[:, 0]
    scale = np.linalg.norm(sides, axis=1) / np.array([width, height, width, height])
    return bool(np.all(turn > 0) and scale.max() < 5.0 * scale.min() and 0.1 < scale.mean() < 10.0)


def similarity(scale: float, rotation_rad: float, source: FloatArray, target: FloatArray) -> FloatArray:
    """(3, 3) similarity that turns from +x towards +y, scales, and takes ``source`` (2,) to ``target`` (2,)."""
    cosine, sine = scale * np.cos(rotation_rad), scale * np.sin(rotation_rad)
    turn = np.array([[cosine, -sine], [sine, cosine]])
    matrix = np.eye(3)
    matrix[:2, :2] = turn
    matrix[:2, 2] = np.asarray(target) - turn @ np.asarray(source)
    return matrix


def search_similarity(
    image: GreyImage,
    base: GreyImage,
    lens: Lens,
    *,
    scales: Sequence[float],
    rotations_rad: Sequence[float],
    near: FloatArray | None = None,
    disk_px: int = 40,
) -> list[Coarse]:
    """Try scales and rotations, and correlate a disk of the frame with all of the base image, both small.

    Parameters
    ----------
    image, base
        (h, w) uint8.
    lens
        The frame's lens.
    scales, rotations_rad
        What is tried: base px a frame px, and the turn from +x towards +y; relative to ``near`` where given.
    near
        (3, 3) undistorted frame px -> base px; what is tried is put before it, about the frame's middle.
    disk_px
        Half the side of the disk, small px: the pictures are reduced until it is that.

    Returns
    -------
    list of Coarse
        The best by each look, the highest correlation first; empty where no disk fits into the base image.
    """
    height, width = image.shape
    middle = lens.undistort_points(np.array([[(width - 1) / 2, (height - 1) / 2]]))[0]
    best: dict[Look, Coarse] = {}
    for scale in scales:
        small: _Small | None = None
        for rotation in rotations_rad:
            about = similarity(scale, rotation, middle, np.zeros(2))
            if near is not None:
                about = near @ similarity(scale, rotation, middle, middle)
                about = similarity(1.0, 0.0, _mapped(about, middle), np.zeros(2)) @ about
            small = small or _small(base, about, middle, disk_px, min(height, width))
            disk = _disk(image, lens, scaling(small.shrink) @ about, middle, small.half)
            for look, score, x, y in _best_places(disk, small):
                if look not in best or score > best[look].score:
                    # The disk's middle pixel shows where the frame's middle lies.
                    place = (np.array([x + small.half, y + small.half]) + 0.5) / small.shrink - 0.5
                    best[look] = Coarse(similarity(1.0, 0.0, np.zeros(2), place) @ about, "search", look, score)
    return sorted(best.values(), key=lambda coarse: -coarse.score)


@dataclass(frozen=True)
class _Small:
    """The base image reduced for a search: its grey, its edges, the reduction, half the disk's side in its pixels."""

    grey: GreyImage
    edges: GreyImage
    shrink: float
    half: int


def _small(base: GreyImage, about: FloatArray, middle: FloatArray, disk_px: int, side_px: int) -> _Small:
    """The base image reduced so that the frame's disk has the wanted size, or less where the base image is large."""
    stretch = float(np.linalg.norm(_mapped(about, middle + np.array([1.0, 0.0])) - _mapped(about, middle)))
    reach = _DISK_SHARE * 0.5 * side_px * stretch
    shrink = min(1.0, disk_px / reach, _SEARCH_SIDE_PX / max(base.shape))
    grey = reduced(base, shrink)
    return _Small(grey, seen_as(grey, "edges"), shrink, max(int(reach * shrink), 1))


def _mapped(matrix: FloatArray, point: FloatArray) -> FloatArray:
    mapped = matrix @ np.array([point[0], point[1], 1.0])
    return np.asarray(mapped[:2] / mapped[2])


def _disk(image: GreyImage, lens: Lens, to_small: FloatArray, middle: FloatArray, half: int) -> GreyImage:
    """The frame's middle as a square of the small base image's pixels, its own middle pixel the frame's middle."""
    centre = _mapped(to_small, middle)
    stretch = float(np.linalg.norm(_mapped(to_small, middle + np.array([1.0, 0.0])) - centre))
    grid = np.stack(np.meshgrid(np.arange(-half, half + 1), np.arange(-half, half + 1)), axis=-1).reshape(-1, 2)
    there = np.column_stack([grid + centre, np.ones(len(grid))]) @ np.linalg.inv(to_small).T
    raw = lens.distort_points(there[:, :2] / there[:, 2:])
    shrunk = min(1.0, stretch)
    raw_small = ((raw + 0.5) * shrunk - 0.5).reshape(2 * half + 1, 2 * half + 1, 2).astype(np.float32)
    return np.asarray(cv2.remap(reduced(image, shrunk), raw_small, None, cv2.INTER_LINEAR), dtype=np.uint8)


def _best_places(disk: GreyImage, small: _Small) -> list[tuple[Look, float, int, int]]:
    """By each look, the highest correlation of the disk with the small base image and its offset (x, y)."""
    if small.half < _LEAST_HALF_PX or min(np.subtract(small.grey.shape, disk.shape)) < 0 or disk.std() < 1.0:
        return []
    tones = np.nan_to_num(cv2.matchTemplate(small.grey, disk, cv2.TM_CCOEFF_NORMED), posinf=0.0, neginf=0.0)
    edges = cv2.matchTemplate(small.edges, seen_as(disk, "edges"), cv2.TM_CCOEFF_NORMED)
    edges = np.nan_to_num(edges, posinf=0.0, neginf=0.0)
    least, most, least_at, most_at = cv2.minMaxLoc(tones)
    _, steepest, _, steepest_at = cv2.minMaxLoc(edges)
    return [("tones", most, *most_at), ("inverted", -least, *least_at), ("edges", steepest, *steepest_at)]
