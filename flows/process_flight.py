"""The whole job: all stages of one flight, or those after the tracks of another program, as a flow.

The stages and their order stand in ``velfield.pipeline.stage``. A task is thin glue: it asks
``velfield.pipeline.graphs`` for the Dask graph of its unit and computes it on the runner. What is finished is known
from the run folder's commit records, so a task whose unit has one returns at once. Futures of one stage are passed to
the next, which draws the lineage in Prefect's UI. On a long flight a task beside them makes maps of what there is so
far. The report is written last, from the summary of all stages, by every run: it is no stage, for nothing depends on it
and it takes a moment.
"""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from flows.console import Console
from flows.orchestration import Orchestration
from flows.prefect_server import choose_orchestration
from flows.previews import Previews
from flows.runners import Runner, RunnerConfig, open_runner, parallel_units
from flows.stopping import stop_lost
from flows.work import Work
from schemas.job import Job, absolute
from schemas.summary import RunSummary
from velfield.errors import InputError
from velfield.pipeline.check_inputs import validate_inputs
from velfield.pipeline.estimate import check_space, disk_full_as_input_error
from velfield.pipeline.plan import (
    Plan,
    changed_since,
    check_folder,
    dropped_inputs,
    make_plan,
    write_flight_record,
)
from velfield.pipeline.summary import summarise_run
from velfield.run.commits import remove_analysis, sweep_partial
from velfield.run.layout import RunLayout, is_remote, remove_tree
from velfield.run.lock import locked


def run_flight(job: Job, runner: RunnerConfig, console: Console, *, of_tracks: bool = False) -> RunSummary:
    """Process a flight, or tracks: one of the flows below, with as many concurrent units as the runner can use.

    Raises
    ------
    InputError
        The inputs or the configuration are not usable; committed units are kept.
    """
    flow, name = (process_tracks, "process-tracks") if of_tracks else (process_flight, "process-flight")
    by = choose_orchestration()
    return by.run(
        lambda: flow(job, runner, console, by),
        name=name,
        folder=absolute(job.root),
        threads=parallel_units(runner),
        parameters=job,
    )


def process_flight(job: Job, runner: RunnerConfig, console: Console, by: Orchestration) -> RunSummary:
    """Aerial video in, velocity field out."""
    layout = RunLayout(Path(job.root))
    with locked(layout, stop_lost), _leave_no_trace(layout):
        by.mark_killed(absolute(job.root))
        sweep_partial(layout.root)
        remove_tree(layout.preview)
        plan = make_plan(job)
        validate_inputs(plan)
        check_space(plan)
        # Not before: what it loads would take the interpreter from planning, which the first frame waits for.
        with open_runner(runner, console.warn) as where, disk_full_as_input_error(plan):
            return _run_stages(plan, where, parallel_units(runner), console, by)


def process_tracks(job: Job, runner: RunnerConfig, console: Console, by: Orchestration) -> RunSummary:
    """Tracks of another program in, velocity field out: the stages after the tracks, on a run folder without frames."""
    from velfield.pipeline.given_tracks.plan import plan_tracks  # seconds, which a run on frames need not await

    check_folder(Path(job.root))
    plan = plan_tracks(job)  # refuses bad tracks before the folder is there
    layout = RunLayout(Path(job.root))
    with locked(layout, stop_lost), open_runner(runner, console.warn) as where:
        by.mark_killed(absolute(job.root))
        sweep_partial(layout.root)
        record_start(plan, f"tracks over {plan.frame_count} times, {where.description}", console)
        work = Work(plan, where, console, by, at_once=parallel_units(runner))
        work.run()
        summary = RunSummary(root=job.root, stages=tuple(work.summaries))
        publish_report(work.plan, summary, where, console, by)
    return summary


@contextmanager
def _leave_no_trace(layout: RunLayout) -> Iterator[None]:
    """Remove the folder again, with nothing but the lock in it, where the inputs are refused."""
    try:
        yield
    except InputError:
        if not is_remote(layout.root) and [path.name for path in layout.root.iterdir()] == [layout.lock.name]:
            with suppress(OSError):  # where an open file cannot be removed
                layout.lock.unlink()
                layout.root.rmdir()
        raise


def _run_stages(plan: Plan, runner: Runner, at_once: int, console: Console, by: Orchestration) -> RunSummary:
    """All stages, then the report."""
    dropped = dropped_inputs(plan)
    record_start(plan, f"{plan.frame_count} frames to process, {runner.description}", console)
    for warning in (*dropped, *plan.info.warnings):
        console.warn(warning)
    work = Work(plan, runner, console, by, at_once=at_once, aside=Previews(plan, runner, console))
    work.run()
    remove_tree(plan.layout.preview)
    summary = summarise_run(work.plan, work.summaries)
    publish_report(work.plan, summary, runner, console, by)
    return summary


def record_start(plan: Plan, what: str, console: Console) -> None:
    """Write the flight record; say what is processed, and what changed since the last run."""
    changed = changed_since(plan)
    write_flight_record(plan)
    console.event("start", f"{plan.job.inputs.source}: {what}")
    if changed:
        text = f"{', '.join(changed)} changed since the last run; dependent stages are recomputed"
        console.event("changed", f"{plan.layout.root}: {text}", changed=changed)
    for line in remove_analysis(plan.layout, unless=plan.keys):
        console.warn(line)


def publish_report(plan: Plan, summary: RunSummary, runner: Runner, console: Console, by: Orchestration) -> None:
    """Write the page and the report, print the warnings, and show the summary."""
    from velfield.pipeline.stages.report import write_report  # 1 s, which the first frame need not await

    for note in runner.call(write_report, plan, summary):  # it reads whole tables
        console.warn_at_end(note)
    console.print_warnings()
    by.publish(plan, summary)
