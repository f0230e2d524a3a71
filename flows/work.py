"""The units of the stages as tasks: named for people, retried, linked to the units that they read."""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Protocol

from flows.console import Console, StageProgress
from flows.orchestration import Orchestration
from flows.runners import Runner
from schemas.records import CommitRecord
from schemas.summary import StageSummary
from velfield.errors import InputError, is_disk_full
from velfield.pipeline.graphs import unit_graph
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import committed
from velfield.pipeline.stage import STAGE, STAGES, Cut, NewBase, Stage
from velfield.pipeline.summary import summarise_stage
from velfield.pipeline.units import Unit, discard_unit, prepare_stage, stage_units
from velfield.run.commits import WHOLE, read_commits

if TYPE_CHECKING:
    from velfield.pipeline.stages.rebase import Rebase

_FEW = 2
"""Units at a time that would take more from urgent work beside them than they gain."""
_QUEUED = 1
"""Units submitted beyond those that run, so that a thread that is done finds the next one."""


@dataclass
class UnderWay:
    """A stage that is being computed, or is done: its units, in order, and what became of each."""

    stage: Stage
    plan: Plan
    units: list[Unit]
    records: list[CommitRecord | None]
    """What an earlier run wrote of each, without its outputs; None: it is to be computed."""
    progress: StageProgress
    show: Callable[[int], None]
    """Called with the steps that are done."""
    started_s: float
    futures: dict[int, Future[Any]] = field(default_factory=dict)
    """By the number of the unit: those submitted."""
    ended: set[int] = field(default_factory=set)
    lost: dict[str, str] = field(default_factory=dict)
    """Why units failed, by their names."""


class Aside(Protocol):
    """Work beside the stages, none of whose results they read: done where there is some, in place of a unit."""

    urgent: bool
    """Whether units wait for the task under way where few run at a time."""

    def next_task(self, stages: Sequence[UnderWay]) -> Callable[[], None] | None:
        """The next task, None if there is nothing to do."""

    def finish(self, error: BaseException | None) -> None:
        """Called when it is done, or failed."""

    def before(self, stage: str) -> None:
        """Called before a stage writes anything."""


@dataclass(frozen=True)
class Mapped:
    """A finished run that is mapped onto a new base image, and the task that registered the image."""

    rebase: "Rebase"
    measured: Future[Any]


