"""Every frame to the base image of the same camera, and to the frame before it.

Paper: intra-sensor registration. For each frame, in order:

1. a prior straight from the base image: key points, MAGSAC homography, no other frame needed; from the previous
   registered frame's key points, mapped through its transform, where that fails;
2. key points matched within a window about the prior, to the base image and to the previous frame;
3. the joint robust fit of polyprojective and row spline (or the paper's case deletion, or a homography);
4. patches of the base image found below the pixel through that map, and the fit again, twice;
5. the displacement mesh, where the held-out points support one.

Matches to the previous frame carry its errors on, so that they would drift: they count only in those cells of the
picture where the base image gives nothing. Where the base image covers the frame, the result does not depend on where
the chain began.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from schemas.flight import RegistrationConfig
from velfield.camera.lens import Lens
from velfield.errors import Failure
from velfield.registration.alignment import MANY, Templates, align, blurred, make_templates
from velfield.registration.fitting import case_deletion
from velfield.registration.joint import ControlPoints, JointFit, joint_fit, kept_of
from velfield.registration.keypoints import KeyPoints, detect_key_points
from velfield.registration.matching import homography_prior, match_guided
from velfield.registration.mesh import MESH_TURNS, robust_mesh
from velfield.registration.transforms import (
    FrameTransform,
    HomographyTransform,
    PolyprojectiveTransform,
    as_points,
    normalisation_of,
    row_knots,
)

CERTIFICATE_CELLS = (6, 8)
"""Rows and columns of cells over the frame, for the spread of the control points and the map of their errors."""

_KEY_POINT_SIGMA_PX = 0.5
_PREVIOUS_SIGMA_PX = 0.7
_FIRST_SCALE_PX = 3.0
_LATER_SCALE_PX = 1.5
_COARSE_SHIFT_PX = 7.0
_FINE_SHIFT_PX = 2.5
_SURE_SHARE = 0.3
"""More of the base image's patches than this found near by: the key points' fit is near enough everywhere."""
_PLENTY_SHARE = 0.8
"""Fewer than this found, and more are looked for: of another sensor's picture half are, too few at the borders."""
_MIN_FOUND_SHARE = 0.15
"""Less than this share of the base image's patches found: it is not this place, whatever the prior says."""
_BASE_KEY_POINTS = 3
"""The base image keeps this many times a frame's key points at most, in proportion to its size."""


@dataclass(frozen=True, eq=False)
class BaseReference:
    """What frames are registered to. Picklable.

    Attributes
    ----------
    shape : (height, width) of the base image, px.
    key_points : of the base image, base px.
    templates, many : patches about its corners; more of them where half are not found.
    """

    shape: tuple[int, int]
    key_points: KeyPoints
    templates: Templates
    many: Templates


@dataclass(frozen=True, eq=False)
class FrameRegistration:
    """One frame's registration and its certificate.

    Attributes
    ----------
    transform : raw to base pixels; none where it failed.
    status : ``ok`` or ``failed:<reason with counts>``.
    count_base, count_previous : control points offered by the base image and by the previous frame.
    count_kept : control points that the robust fit rests on.
    residual_px, heldout_px : RMS distance of the kept control points, fitted and held out of the fit; NaN if failed.
    spread : share of the picture's cells that hold kept control points.
    error_map : (6, 8) RMS held-out distance of the kept control points a cell, base px; NaN where there are none.
    control_points : those kept.
    """

    transform: FrameTransform | None
    status: str
    count_base: int = 0
    count_previous: int = 0
    count_kept: int = 0
    residual_px: float = float("nan")
    heldout_px: float = float("nan")
    spread: float = 0.0
    error_map: FloatArray | None = None
    control_points: ControlPoints | None = None

    @property
    def ok(self) -> bool:
        """Whether the frame is registered."""
        return self.transform is not None


def prepare_base(
    grey: NDArray[np.uint8],
    config: RegistrationConfig,
    *,
    mask: NDArray[np.bool_] | None = None,
    frame_shape: tuple[int, int] | None = None,
) -> BaseReference:
    """Key points and patches of a base image.

    Parameters
    ----------
    grey
        (h, w) uint8.
    mask
        (h, w) bool: where the base image is known; none: everywhere.
    frame_shape
        (height, width) of the frames: a base image of several frames' size keeps more key points.
    """
    frame_area = grey.size if frame_shape is None else frame_shape[0] * frame_shape[1]
    share = float(np.clip(grey.size / frame_area, 1.0, _BASE_KEY_POINTS))
    key_points = detect_key_points(grey, config, mask, count=round(config.key_points * share))
    few, many = make_templates(grey, mask), make_templates(grey, mask, count=MANY)
    return BaseReference((grey.shape[0], grey.shape[1]), key_points, few, many)


