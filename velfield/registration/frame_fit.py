"""The fit of one frame to matched keypoints and to patches of the base image aligned through it, and its quality."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from schemas.arrays import Float32Array, FloatArray, GreyImage, IntArray, Mask
from schemas.flight import RegistrationConfig
from velfield.camera.lens import Lens
from velfield.errors import Failure
from velfield.registration.alignment import Templates, align_patches, smooth_coarse, smooth_fine
from velfield.registration.control_points import ControlPoints, is_inlier, rms
from velfield.registration.fitting import fit_by_case_deletion
from velfield.registration.joint import JointFit, fit_jointly
from velfield.registration.keypoints import Keypoints
from velfield.registration.mesh import MESH_ITERATIONS, cell_index, fit_robust_mesh, measure_support
from velfield.registration.transforms import FrameTransform, PolyprojectiveTransform, as_points, count_row_knots

QUALITY_CELLS = (6, 8)
"""Rows and columns of cells over the frame, for the coverage of the control points and the map of their errors."""

_INITIAL_SCALE_PX = 3.0
_REFIT_SCALE_PX = 1.5
_COARSE_SHIFT_PX = 7.0
_FINE_SHIFT_PX = 2.5
_NEAR_FRACTION = 0.3
"""If a larger fraction of the patches aligns at the fine level, the fit to keypoints is accurate enough to skip the
coarse one."""
_ENOUGH_FRACTION = 0.8
"""If a smaller fraction aligns, the denser patches are used: half of those of another sensor's image align, too few
at the borders."""
_SETTLED_PX, _SETTLED_IN_CHAIN_PX = 0.2, 0.5
"""Where a fit to aligned patches moves 95 % of them by less than this, they are not aligned again: an alignment does
not depend on where it starts, but from keypoints whole bands of rows may start out of its reach."""
_WEAK_FRACTION, _MIN_TRIED = 0.5, 20
"""A band of rows is fitted again from its neighbours if a smaller part of its patches are inliers than in the typical
band, of as many patches at least."""
_MAX_BRIDGES = 3
_MIN_ALIGNED_FRACTION = 0.15
"""If a smaller fraction of the patches aligns, the prior was wrong: the frame is not registered."""


@dataclass(frozen=True, eq=False)
class BaseReference:
    """The base image with the features that frames are registered to."""

    shape: tuple[int, int]
    """(height, width) of the base image, px."""
    templates: Templates
    dense_templates: Templates
    """Patches at its corners; a denser set for another sensor's image."""
    detect: Callable[[], Keypoints]
    """Gives its keypoints, detected when they are first asked for."""

    @property
    def keypoints(self) -> Keypoints:
        """Keypoints, base px: costly, and not needed where optical flow starts all frames."""
        return self.detect()


@dataclass(frozen=True, eq=False)
class FrameRegistration:
    """One frame's registration and its quality metrics."""

    transform: FrameTransform | None
    """Raw to base pixels; None if it failed."""
    status: str
    """``ok`` or ``failed:<reason with counts>``."""
    n_matches_base: int = 0
    n_matches_previous: int = 0
    """Control points matched to the base image and to the previous frame; in a frame that optical flow starts, the
    patches aligned to the base image."""
    n_inliers: int = 0
    """Inliers of the robust fit."""
    residual_px: float = float("nan")
    heldout_px: float = float("nan")
    """RMS residual of the inliers, fitted and cross-validated; NaN if failed."""
    coverage: float = 0.0
    """Fraction of the frame's cells with inliers."""
    error_map: FloatArray | None = None
    """(6, 8) RMS cross-validated residual of the inliers per cell, base px; NaN where there are none."""
    position_sd_px: Float32Array | None = None
    """(24, 32) standard deviation of the map by cell, base px; NaN where no control points support it."""
    control_points: ControlPoints | None = None
    """The inliers."""
    stiffness: tuple[float, float] | None = None
    """Selected for the row shift and for the roll."""

    @property
    def ok(self) -> bool:
        """Whether the frame is registered."""
        return self.transform is not None


