"""Intra-sensor registration: every frame to the base image of the same camera, and to the frame before it.

Paper: intra-sensor registration. The first frame of a chain, and every one that the
way below loses, goes through these steps:

1. a prior homography from the base image (SIFT keypoints, ratio test, MAGSAC), which needs no other frame; if it fails,
   from the keypoints of the previous registered frame, mapped through its transform;
2. guided matching of the keypoints in a window about the prior, to the base image and to the previous frame;
3. the fit, by ``model``: the joint robust fit of polyprojective and row spline (`velfield.registration.joint`, the
   default), a homography fitted in the same way, or with ``model="polyprojective"`` the paper's, by case deletion
   (`velfield.registration.fitting`), after which there is no step 4;
4. subpixel alignment of patches of the base image through that map, and the fit again, twice;
5. the displacement mesh, if cross-validation supports one; its cells are 120 px by default, the paper's 200
   (``cell_size_px``).

Every other frame, and the first where it follows a known one, starts from the one before (``start="optical_flow"``):
the inliers of that frame are tracked into this one by pyramidal Lucas-Kanade, a fit to them takes the place of steps 1
to 3, and steps 4 and 5 follow. Nothing of the earlier frame's error remains: only patches that are aligned to the base
image itself are fitted and counted.
Keypoints cost more than all else of a frame's registration. A frame that comes out worse than the one that its chain
began with, or as the first in fewer than half of its cells, is registered again by its keypoints.

Matches to the previous frame propagate its errors and would let the chain drift: they are used only in those cells of
the frame where the base image gives no match. Where the base image covers the frame, the result does not depend on
where the chain began.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import cv2
import numpy as np

from schemas.arrays import ByteArray, Float32Array, FloatArray, GreyImage, IntArray, Mask
from schemas.flight import RegistrationConfig
from velfield.camera.lens import Lens
from velfield.errors import Failure
from velfield.parallel import once
from velfield.registration.alignment import (
    HALF_PATCH,
    N_PATCHES_CROSS_SENSOR,
    N_PATCHES_SAME_SENSOR,
    Templates,
    align_patches,
    make_template_sets,
    smooth_coarse,
    smooth_fine,
)
from velfield.registration.fitting import fit_by_case_deletion
from velfield.registration.joint import ControlPoints, JointFit, fit_jointly, is_inlier, rms
from velfield.registration.keypoints import (
    Keypoints,
    detect_keypoints,
    estimate_homography_prior,
    fit_homography,
    match_guided,
)
from velfield.registration.mesh import MESH_ITERATIONS, fit_robust_mesh, measure_support
from velfield.registration.transforms import (
    FrameTransform,
    HomographyTransform,
    PolyprojectiveTransform,
    as_points,
    count_row_knots,
)

QUALITY_CELLS = (6, 8)
"""Rows and columns of cells over the frame, for the coverage of the control points and the map of their errors."""

_BASE_SIGMA_PX = 0.5
_PREVIOUS_SIGMA_PX = 0.7
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
_RETEST_FRAMES = 8
"""In a chain, a patch that was an inlier in none of so many frames is tried in one of so many: most patches of another
sensor's image never align, and those take the most iterations."""
_SETTLED_PX, _SETTLED_IN_CHAIN_PX = 0.2, 0.5
"""Where a fit to aligned patches moves 95 % of them by less than this, they are not aligned again: an alignment does
not depend on where it starts, but from keypoints whole bands of rows may start out of its reach."""
_WEAK_FRACTION, _MIN_TRIED = 0.5, 20
"""A band of rows is fitted again from its neighbours if a smaller part of its patches are inliers than in the typical
band, of as many patches at least."""
_SHOWN_PX = 2 * HALF_PATCH
"""A patch that is as far from the frame's border has been seen."""
_MAX_BRIDGES = 3
_MIN_ALIGNED_FRACTION = 0.15
"""If a smaller fraction of the patches aligns, the prior was wrong: the frame is not registered."""
_FLOW_SIGMA_PX = 0.7
_FLOW_POINTS = 500
_FLOW_SCALE, _FLOW_LEVELS, _FLOW_WINDOW_PX = 0.25, 3, 21
"""Optical flow: scale of the frames as by `shrink`, levels of their pyramids above that, side of the window."""
_FLOW_ENDS = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 10, 0.03)
"""A point is followed for so many iterations, or until it moves by less than so many px of the scaled frame."""
_MAX_COVERAGE_LOSS, _MAX_RESIDUAL_RATIO = 0.05, 1.5
"""Against the first frame of the chain: a frame that is worse is registered again by its keypoints."""
_MIN_FIRST_COVERAGE = 0.5
"""Of a first frame that optical flow started from a known one: of a chance agreement the inliers are in few cells."""
_MAX_BASE_KEYPOINT_RATIO = 3
"""Keypoints of the base image over those of a frame, at most; in proportion to its area."""


