"""The fine stage of inter-sensor registration: from a coarse map to control points and the map that they follow.

Paper: inter-sensor registration, after the coarse homography. The frame is put on the base image's grid by what is
known so far, patches are correlated on a grid, and a better map is fitted; from some 400 px of ground at first, where a
coarse map may be far off, to full size, where the paper starts. There the second-order polyprojective is fitted by case
deletion as in the paper, and on from there: its two pixels still hold wrong matches, so the points are chosen anew by
the residual's own scale until the choice stays.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, GreyImage
from schemas.flight import BaseConfig
from velfield.camera.lens import Lens
from velfield.errors import Failure
from velfield.registration.coarse import Coarse, reduced
from velfield.registration.correlation import GridMatches, Look, match_grid
from velfield.registration.fitting import Model, case_deletion, fit_polyprojective
from velfield.registration.transforms import FrameTransform, PolyprojectiveTransform, normalisation_of
from velfield.registration.warp import footprint, warp_to_base

FINE_RADIUS_PX = 10
"""How far a patch is searched once the map is about right, px."""

_FIRST_SIDE_PX = 400.0
_WANTED_POINTS = 500
_LEAST_SCORE = 0.2
_LEAST_POINTS = 20
_FOLDS = 5


@dataclass(frozen=True)
class Pair:
    """The two pictures and what maps between them needs."""

    image: GreyImage
    base: GreyImage
    lens: Lens
    config: BaseConfig

    def transform(self, polyprojective: PolyprojectiveTransform) -> FrameTransform:
        """The frame's map, raw px to base px, with the lens before a map of undistorted px."""
        height, width = self.image.shape
        return FrameTransform(width=width, height=height, lens=self.lens, polyprojective=polyprojective)

    def from_homography(self, matrix: FloatArray) -> FrameTransform:
        """The same of a homography (3, 3)."""
        height, width = self.image.shape
        corners = np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], dtype=np.float64)
        source = self.lens.undistort_points(corners)
        target = _by_homography(matrix, source)
        return self.transform(
            PolyprojectiveTransform.from_homography(matrix, normalisation_of(source), normalisation_of(target))
        )


@dataclass(frozen=True)
class Fitted:
    """A map at the end of a level: its control points of that level and how many were tried."""

    transform: FrameTransform
    model: Model
    source_raw: FloatArray
    target: FloatArray
    kept: NDArray[np.bool_]
    mean_error_px: float
    left_out_error_px: float


def coarse_to_fine(pair: Pair, candidate: Coarse) -> Fitted | Failure:
    """Grid matches at growing scales, each from the map of the one before."""
    transform = pair.from_homography(candidate.matrix)
    x0, y0, x1, y1 = footprint(transform, (pair.image.shape[0], pair.image.shape[1]))
    side = max(x1 - x0, y1 - y0)
    if not np.isfinite(side) or side < 2 * pair.config.patch_size_px:
        return Failure(f"the frame would cover {side:.0f} px of the base image")
    scale, fitted = min(1.0, _FIRST_SIDE_PX / side), None
    radius = pair.config.search_radius_px
    while True:
        last = scale >= 1.0
        models: tuple[Model, ...] = ("homography", "polyprojective") if last else ("homography",)
        fitted = _level(pair, transform, scale, radius, candidate.look, models)
        if isinstance(fitted, Failure):
            return fitted
        transform = fitted.transform
        if last and radius == FINE_RADIUS_PX:
            return _finest(pair, fitted, candidate.look)
        # Another pass at full size if this was the first: the patches were those of a map still far off.
        scale, radius = min(1.0, 2.0 * scale), FINE_RADIUS_PX


def _finest(pair: Pair, fitted: Fitted, look: Look) -> Fitted:
    """The same once more by edges, which sensors share more exactly than tones; kept where left-out points say so."""
    if look == "edges":
        return fitted
    by_edges = _level(pair, fitted.transform, 1.0, FINE_RADIUS_PX, "edges", ("homography", "polyprojective"))
    if isinstance(by_edges, Failure) or by_edges.kept.sum() < pair.config.min_control_points:
        return fitted
    return by_edges if by_edges.left_out_error_px < fitted.left_out_error_px else fitted


