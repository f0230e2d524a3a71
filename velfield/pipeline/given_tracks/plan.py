"""The plan of a run of given tracks (`velfield run --tracks`): stages that read frames are left out."""

from pathlib import Path

import numpy as np

from schemas.job import Job
from schemas.records import InputsRecord, SourceRecord
from velfield.errors import InputError
from velfield.pipeline.given_tracks.load import load_tracks
from velfield.pipeline.given_tracks.write import frame_times
from velfield.pipeline.plan import Plan, check_same_flight
from velfield.pipeline.stage import STAGES, stage_keys
from velfield.run.commits import digest_path
from velfield.sources.frames import SourceInfo


def describe_tracks(job: Job) -> str:
    """One line that says what the run would make of the tracks.

    Raises
    ------
    InputError
        As `plan_tracks`.
    """
    plan = plan_tracks(job)
    span = float(plan.info.times_s[-1] - plan.info.times_s[0])
    return (
        f"{job.inputs.source}: tracks over {span:.1f} s at {plan.frame_count} times, on a map of {plan.info.width} x "
        f"{plan.info.height} px of {plan.config.gsd_m:g} m: {', '.join(plan.keys)}"
    )


def plan_tracks(job: Job) -> Plan:
    """Read the tracks and resolve the run.

    Raises
    ------
    InputError
        The file holds no tracks that can be laid on a map, or fewer than three frames.
    """
    job, path = job.anywhere(), Path(job.inputs.source)
    base = Path(job.inputs.base) if job.inputs.base else None
    given = load_tracks(path, job.config, base=base)
    height, width = given.shape
    if height * width > job.config.frames.max_pixels:
        size = f"{width * given.gsd_m:.0f} x {height * given.gsd_m:.0f} m"
        raise InputError(
            f"{path}: found positions over {size}, too large a map at {given.gsd_m:g} m a pixel; check the unit, leave "
            "out stray positions or give a larger --gsd-m"
        )
    times_s = frame_times(given.table, job.config)
    if len(times_s) < 3:
        raise InputError(f"{path}: found {len(times_s)} times, expected 3 or more for a velocity; give longer tracks")
    source = SourceRecord(
        path=str(path),
        kind="tracks",
        digest=" ".join((digest_path(path), job.config.position_unit or "", job.config.position_y_axis or "")).strip(),
        width=width,
        height=height,
        frame_count=len(times_s),
    )
    inputs = InputsRecord(source=source, base=digest_path(base) if base else None)
    info = SourceInfo("folder", width, height, len(times_s), times_s, ())
    keys = stage_keys(job.config, inputs)
    first = next(k for k, stage in enumerate(STAGES) if stage.from_tracks)
    done = [stage.name for stage in STAGES[first:] if stage.name != "scale"]
    plan = Plan(
        job=job.model_copy(update={"config": job.config.model_copy(update={"gsd_m": given.gsd_m})}),
        info=info,
        indices=np.arange(len(times_s)),
        inputs=inputs,
        keys={name: keys[name] for name in done},  # of the others `verify` asks nothing
    )
    _ = plan.time_intervals  # refuses impossible intervals now
    check_same_flight(plan)
    return plan
