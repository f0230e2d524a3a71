"""A new base image: what depends on it is done again, and only that; the result before stays and keeps its name.

Where the new picture registers well to the old base image, all that is known is mapped by that one map, in seconds: no
frame is decoded, registered or searched for cars. Where it does not, or when asked to, the frames are registered again.
"""

from pathlib import Path

from prefect import flow, task
from prefect.cache_policies import NO_CACHE
from prefect.task_runners import ThreadPoolTaskRunner

from flows.artifacts import publish_summary
from flows.console import Console
from flows.process_flight import process_flight
from flows.runners import RunnerConfig, open_runner, parallel_units
from flows.stale import mark_crashed
from flows.work import Unit, Work
from schemas.job import Inputs, Job, absolute
from schemas.records import RebaseRecord
from schemas.summary import RunSummary
from velfield.errors import Failure, InputError
from velfield.pipeline import graphs
from velfield.pipeline.plan import write_flight_record
from velfield.pipeline.result import unit_name
from velfield.pipeline.stages.field import field_groups, group_name, lay_out_field
from velfield.pipeline.stages.rebase import Rebase, measure_rebase, rebased_plan
from velfield.pipeline.stages.registration import lost_frames
from velfield.pipeline.stages.report import write_report
from velfield.run.commits import sweep_partial
from velfield.run.layout import RunLayout
from velfield.run.lock import locked
from velfield.run.results import (
    discard_result,
    link_shared_outputs,
    publish_result,
    result_exists,
    result_name,
    staging_layout,
)
from velfield.run.run import Run, open_run

MAX_ADDED_ERROR_PX = 1.0
"""A new base image that lies on the old one worse than this, in the mean, has the frames registered again."""

_SHARED = ("frames", "lens", "registration", "detector", "tracklets")
"""Stages that no new base image touches, apart from what stands in ``base/``; of the tracklets only counts are kept."""


def run_reprocess(
    root: Path,
    base: Path,
    *,
    name: str | None = None,
    full: bool = False,
    max_added_error_px: float = MAX_ADDED_ERROR_PX,
    runner: RunnerConfig | None = None,
    console: Console | None = None,
) -> tuple[Path, RunSummary | None]:
    """Reprocess one run on a new base image; returns the new result's folder, and no summary where it was there.

    Raises
    ------
    InputError
        The picture is not of this place, or the run folder is not one. Nothing was changed.
    """
    where = runner or RunnerConfig()
    if not base.exists():
        raise InputError(f"--base: {base} is not there; give a path that exists")
    chosen = result_name(name, base)
    task_runner = ThreadPoolTaskRunner(max_workers=parallel_units(where))
    return reprocess.with_options(task_runner=task_runner)(
        absolute(str(root)), absolute(str(base)), chosen, full, max_added_error_px, where, console or Console("normal")
    )


@flow(name="reprocess", flow_run_name="{root} on {name}", persist_result=False, validate_parameters=False)
def reprocess(
    root: str, base: str, name: str, full: bool, max_added_error_px: float, runner: RunnerConfig, console: Console
) -> tuple[Path, RunSummary | None]:
    """One run, a new base image, a new result beside the old one."""
    run = open_run(root)
    with locked(run.layout):
        mark_crashed(f"{root} on {name}")
        if result_exists(run.layout, name, Path(base)):
            console.event("start", f"{run.layout.results / name} is this base image's result already")
            return publish_result(run, name, Path(base)), None
        job = _new_job(run, name, base)
        found = None if full else _registered(run, base, max_added_error_px, console)
        try:
            summary = _again(run, job, runner, console) if found is None else _mapped(run, job, found, runner, console)
        except InputError:
            discard_result(RunLayout(Path(job.root)))
            raise
        return publish_result(run, name, Path(base)), summary


def _new_job(run: Run, name: str, base: str) -> Job:
    if run.layout.rebased.exists():
        raise InputError(f"{run.layout.root} is itself mapped onto a new base image; reprocess the run that it is of")
    given = run.record.given
    if given is None:
        raise InputError(f"{run.layout.root} does not say where its inputs are; run `velfield run` on it again")
    inputs = Inputs.model_validate(given.model_dump() | {"base": base})
    return Job(root=str(staging_layout(run.layout, name).root), inputs=inputs, config=run.record.config)


def _registered(run: Run, base: str, limit_px: float, console: Console) -> RebaseRecord | None:
    """How the new picture lies on the old base image; none where that is not good enough, said aloud."""
    measure = task(
        measure_rebase, name="new base image on the old one", cache_policy=NO_CACHE, persist_result=False, retries=0
    )
    found = measure(run, Path(base))
    if isinstance(found, Failure):
        console.warn(f"the new base image does not fit on the old one, the frames are tried: {found.reason}")
        return None
    if found.added_error_px > limit_px:
        console.warn(
            f"the new base image lies on the old one to {found.added_error_px:.2f} px, {limit_px:.2f} px wanted: "
            "the frames are registered again"
        )
        return None
    console.event("start", found.text())
    return found


def _again(run: Run, job: Job, runner: RunnerConfig, console: Console) -> RunSummary:
    """All that depends on the base image, as a run of its own that finds its frames read and its lens known."""
    layout = RunLayout(Path(job.root))
    link_shared_outputs(run.layout, layout, ("frames", "lens"))
    task_runner = ThreadPoolTaskRunner(max_workers=parallel_units(runner))
    return process_flight.with_options(task_runner=task_runner)(job, runner, console)


def _mapped(run: Run, job: Job, found: RebaseRecord, runner: RunnerConfig, console: Console) -> RunSummary:
    layout = RunLayout(Path(job.root))
    link_shared_outputs(run.layout, layout, _SHARED, without=("base/", "tracklets/"))
    sweep_partial(layout.root)
    plan = rebased_plan(run, job, found)
    write_flight_record(plan)
    with open_runner(runner) as where:
        work = Work(plan, where, console)
        _run_stages(work, Rebase(run.layout, found))
    summary = RunSummary(root=job.root, stages=tuple(work.summaries), frames_lost=lost_frames(plan))
    write_report(plan, summary)
    publish_summary(plan, summary)
    return summary


def _run_stages(work: Work, rebase: Rebase) -> None:
    plan = work.plan
    for name in ("frames", "lens"):
        work.carry_over(name)
    image = work.run("base", [Unit("all", lambda: graphs.rebase_graph(plan, rebase))], essential=True)
    for name in ("registration", "detector"):
        work.carry_over(name)
    cars = [
        Unit(unit_name(frames), lambda frames=frames: graphs.rebase_detections_graph(plan, frames, rebase), len(frames))
        for frames in plan.units
    ]
    work.run("detections", cars, after=[image], essential=True)
    work.carry_over("tracklets")
    chain = [Unit("all", lambda: graphs.rebase_tracks_graph(plan, rebase))]
    tracks = work.run("tracks", chain, after=[image], essential=True)
    lay_out_field(plan)
    groups = [
        Unit(group_name(group), lambda group=group: graphs.field_graph(plan, group)) for group in field_groups(plan)
    ]
    field = work.run("field", groups, after=[tracks], essential=True)
    work.run("maps", [Unit("all", lambda: graphs.maps_graph(plan))], after=[field], essential=True)