def _level(
    pair: Pair, transform: FrameTransform, scale: float, radius_px: int, look: Look, models: tuple[Model, ...]
) -> Fitted | Failure:
    """One level: warp, match on the grid, fit robustly."""
    pictures = on_base_grid(pair, transform, scale)
    if pictures is None:
        return Failure("the frame would lie outside the base image")
    moving, mask, reference, origin = pictures
    matches = match_grid(
        moving,
        mask,
        reference,
        spacing_px=_spacing(mask, pair.config.grid_spacing_px),
        patch_px=pair.config.patch_size_px,
        radius_px=radius_px,
        look=look,
    )
    return _fit_matches(pair, transform, matches, origin, scale, models)


def on_base_grid(
    pair: Pair, transform: FrameTransform, scale: float
) -> tuple[GreyImage, NDArray[np.bool_], GreyImage, tuple[int, int]] | None:
    """The frame on the base image's grid at a scale, its mask, that part of the base image, the part's origin."""
    window = _window(pair, transform)
    if window is None:
        return None
    x0, y0, width, height = window
    moving, mask = warp_to_base(pair.image, transform, window=window, scale=scale)
    reference = reduced(np.ascontiguousarray(pair.base[y0 : y0 + height, x0 : x0 + width]), scale)
    rows, columns = min(moving.shape[0], reference.shape[0]), min(moving.shape[1], reference.shape[1])
    return moving[:rows, :columns], mask[:rows, :columns], reference[:rows, :columns], (x0, y0)


def _window(pair: Pair, transform: FrameTransform) -> tuple[int, int, int, int] | None:
    """The base image's part that the frame covers, px."""
    x0, y0, x1, y1 = footprint(transform, (pair.image.shape[0], pair.image.shape[1]))
    if not np.isfinite([x0, y0, x1, y1]).all():
        return None
    height, width = pair.base.shape
    margin = pair.config.search_radius_px
    left, top = max(int(x0) - margin, 0), max(int(y0) - margin, 0)
    right, bottom = min(int(x1) + margin + 1, width), min(int(y1) + margin + 1, height)
    least = pair.config.patch_size_px
    return (left, top, right - left, bottom - top) if min(right - left, bottom - top) > least else None


def _spacing(mask: NDArray[np.bool_], wanted_px: int) -> int:
    """The grid's spacing: as wanted, closer where the picture is too small to give enough points."""
    return max(4, min(wanted_px, int(np.sqrt(mask.sum() / _WANTED_POINTS))))


def _fit_matches(
    pair: Pair,
    transform: FrameTransform,
    matches: GridMatches,
    origin: tuple[int, int],
    scale: float,
    models: tuple[Model, ...],
) -> Fitted | Failure:
    """The map that most matches of a level follow: the paper's case deletion, then by the residual's own scale."""
    clear = matches.score >= _LEAST_SCORE
    points, displacement = matches.points[clear], matches.displacement[clear]
    base_points = (points + 0.5) / scale - 0.5 + origin
    source_raw = transform.to_raw(base_points)
    target = base_points + displacement / scale
    inside = np.isfinite(source_raw).all(axis=1)
    source_raw, target = source_raw[inside], target[inside]
    undistorted = pair.lens.undistort_points(source_raw)
    near = _near_one_homography(undistorted, target, 1.0 / scale)
    best: Fitted | None = None
    reason = "the map folds or runs away on the frame"
    for model in models:
        settled = _by_case_deletion(undistorted, target, near, model, scale, pair.config)
        if isinstance(settled, Failure):
            reason = f"{settled.reason} ({near.size} correlated, {near.sum()} near one homography)"
            continue
        fit, kept, mean_error_px = settled
        left_out = float(left_out_errors(undistorted[kept], target[kept], model).mean())
        fitted = Fitted(pair.transform(fit), model, source_raw, target, kept, mean_error_px, left_out)
        # Second-order terms that do not help points left out, or that fold the frame's corners, are worse than none.
        if _sound(fitted.transform) and (best is None or left_out < best.left_out_error_px):
            best = fitted
    return best or Failure(reason)


