"""Tracks of another program in, velocity field out: the stages after the tracks, on a run folder without frames."""

from pathlib import Path

from flows.console import Console
from flows.orchestration import Orchestration
from flows.process_flight import publish_report, record_start, run_flow
from flows.runners import RunnerConfig, open_runner, parallel_units
from flows.stopping import stop_lost
from flows.work import Work
from schemas.job import Job, absolute
from schemas.summary import RunSummary
from velfield.pipeline.given_tracks.plan import plan_tracks
from velfield.pipeline.plan import check_folder
from velfield.run.commits import sweep_partial
from velfield.run.layout import RunLayout
from velfield.run.lock import locked


def run_tracks(job: Job, runner: RunnerConfig, console: Console) -> RunSummary:
    """Process tracks: the flow below.

    Raises
    ------
    InputError
        The tracks or the configuration are not usable.
    """
    return run_flow(process_tracks, "process-tracks", job, runner, console)


def process_tracks(job: Job, runner: RunnerConfig, console: Console, by: Orchestration) -> RunSummary:
    """Tracks in, velocity field out."""
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