@dataclass(frozen=True, eq=False)
class BaseReference:
    """The base image with the features that frames are registered to.

    Attributes
    ----------
    shape : (height, width) of the base image, px.
    templates, dense_templates : patches at its corners; a denser set for another sensor's image.
    detect : gives its keypoints, detected when they are first asked for.
    """

    shape: tuple[int, int]
    templates: Templates
    dense_templates: Templates
    detect: Callable[[], Keypoints]

    @property
    def keypoints(self) -> Keypoints:
        """Keypoints, base px: costly, and not needed where optical flow starts all frames."""
        return self.detect()


@dataclass(frozen=True, eq=False)
class FrameRegistration:
    """One frame's registration and its quality metrics.

    Attributes
    ----------
    transform : raw to base pixels; None if it failed.
    status : ``ok`` or ``failed:<reason with counts>``.
    n_matches_base, n_matches_previous : control points matched to the base image and to the previous frame; in a frame
        that optical flow starts, the patches aligned to the base image.
    n_inliers : inliers of the robust fit.
    residual_px, heldout_px : RMS residual of the inliers, fitted and cross-validated; NaN if failed.
    coverage : fraction of the frame's cells with inliers.
    error_map : (6, 8) RMS cross-validated residual of the inliers per cell, base px; NaN where there are none.
    position_sd_px : (24, 32) standard deviation of the map by cell, base px; NaN where no control points support it.
    control_points : the inliers.
    stiffness : selected for the row shift and for the roll.
    """

    transform: FrameTransform | None
    status: str
    n_matches_base: int = 0
    n_matches_previous: int = 0
    n_inliers: int = 0
    residual_px: float = float("nan")
    heldout_px: float = float("nan")
    coverage: float = 0.0
    error_map: FloatArray | None = None
    position_sd_px: Float32Array | None = None
    control_points: ControlPoints | None = None
    stiffness: tuple[float, float] | None = None

    @property
    def ok(self) -> bool:
        """Whether the frame is registered."""
        return self.transform is not None


def prepare_base(
    grey: GreyImage,
    config: RegistrationConfig,
    *,
    mask: Mask | None = None,
    frame_shape: tuple[int, int] | None = None,
) -> BaseReference:
    """Find the patches of a base image; its keypoints are detected when they are first asked for.

    Parameters
    ----------
    grey
        (h, w) uint8.
    config
        The registration section of the flight's configuration.
    mask
        (h, w) bool: where the base image is valid; None: everywhere.
    frame_shape
        (height, width) of the frames: a base image larger than a frame keeps more keypoints.
    """
    frame_area = grey.size if frame_shape is None else frame_shape[0] * frame_shape[1]
    ratio = float(np.clip(grey.size / frame_area, 1.0, _MAX_BASE_KEYPOINT_RATIO))
    detect = once(partial(detect_keypoints, grey, config, mask, count=round(config.max_keypoints * ratio)))
    templates, dense_templates = make_template_sets(grey, mask, counts=(N_PATCHES_SAME_SENSOR, N_PATCHES_CROSS_SENSOR))
    return BaseReference((grey.shape[0], grey.shape[1]), templates, dense_templates, detect)


