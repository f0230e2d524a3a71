"""Inter-sensor registration: a frame to another sensor's image of the same area (paper: inter-sensor registration).

1. Coarse candidates (`coarse`): a SIFT homography, of the frame or its negative; a search over rotations and scales.
2. For each, coarse to fine, control points and a polyprojective (`control`).
3. Verification: non-overlapping patches that the fit did not use are matched independently. Control points 50 px apart
   share most of their 75-px patches and agree with each other on a wrong area too; these do not. The first candidate
   that is verified is the result. Each that fails leaves its scores, and the logger has them where all fail.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from schemas.arrays import Float32Array, FloatArray, GreyImage
from schemas.flight import BaseConfig
from velfield.camera.lens import Lens
from velfield.errors import Failure
from velfield.registration.fitting import Model
from velfield.registration.intersensor.coarse import (
    MIN_INLIERS,
    CoarseCandidate,
    estimate_sift_homography,
    search_similarity,
)
from velfield.registration.intersensor.control import (
    FINE_RADIUS_PX,
    FineFit,
    ImagePair,
    cv_errors,
    register_coarse_to_fine,
    warp_to_base_grid,
)
from velfield.registration.intersensor.correlation import match_grid
from velfield.registration.intersensor.modality import GRADIENT, MODALITIES, Modality
from velfield.registration.transforms import FrameTransform

_LOG = logging.getLogger(__name__)
MIRRORED = "found a mirrored image"
_CERTAIN_FRACTION = 0.5
"""With a smaller fraction of consistent patches, the flipped base image must not match too; a search does not count."""
MIN_CONSISTENT_FRACTION = 0.25
"""Smallest fraction of verification patches consistent with the map; wrong or flipped areas have 0.03 to 0.15."""
MIN_CONSISTENT_PATCHES = 12
"""And their smallest number."""

_VERIFICATION_COUNT, _VERIFICATION_SIDES_PX = 200, (21, 75)
_VERIFICATION_TOLERANCE_PX = 2.0
_MIN_ROW_CORRECTED_FRACTION = 0.45
"""Smallest fraction consistent after row correction; frames with a row motion of 4 px have 0.6."""
_MIN_BASE_CONTRAST_GREY = 1.0
_ROW_BANDS, _MIN_ROW_POINTS = 64, 8
"""Rows within a 64th of the frame are exposed at about the same time; their motion is the median of so many points."""
_ALL_SCALES = (0.5, 0.63, 0.79, 1.0, 1.26, 1.59, 2.0)
_ALL_ROTATIONS = tuple(np.radians(np.arange(0.0, 360.0, 10.0)))
_FINER_SCALES = (0.87, 0.93, 1.0, 1.07, 1.15)
_FINER_ROTATIONS = tuple(np.radians([-6.0, -3.0, 0.0, 3.0, 6.0]))
_FINER_TEMPLATE_HALF_PX = 80


@dataclass(frozen=True)
class IntersensorResult:
    """A frame's registration to the base image, with its quality metrics."""

    transform: FrameTransform
    """Raw px -> base px: lens, then polyprojective."""
    model: Model
    """The model of lower cross-validated error."""
    source_raw: FloatArray
    target: FloatArray
    cv_errors_px: FloatArray
    """(n, 2) raw px, (n, 2) base px, (n,) base px: control points and the cross-validated error of each."""
    cv_error_px: float
    """Their mean cross-validated error."""
    scale: float
    rotation_rad: float
    """Base px per frame px at the frame's centre, and rotation there, from +x towards +y."""
    method: str
    """How the coarse candidate was found."""
    error_map: Float32Array
    error_map_spacing_px: int
    """(rows, columns) float32 mean cross-validated error about each node of a grid over the base image, base px; NaN
    where no control point is near. Node (i, j) lies at base (j, i) times the spacing."""


