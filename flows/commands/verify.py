"""``velfield verify``: the integrity of a run folder, and its repair."""

from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from flows.options import RunFolder
from velfield.errors import InputError

if TYPE_CHECKING:
    from velfield.run.run import Run

WHOLE, DAMAGED = 0, 3


def verify(run_folder: RunFolder, /, *, repair: Annotated[bool, Parameter(negative=())] = False) -> int:
    """Compare every file and chunk of a run with its commit record; list what is damaged or missing.

    Exit status 0: intact; 3: damaged, or never finished.

    Parameters
    ----------
    repair
        Recompute the damaged units from the same inputs.
    """
    from velfield.pipeline.verify import describe_damage, has_damage, verify_run
    from velfield.run.run import open_run

    run = open_run(run_folder)
    run.require_frames()
    damages = verify_run(run.layout, run.record)
    print(describe_damage(run_folder, damages))
    if not damages:
        return WHOLE
    if not repair:
        if has_damage(damages):
            print(f"velfield verify {run_folder} --repair  recomputes these units")
        else:
            print(f"velfield run ... --out {run_folder}  resumes the run, or prints why it was rejected")
        return DAMAGED
    _repair(run)
    damages = verify_run(run.layout, open_run(run_folder).record)
    print(describe_damage(run_folder, damages))
    return DAMAGED if damages else WHOLE


def _repair(run: "Run") -> None:
    from flows.launch import prepare_process

    prepare_process(verbose=False)
    from flows.console import Console
    from flows.process_flight import run_flight
    from flows.runners import RunnerConfig
    from velfield.analysis.movements.time_slices import SLICE_S
    from velfield.pipeline.analysis.analyse import analyse_run
    from velfield.pipeline.given_tracks.plan import plan_tracks
    from velfield.pipeline.plan import job_of, make_plan
    from velfield.pipeline.verify import invalidate, verify_run
    from velfield.run.commits import ANALYSIS, read_commit
    from velfield.run.flight_record import check_format
    from velfield.run.lock import locked

    check_format(run.layout.root)
    job = job_of(run.layout, run.record)
    of_tracks = run.record.inputs.source.of_tracks
    plan = (plan_tracks if of_tracks else make_plan)(job)
    # Where the inputs changed since, it would be another run and not a repair.
    if plan.keys != run.record.keys:
        raise InputError(
            f"{job.root}: its inputs or the code have changed since the run; run `velfield run` on it again"
        )
    analysis = read_commit(run.layout, ANALYSIS, "all")
    with locked(run.layout):
        damages = verify_run(run.layout, run.record)
        invalidate(run.layout, damages)
    run_flight(job, RunnerConfig(), Console("normal"), of_tracks=of_tracks)
    if any(damage.stage == ANALYSIS for damage in damages):
        slice_s = SLICE_S if analysis is None else analysis.counts["slice_s"]
        for line in analyse_run(run.layout.root, slice_s=slice_s):
            print(line)
