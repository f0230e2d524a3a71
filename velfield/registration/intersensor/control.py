"""Fine inter-sensor registration: control points by grid matching and the transform fitted to them, coarse to fine.

Paper: inter-sensor registration, after the coarse homography. At each pyramid level the frame is warped to the base
image's grid by the current transform, patches are matched on a grid, and a better transform is fitted; from some 400 px
of ground, where a coarse map may be far off, to full resolution, where the paper starts. There the polyprojective is
fitted by case deletion as in the paper. Its threshold of 2 px still admits outliers, so inliers are then re-selected by
the robust scale of the residuals until the set is stable.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from schemas.arrays import FloatArray, GreyImage, Mask
from schemas.flight import BaseConfig
from velfield.camera.lens import Lens
from velfield.errors import Failure
from velfield.registration.fitting import Model, fit_by_case_deletion, fit_polyprojective
from velfield.registration.intersensor.coarse import (
    CoarseCandidate,
    SiftHomography,
    downscale,
    estimate_sift_homography,
    sift_keypoints,
)
from velfield.registration.intersensor.correlation import GridMatches, match_grid
from velfield.registration.intersensor.modality import GRADIENT, Modality
from velfield.registration.keypoints import Keypoints
from velfield.registration.transforms import FrameTransform, HomographyTransform, PolyprojectiveTransform
from velfield.registration.warp import footprint, warp_to_base

FINE_RADIUS_PX = 10
"""Search radius once the map is accurate to a few pixels, px."""

_FIRST_SIDE_PX = 400.0
_TARGET_POINTS = 500
_MIN_SCORE = 0.2
_MIN_POINTS = 20
_RESELECTIONS = 20
_FOLDS = 5


@dataclass(frozen=True)
class ImagePair:
    """The two images, the frame's lens and the configuration."""

    image: GreyImage
    base: GreyImage
    lens: Lens
    config: BaseConfig

    @cached_property
    def base_keypoints(self) -> Keypoints:
        """Keypoints of the base image, to which the frame's are matched in each modality, and mirrored."""
        return sift_keypoints(self.base, self.config.coarse_scale)

    @cached_property
    def flipped(self) -> SiftHomography:
        """SIFT matches of the flipped frame to the base image."""
        return estimate_sift_homography(
            self.image, self.base_keypoints, self.lens, scale=self.config.coarse_scale, mirrored=True
        )

    def transform(self, polyprojective: PolyprojectiveTransform) -> FrameTransform:
        """The frame's map, raw px to base px: the lens, then a transform of undistorted px."""
        height, width = self.image.shape
        return FrameTransform(width=width, height=height, lens=self.lens, polyprojective=polyprojective)

    def from_homography(self, matrix: FloatArray) -> FrameTransform:
        """The frame's map with a homography (3, 3) of undistorted px."""
        height, width = self.image.shape
        return self.transform(PolyprojectiveTransform.of_frame(matrix, self.lens, width, height))


@dataclass(frozen=True)
class FineFit:
    """A transform fitted at one level, with the matches of that level and which of them are inliers."""

    transform: FrameTransform
    model: Model
    source_raw: FloatArray
    target: FloatArray
    inliers: Mask
    cv_error_px: float


def register_coarse_to_fine(pair: ImagePair, candidate: CoarseCandidate) -> FineFit | Failure:
    """Match on the grid at increasing resolution, each level starting from the transform of the one before."""
    transform = pair.from_homography(candidate.matrix)
    x0, y0, x1, y1 = footprint(transform, (pair.image.shape[0], pair.image.shape[1]))
    side = max(x1 - x0, y1 - y0)
    if not np.isfinite(side) or side < 2 * pair.config.patch_size_px:
        return Failure(f"the frame would cover {side:.0f} px of the base image")
    scale, fit = min(1.0, _FIRST_SIDE_PX / side), None
    radius = pair.config.search_radius_px
    while True:
        last = scale >= 1.0
        models: tuple[Model, ...] = ("homography", "polyprojective") if last else ("homography",)
        fit = _fit_level(pair, transform, scale, radius, candidate.modality, models)
        if isinstance(fit, Failure):
            return fit
        transform = fit.transform
        if last and radius == FINE_RADIUS_PX:
            return _refine_by_gradient(pair, fit, candidate.modality)
        # If the first level is at full resolution already, it is repeated: its patches were warped by a coarse map.
        scale, radius = min(1.0, 2.0 * scale), FINE_RADIUS_PX


