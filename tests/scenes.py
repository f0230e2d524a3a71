"""Made cities for the tests of lens and inter-sensor registration: roofs, roads and grain, exactly known."""

import cv2
import numpy as np

from schemas.arrays import FloatArray, GreyImage
from velfield.camera.lens import Lens, pinhole
from velfield.registration.transforms import FrameTransform, PolyprojectiveTransform, fit_normalisation


def city(
    seed: int, side_px: int = 1200, *, blocks: int = 160, angles_deg: tuple[float, ...] = (8.0, 98.0)
) -> GreyImage:
    """A square of roofs and straight roads of a few directions, drawn anti-aliased."""
    rng = np.random.default_rng(seed)
    picture = np.full((side_px, side_px), 105, dtype=np.uint8)
    for _ in range(blocks):
        middle = rng.uniform(0, side_px, 2)
        size = rng.uniform(18, 90, 2)
        box = cv2.boxPoints(((middle[0], middle[1]), (size[0], size[1]), angles_deg[0] + rng.normal(0, 1.0)))
        cv2.fillConvexPoly(picture, np.round(box * 16).astype(np.int32), int(rng.integers(30, 230)), cv2.LINE_AA, 4)
    for _ in range(14):
        angle = np.radians(rng.choice(angles_deg) + rng.normal(0, 0.5))
        along, through = np.array([np.cos(angle), np.sin(angle)]), rng.uniform(0, side_px, 2)
        ends = np.stack([through - 3 * side_px * along, through + 3 * side_px * along])
        width = int(rng.integers(12, 30))
        for grey, thickness in ((int(rng.integers(60, 100)), width), (210, 2)):
            first, last = (tuple(int(value) for value in np.round(end * 16)) for end in ends)
            cv2.line(picture, first, last, grey, thickness, cv2.LINE_AA, 4)
    grain = cv2.GaussianBlur(rng.normal(0, 1, picture.shape), (0, 0), 3.0)
    return np.asarray(np.clip(picture + 60 * grain, 0, 255), dtype=np.uint8)


def similarity(scale: float, rotation_deg: float, source: FloatArray, target: FloatArray) -> FloatArray:
    """(3, 3): turn from +x towards +y, scale, and take one point to another."""
    cosine, sine = scale * np.cos(np.radians(rotation_deg)), scale * np.sin(np.radians(rotation_deg))
    turn = np.array([[cosine, -sine], [sine, cosine]])
    matrix = np.eye(3)
    matrix[:2, :2], matrix[:2, 2] = turn, target - turn @ source
    return matrix


def frame_map(matrix: FloatArray, shape: tuple[int, int], lens: Lens | None = None) -> FrameTransform:
    """The map of a frame of (height, width) by its lens and a homography (3, 3) of undistorted px."""
    height, width = shape
    norm = fit_normalisation(np.array([[0.0, 0.0], [width - 1, height - 1]]))
    polyprojective = PolyprojectiveTransform.from_homography(matrix, norm, norm)
    return FrameTransform(width=width, height=height, lens=lens or pinhole(shape), polyprojective=polyprojective)


def by_homography(matrix: FloatArray, xy: FloatArray) -> FloatArray:
    """Points (n, 2) mapped by (3, 3)."""
    mapped = np.column_stack([xy, np.ones(len(xy))]) @ matrix.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def photograph(ground: GreyImage, to_ground: FloatArray, lens: Lens, shape: tuple[int, int], seed: int) -> GreyImage:
    """A photograph: ``to_ground`` (3, 3) takes undistorted frame px to ground px; twofold oversampled, noisy."""
    height, width = shape
    y, x = np.mgrid[0 : 2 * height, 0 : 2 * width]
    raw = np.stack([(x.ravel() + 0.5) / 2 - 0.5, (y.ravel() + 0.5) / 2 - 0.5], axis=1)
    there = by_homography(to_ground, lens.undistort_points(raw)).reshape(2 * height, 2 * width, 2).astype(np.float32)
    fine = cv2.remap(ground, there[..., 0], there[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    seen = cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(seed).normal(0, 2.0, seen.shape)
    return np.asarray(np.clip(seen + noise, 0, 255), dtype=np.uint8)


def frame_grid(shape: tuple[int, int], step_px: int = 40) -> FloatArray:
    """Points (n, 2) all over a frame."""
    y, x = np.mgrid[0 : shape[0] : step_px, 0 : shape[1] : step_px]
    return np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)


def rms_after_homography(found: FloatArray, true: FloatArray) -> float:
    """RMS distance, px, of points (n, 2) from their truth, up to a homography: what straight lines cannot tell."""
    matrix, _ = cv2.findHomography(found, true, 0)
    return float(np.sqrt(np.mean(np.sum((by_homography(np.asarray(matrix), found) - true) ** 2, axis=1))))