@dataclass
class Work:
    """Computes stages of one plan; ``plan`` changes its keys when units fail.

    ``at_once``: units that the task runner runs at a time. ``mapped``: of a run that is mapped onto a new base image.
    """

    plan: Plan
    runner: Runner
    console: Console
    orchestration: Orchestration
    at_once: int = 2
    aside: Aside | None = None
    mapped: Mapped | None = None
    summaries: list[StageSummary] = field(default_factory=list)
    _stages: dict[str, UnderWay] = field(default_factory=dict)
    _running: int = 0
    _beside: Future[Any] | None = None
    _ends: "SimpleQueue[tuple[int | None, Future[Any]]]" = field(default_factory=SimpleQueue)

    def __post_init__(self) -> None:
        self._given = self.plan

    def run(self) -> None:
        """Compute all units of the plan's stages, stage by stage in the order of the table.

        A unit that fails is lost, and with it the same unit of the stages that read it; all others go on with what is
        there. Where an error ends the run, it is raised when nothing writes into the run folder any more.
        """
        with self.console.stages() as bars:
            try:
                for stage in STAGES:
                    if stage.name not in self.plan.keys:
                        continue
                    if self.mapped and stage.new_base in (NewBase.SHARED, NewBase.COUNTS):
                        self._carry_over(stage)
                        continue
                    if self._beside is None:
                        self._restart_before(stage)
                    steps = "frames" if stage.cut is Cut.BY_FRAMES else "steps"
                    progress = bars.add(stage.name, stage.label, steps)
                    self._compute(self._start(stage, progress))
            except BaseException:
                self.console.print_warnings()
                raise
            finally:
                if self.aside is not None:
                    self.aside.before("")
                while self._running or self._beside is not None:
                    self._next_end()

    def _compute(self, under_way: UnderWay) -> None:
        """Compute the units of a stage: no more of them are submitted than run at once, and a few."""
        left = [k for k in range(len(under_way.units)) if k not in under_way.ended]
        while left or self._running:
            self._submit_aside()
            most = self.at_once + _QUEUED - (self._beside is not None)
            while left and self._running < most and not self._waits_for_aside():
                self._submit(under_way, left.pop(0))
            k = self._next_end()
            if k is not None:
                self._end(under_way, k)
        self._finish(under_way)

    def _waits_for_aside(self) -> bool:
        return self._beside is not None and self.aside is not None and self.aside.urgent and self.at_once <= _FEW

    def _next_end(self) -> int | None:
        """Wait until something ends: the number of a unit, or None where it is the work beside."""
        k, future = self._ends.get()
        if k is None:
            self._beside = None
            if self.aside is not None:
                self.aside.finish(future.exception())
        else:
            self._running -= 1
        return k

    def _restart_before(self, stage: Stage) -> None:
        """Restart the workers of a long flight before a stage that takes much memory."""
        if not (stage.new_workers and self.plan.is_long):
            return
        units = stage_units(self.plan, stage)
        if any(committed(self.plan, stage.name, unit.name) is None for unit in units):
            self.runner.restart_workers()

    def _start(self, stage: Stage, progress: StageProgress) -> UnderWay:
        if self.aside is not None:
            self.aside.before(stage.name)
        prepare_stage(self.plan, stage)
        units = stage_units(self.plan, stage)
        total = sum(unit.steps for unit in units)
        progress.expect(total)
        found = (committed(self.plan, stage.name, unit.name) for unit in units)
        records = [None if record is None else _without_outputs(record) for record in found]
        progress.at_least(sum(unit.steps for unit, record in zip(units, records, strict=True) if record))
        show = self.orchestration.show_progress(stage.name, total)
        under_way = UnderWay(stage, self.plan, units, records, progress, show, time.monotonic())
        self._stages[stage.name] = under_way
        for k, unit in enumerate(units):
            if gone := [name for name in self._alike(stage) if unit.name in self._stages[name].lost]:
                under_way.ended.add(k)
                under_way.lost[unit.name] = (
                    f"{self._describe(under_way, unit)} not done, as its part of {gone[0]} is lost"
                )
                discard_unit(self.plan, stage, unit.name)
        return under_way

    def _alike(self, stage: Stage) -> list[str]:
        """Names of the stages that a stage reads and that are cut by frames as it is."""
        by_frames = stage.cut is Cut.BY_FRAMES
        return [name for name in stage.after if by_frames and name in self._stages and STAGE[name].cut is stage.cut]

    def _upstream(self, under_way: UnderWay, k: int) -> list[Future[Any]]:
        """Futures of the units that a unit reads, for the lineage: of what is not lost."""
        found: list[Future[Any]] = []
        if self.mapped and under_way.stage.new_base is NewBase.MAPPED:
            found.append(self.mapped.measured)
        for name in under_way.stage.after:
            before = self._stages.get(name)
            if before is not None and name in self._alike(under_way.stage):
                found += [before.futures[j] for j in (k, k + 1) if j in before.futures]
            elif before is not None:
                found += before.futures.values()
        return [future for future in found if future.exception() is None]

    def _carry_over(self, stage: Stage) -> None:
        """Summarise a stage whose units an earlier result finished, and that this one takes as they are."""
        records = read_commits(self.plan.layout, stage.name)
        summary = summarise_stage(stage.name, records, units=len(records), before=records, seconds=0.0)
        self.summaries.append(summary)

    def _submit(self, under_way: UnderWay, k: int) -> None:
        plan, stage, unit = under_way.plan, under_way.stage, under_way.units[k]
        record, failed = under_way.records[k], ""
        rebase = self.mapped.rebase if self.mapped else None

        def do() -> CommitRecord:
            nonlocal failed
            if failed:
                self.console.warn(f"{self._describe(under_way, unit)} failed: {failed}; trying again")
            try:
                return record or _without_outputs(self.runner.compute(unit_graph(plan, stage, unit, rebase)))
            except Exception as error:
                failed = _reason(error)
                raise

        label = stage.label if unit.name == WHOLE else f"{stage.label} {unit.name}"
        future = self.orchestration.submit(
            do,
            name=stage.label,
            run_name=label,
            retries=self.plan.config.work.retries,
            after=self._upstream(under_way, k),
        )
        under_way.futures[k] = future
        self._running += 1
        future.add_done_callback(lambda done: self._ends.put((k, done)))

    def _submit_aside(self) -> None:
        if self.aside is None or self._beside is not None:
            return
        do = self.aside.next_task(list(self._stages.values()))
        if do is not None:
            self._beside = self.orchestration.submit(do, name="preview", run_name="preview")
            self._beside.add_done_callback(lambda done: self._ends.put((None, done)))

    def _end(self, under_way: UnderWay, k: int) -> None:
        """Note that a unit is done or lost; raises its error where nothing can follow without it."""
        under_way.ended.add(k)
        future, unit = under_way.futures[k], under_way.units[k]
        if (error := future.exception()) is not None:
            if isinstance(error, InputError) or is_disk_full(error) or self.mapped or under_way.stage.essential:
                raise error
            under_way.lost[unit.name] = f"{self._describe(under_way, unit)} failed: {_reason(error)}; re-run to retry"
            self.console.warn(under_way.lost[unit.name])
            discard_unit(under_way.plan, under_way.stage, unit.name)
        steps = sum(under_way.units[j].steps for j in under_way.ended)
        under_way.progress.at_least(steps)
        under_way.show(steps)

    def _describe(self, under_way: UnderWay, unit: Unit) -> str:
        """A unit for people: with its run, and the times of its frames."""
        text = f"{self.plan.job.root}: {under_way.stage.label}"
        if not unit.frames:
            return f"{text}, unit {unit.name}," if unit.name != WHOLE else text
        times_s = self.plan.info.times_s[self.plan.indices[[unit.frames[0], unit.frames[-1]]]]
        return f"{text} of frames {unit.frames[0]} to {unit.frames[-1]} ({times_s[0]:.3f} to {times_s[1]:.3f} s)"

    def _finish(self, under_way: UnderWay) -> None:
        under_way.progress.remove()
        lost = under_way.lost = dict(sorted(under_way.lost.items()))
        records = [future.result() for _, future in sorted(under_way.futures.items()) if future.exception() is None]
        # Units that failed change the keys of all that is made without them.
        gone = [f"{name} {unit}" for name, one in self._stages.items() for unit in one.lost]
        self.plan = self._given.with_lost_units(gone)
        summary = summarise_stage(
            under_way.stage.name,
            records,
            units=len(under_way.units),
            before=[record for k in under_way.futures if (record := under_way.records[k]) is not None],
            lost=lost,
            seconds=time.monotonic() - under_way.started_s,
        )
        self.summaries.append(summary)
        self._print(under_way.stage, summary)

    def _print(self, stage: Stage, summary: StageSummary) -> None:
        self.console.event(
            "stage",
            f"{stage.label:<13} {summary.text}   {summary.seconds:.1f} s",
            stage=summary.model_dump(mode="json"),
        )
        for note in summary.notes:
            self.console.event("note", f"  {note}")
        for warning in summary.warnings[:5]:
            self.console.warn_at_end(warning)
        if len(summary.warnings) > 5:
            self.console.warn_at_end(
                f"... and {len(summary.warnings) - 5} more of {stage.label}; all are in the report"
            )


def _without_outputs(record: CommitRecord) -> CommitRecord:
    """What a task returns is kept: hundreds of digests a unit would make the driver grow with the flight."""
    return record.model_copy(update={"outputs": {}})


def _reason(error: BaseException) -> str:
    """An error in one line."""
    return " ".join(str(error).split()) or type(error).__name__