def _refine_by_gradient(pair: ImagePair, fit: FineFit, modality: Modality) -> FineFit:
    """Repeat the last level by gradients; keep the fit of lower cross-validated error."""
    if modality == GRADIENT:
        return fit
    refined = _fit_level(pair, fit.transform, 1.0, FINE_RADIUS_PX, GRADIENT, ("homography", "polyprojective"))
    if isinstance(refined, Failure) or refined.inliers.sum() < pair.config.min_control_points:
        return fit
    return refined if refined.cv_error_px < fit.cv_error_px else fit


def _fit_level(
    pair: ImagePair,
    transform: FrameTransform,
    scale: float,
    radius_px: int,
    modality: Modality,
    models: tuple[Model, ...],
) -> FineFit | Failure:
    """One level: warp, match on the grid, fit robustly."""
    images = warp_to_base_grid(pair, transform, scale)
    if images is None:
        return Failure("the frame would lie outside the base image")
    moving, mask, reference, origin = images
    spacing_px = int(np.sqrt(mask.sum() / _TARGET_POINTS))  # where the image is too small for enough points
    matches = match_grid(
        moving,
        mask,
        reference,
        spacing_px=max(4, min(pair.config.grid_spacing_px, spacing_px)),
        patch_px=pair.config.patch_size_px,
        radius_px=radius_px,
        modality=modality,
    )
    return _fit_matches(pair, transform, matches, origin, scale, models)


def warp_to_base_grid(
    pair: ImagePair, transform: FrameTransform, scale: float
) -> tuple[GreyImage, Mask, GreyImage, tuple[int, int]] | None:
    """The frame warped to the base image's grid at a scale, its mask, that part of the base image, the part's origin.

    The part is what the frame covers, plus the search radius; None if they do not overlap by more than a patch.
    """
    x0, y0, x1, y1 = footprint(transform, (pair.image.shape[0], pair.image.shape[1]))
    if not np.isfinite([x0, y0, x1, y1]).all():
        return None
    height, width = pair.base.shape
    margin = pair.config.search_radius_px
    left, top = max(int(x0) - margin, 0), max(int(y0) - margin, 0)
    right, bottom = min(int(x1) + margin + 1, width), min(int(y1) + margin + 1, height)
    if min(right - left, bottom - top) <= pair.config.patch_size_px:
        return None
    window = (left, top, right - left, bottom - top)
    moving, mask = warp_to_base(pair.image, transform, window=window, scale=scale)
    reference = downscale(np.ascontiguousarray(pair.base[top:bottom, left:right]), scale)
    rows, columns = min(moving.shape[0], reference.shape[0]), min(moving.shape[1], reference.shape[1])
    return moving[:rows, :columns], mask[:rows, :columns], reference[:rows, :columns], (left, top)


def _fit_matches(
    pair: ImagePair,
    transform: FrameTransform,
    matches: GridMatches,
    origin: tuple[int, int],
    scale: float,
    models: tuple[Model, ...],
) -> FineFit | Failure:
    """Robust fit of each model to a level's matches; the one of lower cross-validated error."""
    correlated = matches.score >= _MIN_SCORE
    points, displacement = matches.points[correlated], matches.displacement[correlated]
    base_points = (points + 0.5) / scale - 0.5 + origin
    source_raw = transform.to_raw(base_points)
    target = base_points + displacement / scale
    inside = np.isfinite(source_raw).all(axis=1)
    source_raw, target = source_raw[inside], target[inside]
    undistorted = pair.lens.undistort_points(source_raw)
    near = _near_homography(undistorted, target, 1.0 / scale)
    best: FineFit | None = None
    reason = "the transform folds or diverges within the frame"
    for model in models:
        robust = _fit_robustly(undistorted, target, near, model, scale, pair.config)
        if isinstance(robust, Failure):
            reason = f"{robust.reason} ({near.size} matches, {near.sum()} near one homography)"
            continue
        fit, inliers = robust
        cv_error_px = float(cv_errors(undistorted[inliers], target[inliers], model).mean())
        candidate = FineFit(pair.transform(fit), model, source_raw, target, inliers, cv_error_px)
        # Second-order terms that do not lower the cross-validated error, or fold the frame's corners, are rejected.
        if is_regular(candidate.transform) and (best is None or cv_error_px < best.cv_error_px):
            best = candidate
    return best or Failure(reason)