def register_intersensor(
    image: GreyImage,
    base: GreyImage,
    config: BaseConfig,
    *,
    lens: Lens,
) -> IntersensorResult | Failure:
    """Register a raw frame (h, w) uint8 to another sensor's image (H, W) uint8.

    A failure's reason is one line; each candidate's scores go to this module's logger, at level DEBUG.
    """
    if float(base.std()) < _MIN_BASE_CONTRAST_GREY:
        return Failure("found an image of one grey level, expected one of the flight's area; give another")
    pair = ImagePair(image, base, lens, config)
    scores: list[str] = []
    for candidate in _coarse_candidates(pair, scores):
        fit = register_coarse_to_fine(pair, candidate)
        if isinstance(fit, Failure):
            scores.append(f"{candidate.method}: {fit.reason}")
            continue
        count, verification = int(fit.inliers.sum()), verify(pair, fit, candidate.modality)
        needed = f"{config.min_control_points} control points needed"
        scores.append(f"{candidate.method}: {count} of the {needed}, {verification.text}")
        if count >= config.min_control_points and verification.is_verified:
            if candidate.is_blind and not verification.is_certain:
                continue  # a town of equal blocks matches another place of its own kind, with up to 0.43 of the patches
            if not verification.is_certain and pair.flipped.matrix is not None:
                break  # straight roads match their own mirror image well enough to pass the verification
            return _to_result(pair, fit, candidate)
    return Failure(_explain_failure(pair, scores))


def _explain_failure(pair: ImagePair, scores: list[str]) -> str:
    """Message with the cause of a failed registration, and what to do."""
    _LOG.debug("no candidate is verified: %s", "; ".join(scores))
    flipped = pair.flipped
    if flipped.matrix is not None:
        return f"{MIRRORED} ({flipped.inliers} of {flipped.matches} SIFT matches are inliers); flip it"
    return (
        "not an image of this flight's area; give one of the area, seen from above, at 0.5 to 2 times the frames' scale"
    )


def _coarse_candidates(pair: ImagePair, scores: list[str]) -> Iterator[CoarseCandidate]:
    """Coarse maps, the most likely first, the slow search last; ``scores`` records the methods that gave none."""
    for modality in MODALITIES.values():
        if modality.sift_transform is None:
            continue
        image, method = modality.sift_transform(pair.image), f"SIFT ({modality.name})"
        sift = estimate_sift_homography(image, pair.base_keypoints, pair.lens, scale=pair.config.coarse_scale)
        if sift.matrix is None:
            scores.append(f"{method}: {sift.inliers} inliers of {sift.matches} matches, {MIN_INLIERS} needed")
            continue
        yield CoarseCandidate(sift.matrix, method, modality, sift.inliers / sift.matches)
        yield CoarseCandidate(sift.matrix, f"{method}, then {GRADIENT.name}", GRADIENT, sift.inliers / sift.matches)
    yield from _search_candidates(pair, scores)


def _search_candidates(pair: ImagePair, scores: list[str]) -> Iterator[CoarseCandidate]:
    """The best of a search over scales and rotations in each modality, each refined by a finer search."""
    found = search_similarity(pair.image, pair.base, pair.lens, scales=_ALL_SCALES, rotations_rad=_ALL_ROTATIONS)
    if not found:
        scores.append("search: no fit at any rotation and scale")
    for rough in found:
        finer = search_similarity(
            pair.image,
            pair.base,
            pair.lens,
            scales=_FINER_SCALES,
            rotations_rad=_FINER_ROTATIONS,
            initial=rough.matrix,
            template_half_px=_FINER_TEMPLATE_HALF_PX,
        )
        for fine in finer:
            if fine.modality == rough.modality:
                described = f"search ({fine.modality.name}), correlation {fine.score:.2f}"
                yield CoarseCandidate(fine.matrix, described, fine.modality, fine.score, is_blind=True)


@dataclass(frozen=True)
class VerificationPatches:
    """Independent check of a map: how many non-overlapping patches match at all, and how many where the map predicts.

    A rolling shutter may displace rows by more than the tolerance. ``row_corrected`` counts the patches that are
    consistent once the median displacement of control points in the same rows, elsewhere in the frame, is subtracted;
    up to a quarter are by chance on a wrong area in the gradient modality.
    """

    count: int = 0
    consistent: int = 0
    row_corrected: int = 0

    @property
    def is_verified(self) -> bool:
        """Whether enough patches are consistent, with or without row correction."""
        without = self.consistent >= max(MIN_CONSISTENT_PATCHES, MIN_CONSISTENT_FRACTION * self.count)
        return without or self.row_corrected >= max(
            2 * MIN_CONSISTENT_PATCHES, _MIN_ROW_CORRECTED_FRACTION * self.count
        )

    @property
    def is_certain(self) -> bool:
        """Whether so many are that a mirror image is ruled out."""
        return max(self.consistent, self.row_corrected) >= _CERTAIN_FRACTION * self.count

    @property
    def text(self) -> str:
        """The counts in words."""
        counts = f"{self.consistent} of {self.count} verification patches consistent"
        return f"{counts}, {self.row_corrected} after row correction"


