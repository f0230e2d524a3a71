"""Stage ``base``: the base image that frames are registered to.

If an image was given and sampled frames register directly to it, it is the base image. Otherwise frames are registered
to the flight's own base image, a median mosaic free of traffic: the same camera in the same light reaches a tenth of a
pixel. A given image is then first checked against one frame, and the own base image is registered to it once.
"""

from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path

import cv2
import numpy as np

from schemas.arrays import FloatArray, GreyImage
from schemas.records import GridRecord
from velfield.camera.lens import Lens, pinhole
from velfield.camera.map_fit import fit_lens_to_map
from velfield.errors import Failure, InputError
from velfield.exports.gis.cog import write_cog
from velfield.parallel import parallel_map
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import StageResult, advance
from velfield.pipeline.stages.base_fit import BaseFit, check_scale, covered_fraction
from velfield.pipeline.stages.direct import accept_lens, register_directly, trial_frames
from velfield.pipeline.stages.lens import select_usable_frames
from velfield.pipeline.stages.registration import detect_frame_keypoints, read_given_base, write_reference
from velfield.registration.intersensor.base_mesh import fit_base_mesh
from velfield.registration.intersensor.register import IntersensorResult, register_intersensor
from velfield.registration.intrasensor import prepare_base
from velfield.registration.own_base import DetectKeypoints, OwnBase, build_own_base
from velfield.report.figures import png_bytes
from velfield.run.commits import write_atomically, write_record
from velfield.run.frame_transforms import base_mesh_to_record, read_lens
from velfield.run.layout import RunLayout
from velfield.run.stores import FrameStore
from velfield.sources.geo import BaseRaster, reconcile_gsd

_LENS_ROUNDS = 4
_MIN_LENS_CHANGE_PX = 0.7
"""RMS change over the frame that is worth it: the mesh follows less, and a rolling shutter passes for less."""
_SAME_TRAFFIC_S, _FEW_FRAMES = 0.4, 16
"""Frames of the median are no nearer, for within that time few vehicles pass their own length; at least so many."""
_MOST_REFERENCES, _REFERENCES_APART, _OVERLAPPING = 3, 0.2, 0.5
"""Frames that are tried as the reference, how far apart they are as a fraction of the flight, and the fraction of
frames that overlap with one after which no other is tried."""


def _spread_frames(plan: Plan) -> list[int]:
    """Frames sampled over the flight, of which the own base image is built: nearer ones show the same traffic."""
    times_s = plan.info.times_s[plan.indices[[0, -1]]]
    enough = max(_FEW_FRAMES, round(float(times_s[1] - times_s[0]) / _SAME_TRAFFIC_S))
    return select_usable_frames(plan, min(enough, plan.config.base.median_frames))


def build_base(plan: Plan) -> StageResult:
    """Write ``base/``.

    Raises
    ------
    InputError
        The given base image does not show this area, or too few frames overlap.
    """
    given = read_given_base(plan)
    detect = cache(partial(detect_frame_keypoints, plan))
    if given is not None:
        reconcile_gsd(given.gsd_m, plan.config.gsd_m)  # the stage `georeference` does it again, after much work
    plan.layout.map_lens.unlink(missing_ok=True)
    lens, store, layout = read_lens(plan.layout), FrameStore(plan.layout.frames), plan.layout
    sharpness = store.column("sharpness")
    lens_notes: list[str] = []
    spread = _spread_frames(plan)
    reference = max(spread, key=lambda frame: float(np.nan_to_num(sharpness[frame])))
    if given is not None:
        trial = trial_frames(spread)
        direct = register_directly(plan, given, dict(zip(trial, parallel_map(detect, trial), strict=True)), lens)
        if direct.fit is not None:  # half a pixel all over the frame: no other area reaches that
            grid = _given_grid(plan, given, reference, direct.fit)
            layout.own_to_base.unlink(missing_ok=True)
            outputs = [
                *write_given_image(layout, given),
                *_written_lens(layout),
                write_reference(plan, direct.reference),
            ]
            return _finish(plan, grid, outputs, given=given, fit=direct.fit, notes=direct.notes)
        lens, lens_notes = _check_area(plan, store.read(reference), given, direct.lens)
        lens_notes = lens_notes or direct.notes
    own, reference = _build_own_base(plan, detect, lens, spread, _reference_frames(spread, sharpness))
    if isinstance(own, Failure):
        raise InputError(f"no base image can be built from the flight: {own.reason}; give one with --base")
    own_png = png_bytes(own.image)
    write_atomically(layout.own_base_image, own_png)
    write_atomically(layout.own_base_mask, png_bytes(own.valid.astype(np.uint8) * 255))
    reference_image = prepare_base(own.image, plan.config.registration, mask=own.valid, frame_shape=store.shape)
    outputs = [
        layout.own_base_image,
        layout.own_base_mask,
        *_written_lens(layout),
        write_reference(plan, reference_image),
    ]
    fit = None
    if given is None:
        grid = _own_grid(plan, own, reference)
        write_atomically(layout.base_image, own_png)
        layout.base_image_tif.unlink(missing_ok=True)
        layout.own_to_base.unlink(missing_ok=True)
        outputs.append(layout.base_image)
    else:
        fit, written = _register_to_given(plan, own, given)
        grid = _given_grid(plan, given, reference, fit)
        outputs += written
    return _finish(plan, grid, outputs, frames=own.frames, given=given, fit=fit, notes=lens_notes)


