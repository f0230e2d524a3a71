"""A new base image under a finished run: only what depends on it is recomputed; the previous result is kept.

Where the new image registers well to the old base image, all results are mapped by that one transform, in seconds: no
frame is decoded, registered or searched for cars. Where it does not, or with ``--full``, the frames are registered
again.
"""

from concurrent.futures import Future
from pathlib import Path
from typing import Any

from flows.console import Console
from flows.orchestration import Orchestration
from flows.prefect_server import choose_orchestration
from flows.process_flight import process_flight, publish_report
from flows.runners import RunnerConfig, open_runner, parallel_units
from flows.stopping import stop_lost
from flows.work import Mapped, Work
from schemas.job import Inputs, Job, absolute
from schemas.records import RebaseRecord
from schemas.summary import RunSummary
from velfield.errors import Failure, InputError
from velfield.pipeline.plan import job_of, write_flight_record
from velfield.pipeline.stage import STAGE, STAGES, NewBase, stages_before
from velfield.pipeline.stages.rebase import Rebase, measure_rebase, plan_rebase
from velfield.pipeline.summary import summarise_run
from velfield.run.commits import sweep_partial
from velfield.run.flight_record import check_format
from velfield.run.layout import RunLayout, is_remote, remove_tree, to_path
from velfield.run.lock import locked
from velfield.run.results import (
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
    run, image, by = absolute(str(root)), absolute(str(base)), choose_orchestration()
    limit_px = None if full else max_added_error_px
    return by.run(
        lambda: reprocess(run, image, chosen, limit_px, where, console or Console("normal"), by),
        name="reprocess",
        folder=run,
        result=chosen,
        threads=parallel_units(where),
        parameters={"run": run, "base": image, "name": chosen, "full": full},
    )


def reprocess(
    root: str, base: str, name: str, limit_px: float | None, runner: RunnerConfig, console: Console, by: Orchestration
) -> tuple[Path, RunSummary | None]:
    """One run, a new base image, a new result beside the old one."""
    check_format(Path(root))
    run = open_run(root)
    run.require_frames()
    with locked(run.layout, stop_lost):
        by.mark_killed(root)
        if result_exists(run.layout, name, Path(base)):
            console.event("start", f"{run.layout.results / name} is the result on this base image already")
            return publish_result(run, name, Path(base)), None
        job = _new_job(run, name, base)
        found = None if limit_px is None else _registered(run, base, limit_px, console, by)
        try:
            summary = (
                _again(run, job, runner, console, by)
                if found is None
                else _mapped(run, job, *found, runner, console, by)
            )
        except InputError:
            remove_tree(to_path(job.root))
            if not is_remote(run.layout.results) and not any(run.layout.results.iterdir()):
                run.layout.results.rmdir()
            raise
        return publish_result(run, name, Path(base)), summary


def _new_job(run: Run, name: str, base: str) -> Job:
    if run.layout.rebased.exists():
        raise InputError(f"{run.layout.root} is itself mapped onto a new base image; reprocess the original run")
    if run.record.inputs.source.of_tracks:
        raise InputError(
            f"{run.layout.root} was made from tracks and has no frames; run `velfield run --tracks` with the new --base"
        )
    if set(run.record.keys) != set(STAGE):
        raise InputError(f"{run.layout.root} was made by another version of velfield; run `velfield run` on it again")
    job = job_of(run.layout, run.record)
    inputs = Inputs.model_validate(job.inputs.model_dump() | {"base": base})
    return job.model_copy(update={"root": str(staging_layout(run.layout, name).root), "inputs": inputs})


def _registered(
    run: Run, base: str, limit_px: float, console: Console, by: Orchestration
) -> tuple[RebaseRecord, "Future[Any]"] | None:
    """The registration of the new image to the old base image, and the task that measured it; none, with a warning,
    where it is not good enough."""
    name = "new base image on the old one"
    measured = by.submit(lambda: measure_rebase(run, Path(base)), name=name, run_name=name)
    found = measured.result()
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
    return found, measured


def _again(run: Run, job: Job, runner: RunnerConfig, console: Console, by: Orchestration) -> RunSummary:
    """Register the frames to the new base image: a run of its own that starts from the stages before the base image."""
    layout = RunLayout(Path(job.root))
    link_shared_outputs(run.layout, layout, stages_before("base"))
    return process_flight(job, runner, console, by)


def _mapped(
    run: Run,
    job: Job,
    found: RebaseRecord,
    measured: "Future[Any]",
    runner: RunnerConfig,
    console: Console,
    by: Orchestration,
) -> RunSummary:
    layout = RunLayout(Path(job.root))
    link_shared_outputs(run.layout, layout, _names(NewBase.SHARED), without=("base/",))
    link_shared_outputs(run.layout, layout, _names(NewBase.COUNTS), without=("",))  # no outputs, only the records
    sweep_partial(layout.root)
    plan = plan_rebase(run, job, found)
    write_flight_record(plan)
    with open_runner(runner, console.warn) as where:
        mapped = Mapped(Rebase(run.layout, found), measured)
        work = Work(plan, where, console, by, at_once=parallel_units(runner), mapped=mapped)
        work.run()
        summary = summarise_run(plan, work.summaries)
        publish_report(plan, summary, where, console, by)
    return summary


def _names(new_base: NewBase) -> list[str]:
    return [stage.name for stage in STAGES if stage.new_base is new_base]
