"""Intra-sensor registration: every frame to the base image of the same camera, and to the frame before it.

Paper: intra-sensor registration. The first frame of a chain, and every one that the way below loses, goes through
these steps:

1. a prior homography from the base image (SIFT keypoints, MAGSAC); if it fails, from the previous registered frame;
2. guided matching of the keypoints in a window about the prior, to the base image and to the previous frame;
3. the fit, by ``model``: the joint robust fit of polyprojective and row spline (`velfield.registration.joint`, the
   default), a homography fitted in the same way, or with ``model="polyprojective"`` the paper's, by case deletion
   (`velfield.registration.fitting`), after which there is no step 4;
4. subpixel alignment of patches of the base image through that map, and the fit again, twice;
5. the displacement mesh, if cross-validation supports one.

Every other frame, and the first where it follows a known one, starts from the one before (``start="optical_flow"``),
since keypoints cost more than all else: the inliers of that frame are tracked into this one by pyramidal Lucas-Kanade,
a fit to them takes the place of steps 1 to 3, and steps 4 and 5 follow. Nothing of the earlier frame's error remains:
only patches that are aligned to the base image itself are fitted and counted. A frame that comes out worse than the one
that its chain began with, or as the first in fewer than half of its cells, is registered again by its keypoints.

Matches to the previous frame propagate its errors and would let the chain drift: they are used only in those cells of
the frame where the base image gives no match. Where the base image covers the frame, the result does not depend on
where the chain began.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from schemas.arrays import ByteArray, FloatArray, GreyImage, IntArray, Mask
from schemas.flight import RegistrationConfig
from velfield.camera.lens import Lens
from velfield.errors import Failure
from velfield.parallel import once
from velfield.registration.alignment import (
    HALF_PATCH,
    N_PATCHES_CROSS_SENSOR,
    N_PATCHES_SAME_SENSOR,
    Templates,
    make_template_sets,
)
from velfield.registration.control_points import ControlPoints
from velfield.registration.frame_fit import BaseReference, FrameFitter, FrameRegistration, select_in_empty_cells
from velfield.registration.keypoints import (
    Keypoints,
    detect_keypoints,
    estimate_homography_prior,
    fit_homography,
    match_guided,
)
from velfield.registration.transforms import FrameTransform, HomographyTransform, PolyprojectiveTransform, as_points

_BASE_SIGMA_PX = 0.5
_PREVIOUS_SIGMA_PX = 0.7
_RETEST_FRAMES = 8
"""In a chain, a patch that was an inlier in none of so many frames is tried in one of so many: most patches of another
sensor's image never align, and those take the most iterations."""
_SHOWN_PX = 2 * HALF_PATCH
"""A patch that is as far from the frame's border has been seen."""
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


def prepare_base(
    grey: GreyImage,
    config: RegistrationConfig,
    *,
    mask: Mask | None = None,
    frame_shape: tuple[int, int] | None = None,
) -> BaseReference:
    """Find the patches of a base image (h, w) uint8; its keypoints are detected when they are first asked for.

    It is valid in ``mask`` (h, w) bool, None everywhere; one larger than frames of (height, width) keeps more of them.
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
    before: "ChainFrame | None" = None,
) -> list[FrameRegistration]:
    """Register a chain of frames in the order of time, or against it; results in the order of the frames.

    Each is (index, grey (h, w) uint8, function that detects its keypoints in raw px). From ``before``, a frame of known
    map, optical flow may start the first; its keypoints are not used.
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
            previous = None if latest is None else map_keypoints(latest[0](), latest[1])
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
    """Patches of the base image that were recently inliers in a chain of frames."""

    templates: Templates
    """Those in use."""
    frame: int
    """Number of the frame in the chain."""
    last_inlier: IntArray
    """(n,) number of the frame in which each was an inlier last."""

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
    fitter = FrameFitter(grey, base, lens, config)
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
    """Register one raw frame (h, w) uint8 by its keypoints, raw px, and those of the previous registered one, base px.

    If it failed, the result has no transform, and the reason in ``status``.
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
    fitter = FrameFitter(grey, base, lens, config)
    if config.model == "polyprojective":  # the paper matches base and previous frame alike
        fitted = fitter.fit_with_case_deletion(from_base.concatenate(from_previous))
    else:
        fitted = fitter.fit_with_alignment(
            from_base.concatenate(select_in_empty_cells(from_previous, from_base, width, height)), start
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
    if not isinstance(direct, Failure):
        return direct
    if previous is None:
        return Failure(f"no prior from the base image ({direct.reason})")
    chained = estimate_homography_prior(undistorted, keypoints.descriptors, previous)
    if not isinstance(chained, Failure):
        return chained
    return Failure(
        f"no prior, neither from the base image ({direct.reason}) nor from the previous frame ({chained.reason})"
    )


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
