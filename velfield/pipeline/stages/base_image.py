"""The base image of a flight: its own, a median without traffic; and where one was given, how the own one lies on it.

Frames are registered to the flight's own base image, for the same camera in the same light gives a tenth of a pixel;
unless they lie straight on the given one. Where they do not, that is checked against one frame before the own one is
built, and registered once to the own one.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.records import GridRecord
from velfield.camera.lens import Lens, pinhole
from velfield.errors import Failure, InputError
from velfield.exports.cog import write_cog
from velfield.pipeline.plan import Plan
from velfield.pipeline.progress import advance
from velfield.pipeline.result import StageResult
from velfield.pipeline.stages.base_fit import BaseFit, check_scale, covered_share
from velfield.pipeline.stages.external_detections import free_of_vehicles
from velfield.pipeline.stages.lens import spread_usable
from velfield.registration.intersensor import IntersensorResult, register_intersensor
from velfield.registration.intrasensor import BaseReference, prepare_base, register_frame
from velfield.registration.keypoints import Keypoints, detect_keypoints
from velfield.registration.own_base import OwnBase, build_own_base
from velfield.report.figures import png_bytes
from velfield.run.commits import write_atomically
from velfield.run.frame_transforms import polyprojective_to_record, read_lens
from velfield.run.grid import read_grid
from velfield.run.layout import RunLayout
from velfield.run.paths import local_copy, local_output
from velfield.run.stores import open_frames
from velfield.sources.geo import BaseRaster, read_base_raster, reconcile_gsd
from velfield.sources.images import read_grey_image

_TRIED = 8
_DIRECT_HELDOUT_PX, _DIRECT_SPREAD = 0.5, 0.8
"""Frames tried straight on the given picture must all reach this: held-out residual, share of cells with points."""
_THREADS = min(4, os.cpu_count() or 1)
_REFERENCE_LOCK = Lock()
_references: dict[tuple[str, str], BaseReference] = {}


@dataclass(frozen=True)
class FrameKeypoints:
    """Key points of one frame, raw px."""

    frame: int
    keypoints: Keypoints


def spread_frames(plan: Plan) -> list[int]:
    """Frames that the own base image is made from, spread over the flight."""
    return spread_usable(plan, plan.config.base.median_frames)


def detect_unit_keypoints(plan: Plan, frames: Sequence[int]) -> list[FrameKeypoints]:
    """Key points of a block of frames: the costly part of registration, and the parallel one."""
    store, config = open_frames(plan.layout.frames), plan.config.registration
    return [
        FrameKeypoints(frame, detect_keypoints(store.read(frame), config, free_of_vehicles(plan, frame, store.shape)))
        for frame in frames
    ]


def build_base(plan: Plan, blocks: Sequence[Sequence[FrameKeypoints]]) -> StageResult:
    """Write ``base/``.

    Raises
    ------
    InputError
        The given base image is not of this place (with the scores), or too few frames overlap.
    """
    keypoints = {found.frame: found.keypoints for block in blocks for found in block}
    given = _given_picture(plan)
    lens, store, layout = read_lens(plan.layout), open_frames(plan.layout.frames), plan.layout
    sharpness = store.column("sharpness")
    reference = max(keypoints, key=lambda frame: float(np.nan_to_num(sharpness[frame])))
    if given is not None:
        direct = _straight_to(plan, given, keypoints, lens)
        if direct is not None:  # to half a pixel all over the frame: no other place does that
            grid = _given_grid(plan, given, reference, direct)
            layout.own_to_base.unlink(missing_ok=True)
            return _finish(plan, grid, write_given_picture(layout, given), given=given, fit=direct)
        _check_place(plan, store.read(reference), given, lens)
    own = build_own_base(
        store.read,
        keypoints,
        reference=reference,
        lens=lens,
        config=plan.config.registration,
        threads=_THREADS,
    )
    if isinstance(own, Failure):
        raise InputError(f"no base image can be built from the flight: {own.reason}; give one with --base")
    write_atomically(layout.own_base_image, png_bytes(own.image))
    write_atomically(layout.own_base_mask, png_bytes(own.valid.astype(np.uint8) * 255))
    outputs = [layout.own_base_image, layout.own_base_mask]
    fit = None
    if given is None:
        grid = _own_grid(plan, own, reference)
        write_atomically(layout.base_image, png_bytes(own.image))
        layout.base_image_tif.unlink(missing_ok=True)
        layout.own_to_base.unlink(missing_ok=True)
        outputs.append(layout.base_image)
    else:
        fit, written = _onto_given(plan, own, given)
        grid = _given_grid(plan, given, reference, fit)
        outputs += written
    return _finish(plan, grid, outputs, frames=own.frames, given=given, fit=fit)


def _finish(
    plan: Plan,
    grid: GridRecord,
    outputs: list[Path],
    *,
    frames: int | None = None,
    given: BaseRaster | None = None,
    fit: BaseFit | None = None,
) -> StageResult:
    """Write the grid; ``frames``: of how many the own base image was made, none where none was."""
    layout = plan.layout
    layout.rebased.unlink(missing_ok=True)
    write_atomically(layout.grid, grid.model_dump_json(indent=1).encode())
    outputs.append(layout.grid)
    advance("base")
    counts = {"width": float(grid.width_px), "height": float(grid.height_px)}
    if frames is not None:
        counts["frames"] = float(frames)
    if given is None or fit is None:
        return StageResult(outputs, counts)
    counts |= {"intersensor_error_px": fit.error_px, "scale": fit.scale, "covered": fit.covered}
    by_hand = plan.config.gsd_m if given.gsd_m is None else None
    return StageResult(outputs, counts, [*given.notes, fit.note(by_hand)], fit.warnings())


def _given_picture(plan: Plan) -> BaseRaster | None:
    path = plan.job.inputs.base
    return read_base_raster(Path(path), plan.config.frames) if path else None


def _check_place(plan: Plan, grey: NDArray[np.uint8], given: BaseRaster, lens: Lens) -> None:
    """Refuse a picture of another place before any frame is worked on."""
    found = register_intersensor(grey, given.grey, plan.config.base, lens=lens)
    if isinstance(found, Failure):
        raise InputError(f"--base {plan.job.inputs.base}: {found.reason}")
    check_scale(found.scale, given, plan.job.inputs.base or "")


def _own_grid(plan: Plan, own: OwnBase, reference: int) -> GridRecord:
    height, width = own.image.shape
    return GridRecord(
        width_px=width,
        height_px=height,
        origin_x_px=own.origin_xy[0],
        origin_y_px=own.origin_xy[1],
        gsd_m=plan.config.gsd_m,
        how="own",
        reference_frame=reference,
    )


def _onto_given(plan: Plan, own: OwnBase, given: BaseRaster) -> tuple[BaseFit, list[Path]]:
    """Register the own base image to the given picture, and write what follows from it."""
    layout = plan.layout
    found = register_intersensor(own.image, given.grey, plan.config.base, lens=pinhole(own.image.shape))
    if isinstance(found, Failure):
        raise InputError(f"--base {plan.job.inputs.base}: the flight's base image does not fit on it: {found.reason}")
    record = polyprojective_to_record(found.transform.polyprojective)
    write_atomically(layout.own_to_base, record.model_dump_json(indent=1).encode())
    write_atomically(layout.base_error_map, png_bytes(_error_picture(found)))
    written = [layout.own_to_base, layout.base_error_map, *write_given_picture(plan.layout, given)]
    fit = BaseFit(
        straight=False,
        error_px=found.cv_error_px,
        points=len(found.cv_errors_px),
        scale=found.scale,
        rotation_rad=found.rotation_rad,
        covered=covered_share(found.transform, own.valid, given),
    )
    return fit, written


def _straight_to(plan: Plan, given: BaseRaster, keypoints: dict[int, Keypoints], lens: Lens) -> BaseFit | None:
    """How frames lie straight on the given picture, by some that are spread over the flight; none where they do not.

    Where they do, nothing stands between a frame and the map. Where they do not (other season, other light), the
    flight's own base image does, and one smooth map from it to the picture.
    """
    config = plan.config.registration
    reference = prepare_base(given.grey, config, mask=given.valid, frame_shape=(plan.info.height, plan.info.width))
    store = open_frames(plan.layout.frames)
    frames = sorted(keypoints)
    tried = [
        frames[k] for k in np.unique(np.linspace(0, len(frames) - 1, min(_TRIED, len(frames))).round().astype(int))
    ]
    fits = []
    for frame in tried:
        found = register_frame(store.read(frame), keypoints[frame], reference, lens, config)
        if found.transform is None or not found.heldout_px <= _DIRECT_HELDOUT_PX or found.spread < _DIRECT_SPREAD:
            return None
        scale, rotation = found.transform.scale_and_rotation()
        check_scale(scale, given, plan.job.inputs.base or "")
        covered = covered_share(found.transform, None, given)
        fits.append(BaseFit(True, found.heldout_px, found.count_kept, scale, rotation, covered))
    return replace(
        fits[len(fits) // 2],
        error_px=float(np.mean([fit.error_px for fit in fits])),
        points=int(np.mean([fit.points for fit in fits])),
        covered=float(np.mean([fit.covered for fit in fits])),
    )


def write_given_picture(layout: RunLayout, given: BaseRaster) -> list[Path]:
    """The given picture as the run's base image: GeoTIFF where it has coordinates."""
    for before in (layout.base_image, layout.base_image_tif):
        before.unlink(missing_ok=True)
    if given.crs_wkt is not None and given.affine is not None:
        with local_output(layout.base_image_tif) as here:
            write_cog(here, [given.grey], names=["grey"], units=["1"], crs_wkt=given.crs_wkt, affine=given.affine)
        return [layout.base_image_tif]
    write_atomically(layout.base_image, png_bytes(given.grey))
    return [layout.base_image]


