"""Transfer of a finished run to a new base image, without processing frames or detecting vehicles again.

The new image is registered to the old base image (inter-sensor). The transform of every frame is then composed with
that registration, detections and tracklets are mapped by it, and the field is recomputed. The position error that this
adds is the cross-validated error of that registration.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from schemas.arrays import FloatArray
from schemas.georeference import GeoreferenceRecord
from schemas.job import Job
from schemas.records import FlightRecord, GridRecord, InputsRecord, RebaseRecord, WorkingRecord
from schemas.scale import ScaleEstimate
from schemas.tables import DETECTION_COLUMNS, DIMENSION_COLUMNS, TRACK_POSITION_COLUMNS, TRACKLET_COLUMNS
from velfield.camera.lens import pinhole
from velfield.errors import Failure
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import StageResult, advance
from velfield.pipeline.stage import STAGES, NewBase
from velfield.pipeline.stages.base_image import write_given_image
from velfield.pipeline.stages.georeference import (
    describe,
    georeference_counts,
    georeference_warnings,
    scale_by_grid,
    write_georeference,
)
from velfield.registration.intersensor.register import register_intersensor
from velfield.registration.transforms import PolyprojectiveTransform
from velfield.run.commits import content_key, digest_path, read_commit, write_record
from velfield.run.frame_transforms import (
    polyprojective_from_record,
    polyprojective_to_record,
    read_georeference,
    read_grid,
    read_own_grid,
    read_working,
)
from velfield.run.layout import RunLayout
from velfield.run.run import Run
from velfield.run.stores import RegistrationStore
from velfield.run.tables import link_file, read_tables, write_table, write_tracks
from velfield.sources.frames import SourceInfo
from velfield.sources.geo import BaseRaster, read_base_raster
from velfield.sources.scale import choose_scale


@dataclass(frozen=True)
class Rebase:
    """Inputs of a unit of the new result, besides its plan: the old run, and the transform from it."""

    old: RunLayout
    record: RebaseRecord


def measure_rebase(run: Run, base: Path) -> RebaseRecord | Failure:
    """Register a new base image to that of a run.

    Raises
    ------
    InputError
        The image cannot be read.
    """
    config = run.record.config
    given = read_base_raster(base, config.frames)
    old = run.base_image
    result = register_intersensor(old, given.grey, config.base, lens=pinhole(old.shape))
    if isinstance(result, Failure):
        return result
    return RebaseRecord(
        transform=polyprojective_to_record(result.transform.polyprojective),
        added_error_px=result.cv_error_px,
        added_error_95_px=float(np.percentile(result.cv_errors_px, 95)),
        points=len(result.cv_errors_px),
        scale=result.scale,
        rotation_rad=result.rotation_rad,
        old_base=run.record.keys.get("base", ""),
        gsd_m=given.gsd_m or (run.grid.gsd_m and run.grid.gsd_m / result.scale),
    )


def plan_rebase(run: Run, job: Job, record: RebaseRecord) -> Plan:
    """The plan of the new result, from the run folder alone: its source may be gone."""
    assert job.inputs.base is not None, "a rebase needs a new base image"
    digest = digest_path(Path(job.inputs.base))
    inputs = run.record.inputs.model_copy(update={"base": digest})
    # Of the length that the run's files were cut by: another release may cut others.
    unit_frames = RegistrationStore(run.layout.registration).unit_frames
    work = job.config.work.model_copy(update={"unit_frames": unit_frames})
    config = job.config.model_copy(update={"gsd_m": record.gsd_m, "work": work})
    return Plan(
        job=job.model_copy(update={"config": config}),
        info=describe_source(run),
        indices=np.arange(run.frames.count),
        inputs=inputs,
        keys=_mapped_keys(run.record, inputs),
    )


def describe_source(run: Run) -> SourceInfo:
    """The source of a finished run, by its record alone."""
    source = run.record.inputs.source
    return SourceInfo(
        kind="video" if source.kind == "video" else "folder",
        width=source.width,
        height=source.height,
        frame_count=source.frame_count,
        times_s=run.times_s,
        names=(),
    )


def _mapped_keys(old: FlightRecord, inputs: InputsRecord) -> dict[str, str]:
    """New keys for the mapped stages; the others keep theirs."""
    keys = dict(old.keys)
    for stage in STAGES:
        if stage.new_base in (NewBase.MAPPED, NewBase.COMPUTED):
            read = [keys[stage.name], inputs.base]
            keys[stage.name] = content_key(stage.name, stage.version, parameters=["mapped"], inputs=read)
    return keys


def rebase_image(plan: Plan, rebase: Rebase) -> StageResult:
    """Write ``base/`` on the new image's grid."""
    layout, old, record = plan.layout, rebase.old, rebase.record
    assert plan.job.inputs.base is not None, "a rebase needs a new base image"
    given = read_base_raster(Path(plan.job.inputs.base), plan.config.frames)
    outputs = write_given_image(layout, given)
    grid = _mapped_grid(read_grid(old), given, record)
    working = read_working(old)
    rescaled = WorkingRecord.model_validate(working.model_dump() | {"scale": working.scale / record.scale})
    for path, model in ((layout.rebased, record), (layout.grid, grid), (layout.working, rescaled)):
        write_record(path, model)
        outputs.append(path)
    for name in (old.own_to_base, old.own_base_image, old.own_base_mask, old.map_lens):
        if name.exists():
            outputs.append(link_file(name, layout.base / name.name))
    advance("base")
    committed = read_commit(old, "base", "all")
    counts = {
        "width": float(grid.width_px),
        "height": float(grid.height_px),
        "frames": committed.counts.get("frames", 0.0) if committed else 0.0,
        "intersensor_error_px": float(grid.intersensor_error_px or 0.0),
    }
    return StageResult(outputs, counts, [*given.notes, record.text()])