def _reference_frames(spread: list[int], sharpness: FloatArray) -> list[int]:
    """Frames that may define the grid: the sharpest, and the sharpest of those far from it in the flight."""
    chosen: list[int] = []
    left = sorted(spread, key=lambda frame: -float(np.nan_to_num(sharpness[frame])))
    while left and len(chosen) < _MOST_REFERENCES:
        chosen.append(left[0])
        far = _REFERENCES_APART * (spread[-1] - spread[0])
        left = [frame for frame in left if min(abs(frame - one) for one in chosen) > far]
    return chosen


def _build_own_base(
    plan: Plan, detect: DetectKeypoints, lens: Lens, frames: list[int], references: list[int]
) -> tuple[OwnBase | Failure, int]:
    """The own base image on the grid of the first frame with which most others overlap, and that frame.

    The sharpest frame may be one of few that look elsewhere or obliquely: then another one is tried.
    """
    store, tried = FrameStore(plan.layout.frames), []
    for reference in references:
        own = build_own_base(
            store.read,
            detect,
            frames,
            reference=reference,
            lens=lens,
            config=plan.config.registration,
        )
        tried.append((own, reference))
        if not isinstance(own, Failure) and own.frames > _OVERLAPPING * len(frames):
            break
    return max(tried, key=lambda pair: 0 if isinstance(pair[0], Failure) else pair[0].frames)


def _written_lens(layout: RunLayout) -> list[Path]:
    return [layout.map_lens] if layout.map_lens.exists() else []


def _finish(
    plan: Plan,
    grid: GridRecord,
    outputs: list[Path],
    *,
    frames: int | None = None,
    given: BaseRaster | None = None,
    fit: BaseFit | None = None,
    notes: Sequence[str],
) -> StageResult:
    """Write the grid; ``frames``: number of frames in the own base image, None if there is none."""
    layout = plan.layout
    layout.rebased.unlink(missing_ok=True)
    for later in (layout.georeference, layout.scale):  # of stages that follow
        later.unlink(missing_ok=True)
    write_record(layout.grid, grid)
    outputs.append(layout.grid)
    advance("base")
    counts = {"width": float(grid.width_px), "height": float(grid.height_px)}
    if frames is not None:
        counts["frames"] = float(frames)
    if given is None or fit is None:
        return StageResult(outputs, counts, list(notes))
    counts |= {"intersensor_error_px": fit.error_px, "scale": fit.scale, "covered": fit.covered}
    return StageResult(outputs, counts, [*given.notes, fit.note(), *notes], fit.warnings())


def _check_area(plan: Plan, grey: GreyImage, given: BaseRaster, lens: Lens) -> tuple[Lens, list[str]]:
    """Reject an image of another area before any frame is processed; else the lens, and notes on it."""
    result = register_intersensor(grey, given.grey, plan.config.base, lens=lens)
    if isinstance(result, Failure):
        raise InputError(f"--base {plan.job.inputs.base}: {result.reason}")
    check_scale(result.scale, given, plan.job.inputs.base or "")
    if plan.config.lens.calibrate == "never":
        return lens, []
    return _refine_by_map(plan, grey, given, lens, result)