def _given_grid(plan: Plan, given: BaseRaster, reference: int, fit: BaseFit) -> GridRecord:
    height, width = given.grey.shape
    return GridRecord(
        width_px=width,
        height_px=height,
        gsd_m=reconcile_gsd(given.gsd_m, plan.config.gsd_m),
        crs_wkt=given.crs_wkt,
        affine=given.affine,
        how="given",
        frames_to="given" if fit.straight else "own",
        reference_frame=reference,
        intersensor_error_px=fit.error_px,
        intersensor_points=fit.points,
    )


def _error_picture(found: IntersensorResult) -> NDArray[np.uint8]:
    """The error map as grey levels, 50 a pixel of error; white where nothing is known."""
    levels = np.where(np.isfinite(found.error_map), np.clip(found.error_map * 50, 0, 250), 255)
    side = max(1, found.error_map_spacing_px // 4)
    return np.asarray(cv2.resize(levels.astype(np.uint8), None, fx=side, fy=side, interpolation=cv2.INTER_NEAREST))


def base_reference(plan: Plan) -> BaseReference:
    """What frames are registered to; the last one made is kept, for the units of a run all want the same."""
    with _REFERENCE_LOCK:
        wanted = (str(plan.layout.root), plan.keys["base"])
        if wanted not in _references:
            _references.clear()
            _references[wanted] = _make_reference(plan)
        return _references[wanted]


def _make_reference(plan: Plan) -> BaseReference:
    limit = plan.config.frames.max_pixels
    shape = open_frames(plan.layout.frames).shape
    if read_grid(plan.layout).frames_to == "given":
        given = _given_picture(plan)
        assert given is not None, "the grid says that a base image was given"
        return prepare_base(given.grey, plan.config.registration, mask=given.valid, frame_shape=shape)
    with local_copy(plan.layout.own_base_image) as picture, local_copy(plan.layout.own_base_mask) as known:
        grey, mask = read_grey_image(picture, limit), read_grey_image(known, limit) > 0
    return prepare_base(grey, plan.config.registration, mask=mask, frame_shape=shape)
