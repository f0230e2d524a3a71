"""The units of the stages as Prefect tasks: named for people, retried, linked to the units that they read.

Units are submitted as soon as what they read is there, and no more of them than run at once: a unit of a stage that
follows another unit by unit (``Stage.follows``) need not wait for the whole of that stage, and of the units that can
run, those of the later stage come first.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from queue import SimpleQueue
from typing import Any, Protocol

from prefect import task
from prefect.cache_policies import NO_CACHE
from prefect.futures import PrefectFuture

from flows.artifacts import LongStage
from flows.console import Console, StageProgress
from flows.runners import Runner, WorkersKilledError
from schemas.records import CommitRecord
from schemas.summary import StageSummary
from velfield.errors import InputError, is_disk_full
from velfield.pipeline.graphs import unit_graph
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import committed
from velfield.pipeline.stage import STAGE, STAGES, Cut, Stage, stages_awaited
from velfield.pipeline.summary import summarise_stage
from velfield.pipeline.units import WHOLE, Unit, prepare_stage, stage_units
from velfield.run.commits import read_commits

Future = PrefectFuture[Any]
GraphOf = Callable[[Plan, Stage, Unit], Any]
"""The Dask graph of a unit."""
LONG_MPX = 1200.0
"""Frames times megapixels of a long flight: two minutes of two processors."""
_QUEUED = 1
"""Units submitted beyond those that run, so that a thread that is done finds the next one."""


def is_long(plan: Plan) -> bool:
    """Whether a flight takes so long that previews, and seconds that save memory, are worth it."""
    return plan.frame_count * plan.info.width * plan.info.height / 1e6 >= LONG_MPX


@dataclass
class UnderWay:
    """A stage that is being computed, or is done: its units, in order, and what became of each."""

    stage: Stage
    plan: Plan
    units: list[Unit]
    essential: bool
    progress: StageProgress
    artifact: LongStage
    started_s: float
    futures: dict[int, Future] = field(default_factory=dict)
    """By the number of the unit: those submitted."""
    ended: set[int] = field(default_factory=set)
    lost: dict[str, str] = field(default_factory=dict)
    """Why units failed, by their names."""
    before: list[CommitRecord] = field(default_factory=list)
    """Records of the units that an earlier run finished."""

    @property
    def done(self) -> bool:
        return len(self.ended) == len(self.units)

    @property
    def waiting(self) -> list[int]:
        """Units not submitted yet."""
        return [k for k in range(len(self.units)) if k not in self.futures]


class Aside(Protocol):
    """Work beside the stages, none of whose results they read: done where there is some, in place of a unit."""

    def next_task(self, stages: Sequence[UnderWay]) -> Callable[[], None] | None:
        """What to do now, if anything."""

    def finish(self, error: BaseException | None) -> None:
        """Called when it is done, or failed."""

    def before(self, stage: str) -> None:
        """Called before a stage writes anything."""


@dataclass
class Work:
    """Computes stages of one plan; ``plan`` changes its keys when units fail.

    ``at_once``: units that the task runner runs at a time.
    """

    plan: Plan
    runner: Runner
    console: Console
    at_once: int = 2
    aside: Aside | None = None
    summaries: list[StageSummary] = field(default_factory=list)
    _under_way: dict[str, UnderWay] = field(default_factory=dict)
    _last_end_s: float = 0.0
    _given: Plan | None = None
    _ends: "SimpleQueue[tuple[str, int, Future]]" = field(default_factory=SimpleQueue)

    def __post_init__(self) -> None:
        self._given = self.plan

    def run(
        self, stages: Sequence[Stage] = STAGES, graph: GraphOf = unit_graph, *, essential: bool | None = None
    ) -> None:
        """Compute all units of some stages, in the order of the table, and wait for them.

        A unit waits for all units of the stages that its stage reads, done or lost: it goes on with what is there. Of
        the stages that its own follows it waits for the units of the same frames, and as many after as the halo.

        Parameters
        ----------
        graph
            The Dask graph of a unit.
        essential
            Nothing can follow without these stages: their failure is the run's. Default: as the table says.
        """
        todo = list(stages)
        running = 0
        aside: Future | None = None
        with self.console.stages() as bars:
            while todo or running or aside is not None:
                for stage in [stage for stage in todo if self._can_start(stage, todo)]:
                    if not running and aside is None:
                        self._restart_before(stage)
                    self._start(stage, bars.add(stage.name, stage.label), essential)
                    todo.remove(stage)
                if aside is None:
                    aside = self._submit_aside()
                room = self.at_once + _QUEUED - running - (aside is not None)
                running += self._submit_ready(graph, room)
                if not running and aside is None:
                    continue
                name, k, future = self._ends.get()
                if not name:
                    aside = None
                    if self.aside is not None:
                        self.aside.finish(_failure_cause(future) if _is_lost(future) else None)
                    continue
                running -= 1
                try:
                    self._end(self._under_way[name], k)
                except BaseException:
                    for _ in range(running):  # what is under way writes into the run folder
                        self._ends.get()
                    raise

    def _restart_before(self, stage: Stage) -> None:
        """Where a flight is long, let a stage that takes much memory start without what earlier work left."""
        if not (stage.new_workers and is_long(self.plan)):
            return
        units = stage_units(self.plan, stage)
        if any(committed(self.plan, stage.name, unit.name) is None for unit in units):
            self.runner.restart_workers()

    def _can_start(self, stage: Stage, todo: Sequence[Stage]) -> bool:
        """Whether all that it reads is done; of a stage that it follows, whether that has started."""
        left = {one.name for one in todo}
        for name in stage.after:
            before = self._under_way.get(name)
            if name in left or (before is not None and name not in stage.follows and not before.done):
                return False
        return True

    def _start(self, stage: Stage, progress: StageProgress, essential: bool | None) -> None:
        assert self._given is not None
        awaited = stages_awaited(stage.name)
        lost = [f"{name} {unit}" for name in awaited if name in self._under_way for unit in self._under_way[name].lost]
        plan = self._given.with_lost_units(lost)
        if self.aside is not None:
            self.aside.before(stage.name)
        prepare_stage(plan, stage)
        units = stage_units(plan, stage)
        total = sum(unit.steps for unit in units)
        progress.expect(total)
        whole = stage.essential if essential is None else essential
        artifact = LongStage(stage.name, total)
        under_way = UnderWay(stage, plan, units, whole, progress, artifact, time.monotonic())
        self._under_way[stage.name] = under_way
        if not units:
            self._finish(under_way)

    def _submit_ready(self, graph: GraphOf, room: int) -> int:
        """Submit units whose reading is there, those of later stages first; returns their number."""
        count = 0
        for under_way in reversed(list(self._under_way.values())):
            for k in under_way.waiting:
                if count >= room:
                    return count
                if self._is_ready(under_way, k):
                    self._submit(under_way, k, graph)
                    count += 1
        return count

    def _is_ready(self, under_way: UnderWay, k: int) -> bool:
        followed = [self._under_way[name] for name in under_way.stage.follows if name in self._under_way]
        return all(set(_same_units(under_way, before, k)) <= before.ended for before in followed)

    def _upstream(self, under_way: UnderWay, k: int) -> list[Future]:
        """What a unit, by its number, reads: of stages cut as its own the same units, of others what was not lost."""
        found: list[Future] = []
        for name in under_way.stage.after:
            before = self._under_way.get(name)
            if before is None:
                continue
            if under_way.stage.cut is before.stage.cut is Cut.BY_FRAMES:
                found += [before.futures[j] for j in _same_units(under_way, before, k)]
            else:
                found += [before.futures[j] for j in sorted(before.ended) if not _is_lost(before.futures[j])]
        return found

    def carry_over(self, stage: Stage) -> None:
        """Summarise a stage whose units an earlier result finished, and that this one takes as they are."""
        records = read_commits(self.plan.layout, stage.name)
        summary = summarise_stage(stage.name, records, units=len(records), before=records, seconds=0.0)
        self.summaries.append(summary)

    def _submit(self, under_way: UnderWay, k: int, graph: GraphOf) -> None:
        plan, stage, unit = under_way.plan, under_way.stage, under_way.units[k]
        record = committed(plan, stage.name, unit.name)
        under_way.before += [] if record is None else [_without_outputs(record)]

        def do() -> CommitRecord:
            return _without_outputs(record or self.runner.compute(graph(plan, stage, unit)))

        label = stage.label if unit.name == WHOLE else f"{stage.label} {unit.name}"
        future = task(
            do,
            name=stage.label,
            task_run_name=label,
            retries=self.plan.config.work.retries,
            retry_delay_seconds=1,
            retry_condition_fn=_worth_retrying,
            cache_policy=NO_CACHE,
            persist_result=False,
        ).submit(wait_for=self._upstream(under_way, k))
        under_way.futures[k] = future
        future.add_done_callback(lambda done: self._ends.put((stage.name, k, done)))

    def _submit_aside(self) -> Future | None:
        do = None if self.aside is None else self.aside.next_task(list(self._under_way.values()))
        if do is None:
            return None
        future = task(
            do, name="preview", task_run_name="preview", retries=0, cache_policy=NO_CACHE, persist_result=False
        ).submit()
        future.add_done_callback(lambda done: self._ends.put(("", 0, done)))
        return future

    def _end(self, under_way: UnderWay, k: int) -> None:
        """Note that a unit is done or lost; raises its error where nothing can follow without it."""
        under_way.ended.add(k)
        future, unit = under_way.futures[k], under_way.units[k]
        if _is_lost(future):
            error = _failure_cause(future)
            if isinstance(error, InputError) or is_disk_full(error) or under_way.essential:
                raise error
            reason = " ".join(str(error).split()) or type(error).__name__
            under_way.lost[unit.name] = f"{self._describe(under_way, unit)} failed: {reason}; re-run to retry"
            self.console.warn(under_way.lost[unit.name])
        steps = sum(under_way.units[j].steps for j in under_way.ended)
        under_way.progress.at_least(steps)
        under_way.artifact.update(steps)
        if under_way.done:
            self._finish(under_way)

    def _describe(self, under_way: UnderWay, unit: Unit) -> str:
        """A unit for people: with its run, and the times of its frames."""
        text = f"{self.plan.job.root}: {under_way.stage.label}"
        if not unit.frames:
            return f"{text}, unit {unit.name}," if unit.name != WHOLE else text
        times_s = self.plan.info.times_s[self.plan.indices[[unit.frames[0], unit.frames[-1]]]]
        return f"{text} of frames {unit.frames[0]} to {unit.frames[-1]} ({times_s[0]:.3f} to {times_s[1]:.3f} s)"

    def _finish(self, under_way: UnderWay) -> None:
        under_way.progress.remove()
        futures = [under_way.futures[k] for k in range(len(under_way.units))]
        lost = under_way.lost = dict(sorted(under_way.lost.items()))
        # Units that failed change the keys of all that is made without them.
        self.plan = self.plan.with_lost_units([f"{under_way.stage.name} {unit}" for unit in lost])
        summary = summarise_stage(
            under_way.stage.name,
            [future.result() for future in futures if not _is_lost(future)],
            units=len(under_way.units),
            before=under_way.before,
            lost=lost,
            seconds=time.monotonic() - max(under_way.started_s, self._last_end_s),
        )
        self._last_end_s = time.monotonic()
        self.summaries.append(summary)
        self.summaries.sort(key=lambda one: list(STAGE).index(one.name))
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
            self.console.warn(warning)
        if len(summary.warnings) > 5:
            self.console.warn(f"... and {len(summary.warnings) - 5} more of {stage.label}; all are in the report")


def _same_units(under_way: UnderWay, before: UnderWay, k: int) -> range:
    """Numbers of the units of the same frames, and as many after as the halo, of a stage that is cut alike."""
    return range(k, min(k + 1 + under_way.stage.halo, len(before.units)))


def _without_outputs(record: CommitRecord) -> CommitRecord:
    """Prefect keeps what a task returns: hundreds of digests a unit would make the driver grow with the flight."""
    return record.model_copy(update={"outputs": {}})


def _worth_retrying(_task: Any, run: Any, state: Any) -> bool:
    """Bad input stays bad, and a full disk full: only what may pass, such as a killed worker, is tried again.

    What killed all workers that tried it is given to a fresh one once: more would kill those of other units too.
    """
    try:
        state.result()
    except InputError:
        return False
    except WorkersKilledError:
        return bool(run.run_count <= 1)
    except Exception as error:
        return not is_disk_full(error)
    return False


def _is_lost(future: Future) -> bool:
    future.wait()  # a callback may come an instant before its state says so
    return not future.state.is_completed()


def _failure_cause(future: Future) -> BaseException:
    if not future.state.is_final():
        return RuntimeError("a unit that it reads failed")
    outcome = future.result(raise_on_failure=False)
    if isinstance(outcome, BaseException):
        return outcome
    return RuntimeError(future.state.message or f"not run ({future.state.name})")
