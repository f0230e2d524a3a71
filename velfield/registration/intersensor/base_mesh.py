"""Displacement mesh between the flight's own base image and a given one, and how accurate the map is where.

One polyprojective between the two (paper: inter-sensor registration) follows neither relief of the ground, which the
camera sees from one side and an orthophoto from above, nor what the lens model leaves. Patches are matched on the grid
through the map found so far, the mesh is fitted to what is left, and both are repeated: a first map that is several
pixels off in the corners matches few patches there.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from schemas.arrays import FloatArray, GreyImage, Mask
from schemas.flight import BaseConfig
from velfield.registration.control_points import ControlPoints, assign_folds, robust_scale
from velfield.registration.intersensor.correlation import match_grid
from velfield.registration.intersensor.modality import MODALITIES, Modality
from velfield.registration.joint import robust_weights
from velfield.registration.mesh import NEIGHBOURS, Support, fit_mesh, measure_support, no_support
from velfield.registration.transforms import MeshedTransform, PolyprojectiveTransform
from velfield.registration.warp import warp_to_base

CELL_PX = 160
"""Side of the mesh's cells, px of the own base image: relief that vehicles drive on is no steeper."""
PATCH_PX, SPACING_PX = 41, 30
"""Patches of the paper's 75 px hold roofs beside the road; these are smaller, and there are three times as many. On two
sensors so different that too few of them agree, the paper's are used."""
_MIN_AGREEING = 0.3
"""Fraction of the patches that must agree with the mesh; by chance a tenth does."""
_ROUNDS = 3
_RADII_PX = (10, 6, 4)
_MIN_SCORE = 0.3
_FOLD_PATCHES = 3
"""Neighbouring patches share pixels: those of one cell of so many patches a side share a fold."""
_MIN_POINTS = 12
_INLIER_SIGMAS = 3.0
_AGREEMENT_PX = 1.5
_COMPARED = 9
_MODALITY_SPACING = 4
"""Every so many grid points decide how the images are compared."""


@dataclass(frozen=True, eq=False)
class BaseMesh:
    """The map from the own base image to the given one, its mean hold-out error, points and support.

    ``support`` is over the own base image.
    """

    transform: MeshedTransform
    heldout_px: float
    points: int
    support: Support


def fit_base_mesh(
    own: GreyImage, valid: Mask, given: GreyImage, start: PolyprojectiveTransform, config: BaseConfig
) -> BaseMesh:
    """Fit a mesh to the displacement that ``start``, a polyprojective from own px to given px, leaves.

    ``own`` and ``valid`` (h, w) uint8 and bool are the flight's own base image and where it is valid, ``given`` (H, W)
    uint8. The configuration's patches are used where the small ones do not agree.
    """
    images = _Images(own, valid, given, start)
    fit, agreeing = _fit(images, PATCH_PX, SPACING_PX)
    if agreeing >= _MIN_AGREEING:
        return fit
    by_large, agreeing_large = _fit(images, config.patch_size_px, config.grid_spacing_px)
    return by_large if agreeing_large > agreeing else fit


@dataclass(frozen=True, eq=False)
class _Images:
    """The two base images, and the polyprojective between them."""

    own: GreyImage
    valid: Mask
    given: GreyImage
    start: PolyprojectiveTransform

    def match(
        self, transform: MeshedTransform, modality: Modality, *, patch_px: int, spacing_px: int, radius_px: int
    ) -> ControlPoints:
        """Matches of the own image, warped by a map, with the given one: own px to given px."""
        image_map = _AsRaw(transform, transform.inverse)
        window = (0, 0, self.given.shape[1], self.given.shape[0])
        moving, mask = warp_to_base(self.own, image_map, window=window)
        inside, _ = warp_to_base(self.valid.astype(np.uint8) * 255, image_map, window=window)
        matches = match_grid(
            moving,
            mask & (inside > 127),
            self.given,
            spacing_px=spacing_px,
            patch_px=patch_px,
            radius_px=radius_px,
            modality=modality,
        )
        good = matches.score >= _MIN_SCORE
        own_xy = image_map.to_raw(matches.points[good])
        target = matches.points[good] + matches.displacement[good]
        finite = np.isfinite(own_xy).all(axis=1)
        return ControlPoints(own_xy[finite], target[finite], np.ones(int(finite.sum())))


def _fit(images: _Images, patch_px: int, spacing_px: int) -> tuple[BaseMesh, float]:
    """The mesh by patches of one size, and the fraction of them that agrees with it."""
    height, width = images.own.shape
    start = images.start
    transform = MeshedTransform(start, np.zeros((1, 1, 2)), CELL_PX)
    modality = _choose_modality(images, transform, patch_px, spacing_px)
    fold_px = float(_FOLD_PATCHES * patch_px)
    inliers: Mask = np.zeros(0, bool)
    for radius_px in _RADII_PX:
        points = images.match(transform, modality, patch_px=patch_px, spacing_px=spacing_px, radius_px=radius_px)
        if len(points) < _MIN_POINTS:
            return BaseMesh(transform, float("nan"), len(points), no_support(width, height)), 0.0
        residuals = points.xy_base - start(points.xy_raw)
        left = points.xy_base - transform(points.xy_raw)
        for _ in range(_ROUNDS):
            scale = robust_scale(left, points.sigma_px)
            fit = fit_mesh(
                points.xy_raw,
                residuals,
                residuals,
                robust_weights(left, points.sigma_px, scale),
                width=width,
                height=height,
                cell_size_px=CELL_PX,
                fold=assign_folds(points.xy_raw, fold_px),
            )
            left = fit.residuals
        mesh = np.zeros((1, 1, 2)) if fit.mesh is None else fit.mesh
        transform = MeshedTransform(start, mesh, CELL_PX)
        inliers = np.asarray(np.hypot(*left.T) < _INLIER_SIGMAS * robust_scale(left, points.sigma_px))
    errors = fit.cv_residuals[inliers]
    support = measure_support(points.xy_raw[inliers], errors, width=width, height=height)
    near = float((np.hypot(*fit.cv_residuals.T) < _AGREEMENT_PX).mean())
    return BaseMesh(transform, float(np.hypot(*errors.T).mean()), int(inliers.sum()), support), near


def _choose_modality(images: _Images, transform: MeshedTransform, patch_px: int, spacing_px: int) -> Modality:
    """The modality in which most patches agree with their neighbours."""

    def agreeing(modality: Modality) -> int:
        points = images.match(
            transform,
            modality,
            patch_px=patch_px,
            spacing_px=_MODALITY_SPACING * spacing_px,
            radius_px=_RADII_PX[0],
        )
        if len(points) < NEIGHBOURS:
            return 0
        left = points.xy_base - transform(points.xy_raw)
        _, nearest = KDTree(points.xy_raw).query(points.xy_raw, k=min(_COMPARED, len(points)))
        return int((np.hypot(*(left - np.median(left[nearest], axis=1)).T) < _AGREEMENT_PX).sum())

    return max(MODALITIES.values(), key=agreeing)


class _AsRaw(NamedTuple):
    """The own base image as a raw frame, and the given one as its base."""

    to_base: Callable[[FloatArray], FloatArray]
    to_raw: Callable[[FloatArray], FloatArray]
