"""A new base image under a finished run: only what depends on it is recomputed; the previous result is kept.

Where the new image registers well to the old base image, all results are mapped by that one transform, in seconds: no
frame is decoded, registered or searched for cars. Where it does not, or with ``--full``, the frames are registered
again.
"""

from functools import partial
from pathlib import Path

from prefect import flow, task
from prefect.cache_policies import NO_CACHE
from prefect.task_runners import ThreadPoolTaskRunner

from flows.console import Console
from flows.process_flight import process_flight, publish_report
from flows.runners import RunnerConfig, open_runner, parallel_units
from flows.stale import mark_crashed
from flows.stopping import stop_lost
from flows.work import Work
from schemas.job import Inputs, Job, absolute
from schemas.records import RebaseRecord
from schemas.summary import RunSummary
from velfield.errors import Failure, InputError
from velfield.pipeline.given_tracks.plan import TRACKS
from velfield.pipeline.graphs import rebase_graph
from velfield.pipeline.plan import write_flight_record
from velfield.pipeline.stage import STAGE, STAGES, NewBase, stages_before
from velfield.pipeline.stages.rebase import Rebase, measure_rebase, plan_rebase
from velfield.pipeline.summary import summarise_run
from velfield.run.commits import sweep_partial
from velfield.run.flight_record import check_format
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
"""Above this mean registration error of the new base image to the old one the frames are registered again."""


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
        The image is of another place, or the run folder is not one. Nothing was changed.
    """
    where = runner or RunnerConfig()
    if not base.exists():
        raise InputError(f"--base {base}: no such file; check the path")
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
    check_format(Path(root))
    run = open_run(root)
    run.require_frames()
    with locked(run.layout, stop_lost):
        mark_crashed(f"{root} on {name}")
        if result_exists(run.layout, name, Path(base)):
            console.event("start", f"{run.layout.results / name} is the result on this base image already")
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
        raise InputError(f"{run.layout.root} is itself mapped onto a new base image; reprocess the original run")
    if run.record.inputs.source.kind == TRACKS:
        raise InputError(
            f"{run.layout.root} was made from tracks and has no frames; run `velfield run --tracks` with the new --base"
        )
    if set(run.record.keys) != set(STAGE):
        raise InputError(f"{run.layout.root} was made by another version of velfield; run `velfield run` on it again")
    given = run.record.given
    if given is None:
        raise InputError(f"{run.layout.root} has no record of its inputs; run `velfield run` on it again")
    inputs = Inputs.model_validate(given.model_dump() | {"base": base})
    return Job(root=str(staging_layout(run.layout, name).root), inputs=inputs, config=run.record.config)


def _registered(run: Run, base: str, limit_px: float, console: Console) -> RebaseRecord | None:
    """The registration of the new image to the old base image; none, with a warning, where it is not good enough."""
    measure = task(
        measure_rebase, name="new base image on the old one", cache_policy=NO_CACHE, persist_result=False, retries=0
    )
    found = measure(run, Path(base))
    if isinstance(found, Failure):
        console.warn(
            f"the new base image does not register to the old one, so the frames are registered again: {found.reason}"
        )
        return None
    if found.added_error_px > limit_px:
        console.warn(
            f"the new base image registers to the old one with an error of {found.added_error_px:.2f} px, more than "
            f"{limit_px:.2f} px: the frames are registered again"
        )
        return None
    console.event("start", found.text())
    return found


def _again(run: Run, job: Job, runner: RunnerConfig, console: Console) -> RunSummary:
    """Register the frames to the new base image: a run of its own that starts from the stages before the base image."""
    layout = RunLayout(Path(job.root))
    link_shared_outputs(run.layout, layout, stages_before("base"))
    task_runner = ThreadPoolTaskRunner(max_workers=parallel_units(runner))
    return process_flight.with_options(task_runner=task_runner)(job, runner, console)


def _mapped(run: Run, job: Job, found: RebaseRecord, runner: RunnerConfig, console: Console) -> RunSummary:
    layout = RunLayout(Path(job.root))
    link_shared_outputs(run.layout, layout, _names(NewBase.SHARED), without=("base/",))
    link_shared_outputs(run.layout, layout, _names(NewBase.COUNTS), without=("",))  # no outputs, only the records
    sweep_partial(layout.root)
    plan = plan_rebase(run, job, found)
    write_flight_record(plan)
    with open_runner(runner, console.warn) as where:
        work = Work(plan, where, console, at_once=parallel_units(runner))
        _run_stages(work, Rebase(run.layout, found))
        summary = summarise_run(plan, work.summaries)
        publish_report(plan, summary, where, console)
    return summary


def _names(new_base: NewBase) -> list[str]:
    return [stage.name for stage in STAGES if stage.new_base is new_base]


def _run_stages(work: Work, rebase: Rebase) -> None:
    graph = partial(rebase_graph, rebase=rebase)
    for stage in STAGES:
        if stage.new_base in (NewBase.SHARED, NewBase.COUNTS):
            work.carry_over(stage)
        else:
            work.run([stage], graph, essential=True)
