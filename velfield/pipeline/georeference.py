"""Georeference a finished run by ground control points: its map moves, no frame is registered again.

The map's place, scale and north are those of the points from then on. Maps, exports, the page and the report follow;
the field is accumulated again where the scale changed, as its bins are in metres a second. Tracklets stay as they are:
their limits were those of the scale before.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from schemas.georeference import ControlPoint, ControlPointsRecord, GeoreferenceRecord
from schemas.summary import RunSummary
from velfield.errors import InputError
from velfield.pipeline.local import compute_stages
from velfield.pipeline.plan import Plan, job_of
from velfield.pipeline.result import StageResult, commit
from velfield.pipeline.stage import STAGE, STAGES
from velfield.pipeline.stages.georeference import (
    base_digest,
    describe,
    georeference_counts,
    georeference_warnings,
    scale_of_points,
    with_control_points,
    write_georeference,
)
from velfield.pipeline.stages.rebase import describe_source
from velfield.pipeline.stages.report import write_report
from velfield.pipeline.summary import summarise_run, summarise_stage
from velfield.run.commits import WHOLE, read_commits, remove_analysis, write_record
from velfield.run.flight_record import check_format
from velfield.run.frame_transforms import read_first_georeference, read_georeference
from velfield.run.layout import RunLayout, remove_tree, to_path
from velfield.run.lock import locked
from velfield.run.run import Run, open_run
from velfield.sources.control_points import Model, fit_control_points
from velfield.sources.scale import choose_scale

_SAME_SCALE = 1e-4
_OTHER_LIMITS = 0.1
"""Where the scale changes by more than this fraction, it matters that the limits of tracking were those before."""


@dataclass(frozen=True)
class Georeferenced:
    """Result of `georeference`."""

    points: ControlPointsRecord
    """The control points and the fit."""
    record: GeoreferenceRecord
    """Scale, north and place of the map from now on."""
    notes: tuple[str, ...] = ()
    """One line each, for the user."""

    def all_notes(self) -> tuple[str, ...]:
        """Disagreements between the sources of scale, contradictions, and the notes."""
        return (*self.record.scale.disagreements, *self.record.remarks, *self.notes)


def fit_run_points(
    run: Run, points: Sequence[ControlPoint], epsg: int, model: Model | None = None
) -> ControlPointsRecord:
    """Fit a run's map to control points, and write nothing: what `georeference` would use.

    Raises
    ------
    InputError
        Too few points, on one line, outside the map, of no reference system, or the map would be distorted.
    """
    shape = (run.grid.height_px, run.grid.width_px)
    return fit_control_points(points, epsg, shape=shape, base_digest=base_digest(run.layout), model=model)


def georeference(
    root: str | Path, points: Sequence[ControlPoint], epsg: int = 4326, model: Model | None = None
) -> Georeferenced:
    """Georeference a finished run by control points, and bring all that shows coordinates up to date.

    Parameters
    ----------
    root
        The run folder.
    points
        Three or more.
    epsg
        Code of their coordinates; 4326: longitude and latitude.
    model
        None: a similarity, or with six points or more an affine transform where that is closer at points left out.

    Raises
    ------
    InputError
        Not a finished run, another process works on it, or the points cannot be used; nothing was changed.
    """
    run = open_finished_run(root)
    fitted = fit_run_points(run, points, epsg, model)
    with locked(run.layout):
        before_m, plan = run.grid.gsd_m, plan_of_finished(run)
        write_record(run.layout.control_points, fitted)
        first = _record(read_first_georeference(run.layout) or GeoreferenceRecord(), fitted)
        record = _record(read_georeference(run.layout) or GeoreferenceRecord(), fitted)
        for stage, path, written in (
            ("georeference", run.layout.georeference, first),
            ("scale", run.layout.scale, record),
        ):
            outputs = write_georeference(run.layout, path, written, plan.config.frames)
            counts = georeference_counts(written) | _vehicle_counts(run.layout, stage)
            done = StageResult(outputs, counts, describe(written), georeference_warnings(written))
            commit(plan, stage, WHOLE, done, started=time.time())
        changed = 1.0 if before_m is None else abs(fitted.gsd_m / before_m - 1)
        if changed > _SAME_SCALE:
            remove_tree(run.layout.field)
            compute_stages(plan, ("field",))
        compute_stages(plan, ("maps",))
        write_report(plan, _summary(plan))
        exported = "files exported so far are of the place and scale before; export them again"
        notes = [*remove_analysis(run.layout), exported]
        if before_m is None or changed > _OTHER_LIMITS:
            before = "not known" if before_m is None else f"{before_m:.4g} m a pixel"
            again = f"to track them with {fitted.gsd_m:.4g} m, run the flight again with --gsd-m {fitted.gsd_m:.4g}"
            notes.insert(0, f"the scale was {before} when vehicles were tracked; {again}")
    return Georeferenced(fitted, record, tuple(notes))


def open_finished_run(root: str | Path) -> Run:
    """A run that can be georeferenced.

    Raises
    ------
    InputError
        It is not finished, or another version's.
    """
    folder = to_path(root)
    check_format(folder)
    run = open_run(folder)
    if set(run.record.keys) != set(STAGE):
        raise InputError(f"{root} was made by another version of velfield; run `velfield run` on it again")
    if not run.layout.report.exists():
        raise InputError(f"{root} is not finished; run `velfield run` on it again")
    return run


def plan_of_finished(run: Run) -> Plan:
    """The plan of a finished run, from its folder alone: its source may be gone."""
    job = job_of(run.layout, run.record)
    return Plan(job, describe_source(run), np.arange(run.frames.count), run.record.inputs, run.record.keys)


def _vehicle_counts(layout: RunLayout, stage: str) -> dict[str, float]:
    """Counts of the stage that concern the scale by vehicles, from its commit records."""
    return {
        key: value
        for record in read_commits(layout, stage)
        for key, value in record.counts.items()
        if key in ("vehicles", "vehicle_gsd_m")
    }


def _record(before: GeoreferenceRecord, points: ControlPointsRecord) -> GeoreferenceRecord:
    every = [before.scale.used, *before.scale.others]
    kept = [estimate for estimate in every if estimate is not None and estimate.source != "control_points"]
    scale = choose_scale([scale_of_points(points), *kept])
    return with_control_points(before.model_copy(update={"scale": scale, "remarks": ()}), points)


def _summary(plan: Plan) -> RunSummary:
    found = {stage.name: read_commits(plan.layout, stage.name) for stage in STAGES}
    done = [summarise_stage(name, one, units=len(one), before=one, seconds=0.0) for name, one in found.items()]
    return summarise_run(plan, done)