def _mapped_grid(old: GridRecord, given: BaseRaster, record: RebaseRecord) -> GridRecord:
    height, width = given.grey.shape
    before = (old.intersensor_error_px or 0.0) * record.scale
    return GridRecord(
        width_px=width,
        height_px=height,
        gsd_m=given.gsd_m,  # another is that of `rebase_georeference`
        crs_wkt=given.crs_wkt,
        affine=given.affine,
        base_source="given",
        registered_to=old.registered_to,
        reference_frame=old.reference_frame,
        intersensor_error_px=float(np.hypot(before, record.added_error_px)),
        intersensor_points=record.points,
    )


def rebase_georeference(plan: Plan, rebase: Rebase) -> StageResult:
    """Write ``base/georeference.json`` of the new base image: its own reference system, else scale and north mapped."""
    old, record = read_georeference(rebase.old), rebase.record
    grid, update = read_own_grid(plan.layout), {}
    estimates = scale_by_grid(grid)
    if old is not None and grid.crs_wkt is None:
        every = [old.scale.used, *old.scale.others] if old.scale.used is not None else []
        estimates += [_rescale(estimate, record.scale) for estimate in every if estimate is not None]
        if old.north_rad is not None:
            update = {"north_rad": old.north_rad + record.rotation_rad, "north_sd_deg": old.north_sd_deg}
    kept = {"telemetry": old.telemetry, "start": old.start} if old else {}
    new = GeoreferenceRecord(scale=choose_scale(estimates), **kept, **update)
    outputs = write_georeference(plan.layout, plan.layout.georeference, new, plan.config.frames)
    advance("georeference")
    return StageResult(outputs, georeference_counts(new), describe(new), georeference_warnings(new))


def rebase_scale(plan: Plan, rebase: Rebase) -> StageResult:
    """Write nothing: the georeference that was mapped holds the scale by the vehicles already."""
    del rebase
    record = read_georeference(plan.layout) or GeoreferenceRecord()
    advance("scale")
    return StageResult([], georeference_counts(record))


def _rescale(estimate: ScaleEstimate, scale: float) -> ScaleEstimate:
    lengths = {name: getattr(estimate, name) / scale for name in ("gsd_m", "low_m", "high_m")}
    return estimate.model_copy(update=lengths)


def rebase_detections(plan: Plan, frames: range, rebase: Rebase) -> StageResult:
    """Map the detections of a unit, and its weak candidates; their image patches are linked."""
    unit, layout, old = frames.start // plan.unit_frames, plan.layout, rebase.old
    if not layout.unit_file(old.detections, unit).exists():
        warning = f"frames {frames.start} to {frames.stop - 1} have no detections"
        return StageResult([], {"frames": 0.0, "cars": 0.0}, warnings=[warning])
    transform = polyprojective_from_record(rebase.record.transform)
    written, counts = [], {"frames": 0.0, "cars": 0.0}
    for source, target in ((old.detections, layout.detections), (old.weak_detections, layout.weak_detections)):
        path = layout.unit_file(source, unit)
        if path.exists():
            table = map_detections(read_tables([path], DETECTION_COLUMNS), transform)
            write_table(target / path.name, table, DETECTION_COLUMNS)
            patches = path.with_suffix(".patches.npz")
            written += [target / path.name, link_file(patches, target / patches.name)]
            if source == old.detections:
                counts = {"frames": float(table["frame"].nunique()), "cars": float(len(table))}
    advance("detections", len(frames))
    return StageResult(written, counts)