def register_segment(
    frames: Iterable[tuple[int, NDArray[np.uint8], KeyPoints]],
    base: BaseReference,
    lens: Lens,
    config: RegistrationConfig,
    first_previous: KeyPoints | None = None,
) -> list[FrameRegistration]:
    """Register frames in time order; each result in the order of the frames.

    Parameters
    ----------
    frames
        (index, grey (h, w) uint8, key points in raw px) of each.
    first_previous
        Key points of the frame before the first, in base px (see `mapped_key_points`); none: the chain begins here.
    """
    results = []
    previous = first_previous
    for _, grey, key_points in frames:
        result = register_frame(grey, key_points, base, lens, config, previous)
        results.append(result)
        if result.transform is not None:
            previous = mapped_key_points(key_points, result.transform)
    return results


def mapped_key_points(key_points: KeyPoints, transform: FrameTransform) -> KeyPoints:
    """A registered frame's key points in base pixels: they stand for the previous registered image."""
    xy = transform.to_base(key_points.xy)
    finite = np.isfinite(xy).all(axis=1)
    return KeyPoints(xy[finite], key_points.descriptors[finite])


def register_frame(
    grey: NDArray[np.uint8],
    key_points: KeyPoints,
    base: BaseReference,
    lens: Lens,
    config: RegistrationConfig,
    previous: KeyPoints | None = None,
) -> FrameRegistration:
    """Register one frame.

    Parameters
    ----------
    grey
        (h, w) uint8, raw.
    key_points
        Its key points, raw px.
    previous
        The previous registered frame's key points, base px.
    """
    undistorted = as_points(lens.undistort_points(key_points.xy))
    prior = _prior(undistorted, key_points, base, previous)
    if isinstance(prior, Failure):
        return FrameRegistration(None, f"failed:{prior.reason}")
    predicted = prior(undistorted)
    from_base = _matched(key_points, predicted, base.key_points, config, _KEY_POINT_SIGMA_PX)
    from_previous = _matched(key_points, predicted, previous, config, _PREVIOUS_SIGMA_PX)
    height, width = grey.shape
    corners = as_points(lens.undistort_points(_corners(width, height)))
    start = PolyprojectiveTransform.from_homography(
        prior.matrix, normalisation_of(corners), normalisation_of(prior(corners))
    )
    task = _Task(grey, base, lens, config)
    if config.model == "polyprojective":  # the paper's, to both alike
        fitted = task.deleted(from_base.joined(from_previous))
    else:
        fitted = task.aligned(from_base.joined(_elsewhere(from_previous, from_base, width, height)), start)
    if isinstance(fitted, Failure):
        return FrameRegistration(None, f"failed:{fitted.reason}", len(from_base), len(from_previous))
    used, fit = fitted
    return task.certified(used, fit, len(from_base), len(from_previous))


def _prior(
    undistorted: FloatArray, key_points: KeyPoints, base: BaseReference, previous: KeyPoints | None
) -> HomographyTransform | Failure:
    """The homography that starts the frame: from the base image, or chained where that fails."""
    straight = homography_prior(undistorted, key_points.descriptors, base.key_points)
    if straight or previous is None:
        return straight if straight else Failure(f"no prior from the base image ({_reason(straight)})")
    chained = homography_prior(undistorted, key_points.descriptors, previous)
    if chained:
        return chained
    return Failure(
        f"no prior, neither from the base image ({_reason(straight)}) nor from the previous frame ({_reason(chained)})"
    )


def _reason(result: object) -> str:
    return result.reason if isinstance(result, Failure) else ""


def _corners(width: int, height: int) -> FloatArray:
    return np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], dtype=np.float64)


