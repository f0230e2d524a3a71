"""The units of a stage as Prefect tasks: named for people, retried, linked to the units that they read."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from prefect import task
from prefect.cache_policies import NO_CACHE
from prefect.futures import PrefectFuture, as_completed

from flows.artifacts import LongStage
from flows.console import Console, StageProgress
from flows.runners import Runner
from schemas.records import CommitRecord
from schemas.summary import StageSummary
from velfield.errors import InputError
from velfield.pipeline.graphs import unit_graph
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import committed
from velfield.pipeline.stage import STAGE, Cut, Stage
from velfield.pipeline.summary import summarise_stage
from velfield.pipeline.units import WHOLE, Unit, prepare_stage, stage_units
from velfield.run.commits import read_commits

Future = PrefectFuture[Any]
GraphOf = Callable[[Plan, Stage, Unit], Any]
"""The Dask graph of a unit."""


@dataclass
class Submitted:
    """The units of one stage, submitted: their futures in order, and the names of those that failed."""

    futures: list[Future] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)


@dataclass
class Work:
    """Runs stage after stage of one plan; ``plan`` changes its keys when units fail."""

    plan: Plan
    runner: Runner
    console: Console
    summaries: list[StageSummary] = field(default_factory=list)
    _submitted: dict[str, Submitted] = field(default_factory=dict)

    def run(self, stage: Stage, graph: GraphOf = unit_graph, *, essential: bool | None = None) -> None:
        """Compute all units of a stage and wait for them.

        A unit of frames waits for the units of the same frames, and as many after as the stage's halo, of the stages
        that it reads and that are cut by frames; for the others it waits until all of their units are done or lost:
        it goes on with what is there.

        Parameters
        ----------
        graph
            The Dask graph of a unit.
        essential
            Nothing can follow without this stage: its failure is the run's. Default: as the table says.
        """
        started = time.monotonic()
        prepare_stage(self.plan, stage)
        units = stage_units(self.plan, stage)
        submitted = Submitted()
        before: list[CommitRecord] = []
        with self.console.stage(stage.name, stage.label, sum(unit.steps for unit in units)) as progress:
            for k, unit in enumerate(units):
                record = committed(self.plan, stage.name, unit.name)
                before += [] if record is None else [record]
                submitted.futures.append(self._submit(stage, unit, graph, self._upstream(stage, k)))
            essential = stage.essential if essential is None else essential
            records = self._collect(stage, submitted, units, progress, essential=essential)
        self._submitted[stage.name] = submitted
        # Units that failed change the keys of all that is made without them.
        self.plan = self.plan.with_lost_units([f"{stage.name} {unit}" for unit in submitted.lost])
        summary = summarise_stage(
            stage.name,
            records,
            units=len(units),
            before=before,
            lost=submitted.lost,
            seconds=time.monotonic() - started,
        )
        self.summaries.append(summary)
        self._print(stage, summary)

    def _print(self, stage: Stage, summary: StageSummary) -> None:
        self.console.event(
            "stage",
            f"{stage.label:<13} {summary.text}   {summary.seconds:.1f} s",
            stage=summary.model_dump(mode="json"),
        )
        for note in summary.notes:
            self.console.event("note", f"  {note}")
        for warning in summary.warnings[:5]:
            self.console.warn(warning)
        if len(summary.warnings) > 5:
            self.console.warn(f"... and {len(summary.warnings) - 5} more of {stage.label}; all are in the report")

    def _upstream(self, stage: Stage, unit: int) -> list[Future]:
        """What a unit, by its number, waits for."""
        found: list[Future] = []
        for name in stage.after:
            futures = self._submitted.get(name, Submitted()).futures
            if stage.cut is STAGE[name].cut is Cut.BY_FRAMES:
                found += futures[unit : unit + 1 + stage.halo]
            else:
                found += [future for future in futures if not _is_lost(future)]
        return found

    def carry_over(self, stage: Stage) -> None:
        """Summarise a stage whose units an earlier result finished, and that this one takes as they are."""
        records = read_commits(self.plan.layout, stage.name)
        summary = summarise_stage(stage.name, records, units=len(records), before=records, lost=(), seconds=0.0)
        self.summaries.append(summary)

    def _submit(self, stage: Stage, unit: Unit, graph: GraphOf, wait_for: list[Future]) -> Future:
        plan = self.plan

        def do() -> CommitRecord:
            record = committed(plan, stage.name, unit.name) or self.runner.compute(graph(plan, stage, unit))
            # Prefect keeps what a task returns: hundreds of digests a unit would make the driver grow with the flight.
            return record.model_copy(update={"outputs": {}})

        label = stage.label if unit.name == WHOLE else f"{stage.label} {unit.name}"
        return task(
            do,
            name=stage.label,
            task_run_name=label,
            retries=self.plan.config.work.retries,
            retry_delay_seconds=1,
            retry_condition_fn=_worth_retrying,
            cache_policy=NO_CACHE,
            persist_result=False,
        ).submit(wait_for=wait_for)

    def _collect(
        self, stage: Stage, submitted: Submitted, units: Sequence[Unit], progress: StageProgress, *, essential: bool
    ) -> list[CommitRecord]:
        done = 0
        artifact = LongStage(stage.name, sum(unit.steps for unit in units))
        steps = {future: unit.steps for future, unit in zip(submitted.futures, units, strict=True)}
        for future in as_completed(submitted.futures):
            done += steps[future]
            progress.at_least(done)
            artifact.update(done)
        records = []
        for future, unit in zip(submitted.futures, units, strict=True):
            if not _is_lost(future):
                records.append(future.result())
                continue
            error = _failure_cause(future)
            if isinstance(error, InputError) or essential:
                raise error
            submitted.lost.append(unit.name)
            self.console.warn(f"unit {unit.name} of {stage.label} failed: {error}; re-run to retry")
        return records


def _worth_retrying(_task: Any, _run: Any, state: Any) -> bool:
    """Bad input stays bad: only what may pass (a killed worker, a full disk that empties) is retried."""
    try:
        state.result()
    except InputError:
        return False
    except Exception:
        return True
    return False


def _is_lost(future: Future) -> bool:
    future.wait()  # as_completed may give a future an instant before its state says so
    return not future.state.is_completed()


def _failure_cause(future: Future) -> BaseException:
    if not future.state.is_final():
        return RuntimeError("a unit that it reads failed")
    outcome = future.result(raise_on_failure=False)
    if isinstance(outcome, BaseException):
        return outcome
    return RuntimeError(future.state.message or f"not run ({future.state.name})")