def rebase_tracks(plan: Plan, rebase: Rebase) -> StageResult:
    """Map all tracklets, unit by unit."""
    transform, written = polyprojective_from_record(rebase.record.transform), list[Path]()
    old, layout = rebase.old, plan.layout
    ids, counts = {}, {}
    for name, source, target in (("tracks", old.tracks, layout.tracks), ("doubtful", old.doubtful, layout.doubtful)):
        ids[name], counts[name] = set[int](), 0
        for path in layout.unit_files(source):
            table = map_tracklets(read_tables([path], TRACKLET_COLUMNS | {"recovered": "bool"}), transform)
            written.append(target / path.name)
            write_tracks(written[-1], table)
            ids[name].update(table["track_id"].unique().tolist())
            counts[name] += len(table)
    lone = 0
    for source, target in (
        (old.track_positions, layout.track_positions),
        (old.doubtful_positions, layout.doubtful_positions),
    ):
        for path in layout.unit_files(source):
            table = read_tables([path], TRACK_POSITION_COLUMNS)
            table[["x_px", "y_px"]] = transform(table[["x_px", "y_px"]].to_numpy(np.float64))
            written.append(target / path.name)
            write_table(written[-1], table, TRACK_POSITION_COLUMNS)
            lone += int((table["track_id"] < 0).sum())
    if rebase.old.dimensions.exists():
        table = read_tables([rebase.old.dimensions], DIMENSION_COLUMNS)
        sizes = ["length_px", "length_sd_px", "width_px", "width_sd_px"]
        table[sizes] = table[sizes] * rebase.record.scale
        written.append(plan.layout.dimensions)
        write_table(written[-1], table, DIMENSION_COLUMNS)
    if rebase.old.joins.exists():
        written.append(link_file(rebase.old.joins, plan.layout.joins))
    advance("tracks")
    found = {name: float(len(known)) for name, known in ids.items()}
    return StageResult(written, found | {"tracklets": float(counts["tracks"]), "lone": float(lone)})


def map_detections(table: pd.DataFrame, transform: PolyprojectiveTransform) -> pd.DataFrame:
    """Map a table of detections (`DETECTION_COLUMNS`) to the new base image: position, axis and area."""
    table = table.copy()
    xy = table[["x_px", "y_px"]].to_numpy(np.float64)
    jacobian = transform.jacobian(xy)
    axis = table["orientation_rad"].to_numpy(np.float64)
    mapped_axis = np.einsum("nij,nj->ni", jacobian, np.column_stack([np.cos(axis), np.sin(axis)]))
    table[["x_px", "y_px"]] = transform(xy)
    table["orientation_rad"] = np.mod(np.arctan2(mapped_axis[:, 1], mapped_axis[:, 0]), np.pi)
    table["area_px"] = table["area_px"].to_numpy(np.float64) * _area_factor(jacobian)
    return table


def map_tracklets(table: pd.DataFrame, transform: PolyprojectiveTransform) -> pd.DataFrame:
    """Map a table of tracklets (`TRACKLET_COLUMNS`) to the new base image: positions, velocities, their errors."""
    table = table.copy()
    positions = [table[[f"x_{k}_px", f"y_{k}_px"]].to_numpy(np.float64) for k in range(3)]
    for k, link in enumerate(("01", "12")):
        jacobian = transform.jacobian((positions[k] + positions[k + 1]) / 2)
        names = [f"v{axis}_{link}_px_per_s" for axis in "xy"]
        table[names] = np.einsum("nij,nj->ni", jacobian, table[names].to_numpy(np.float64))
        name = f"displacement_sd_{link}_px"
        table[name] = table[name].to_numpy(np.float64) * np.sqrt(_area_factor(jacobian))
    for k, xy in enumerate(positions):
        table[[f"x_{k}_px", f"y_{k}_px"]] = transform(xy)
    return table


def _area_factor(jacobian: FloatArray) -> FloatArray:
    return np.asarray(np.abs(np.linalg.det(jacobian)))