def register_chain(
    frames: Iterable[tuple[int, GreyImage, Callable[[], Keypoints]]],
    base: BaseReference,
    lens: Lens,
    config: RegistrationConfig,
    first_previous: Keypoints | None = None,
    before: "ChainFrame | None" = None,
) -> list[FrameRegistration]:
    """Register a chain of frames in the order of time, or against it; results in the order of the frames.

    Parameters
    ----------
    frames
        (index, grey (h, w) uint8, function that detects its keypoints in raw px) of each.
    first_previous
        Keypoints of the frame before the first, in base px (see `map_keypoints`); None: the chain begins here.
    before
        A frame of known map from which optical flow may start the first; its keypoints are not used.
    """
    results: list[FrameRegistration] = []
    by_flow = config.start == "optical_flow" and config.model != "polyprojective"
    latest: tuple[Callable[[], Keypoints], FrameTransform] | None = None
    first: FrameRegistration | None = None
    history: _PatchHistory | None = None
    for _, grey, detect in frames:
        small = shrink(grey) if by_flow else grey
        result = None
        if by_flow and before is not None:
            if first is not None:
                history = history or _PatchHistory.begin(base, before.result)
            chosen = base.templates if history is None else history.choose(before, grey.shape)
            result = _register_by_flow(grey, small, before, base, lens, config, chosen)
            result = None if result is None or _is_worse(result, first) else result
            first = first or result
        if result is None:
            previous = first_previous if latest is None else map_keypoints(latest[0](), latest[1])
            result = register_frame(grey, detect(), base, lens, config, previous)
            first = result if result.ok else first
        results.append(result)
        if result.transform is not None:
            before, latest = ChainFrame(result, result.transform, small), (detect, result.transform)
            if history is not None:
                history.note(result)
    return results


@dataclass(frozen=True, eq=False)
class ChainFrame:
    """A frame that the next one starts from: its registration and map, and the frame as by `shrink`."""

    result: FrameRegistration
    transform: FrameTransform
    small: GreyImage

    @classmethod
    def of_known_map(cls, grey: GreyImage, transform: FrameTransform, base: BaseReference) -> "ChainFrame":
        """A frame (h, w) uint8 whose map is known to a few pixels, as if it had been registered by all patches that it
        shows of the base image."""
        xy_base = base.templates.xy.astype(np.float64)
        xy_raw = transform.to_raw(xy_base)
        shown = ((xy_raw >= 0) & (xy_raw <= np.array(grey.shape[::-1]) - 1)).all(axis=1)
        points = ControlPoints(xy_raw[shown], xy_base[shown], np.full(int(shown.sum()), _FLOW_SIGMA_PX))
        return cls(FrameRegistration(transform, "ok", control_points=points), transform, shrink(grey))


@dataclass
class _PatchHistory:
    """Patches of the base image that were recently inliers in a chain of frames.

    Attributes
    ----------
    templates : those in use.
    frame : number of the frame in the chain.
    last_inlier : (n,) number of the frame in which each was an inlier last.
    """

    templates: Templates
    frame: int
    last_inlier: IntArray

    @classmethod
    def begin(cls, base: BaseReference, first: FrameRegistration) -> "_PatchHistory":
        """From the first registered frame: the set that its inliers are of."""
        sets = [base.templates, base.dense_templates]
        templates = max(sets, key=lambda one: int(_are_inliers(one, first).sum()))
        history = cls(templates, 0, np.full(len(templates), -_RETEST_FRAMES))
        history.note(first)
        return history

    def note(self, result: FrameRegistration) -> None:
        """Remember the inliers of a frame."""
        self.last_inlier[_are_inliers(self.templates, result)] = self.frame
        self.frame += 1

    def choose(self, before: ChainFrame, shape: tuple[int, ...]) -> Templates:
        """Inliers of the last frames, those that the frame before did not show, and some of the others in turn."""
        recent = self.frame - self.last_inlier <= _RETEST_FRAMES
        turn = np.arange(len(self.templates)) % _RETEST_FRAMES == self.frame % _RETEST_FRAMES
        xy_raw = before.transform.to_raw_roughly(self.templates.xy)  # row motion and mesh are a few pixels
        shown = ((xy_raw >= _SHOWN_PX) & (xy_raw <= np.array(shape[::-1]) - 1 - _SHOWN_PX)).all(axis=1)
        return self.templates.select(recent | turn | ~shown)