def _fit_robustly(
    source: FloatArray, target: FloatArray, near: Mask, model: Model, scale: float, config: BaseConfig
) -> tuple[PolyprojectiveTransform, Mask] | Failure:
    """The paper's case deletion among the points ``near`` one homography, then inliers re-selected until stable."""
    deletion = fit_by_case_deletion(
        source[near],
        target[near],
        model=model,
        drop_fraction=config.drop_fraction,
        max_mean_error_px=max(config.max_mean_error_px, 1.0 / scale),
        min_control_points=_MIN_POINTS,
    )
    if isinstance(deletion, Failure):
        return deletion
    inliers = near.copy()
    inliers[near] = deletion.inliers
    return _reselect_inliers(source, target, inliers, model, min_sigma_px=0.3 / scale)


def is_regular(transform: FrameTransform) -> bool:
    """Whether the map neither folds nor diverges in the frame: its Jacobian determinant varies less than 16-fold."""
    grid = np.stack(
        np.meshgrid(np.linspace(0, transform.width - 1, 9), np.linspace(0, transform.height - 1, 9)), axis=-1
    ).reshape(-1, 2)
    j = transform.jacobian(grid)
    area = j[:, 0, 0] * j[:, 1, 1] - j[:, 0, 1] * j[:, 1, 0]
    return bool(np.all(np.isfinite(area)) and area.min() > 0 and area.max() < 16.0 * area.min())


def _near_homography(source: FloatArray, target: FloatArray, unit_px: float) -> Mask:
    """Matches (n,) within 12 px of the MAGSAC homography: a fit of 17 parameters to outliers would fold."""
    if len(source) < _MIN_POINTS:
        return np.zeros(len(source), dtype=bool)
    matrix, _ = cv2.findHomography(source, target, cv2.USAC_MAGSAC, 3.0 * unit_px, maxIters=5000, confidence=0.999)
    if matrix is None:
        return np.zeros(len(source), dtype=bool)
    return np.asarray(np.linalg.norm(HomographyTransform(matrix)(source) - target, axis=1) < 12.0 * unit_px)


def _reselect_inliers(
    source: FloatArray, target: FloatArray, inliers: Mask, model: Model, *, min_sigma_px: float
) -> tuple[PolyprojectiveTransform, Mask] | Failure:
    """Refit and re-select the points within three robust standard deviations until the set is stable."""
    step = 0
    while True:
        fit = fit_polyprojective(source[inliers], target[inliers], model=model)
        if isinstance(fit, Failure):
            return fit
        error = np.linalg.norm(fit(source) - target, axis=1)
        # The median of a two-dimensional Gaussian's radius is 1.18 sigma.
        sigma = float(np.median(np.nan_to_num(error[inliers], nan=np.inf))) / 1.18
        selected = error < 3.0 * max(sigma, min_sigma_px)
        if step == _RESELECTIONS or np.array_equal(selected, inliers) or selected.sum() < 12:
            return fit, inliers
        inliers, step = selected, step + 1


def cv_errors(source: FloatArray, target: FloatArray, model: Model) -> FloatArray:
    """Cross-validated error (n,) of each point: under the transform fitted to the other folds."""
    fold = np.arange(len(source)) * 7 % _FOLDS
    errors = np.full(len(source), np.inf)
    for part in range(_FOLDS):
        fit = fit_polyprojective(source[fold != part], target[fold != part], model=model)
        if not isinstance(fit, Failure):
            errors[fold == part] = np.linalg.norm(fit(source[fold == part]) - target[fold == part], axis=1)
    return np.asarray(np.nan_to_num(errors, nan=np.inf), dtype=np.float64)
