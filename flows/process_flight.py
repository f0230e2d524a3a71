"""The whole job in the paper's order: frames, lens, base image, registration, cars, tracklets, velocity field, maps.

A task is thin glue: it asks ``velfield.pipeline.graphs`` for the Dask graph of its unit and computes it on the runner.
What is finished is known from the run folder's commit records, so a task whose unit stands there returns at once,
whatever Prefect remembers of it. Futures of one stage are handed to the next, which draws the lineage in the UI.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from prefect import flow
from prefect.task_runners import ThreadPoolTaskRunner

from flows.artifacts import publish_summary
from flows.console import Console
from flows.runners import RunnerConfig, open_runner, parallel_units
from flows.stale import mark_crashed
from flows.work import Unit, Work
from schemas.job import Job
from schemas.summary import RunSummary
from velfield.pipeline import graphs
from velfield.pipeline.check_inputs import check_given
from velfield.pipeline.estimate import check_space
from velfield.pipeline.plan import Plan, changed_since, make_plan, write_flight_record
from velfield.pipeline.result import unit_name
from velfield.pipeline.stages.field import field_groups, group_name, lay_out_field
from velfield.pipeline.stages.frames import lay_out_frames
from velfield.pipeline.stages.registration import lay_out_registration, lost_frames
from velfield.pipeline.stages.report import write_report
from velfield.run.commits import sweep_partial
from velfield.run.layout import RunLayout
from velfield.run.lock import locked


def run_flight(job: Job, runner: RunnerConfig, console: Console) -> RunSummary:
    """Process a flight: the flow below, with as many units under way at once as the runner is worth.

    Raises
    ------
    InputError
        The inputs or the configuration are not usable; nothing that was committed is lost.
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
        check_given(plan)
        check_space(plan)
        changed = changed_since(plan)
        write_flight_record(plan)
        console.event("start", f"{job.inputs.source}: {plan.frame_count} frames to work on, {where.description}")
        if changed:
            told = f"{', '.join(changed)} given otherwise than before, so what follows from it is done anew"
            console.event("changed", f"{job.root}: {told}", changed=changed)
        for warning in plan.info.warnings:
            console.warn(warning)
        work = Work(plan, where, console)
        _run_stages(work)
        summary = RunSummary(root=job.root, stages=tuple(work.summaries), frames_lost=lost_frames(work.plan))
        for note in write_report(work.plan, summary):
            console.warn(note)
        publish_summary(work.plan, summary)
        return summary


def _run_stages(work: Work) -> None:
    # work.plan is read anew at each stage: units that were lost change the keys of all that is made without them.
    lay_out_frames(work.plan)
    frames = work.run("frames", _by_frames(work.plan, graphs.frames_graph))
    lens = work.run("lens", _whole(work.plan, graphs.lens_graph), after=[frames], essential=True)
    base = work.run("base", _whole(work.plan, graphs.base_graph), after=[frames, lens], essential=True)

    lay_out_registration(work.plan)
    units = _by_frames(work.plan, graphs.registration_graph)
    registered = work.run("registration", units, after=[base], beside=frames)
    detector = work.run("detector", _whole(work.plan, graphs.detector_graph), after=[registered], essential=True)
    units = _by_frames(work.plan, graphs.detections_graph)
    detections = work.run("detections", units, after=[detector], beside=registered)

    tracklets = work.run("tracklets", _by_frames(work.plan, graphs.tracklets_graph), beside=detections, halo=1)
    chain = [Unit(graphs.WHOLE, _bound(graphs.tracks_graph, work.plan, work.plan.units))]
    tracks = work.run("tracks", chain, after=[tracklets], essential=True)

    lay_out_field(work.plan)
    groups = [
        Unit(group_name(group), _bound(graphs.field_graph, work.plan, group)) for group in field_groups(work.plan)
    ]
    field = work.run("field", groups, after=[tracks], essential=True)
    work.run("maps", _whole(work.plan, graphs.maps_graph), after=[field], essential=True)


def _bound(graph: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
    return lambda: graph(*arguments)


def _whole(plan: Plan, graph: Callable[[Plan], Any]) -> list[Unit]:
    return [Unit(graphs.WHOLE, _bound(graph, plan))]


def _by_frames(plan: Plan, graph: Callable[[Plan, range], Any]) -> list[Unit]:
    return [Unit(unit_name(frames), _bound(graph, plan, frames), len(frames)) for frames in plan.units]
