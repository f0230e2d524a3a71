"""Maps before the flight is through: of its first frames, and then of the units that are finished so far.

A preview is a run folder of its own inside the run's, `RunLayout.preview`, made by the stages of any run; its field,
maps and page then take the place of those in the run folder. The first one is of a few frames alone, with the detector
that ships unless one is given: lens and base image of the flight need frames of all of it. The later ones share all
that is finished, and add the tracklets, the tracks, the field and the maps of what is there. They have keys of their
own, as if the other units were lost: nothing of a preview is taken for the result, which is to the bit what it is
without them.
"""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

from schemas.job import Job
from schemas.records import InputsRecord
from schemas.summary import RunSummary
from velfield.detection.registry import shipped_detector
from velfield.pipeline.graphs import compute_here
from velfield.pipeline.local import Compute, compute_stages
from velfield.pipeline.plan import Plan, write_flight_record
from velfield.pipeline.result import without_progress
from velfield.pipeline.stage import FIELD_STAGES, STAGE, STAGES, stage_keys, stages_before
from velfield.pipeline.stages.report import write_report
from velfield.pipeline.summary import lost_frames, summarise_stage
from velfield.pipeline.units import stage_units
from velfield.run.commits import commit_path, read_commits, valid_commit, write_atomically
from velfield.run.layout import RunLayout, remove_tree
from velfield.run.results import link_shared_outputs

FIRST_FRAMES = 12
"""Frames of the first preview: two seconds and a half."""
_LENS_FRAMES, _MEDIAN_FRAMES = 3, 8
"""Of them, those that give its lens and its base image: neighbours, which show little more than a few do."""
_LARGE_PX = 6_000_000
"""Frames of more pixels are processed at half their size: a quarter of the work, and of 4K a car still has 10 px."""
Publishing = AbstractContextManager[object]
"""Entered to replace the field and the page of the run; raises where the run's own are being made."""


def make_first_preview(plan: Plan) -> int:
    """Make the preview of a flight's first frames, on one worker; returns their number.

    One piece of work on one worker: stage by stage it would wait for a free one as often, and for seconds each time.

    Raises
    ------
    InputError
        As in any run: they show too little to register them, or to size a car.
    """
    remove_tree(plan.layout.preview)
    first = _first_plan(plan)
    _make(first, tuple(STAGE), compute_here)
    _write_page(plan, first, f"the first {first.frame_count} of {plan.frame_count} frames")
    return first.frame_count


def publish_first_preview(plan: Plan, publishing: Publishing) -> None:
    """Publish the preview of the first frames."""
    with publishing:
        _publish(plan.layout, RunLayout(plan.layout.preview), with_tracks=False)


def preview_finished_units(plan: Plan, compute: Compute, publishing: Publishing) -> int:
    """Make and publish the preview of the units whose detections are finished; returns the number of their frames."""
    remove_tree(plan.layout.preview)
    units = {unit.name: len(unit.frames) for unit in stage_units(plan, STAGE["detections"])}
    found = {name: valid_commit(plan.layout, "detections", name, plan.keys["detections"]) for name in units}
    finished = [name for name, record in found.items() if record is not None]
    so_far = _with_root(plan).with_lost_units([f"detections {name}" for name in units if name not in finished])
    link_shared_outputs(plan.layout, so_far.layout, stages_before(FIELD_STAGES[0]))
    _make(so_far, FIELD_STAGES, compute)
    frames = sum(units[name] for name in finished)
    _write_page(plan, so_far, f"{frames} of {plan.frame_count} frames")
    with publishing:
        _publish(plan.layout, so_far.layout, with_tracks=True)
    return frames


def _with_root(plan: Plan, **inputs: str | None) -> Plan:
    """The plan in the preview's folder, its field without time intervals and weights of time, which no map needs."""
    field = plan.config.field.model_copy(update={"time_weighted": False, "time_intervals": None})
    config = plan.config.model_copy(update={"field": field})
    given = plan.job.inputs.model_copy(update=inputs)
    return replace(plan, job=Job(root=str(plan.layout.preview), inputs=given, config=config))


def _first_plan(plan: Plan) -> Plan:
    """The plan of the first frames: without what takes long and shows little, such as fine-tuning where a car's size is
    known, and pairs of frames for the lens, which hardly move."""
    layout = plan.layout
    inputs: dict[str, str | None] = {}
    record = plan.inputs
    if plan.config.gsd_m is not None and not (plan.job.inputs.detector or plan.job.inputs.detections):
        detector = layout.preview / "shipped_detector.json"
        write_atomically(detector, shipped_detector().to_json().encode())
        inputs = {"detector": str(detector), "labels": None}
        record = InputsRecord.model_validate(record.model_dump() | {"detector": "shipped", "labels": None})
    first = _with_root(plan, **inputs)
    config = first.config
    reduction = 2 if plan.is_of_frames_alone and plan.info.width * plan.info.height > _LARGE_PX else 1
    lens, base = config.lens, config.base
    # frames of a moment lie on each other with their distortion; on a given image they do not
    calibrate = lens.calibrate if plan.job.inputs.base else "never"
    lens_frames = {"frames": min(lens.frames, _LENS_FRAMES), "refine": "never", "calibrate": calibrate}
    few = {
        "gsd_m": None if config.gsd_m is None else config.gsd_m * reduction,
        "lens": lens.model_copy(update=lens_frames),
        "detection": config.detection.model_copy(update={"full_frame_every": FIRST_FRAMES}),
        "base": base.model_copy(update={"median_frames": min(base.median_frames, _MEDIAN_FRAMES)}),
    }
    job = first.job.model_copy(update={"config": config.model_copy(update=few)})
    keys, indices = stage_keys(job.config, record), plan.indices[:FIRST_FRAMES]
    first = replace(first, job=job, indices=indices, inputs=record, keys=keys, reduction=reduction)
    return first.with_lost_units(["all other frames"])


def _make(plan: Plan, stages: Sequence[str], compute: Compute) -> None:
    write_flight_record(plan)
    with without_progress():
        compute_stages(plan, stages, compute)


def _write_page(plan: Plan, preview: Plan, what: str) -> None:
    records = {stage.name: read_commits(preview.layout, stage.name) for stage in STAGES}
    summary = RunSummary(
        root=plan.job.root,
        stages=tuple(
            summarise_stage(name, found, units=len(found), before=(), seconds=sum(one.seconds for one in found))
            for name, found in records.items()
        ),
        frames_lost=lost_frames(preview),
    )
    write_report(preview, summary, preview_of=what)


def _publish(layout: RunLayout, new: RunLayout, *, with_tracks: bool) -> None:
    """Let a preview's field, maps and page take the place of the run folder's."""
    for name in FIELD_STAGES:  # no record may vouch for what is replaced
        for path in commit_path(layout, name, "all").parent.glob("*.json"):
            path.unlink()
    tracks = [(new.tracks, layout.tracks)] if with_tracks else []
    for source, target in (*tracks, (new.field, layout.field), (new.view, layout.view), (new.maps, layout.maps)):
        _replace_tree(source, target)
    if new.scale.exists():
        layout.base.mkdir(exist_ok=True)
        new.scale.replace(layout.scale)  # that of the field and the page
    new.report.replace(layout.report)
    remove_tree(new.root)


def _replace_tree(source: Path, target: Path) -> None:
    """Give a folder the place of another one; who reads it meets the one or the other, or for a moment none."""
    old = source.with_name(f"{source.name}.old")
    if target.exists():
        target.rename(old)
    source.rename(target)
    remove_tree(old)