def _refine_by_map(
    plan: Plan, grey: GreyImage, given: BaseRaster, lens: Lens, result: IntersensorResult
) -> tuple[Lens, list[str]]:
    """The lens by matches of one frame with the given image, where they decide for another; matched again through it.

    A lens that is off in the corners gives no matches there: each round reaches farther out.
    """
    best, points, last = lens, len(result.cv_errors_px), None
    for _ in range(_LENS_ROUNDS):
        fit = fit_lens_to_map(result.source_raw, result.target, best, grey.shape)
        if fit is None or fit.change_px < _MIN_LENS_CHANGE_PX or not (fit.is_better or last is not None):
            break
        again = register_intersensor(grey, given.grey, plan.config.base, lens=fit.lens)
        if isinstance(again, Failure):
            break
        if len(again.cv_errors_px) < points and again.cv_error_px > result.cv_error_px:
            break
        best, points, last, result = fit.lens, len(again.cv_errors_px), fit, again
    if last is None:
        return lens, []
    return last.lens, accept_lens(plan, last.lens, f"{last.matches} matches, {points} through it")


def _own_grid(plan: Plan, own: OwnBase, reference: int) -> GridRecord:
    height, width = own.image.shape
    return GridRecord(
        width_px=width,
        height_px=height,
        origin_x_px=own.origin_xy[0],
        origin_y_px=own.origin_xy[1],
        base_source="flight",
        reference_frame=reference,
    )


def _register_to_given(plan: Plan, own: OwnBase, given: BaseRaster) -> tuple[BaseFit, list[Path]]:
    """Register the own base image to the given image; write the transform and the error map."""
    layout = plan.layout
    result = register_intersensor(own.image, given.grey, plan.config.base, lens=pinhole(own.image.shape))
    if isinstance(result, Failure):
        name = plan.job.inputs.base
        raise InputError(f"--base {name}: the flight's own base image could not be registered to it: {result.reason}")
    mesh = fit_base_mesh(own.image, own.valid, given.grey, result.transform.polyprojective, plan.config.base)
    write_record(layout.own_to_base, base_mesh_to_record(mesh))
    write_atomically(layout.base_error_map, png_bytes(_draw_error_map(result)))
    written = [layout.own_to_base, layout.base_error_map, *write_given_image(plan.layout, given)]
    fit = BaseFit(
        direct=False,
        error_px=mesh.heldout_px,
        points=mesh.points,
        scale=result.scale,
        rotation_rad=result.rotation_rad,
        covered=covered_fraction(result.transform, own.valid, given),
    )
    return fit, written


def write_given_image(layout: RunLayout, given: BaseRaster) -> list[Path]:
    """Write the given image as the run's base image: a GeoTIFF if it is georeferenced."""
    for before in (layout.base_image, layout.base_image_tif):
        before.unlink(missing_ok=True)
    if given.crs_wkt is not None and given.affine is not None:
        path = layout.base_image_tif
        write_cog(path, [given.grey], names=["grey"], units=["1"], crs_wkt=given.crs_wkt, affine=given.affine)
        return [path]
    write_atomically(layout.base_image, png_bytes(given.grey))
    return [layout.base_image]


def _given_grid(plan: Plan, given: BaseRaster, reference: int, fit: BaseFit) -> GridRecord:
    height, width = given.grey.shape
    return GridRecord(
        width_px=width,
        height_px=height,
        gsd_m=given.gsd_m,
        crs_wkt=given.crs_wkt,
        affine=given.affine,
        base_source="given",
        registered_to="given" if fit.direct else "flight",
        reference_frame=reference,
        intersensor_error_px=fit.error_px,
        intersensor_points=fit.points,
    )


def _draw_error_map(result: IntersensorResult) -> GreyImage:
    """The error map as grey levels, 50 per pixel of error; white where there is no data."""
    levels = np.where(np.isfinite(result.error_map), np.clip(result.error_map * 50, 0, 250), 255)
    side = max(1, result.error_map_spacing_px // 4)
    return np.asarray(cv2.resize(levels.astype(np.uint8), None, fx=side, fy=side, interpolation=cv2.INTER_NEAREST))