def _are_inliers(templates: Templates, result: FrameRegistration) -> Mask:
    """Mask of the patches (n,) that are among a frame's inliers: both are whole pixels of the base image."""
    inliers = result.control_points
    if inliers is None:
        return np.zeros(len(templates), bool)
    width = int(max(templates.xy[:, 0].max(initial=0), inliers.xy_base[:, 0].max(initial=0))) + 1
    whole = inliers.xy_base[(inliers.xy_base == np.rint(inliers.xy_base)).all(axis=1)]
    numbers, found = (np.asarray(xy @ (1, width), np.int64) for xy in (templates.xy, whole))
    return np.isin(numbers, found)


def _is_worse(result: FrameRegistration, first: FrameRegistration | None) -> bool:
    """Whether a frame may have gone astray from the first of its chain; from a known frame, where it is the first."""
    if first is None:
        return result.coverage < _MIN_FIRST_COVERAGE
    return (
        result.coverage < first.coverage - _MAX_COVERAGE_LOSS
        or not result.heldout_px <= _MAX_RESIDUAL_RATIO * first.heldout_px
    )


def shrink(grey: ByteArray) -> ByteArray:
    """The frame as optical flow sees it: the means of squares of 4 x 4 px; what fills no square is left out."""
    rows, columns = grey.shape[0] // 4, grey.shape[1] // 4
    small = cv2.resize(grey[: 4 * rows, : 4 * columns], (columns, rows), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)


def _register_by_flow(
    grey: GreyImage,
    small: GreyImage,
    before: ChainFrame,
    base: BaseReference,
    lens: Lens,
    config: RegistrationConfig,
    templates: Templates,
) -> FrameRegistration | None:
    """Register a frame from the inliers of the frame before, by these patches; None where it fails."""
    inliers = before.result.control_points
    if not inliers:
        return None
    chosen = np.linspace(0, len(inliers) - 1, min(_FLOW_POINTS, len(inliers))).astype(np.int64)
    start = ((inliers.xy_raw[chosen] + 0.5) * _FLOW_SCALE - 0.5).astype(np.float32)
    window = (_FLOW_WINDOW_PX, _FLOW_WINDOW_PX)
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        before.small, small, start[:, None], None, winSize=window, maxLevel=_FLOW_LEVELS, criteria=_FLOW_ENDS
    )
    xy_raw = (moved[:, 0].astype(np.float64) + 0.5) / _FLOW_SCALE - 0.5
    height, width = grey.shape
    kept = (found.ravel() > 0) & (xy_raw >= 0).all(axis=1) & (xy_raw <= (width - 1, height - 1)).all(axis=1)
    points = ControlPoints(xy_raw[kept], inliers.xy_base[chosen][kept], np.full(int(kept.sum()), _FLOW_SIGMA_PX))
    undistorted = as_points(lens.undistort_points(points.xy_raw))
    prior = fit_homography(undistorted, points.xy_base)
    if isinstance(prior, Failure):
        return None
    fitter = _FrameFitter(grey, base, lens, config)
    start_transform = PolyprojectiveTransform.of_frame(prior.matrix, lens, width, height)
    fitted = fitter.fit_with_alignment(points, start_transform, before.result.stiffness, templates)
    if isinstance(fitted, Failure):
        return None
    used, fit = fitted
    result = fitter.with_quality_metrics(used, fit, len(used), 0)
    return result if result.ok else None


def map_keypoints(keypoints: Keypoints, transform: FrameTransform) -> Keypoints:
    """A registered frame's keypoints in base pixels: the reference for the next frame."""
    xy = transform.to_base(keypoints.xy)
    finite = np.isfinite(xy).all(axis=1)
    return Keypoints(xy[finite], keypoints.descriptors[finite])


