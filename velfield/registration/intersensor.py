"""A frame registered to another sensor's picture of the place (paper: inter-sensor registration).

1. Coarse candidates (`coarse`): SIFT and a robust homography, upright or of the negative; a search over rotations and
   scales.
2. Each, coarse to fine, to control points and a polyprojective (`control`).
3. The verdict: patches that do not overlap, none of them used by the fit, each asked where it lies. Control points
   50 px apart share much of their 75-px patches, and on a wrong place agree with each other; these do not. Each
   candidate that fails leaves its scores, and the failure says them in one line.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, GreyImage
from schemas.flight import BaseConfig
from velfield.camera.lens import Lens
from velfield.errors import Failure
from velfield.registration.coarse import LEAST_INLIERS, Coarse, search_similarity, sift_agreement
from velfield.registration.control import (
    FINE_RADIUS_PX,
    Fitted,
    Pair,
    coarse_to_fine,
    left_out_errors,
    on_base_grid,
)
from velfield.registration.correlation import Look, match_grid
from velfield.registration.fitting import Model
from velfield.registration.transforms import FrameTransform

_SURE_SHARE = 0.5
"""Below this share of agreeing patches a place is believed only if its mirror picture is not."""
MIN_AGREEING_SHARE = 0.25
"""Share of the separate patches that must lie where the map says; on another place, or mirrored, .03 to .15 do."""
MIN_AGREEING_PATCHES = 12
"""And no fewer of them than this."""

_WITNESS_COUNT, _WITNESS_SIDES_PX = 200, (21, 75)
_WITNESS_TOLERANCE_PX = 2.0
_BY_ROWS_SHARE = 0.45
"""Share of them that must agree by their rows where fewer do straight; of frames whose rows wobble by 4 px, .6 do."""
_LEAST_CONTRAST_GREY = 1.0
_ROW_BANDS, _ROW_POINTS = 64, 8
"""Rows within a 64th of the frame were taken at about one time; so many points tell how they moved."""
_NEAR_SCALES = (0.8, 0.89, 1.0, 1.12, 1.25)
_NEAR_TURNS = tuple(np.radians([-10.0, -5.0, 0.0, 5.0, 10.0]))
_ALL_SCALES = (0.5, 0.63, 0.79, 1.0, 1.26, 1.59, 2.0)
_ALL_TURNS = tuple(np.radians(np.arange(0.0, 360.0, 10.0)))
_FINER_SCALES = (0.87, 0.93, 1.0, 1.07, 1.15)
_FINER_TURNS = tuple(np.radians([-6.0, -3.0, 0.0, 3.0, 6.0]))
_FINER_DISK_PX = 80


@dataclass(frozen=True)
class IntersensorResult:
    """A frame's place on the base image and how good it is.

    Attributes
    ----------
    transform
        Raw px -> base px: lens, then the map.
    model
        The map that left-out points chose.
    source_raw, target, error_left_out_px
        (n, 2) raw px, (n, 2) base px, (n,) base px: control points and each one's error when left out of the fit.
    mean_error_px, left_out_error_px
        Mean distance of the control points, fitted and left out, base px.
    tried_points
        How many points were correlated.
    scale, rotation_rad
        Base px a frame px at the frame's middle, and the turn there, from +x towards +y.
    scores
        What each candidate came to.
    error_map, error_map_spacing_px
        (rows, columns) float32 mean left-out error about each node of a grid over the base image, base px; NaN where no
        control point is near. Node (i, j) lies at base (j, i) times the spacing.
    """

    transform: FrameTransform
    model: Model
    source_raw: FloatArray
    target: FloatArray
    error_left_out_px: FloatArray
    mean_error_px: float
    left_out_error_px: float
    tried_points: int
    scale: float
    rotation_rad: float
    how: str
    scores: tuple[str, ...]
    error_map: NDArray[np.float32]
    error_map_spacing_px: int


def register_intersensor(
    image: GreyImage,
    base: GreyImage,
    config: BaseConfig,
    *,
    lens: Lens,
    initial: FloatArray | None = None,
) -> IntersensorResult | Failure:
    """Register a raw frame to another sensor's picture.

    Parameters
    ----------
    image
        (h, w) uint8, raw.
    base
        (H, W) uint8, the base image.
    config
        The base section of the flight's configuration.
    lens
        The camera's lens.
    initial
        (3, 3) undistorted frame px -> base px, tried first; may be off by a fifth in scale and ten degrees.

    Returns
    -------
    IntersensorResult or Failure
        The failure's reason is one line with each candidate's scores.
    """
    if float(base.std()) < _LEAST_CONTRAST_GREY:
        return Failure("found a picture of one grey level, expected one of the flight's place; give another")
    pair = Pair(image, base, lens, config)
    scores: list[str] = []
    for candidate in _candidates(pair, initial, scores):
        fitted = coarse_to_fine(pair, candidate)
        if isinstance(fitted, Failure):
            scores.append(f"{candidate.how}: {fitted.reason}")
            continue
        count, heard = int(fitted.kept.sum()), _witnesses(pair, fitted, candidate.look)
        scores.append(f"{candidate.how}: {count} control points, {heard.text}")
        if count >= config.min_control_points and heard.borne_out:
            if not heard.sure and _is_mirrored(pair):
                break  # straight roads agree with their own mirror picture well enough to be taken for the place
            return _result(pair, fitted, candidate, tuple(scores))
    return Failure(_why_not(pair, scores))


def _is_mirrored(pair: Pair) -> bool:
    """Whether the base image, flipped, shows the place beyond doubt."""
    flipped = sift_agreement(pair.image, pair.base, pair.lens, wanted_scale=pair.config.coarse_scale, mirrored=True)
    return flipped.matrix is not None


def _why_not(pair: Pair, scores: list[str]) -> str:
    """What was found and what to do first, for people; then the scores."""
    mirrored = sift_agreement(pair.image, pair.base, pair.lens, wanted_scale=pair.config.coarse_scale, mirrored=True)
    if mirrored.matrix is not None:
        return f"found a mirrored picture ({mirrored.inliers} of {mirrored.matches} SIFT matches agree so); flip it"
    needed = f"{pair.config.min_control_points} control points and {MIN_AGREEING_SHARE:.0%} of separate patches needed"
    return (
        "not a picture of this flight's place; give one of the place, seen from above, at 0.5 to 2 times the frames' "
        f"scale. Tried ({needed}): {'; '.join(scores)}"
    )


def _candidates(pair: Pair, initial: FloatArray | None, scores: list[str]) -> Iterator[Coarse]:
    """Coarse maps, the likeliest first; the slow search only when the others failed. ``scores`` gets what had none."""
    if initial is not None:
        yield from _searched(pair, "given", (_NEAR_SCALES, _NEAR_TURNS), np.asarray(initial, dtype=np.float64), scores)
    for how, image in (("SIFT", pair.image), ("SIFT of the negative", np.bitwise_not(pair.image))):
        found = sift_agreement(image, pair.base, pair.lens, wanted_scale=pair.config.coarse_scale)
        if found.matrix is None:
            scores.append(f"{how}: {found.inliers} of {found.matches} matches agree, {LEAST_INLIERS} needed")
            continue
        look: Look = "tones" if how == "SIFT" else "inverted"
        yield Coarse(found.matrix, how, look, found.inliers / found.matches)
        yield Coarse(found.matrix, f"{how}, by edges", "edges", found.inliers / found.matches)
    yield from _searched(pair, "search", (_ALL_SCALES, _ALL_TURNS), None, scores)


def _searched(
    pair: Pair, how: str, tried: tuple[tuple[float, ...], tuple[float, ...]], near: FloatArray | None, scores: list[str]
) -> Iterator[Coarse]:
    """The best of a search by each look, each searched again more finely about itself."""
    found = search_similarity(pair.image, pair.base, pair.lens, scales=tried[0], rotations_rad=tried[1], near=near)
    if not found:
        scores.append(f"{how}: no turn or scale of the frame's middle fits into the base image")
    for rough in found:
        finer = search_similarity(
            pair.image,
            pair.base,
            pair.lens,
            scales=_FINER_SCALES,
            rotations_rad=_FINER_TURNS,
            near=rough.matrix,
            disk_px=_FINER_DISK_PX,
        )
        for fine in finer:
            if fine.look == rough.look:
                yield Coarse(fine.matrix, f"{how} by {fine.look}, correlation {fine.score:.2f}", fine.look, fine.score)


@dataclass(frozen=True)
class _Witnesses:
    """Patches that do not overlap: how many lie anywhere clearly, where the map says, and where it says by their rows.

    The rows of a rolling shutter may have moved by more than the tolerance: a patch agrees by its rows where control
    points of the same rows, elsewhere in the picture, moved alike. By edges of a wrong place up to a quarter do.
    """

    count: int = 0
    agreeing: int = 0
    by_rows: int = 0

    @property
    def borne_out(self) -> bool:
        straight = self.agreeing >= max(MIN_AGREEING_PATCHES, MIN_AGREEING_SHARE * self.count)
        return straight or self.by_rows >= max(2 * MIN_AGREEING_PATCHES, _BY_ROWS_SHARE * self.count)

    @property
    def sure(self) -> bool:
        return max(self.agreeing, self.by_rows) >= _SURE_SHARE * self.count

    @property
    def text(self) -> str:
        return f"{self.agreeing} of {self.count} separate patches agree, {self.by_rows} by rows"


def _witnesses(pair: Pair, fitted: Fitted, look: Look) -> _Witnesses:
    pictures = on_base_grid(pair, fitted.transform, 1.0)
    if pictures is None:
        return _Witnesses()
    moving, mask, reference, origin = pictures
    side = int(np.clip(np.sqrt(mask.sum() / _WITNESS_COUNT), *_WITNESS_SIDES_PX)) | 1
    matches = match_grid(moving, mask, reference, spacing_px=side, patch_px=side, radius_px=FINE_RADIUS_PX, look=look)
    raw = fitted.transform.to_raw(matches.points + origin)
    rest = matches.displacement - _motion_of_rows(fitted, raw, apart_px=1.5 * pair.config.patch_size_px)
    straight, by_rows = (
        int((np.linalg.norm(miss, axis=1) < _WITNESS_TOLERANCE_PX).sum()) for miss in (matches.displacement, rest)
    )
    return _Witnesses(len(matches.points), straight, by_rows)


def _motion_of_rows(fitted: Fitted, raw: FloatArray, *, apart_px: float) -> FloatArray:
    """Median displacement (n, 2), base px, of the control points in the rows of raw places (n, 2), none too near."""
    rest = fitted.target - fitted.transform.to_base(fitted.source_raw)
    usable = np.linalg.norm(rest, axis=1) < 2.0 * FINE_RADIUS_PX
    at, rest = fitted.source_raw[usable], rest[usable]
    reach = fitted.transform.height / _ROW_BANDS
    motion = np.zeros_like(raw)
    for k, (x, y) in enumerate(raw):
        same = (np.abs(at[:, 1] - y) < reach) & (np.abs(at[:, 0] - x) > apart_px)
        if same.sum() >= _ROW_POINTS:
            motion[k] = np.median(rest[same], axis=0)
    return motion


def _result(pair: Pair, fitted: Fitted, candidate: Coarse, scores: tuple[str, ...]) -> IntersensorResult:
    source_raw, target = fitted.source_raw[fitted.kept], fitted.target[fitted.kept]
    errors = left_out_errors(pair.lens.undistort_points(source_raw), target, fitted.model)
    scale, rotation = fitted.transform.scale_and_rotation()
    spacing = max(1, pair.config.grid_spacing_px)
    return IntersensorResult(
        transform=fitted.transform,
        model=fitted.model,
        source_raw=source_raw,
        target=target,
        error_left_out_px=errors,
        mean_error_px=fitted.mean_error_px,
        left_out_error_px=float(errors.mean()),
        tried_points=int(fitted.kept.size),
        scale=scale,
        rotation_rad=rotation,
        how=candidate.how,
        scores=scores,
        error_map=_error_map(target, errors, (pair.base.shape[0], pair.base.shape[1]), spacing),
        error_map_spacing_px=spacing,
    )


def _error_map(points: FloatArray, errors: FloatArray, shape: tuple[int, int], spacing: int) -> NDArray[np.float32]:
    """Mean error about each node, points weighed by a Gaussian of one spacing; NaN farther than two from any point."""
    ys, xs = np.arange(0, shape[0], spacing), np.arange(0, shape[1], spacing)
    weight, total = np.zeros((ys.size, xs.size)), np.zeros((ys.size, xs.size))
    for (x, y), error in zip(points, errors, strict=True):
        near_y, near_x = np.exp(-0.5 * ((ys - y) / spacing) ** 2), np.exp(-0.5 * ((xs - x) / spacing) ** 2)
        here = near_y[:, None] * near_x[None, :]
        weight += here
        total += here * error
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(weight > np.exp(-2.0), total / weight, np.nan), dtype=np.float32)