@dataclass(frozen=True, eq=False)
class FrameFitter:
    """The fits of one frame, with the data they have in common."""

    grey: GreyImage
    base: BaseReference
    lens: Lens
    config: RegistrationConfig

    @cached_property
    def fine(self) -> Float32Array:
        """The frame at the fine blur level, at which patches are aligned."""
        return smooth_fine(self.grey)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the frame, px."""
        return self.grey.shape[1], self.grey.shape[0]

    def _fit(
        self,
        points: ControlPoints,
        start: PolyprojectiveTransform,
        previous_fit: JointFit | None = None,
        stiffness: tuple[float, float] | None = None,
        *,
        rough: bool = False,
    ) -> JointFit | Failure:
        if len(points) < self.config.min_control_points:
            return Failure(f"{len(points)} control points, {self.config.min_control_points} needed")
        width, height = self.size
        return fit_jointly(
            points,
            start=start,
            lens=self.lens,
            width=width,
            height=height,
            knots=count_row_knots(self.config),
            homography=self.config.model == "homography",
            start_rows=None if previous_fit is None else previous_fit.transform.row_coefficients,
            start_scale_px=_INITIAL_SCALE_PX if previous_fit is None else _REFIT_SCALE_PX,
            start_stiffness=stiffness if previous_fit is None else previous_fit.stiffness,
            rough=rough,
        )

    def fit_with_alignment(
        self,
        points: ControlPoints,
        start: PolyprojectiveTransform,
        stiffness: tuple[float, float] | None = None,
        chosen: Templates | None = None,
    ) -> tuple[ControlPoints, JointFit] | Failure:
        """Fit to matched keypoints, then twice to patches of the base image aligned through that fit.

        Patches that were ``chosen`` are taken as they are, and ``points`` for a start only; else the usual set, or the
        denser one, and ``points`` in cells where no patch aligns.

        If few patches align at the fine level, a coarse level with a larger search range comes first. Otherwise it does
        harm: at the border of another sensor's image, where few patches align correctly, wrong alignments from the
        larger range shifted the rows by two pixels.
        """
        fit = self._fit(points, start, stiffness=stiffness, rough=True)
        if isinstance(fit, Failure):
            return fit
        templates = chosen or self.base.templates
        aligned, in_frame = align_patches(
            self.fine, fit.transform, templates, coarse=False, max_shift_px=_FINE_SHIFT_PX
        )
        enough = chosen is not None or len(aligned) >= _ENOUGH_FRACTION * in_frame
        if not enough:
            templates = self.base.dense_templates
        steps: list[tuple[Float32Array, bool, float]] = [(self.fine, False, _FINE_SHIFT_PX)] * 2
        if len(aligned) < _NEAR_FRACTION * in_frame:
            steps.insert(0, (smooth_coarse(self.fine), True, _COARSE_SHIFT_PX))
        used, settled_px = points, _SETTLED_PX if chosen is None else _SETTLED_IN_CHAIN_PX
        for k, (image, is_coarse, limit) in enumerate(steps):
            if k or not enough:
                aligned, in_frame = align_patches(image, fit.transform, templates, coarse=is_coarse, max_shift_px=limit)
            if not len(aligned) or len(aligned) < _MIN_ALIGNED_FRACTION * in_frame:
                return Failure(f"{len(aligned)} of {in_frame} patches of the base image align")
            # points that optical flow carried on are the frame before's word: a chain would confirm itself by them
            used = (
                aligned.concatenate(select_in_empty_cells(points, aligned, *self.size)) if chosen is None else aligned
            )
            refit = self._fit(used, fit.transform.polyprojective, fit)
            if isinstance(refit, Failure):
                return refit
            moved = fit.transform.to_base(aligned.xy_raw) - refit.transform.to_base(aligned.xy_raw)
            fit = refit
            if not is_coarse and np.quantile(np.hypot(*moved.T), 0.95) < settled_px:
                break
        if chosen is None:
            for _ in range(_MAX_BRIDGES):
                used, fit, bridged = self._bridge_weak_rows(used, fit, templates)
                if not bridged:
                    break
        return used, fit

    def _bridge_weak_rows(
        self, used: ControlPoints, fit: JointFit, templates: Templates
    ) -> tuple[ControlPoints, JointFit, bool]:
        """The fit, or one through other alignments where rows have few inliers, if more patches agree; and whether.

        The spline may bend to a band of rows of which the roofs match and little else: aligned from there, the ground
        is out of reach, and some roofs confirm the bend. So the band's rows are interpolated from its neighbours, and
        the patches are aligned again from there.
        """
        knots = count_row_knots(self.config)
        weak = self._weak_rows(used, fit, templates, knots) if knots else np.zeros(0, bool)
        if not weak.any() or weak.all():
            return used, fit, False
        rows = fit.transform.row_coefficients.copy()
        for part in rows:
            part[weak] = np.interp(np.flatnonzero(weak), np.flatnonzero(~weak), part[~weak])
        bridged = replace(fit, transform=replace(fit.transform, row_coefficients=rows))
        aligned, _ = align_patches(self.fine, bridged.transform, templates, coarse=False, max_shift_px=_FINE_SHIFT_PX)
        again = aligned.concatenate(select_in_empty_cells(used, aligned, *self.size))
        refit = self._fit(again, bridged.transform.polyprojective, bridged)
        if isinstance(refit, Failure):
            return used, fit, False
        before, after = (
            int(weak[self._row_band(points.xy_raw[one.inliers], knots)].sum())
            for points, one in ((used, fit), (again, refit))
        )
        return (again, refit, True) if after > before else (used, fit, False)

    def _weak_rows(self, used: ControlPoints, fit: JointFit, templates: Templates, knots: int) -> Mask:
        """Bands of rows (knots,) where far fewer patches are inliers than in the typical band, and their neighbours."""
        width, height = self.size
        xy_raw = fit.transform.to_raw(templates.xy)
        shown = ((xy_raw >= 0) & (xy_raw <= (width - 1, height - 1))).all(axis=1)
        bands = [self._row_band(xy, knots) for xy in (xy_raw[shown], used.xy_raw[fit.inliers])]
        tried, inliers = (np.convolve(np.bincount(band, minlength=knots), np.ones(3), "same") for band in bands)
        enough = tried >= _MIN_TRIED
        fraction = inliers / np.maximum(tried, 1.0)
        typical = float(np.median(fraction[enough])) if enough.any() else 0.0
        weak = enough & (fraction < _WEAK_FRACTION * typical)
        return np.asarray(np.convolve(weak, np.ones(3), "same") > 0)

    def _row_band(self, xy_raw: FloatArray, knots: int) -> IntArray:
        """Band of rows (n,) of raw points, as many bands as knots."""
        return np.clip((xy_raw[:, 1] + 0.5) / self.size[1] * knots, 0, knots - 1).astype(np.int64)

    def fit_with_case_deletion(self, points: ControlPoints) -> tuple[ControlPoints, JointFit] | Failure:
        """The paper's fit: polyprojective by case deletion on matched keypoints."""
        config = self.config
        source = as_points(self.lens.undistort_points(points.xy_raw))
        result = fit_by_case_deletion(
            source,
            points.xy_base,
            drop_fraction=config.drop_fraction,
            max_mean_error_px=config.max_mean_error_px,
            min_control_points=config.min_control_points,
        )
        if isinstance(result, Failure):
            return result
        width, height = self.size
        transform = FrameTransform(width=width, height=height, lens=self.lens, polyprojective=result.transform)
        inliers = points.select(result.inliers)
        refit = fit_jointly(
            inliers, start=result.transform, lens=self.lens, width=width, height=height, knots=0, start_scale_px=3.0
        )
        if isinstance(refit, Failure):
            return refit
        residuals = inliers.xy_base - transform.to_base(inliers.xy_raw)
        cv_residuals = refit.cv_residuals - refit.residuals + residuals
        ones = np.ones(len(inliers))
        return inliers, JointFit(transform, ones, residuals, cv_residuals, refit.scale, refit.stiffness)

    def with_quality_metrics(
        self, points: ControlPoints, fit: JointFit, n_matches_base: int, n_matches_previous: int
    ) -> FrameRegistration:
        """Add mesh, counts and cross-validated errors; a failure if those exceed the configured limits."""
        width, height = self.size
        transform, residuals, cv_residuals, weights = fit.transform, fit.residuals, fit.cv_residuals, fit.weights
        if self.config.mesh and self.config.model != "homography":
            mesh_fit, weights = fit_robust_mesh(
                points,
                fit,
                width=width,
                height=height,
                cell_size_px=self.config.cell_size_px,
                iterations=1 if self.config.model == "polyprojective" else MESH_ITERATIONS,
            )
            cv_residuals = mesh_fit.cv_residuals
            transform = replace(transform, mesh=mesh_fit.mesh, cell_size_px=self.config.cell_size_px)
            residuals = points.xy_base - transform.to_base(points.xy_raw)
        inliers = is_inlier(weights)
        error_map = _cell_rms(points.xy_raw[inliers], cv_residuals[inliers], width, height)
        count, heldout_px = int(inliers.sum()), rms(cv_residuals[inliers])
        counts = (n_matches_base, n_matches_previous, count)
        if count < self.config.min_control_points:
            reason = f"{count} of {len(points)} control points are inliers, {self.config.min_control_points} needed"
            return FrameRegistration(None, f"failed:{reason}", *counts)
        if not heldout_px <= self.config.max_residual_px:
            reason = f"held-out residual {heldout_px:.2f} px, at most {self.config.max_residual_px:g} allowed"
            return FrameRegistration(None, f"failed:{reason}", *counts)
        coverage = float(np.isfinite(error_map).mean())
        support = measure_support(points.xy_raw[inliers], cv_residuals[inliers], width=width, height=height)
        return FrameRegistration(
            transform,
            "ok",
            *counts,
            rms(residuals[inliers]),
            heldout_px,
            coverage,
            error_map,
            support.sd_px,
            points.select(inliers),
            fit.stiffness,
        )


def select_in_empty_cells(points: ControlPoints, aligned: ControlPoints, width: int, height: int) -> ControlPoints:
    """Select the control points of ``points`` in the cells of the frame where ``aligned`` has none."""
    empty = np.ones(QUALITY_CELLS[0] * QUALITY_CELLS[1], bool)
    empty[cell_index(aligned.xy_raw, QUALITY_CELLS, width, height)] = False
    return points.select(empty[cell_index(points.xy_raw, QUALITY_CELLS, width, height)])


def _cell_rms(xy_raw: FloatArray, errors: FloatArray, width: int, height: int) -> FloatArray:
    rows, columns = QUALITY_CELLS
    cell = cell_index(xy_raw, QUALITY_CELLS, width, height)
    squares = np.bincount(cell, (errors**2).sum(axis=1), rows * columns)
    counts = np.bincount(cell, minlength=rows * columns)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.sqrt(squares / counts).reshape(rows, columns))