def verify(pair: ImagePair, fit: FineFit, modality: Modality) -> VerificationPatches:
    """Match non-overlapping patches of the warped frame, independently of the control points, and compare."""
    images = warp_to_base_grid(pair, fit.transform, 1.0)
    if images is None:
        return VerificationPatches()
    moving, mask, reference, origin = images
    side = int(np.clip(np.sqrt(mask.sum() / _VERIFICATION_COUNT), *_VERIFICATION_SIDES_PX)) | 1
    matches = match_grid(
        moving, mask, reference, spacing_px=side, patch_px=side, radius_px=FINE_RADIUS_PX, modality=modality
    )
    raw = fit.transform.to_raw(matches.points + origin)
    corrected = matches.displacement - _estimate_row_motion(fit, raw, min_distance_px=1.5 * pair.config.patch_size_px)
    consistent, row_corrected = (
        int((np.linalg.norm(displacement, axis=1) < _VERIFICATION_TOLERANCE_PX).sum())
        for displacement in (matches.displacement, corrected)
    )
    return VerificationPatches(len(matches.points), consistent, row_corrected)


def _estimate_row_motion(fit: FineFit, raw: FloatArray, *, min_distance_px: float) -> FloatArray:
    """Median residual (n, 2), base px, of the control points in the same rows as raw points (n, 2), but apart."""
    residuals = fit.target - fit.transform.to_base(fit.source_raw)
    usable = np.linalg.norm(residuals, axis=1) < 2.0 * FINE_RADIUS_PX
    source_raw, residuals = fit.source_raw[usable], residuals[usable]
    half_band = fit.transform.height / _ROW_BANDS
    motion = np.zeros_like(raw)
    for k, (x, y) in enumerate(raw):
        same_rows = (np.abs(source_raw[:, 1] - y) < half_band) & (np.abs(source_raw[:, 0] - x) > min_distance_px)
        if same_rows.sum() >= _MIN_ROW_POINTS:
            motion[k] = np.median(residuals[same_rows], axis=0)
    return motion


def _to_result(pair: ImagePair, fit: FineFit, candidate: CoarseCandidate) -> IntersensorResult:
    source_raw, target = fit.source_raw[fit.inliers], fit.target[fit.inliers]
    errors = cv_errors(pair.lens.undistort_points(source_raw), target, fit.model)
    scale, rotation = fit.transform.scale_and_rotation()
    spacing = max(1, pair.config.grid_spacing_px)
    return IntersensorResult(
        transform=fit.transform,
        model=fit.model,
        source_raw=source_raw,
        target=target,
        cv_errors_px=errors,
        cv_error_px=float(errors.mean()),
        scale=scale,
        rotation_rad=rotation,
        method=candidate.method,
        error_map=_map_errors(target, errors, (pair.base.shape[0], pair.base.shape[1]), spacing),
        error_map_spacing_px=spacing,
    )


def _map_errors(points: FloatArray, errors: FloatArray, shape: tuple[int, int], spacing: int) -> Float32Array:
    """Gaussian-weighted mean error about each node, sigma one spacing; NaN farther than two spacings from any point."""
    ys, xs = np.arange(0, shape[0], spacing), np.arange(0, shape[1], spacing)
    weight, total = np.zeros((ys.size, xs.size)), np.zeros((ys.size, xs.size))
    for (x, y), error in zip(points, errors, strict=True):
        near_y, near_x = np.exp(-0.5 * ((ys - y) / spacing) ** 2), np.exp(-0.5 * ((xs - x) / spacing) ** 2)
        here = near_y[:, None] * near_x[None, :]
        weight += here
        total += here * error
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(weight > np.exp(-2.0), total / weight, np.nan), dtype=np.float32)
