"""The whole job: all stages of one flight as a Prefect flow.

The stages and their order stand in ``velfield.pipeline.stage``. A task is thin glue: it asks
``velfield.pipeline.graphs`` for the Dask graph of its unit and computes it on the runner. What is finished is known
from the run folder's commit records, so a task whose unit has one returns at once, whatever Prefect remembers of it.
Futures of one stage are passed to the next, which draws the lineage in the UI. The report is written last, from the
summary of all stages, by every run: it is no stage, for nothing depends on it and it takes a moment.
"""

from pathlib import Path

from prefect import flow
from prefect.task_runners import ThreadPoolTaskRunner

from flows.artifacts import publish_summary
from flows.console import Console
from flows.runners import RunnerConfig, open_runner, parallel_units
from flows.stale import mark_crashed
from flows.work import Work
from schemas.job import Job
from schemas.summary import RunSummary
from velfield.pipeline.check_inputs import validate_inputs
from velfield.pipeline.estimate import check_space
from velfield.pipeline.plan import changed_since, make_plan, write_flight_record
from velfield.pipeline.stage import STAGES
from velfield.pipeline.stages.registration import lost_frames
from velfield.pipeline.stages.report import write_report
from velfield.run.commits import sweep_partial
from velfield.run.layout import RunLayout
from velfield.run.lock import locked


def run_flight(job: Job, runner: RunnerConfig, console: Console) -> RunSummary:
    """Process a flight: the flow below, with as many concurrent units as the runner can use.

    Raises
    ------
    InputError
        The inputs or the configuration are not usable; committed units are kept.
    """
    task_runner = ThreadPoolTaskRunner(max_workers=parallel_units(runner))
    return process_flight.with_options(task_runner=task_runner)(job, runner, console)


@flow(name="process-flight", flow_run_name="{job.root}", persist_result=False, validate_parameters=False)
def process_flight(job: Job, runner: RunnerConfig, console: Console) -> RunSummary:
    """Aerial video in, velocity field out."""
    layout = RunLayout(Path(job.root))
    with locked(layout), open_runner(runner) as where:
        mark_crashed(job.root)
        sweep_partial(layout.root)
        plan = make_plan(job)
        validate_inputs(plan)
        check_space(plan)
        changed = changed_since(plan)
        write_flight_record(plan)
        console.event("start", f"{job.inputs.source}: {plan.frame_count} frames to process, {where.description}")
        if changed:
            text = f"{', '.join(changed)} changed since the last run; dependent stages are recomputed"
            console.event("changed", f"{job.root}: {text}", changed=changed)
        for warning in plan.info.warnings:
            console.warn(warning)
        work = Work(plan, where, console)
        for stage in STAGES:
            work.run(stage)
        summary = RunSummary(root=job.root, stages=tuple(work.summaries), frames_lost=lost_frames(work.plan))
        for note in write_report(work.plan, summary):
            console.warn(note)
        publish_summary(work.plan, summary)
        return summary