def _matched(
    key_points: KeyPoints,
    predicted: FloatArray,
    reference: KeyPoints | None,
    config: RegistrationConfig,
    sigma_px: float,
) -> ControlPoints:
    """Control points from guided matches; none where there is no reference."""
    if reference is None:
        return ControlPoints(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    pairs = match_guided(predicted, key_points.descriptors, reference, search_px=config.match_search_px)
    return ControlPoints(key_points.xy[pairs[:, 0]], reference.xy[pairs[:, 1]], np.full(len(pairs), sigma_px))


@dataclass(frozen=True, eq=False)
class _Task:
    """What stays the same while one frame is fitted."""

    grey: NDArray[np.uint8]
    base: BaseReference
    lens: Lens
    config: RegistrationConfig

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the frame, px."""
        return self.grey.shape[1], self.grey.shape[0]

    def _fit(
        self, points: ControlPoints, start: PolyprojectiveTransform, earlier: JointFit | None = None
    ) -> JointFit | Failure:
        if len(points) < self.config.min_control_points:
            return Failure(f"{len(points)} control points, {self.config.min_control_points} needed")
        width, height = self.size
        return joint_fit(
            points,
            start=start,
            lens=self.lens,
            width=width,
            height=height,
            knots=row_knots(self.config),
            homography=self.config.model == "homography",
            start_rows=None if earlier is None else earlier.transform.row_coefficients,
            start_scale_px=_FIRST_SCALE_PX if earlier is None else _LATER_SCALE_PX,
            start_stiffness=None if earlier is None else earlier.stiffness,
        )

    def aligned(
        self, points: ControlPoints, start: PolyprojectiveTransform
    ) -> tuple[ControlPoints, JointFit] | Failure:
        """Fit to matched key points, then twice to patches of the base image found through that fit.

        Where few patches lie near by they are looked for farther off first. Elsewhere that does harm: at a border of
        another sensor's picture, where few patches are right, wrong ones from afar pulled the rows by two pixels.
        """
        fit = self._fit(points, start)
        if isinstance(fit, Failure):
            return fit
        fine, coarse = blurred(self.grey)
        templates = self.base.templates
        found, looked_for = align(fine, fit.transform, templates, coarse=False, max_shift_px=_FINE_SHIFT_PX)
        plenty = len(found) >= _PLENTY_SHARE * looked_for
        if not plenty:
            templates = self.base.many
        steps = [(fine, False, _FINE_SHIFT_PX)] * 2
        if len(found) < _SURE_SHARE * looked_for:
            steps.insert(0, (coarse, True, _COARSE_SHIFT_PX))
        used = points
        for k, (picture, is_coarse, limit) in enumerate(steps):
            if k or not plenty:
                found, looked_for = align(picture, fit.transform, templates, coarse=is_coarse, max_shift_px=limit)
            if len(found) < _MIN_FOUND_SHARE * looked_for:
                return Failure(f"{len(found)} of {looked_for} patches of the base image found")
            used = found.joined(_elsewhere(points, found, *self.size))
            following = self._fit(used, fit.transform.polyprojective, fit)
            if isinstance(following, Failure):
                return following
            fit = following
        return used, fit

    def deleted(self, points: ControlPoints) -> tuple[ControlPoints, JointFit] | Failure:
        """The paper's fit: polyprojective by case deletion on matched key points."""
        config = self.config
        source = as_points(self.lens.undistort_points(points.xy_raw))
        result = case_deletion(
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
        kept = points.where(result.kept)
        refit = joint_fit(
            kept, start=result.transform, lens=self.lens, width=width, height=height, knots=0, start_scale_px=3.0
        )
        if isinstance(refit, Failure):
            return refit
        residuals = kept.xy_base - transform.to_base(kept.xy_raw)
        heldout = refit.heldout - refit.residuals + residuals
        ones = np.ones(len(kept))
        return kept, JointFit(transform, ones, residuals, heldout, refit.scale, refit.stiffness)

    def certified(
        self, points: ControlPoints, fit: JointFit, count_base: int, count_previous: int
    ) -> FrameRegistration:
        """The mesh, the counts and the held-out errors; a failure where they do not bear the frame out."""
        width, height = self.size
        transform, residuals, heldout, weights = fit.transform, fit.residuals, fit.heldout, fit.weights
        if self.config.mesh and self.config.model != "homography":
            found, weights = robust_mesh(
                points,
                fit,
                width=width,
                height=height,
                cell_size_px=self.config.cell_size_px,
                turns=1 if self.config.model == "polyprojective" else MESH_TURNS,
            )
            heldout = found.heldout
            transform = replace(transform, mesh=found.mesh, cell_size_px=self.config.cell_size_px)
            residuals = points.xy_base - transform.to_base(points.xy_raw)
        kept = kept_of(weights)
        error_map = _error_map(points.xy_raw[kept], heldout[kept], width, height)
        count, heldout_px = int(kept.sum()), _rms(heldout[kept])
        counts = (count_base, count_previous, count)
        if count < self.config.min_control_points:
            reason = f"{count} of {len(points)} control points agree, {self.config.min_control_points} needed"
            return FrameRegistration(None, f"failed:{reason}", *counts)
        if not heldout_px <= self.config.max_residual_px:
            reason = f"held-out residual {heldout_px:.2f} px, at most {self.config.max_residual_px:g} allowed"
            return FrameRegistration(None, f"failed:{reason}", *counts)
        spread = float(np.isfinite(error_map).mean())
        return FrameRegistration(
            transform, "ok", *counts, _rms(residuals[kept]), heldout_px, spread, error_map, points.where(kept)
        )


def _cell_of(xy_raw: FloatArray, width: int, height: int) -> NDArray[np.int64]:
    rows, columns = CERTIFICATE_CELLS
    row = np.clip((xy_raw[:, 1] + 0.5) / height * rows, 0, rows - 1).astype(np.int64)
    column = np.clip((xy_raw[:, 0] + 0.5) / width * columns, 0, columns - 1).astype(np.int64)
    return np.asarray(row * columns + column)


def _elsewhere(points: ControlPoints, found: ControlPoints, width: int, height: int) -> ControlPoints:
    """Those of ``points`` in cells of the picture where ``found`` has none."""
    taken = np.unique(_cell_of(found.xy_raw, width, height))
    return points.where(~np.isin(_cell_of(points.xy_raw, width, height), taken))


def _error_map(xy_raw: FloatArray, errors: FloatArray, width: int, height: int) -> FloatArray:
    rows, columns = CERTIFICATE_CELLS
    cell = _cell_of(xy_raw, width, height)
    squares = np.bincount(cell, (errors**2).sum(axis=1), rows * columns)
    counts = np.bincount(cell, minlength=rows * columns)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.sqrt(squares / counts).reshape(rows, columns))


def _rms(vectors: FloatArray) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean())) if len(vectors) else float("nan")
