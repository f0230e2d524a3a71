"""The units of a stage as Prefect tasks: named for people, retried, linked to what they build on."""

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
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import committed
from velfield.pipeline.summary import summarise_stage
from velfield.run.commits import read_commits

Future = PrefectFuture[Any]
_LABELS = {
    "frames": "frames",
    "lens": "lens",
    "base": "base image",
    "registration": "registration",
    "detector": "detector",
    "detections": "detections",
    "tracklets": "tracklets",
    "tracks": "tracks",
    "field": "field",
    "maps": "maps",
}


@dataclass(frozen=True)
class Unit:
    """One unit of a stage: its name, how to get its graph, how many steps of progress it is."""

    name: str
    graph: Callable[[], Any]
    steps: int = 1


@dataclass
class Stage:
    """The units of one stage, submitted: their futures in order, and the names of those that were lost."""

    futures: list[Future] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)


@dataclass
class Work:
    """Runs stage after stage of one plan; ``plan`` changes its keys when units are lost."""

    plan: Plan
    runner: Runner
    console: Console
    summaries: list[StageSummary] = field(default_factory=list)

    def run(
        self,
        name: str,
        units: Sequence[Unit],
        *,
        after: Sequence[Stage] = (),
        beside: Stage | None = None,
        halo: int = 0,
        essential: bool = False,
    ) -> Stage:
        """Compute all units of a stage and wait for them.

        Parameters
        ----------
        after
            Stages of which every unit must be done or lost: what follows goes on with what is there.
        beside, halo
            A stage cut in the same way: unit k builds on its units k to k + halo.
        essential
            Nothing can follow without this stage: its failure is the run's.
        """
        started = time.monotonic()
        whole = [future for stage in after for future in stage.futures if not _is_lost(future)]
        stage = Stage()
        before: list[CommitRecord] = []
        with self.console.stage(name, _LABELS[name], sum(unit.steps for unit in units)) as progress:
            for k, unit in enumerate(units):
                local = beside.futures[k : k + 1 + halo] if beside else []
                record = committed(self.plan, name, unit.name)
                before += [] if record is None else [record]
                stage.futures.append(self._submit(name, unit, [*whole, *local]))
            records = self._collect(name, stage, units, progress, essential=essential)
        self.plan = self.plan.despite([f"{name} {unit}" for unit in stage.lost])
        summary = summarise_stage(
            name,
            records,
            units=len(units),
            before=before,
            lost=stage.lost,
            seconds=time.monotonic() - started,
        )
        self.summaries.append(summary)
        self.console.event(
            "stage",
            f"{_LABELS[name]:<13} {summary.text}   {summary.seconds:.1f} s",
            stage=summary.model_dump(mode="json"),
        )
        for note in summary.notes:
            self.console.event("note", f"  {note}")
        for warning in summary.warnings[:5]:
            self.console.warn(warning)
        if len(summary.warnings) > 5:
            self.console.warn(f"... and {len(summary.warnings) - 5} more of {_LABELS[name]}; all are in the report")
        return stage

    def carry_over(self, name: str) -> None:
        """Tell of a stage whose units an earlier result had finished, and that this one takes as they are."""
        records = read_commits(self.plan.layout, name)
        summary = summarise_stage(name, records, units=len(records), before=records, lost=(), seconds=0.0)
        self.summaries.append(summary)

    def _submit(self, name: str, unit: Unit, wait_for: list[Future]) -> Future:
        plan = self.plan

        def do() -> CommitRecord:
            record = committed(plan, name, unit.name) or self.runner.compute(unit.graph())
            # Prefect keeps what a task returns: hundreds of digests a unit would make the driver grow with the flight.
            return record.model_copy(update={"outputs": {}})

        label = _LABELS[name] if unit.name == "all" else f"{_LABELS[name]} {unit.name}"
        return task(
            do,
            name=_LABELS[name],
            task_run_name=label,
            retries=self.plan.config.work.retries,
            retry_delay_seconds=1,
            retry_condition_fn=_worth_retrying,
            cache_policy=NO_CACHE,
            persist_result=False,
        ).submit(wait_for=wait_for)

    def _collect(
        self, name: str, stage: Stage, units: Sequence[Unit], progress: StageProgress, *, essential: bool
    ) -> list[CommitRecord]:
        done = 0
        shown = LongStage(name, sum(unit.steps for unit in units))
        steps = {future: unit.steps for future, unit in zip(stage.futures, units, strict=True)}
        for future in as_completed(stage.futures):
            done += steps[future]
            progress.at_least(done)
            shown.tell(done)
        records = []
        for future, unit in zip(stage.futures, units, strict=True):
            if not _is_lost(future):
                records.append(future.result())
                continue
            error = _error_of(future)
            if isinstance(error, InputError) or essential:
                raise error
            stage.lost.append(unit.name)
            self.console.warn(f"{unit.name} was lost: {error}; the next run with the same folder tries it again")
        return records


def _worth_retrying(_task: Any, _run: Any, state: Any) -> bool:
    """Bad input stays bad: only what may pass (a killed worker, a full disk that empties) is tried again."""
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


def _error_of(future: Future) -> BaseException:
    if not future.state.is_final():
        return RuntimeError("what it builds on was lost")
    outcome = future.result(raise_on_failure=False)
    if isinstance(outcome, BaseException):
        return outcome
    return RuntimeError(future.state.message or f"not run ({future.state.name})")