def _by_case_deletion(
    source: FloatArray, target: FloatArray, near: NDArray[np.bool_], model: Model, scale: float, config: BaseConfig
) -> tuple[PolyprojectiveTransform, NDArray[np.bool_], float] | Failure:
    """The paper's case deletion among the points ``near`` one homography, then on until the points settle."""
    deleted = case_deletion(
        source[near],
        target[near],
        model=model,
        drop_fraction=config.drop_fraction,
        max_mean_error_px=max(config.max_mean_error_px, 1.0 / scale),
        min_control_points=_LEAST_POINTS,
    )
    if isinstance(deleted, Failure):
        return deleted
    kept = near.copy()
    kept[near] = deleted.kept
    return _settle(source, target, kept, model, least_px=0.3 / scale)


def _sound(transform: FrameTransform) -> bool:
    """Whether the map neither folds nor runs away anywhere on the frame: its scale changes by less than fourfold."""
    grid = np.stack(
        np.meshgrid(np.linspace(0, transform.width - 1, 9), np.linspace(0, transform.height - 1, 9)), axis=-1
    ).reshape(-1, 2)
    j = transform.jacobian(grid)
    area = j[:, 0, 0] * j[:, 1, 1] - j[:, 0, 1] * j[:, 1, 0]
    return bool(np.all(np.isfinite(area)) and area.min() > 0 and area.max() < 16.0 * area.min())


def _near_one_homography(source: FloatArray, target: FloatArray, unit_px: float) -> NDArray[np.bool_]:
    """Matches (n,) roughly on the homography that most follow: seventeen parameters fitted to wrong matches fold."""
    if len(source) < _LEAST_POINTS:
        return np.zeros(len(source), dtype=bool)
    matrix, _ = cv2.findHomography(source, target, cv2.USAC_MAGSAC, 3.0 * unit_px, maxIters=5000, confidence=0.999)
    if matrix is None:
        return np.zeros(len(source), dtype=bool)
    return np.asarray(np.linalg.norm(_by_homography(matrix, source) - target, axis=1) < 12.0 * unit_px)


def _settle(
    source: FloatArray, target: FloatArray, kept: NDArray[np.bool_], model: Model, *, least_px: float
) -> tuple[PolyprojectiveTransform, NDArray[np.bool_], float] | Failure:
    """Refit and choose the points anew, within three of the residual's own scale, until the choice stays."""
    for _ in range(20):
        fit = fit_polyprojective(source[kept], target[kept], model=model)
        if isinstance(fit, Failure):
            return fit
        error = np.nan_to_num(np.linalg.norm(fit(source) - target, axis=1), nan=np.inf)
        # Of a two-dimensional Gaussian error half lies within 1.18 sigma.
        sigma = float(np.median(error[kept])) / 1.18
        chosen = error < 3.0 * max(sigma, least_px)
        if np.array_equal(chosen, kept) or chosen.sum() < 12:
            break
        kept = chosen
    fit = fit_polyprojective(source[kept], target[kept], model=model)
    if isinstance(fit, Failure):
        return fit
    error = np.linalg.norm(fit(source[kept]) - target[kept], axis=1)
    return fit, kept, float(error.mean())


def left_out_errors(source: FloatArray, target: FloatArray, model: Model) -> FloatArray:
    """Each point's error (n,) under the map fitted to the other folds."""
    fold = np.arange(len(source)) * 7 % _FOLDS
    errors = np.full(len(source), np.inf)
    for part in range(_FOLDS):
        fit = fit_polyprojective(source[fold != part], target[fold != part], model=model)
        if not isinstance(fit, Failure):
            errors[fold == part] = np.linalg.norm(fit(source[fold == part]) - target[fold == part], axis=1)
    return np.asarray(np.nan_to_num(errors, nan=np.inf), dtype=np.float64)


def _by_homography(matrix: FloatArray, xy: FloatArray) -> FloatArray:
    mapped = np.column_stack([xy, np.ones(len(xy))]) @ matrix.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])