def register_frame(
    grey: GreyImage,
    keypoints: Keypoints,
    base: BaseReference,
    lens: Lens,
    config: RegistrationConfig,
    previous: Keypoints | None = None,
) -> FrameRegistration:
    """Register one frame.

    Parameters
    ----------
    grey
        (h, w) uint8, raw.
    keypoints
        Its keypoints, raw px.
    base
        Base image, from `prepare_base`.
    lens, config
        The camera's lens and the registration section of the configuration.
    previous
        Keypoints of the previous registered frame, base px; None: there is none.

    Returns
    -------
    FrameRegistration
        If it failed: no transform, and the reason in ``status``.
    """
    undistorted = as_points(lens.undistort_points(keypoints.xy))
    prior = _estimate_prior(undistorted, keypoints, base, previous)
    if isinstance(prior, Failure):
        return FrameRegistration(None, f"failed:{prior.reason}")
    predicted = prior(undistorted)
    from_base = _match_control_points(keypoints, predicted, base.keypoints, config, _BASE_SIGMA_PX)
    from_previous = _match_control_points(keypoints, predicted, previous, config, _PREVIOUS_SIGMA_PX)
    height, width = grey.shape
    start = PolyprojectiveTransform.of_frame(prior.matrix, lens, width, height)
    fitter = _FrameFitter(grey, base, lens, config)
    if config.model == "polyprojective":  # the paper matches base and previous frame alike
        fitted = fitter.fit_with_case_deletion(from_base.concatenate(from_previous))
    else:
        fitted = fitter.fit_with_alignment(
            from_base.concatenate(_select_in_empty_cells(from_previous, from_base, width, height)), start
        )
    if isinstance(fitted, Failure):
        return FrameRegistration(None, f"failed:{fitted.reason}", len(from_base), len(from_previous))
    used, fit = fitted
    return fitter.with_quality_metrics(used, fit, len(from_base), len(from_previous))


def _estimate_prior(
    undistorted: FloatArray, keypoints: Keypoints, base: BaseReference, previous: Keypoints | None
) -> HomographyTransform | Failure:
    """The prior homography: from the base image, else from the previous frame."""
    direct = estimate_homography_prior(undistorted, keypoints.descriptors, base.keypoints)
    if direct or previous is None:
        return direct if direct else Failure(f"no prior from the base image ({_reason(direct)})")
    chained = estimate_homography_prior(undistorted, keypoints.descriptors, previous)
    if chained:
        return chained
    return Failure(
        f"no prior, neither from the base image ({_reason(direct)}) nor from the previous frame ({_reason(chained)})"
    )


def _reason(result: object) -> str:
    return result.reason if isinstance(result, Failure) else ""


def _match_control_points(
    keypoints: Keypoints,
    predicted: FloatArray,
    reference: Keypoints | None,
    config: RegistrationConfig,
    sigma_px: float,
) -> ControlPoints:
    """Control points by guided matching; empty without a reference."""
    if reference is None:
        return ControlPoints(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    pairs = match_guided(predicted, keypoints.descriptors, reference, search_px=config.match_search_px)
    return ControlPoints(keypoints.xy[pairs[:, 0]], reference.xy[pairs[:, 1]], np.full(len(pairs), sigma_px))


@dataclass(frozen=True, eq=False)
class _FrameFitter:
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
                aligned.concatenate(_select_in_empty_cells(points, aligned, *self.size)) if chosen is None else aligned
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
        again = aligned.concatenate(_select_in_empty_cells(used, aligned, *self.size))
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


def _cell_index(xy_raw: FloatArray, width: int, height: int) -> IntArray:
    rows, columns = QUALITY_CELLS
    row = np.clip((xy_raw[:, 1] + 0.5) / height * rows, 0, rows - 1).astype(np.int64)
    column = np.clip((xy_raw[:, 0] + 0.5) / width * columns, 0, columns - 1).astype(np.int64)
    return np.asarray(row * columns + column)


def _select_in_empty_cells(points: ControlPoints, aligned: ControlPoints, width: int, height: int) -> ControlPoints:
    """Select the control points of ``points`` in the cells of the frame where ``aligned`` has none."""
    empty = np.ones(QUALITY_CELLS[0] * QUALITY_CELLS[1], bool)
    empty[_cell_index(aligned.xy_raw, width, height)] = False
    return points.select(empty[_cell_index(points.xy_raw, width, height)])


def _cell_rms(xy_raw: FloatArray, errors: FloatArray, width: int, height: int) -> FloatArray:
    rows, columns = QUALITY_CELLS
    cell = _cell_index(xy_raw, width, height)
    squares = np.bincount(cell, (errors**2).sum(axis=1), rows * columns)
    counts = np.bincount(cell, minlength=rows * columns)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.sqrt(squares / counts).reshape(rows, columns))
