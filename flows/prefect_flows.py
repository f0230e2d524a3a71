"""Runs as Prefect flows, and their units as tasks: named for people, retried, linked to the units that they read."""

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from prefect import flow as prefect_flow
from prefect import get_run_logger, tags, task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State
from prefect.context import TagsContext
from prefect.exceptions import MissingContextError
from prefect.futures import PrefectFuture
from prefect.states import Completed, Failed
from prefect.task_runners import ThreadPoolTaskRunner

from flows.artifacts import LongStage, publish_summary
from flows.orchestration import RETRY_S, Orchestration, worth_retrying
from flows.stale import mark_crashed
from schemas.summary import RunSummary
from velfield.errors import InputError
from velfield.pipeline.plan import Plan

T = TypeVar("T")


class PrefectFlows(Orchestration):
    """Flows and tasks of the server that Prefect's settings name."""

    def __init__(self) -> None:
        self._shown: dict[Future[Any], PrefectFuture[Any]] = {}

    def run(
        self, flow: Callable[[], T], *, name: str, folder: str, result: str = "", threads: int, parameters: Any
    ) -> T:
        found: list[T] = []

        def shown(run_folder: str, parameters: Any) -> object:  # `flows.stale` finds runs by the first
            try:
                with TagsContext(current_tags=set()):  # the tags are the run's: each unit would only repeat them
                    found.append(flow())
            except InputError as error:
                return refused(error)
            return end_state(found[0])

        title = Path(folder).name
        run_name = f"{title} on {result}" if result else title

        runner: Any = ThreadPoolTaskRunner(max_workers=threads)
        as_flow = prefect_flow(
            name=name,
            flow_run_name=lambda: run_name,  # by a function: Prefect takes braces in a text for fields
            task_runner=runner,
            persist_result=False,
            validate_parameters=False,
        )
        with tags(name, title, *([result] if result else [])):
            as_flow(shown)(folder, parameters)
        return found[0]

    def submit(
        self, do: Callable[[], T], *, name: str, run_name: str, retries: int = 0, after: Sequence[Future[Any]] = ()
    ) -> "Future[T]":
        future: Future[T] = Future()
        as_task = task(
            name=name,
            task_run_name=run_name,
            retries=retries,
            retry_delay_seconds=RETRY_S,
            retry_condition_fn=_worth_retrying,
            cache_policy=NO_CACHE,
            persist_result=False,
        )
        before = [self._shown[one] for one in after]
        self._shown[future] = shown = as_task(do).submit(return_state=False, wait_for=before)
        shown.add_done_callback(lambda done: _settle(future, done))
        return future

    def mark_killed(self, folder: str) -> None:
        mark_crashed(folder)

    def show_progress(self, stage: str, steps: int) -> Callable[[int], None]:
        return LongStage(stage, steps).update

    def publish(self, plan: Plan, summary: RunSummary) -> None:
        publish_summary(plan, summary)


def end_state(outcome: object) -> object:
    """What a flow returns: its outcome, or where a run lost something the state ``Incomplete``, which says how much."""
    if not isinstance(outcome, RunSummary) or outcome.complete:
        return outcome
    return Completed(name="Incomplete", message=f"{outcome.loss}; its summary says why")


def refused(error: InputError) -> "State[InputError]":
    """What a flow returns for bad input: a failed state with the error's line, which is logged too; Prefect raises it
    again to the flow's caller."""
    get_run_logger().error("%s", error)
    return Failed(message=str(error), data=error)


class _WithoutBadInput(logging.Filter):
    """Leaves out the tracebacks that Prefect logs of bad input: the state of the run or task has the error's line."""

    def filter(self, record: logging.LogRecord) -> bool:
        return record.exc_info is None or not isinstance(record.exc_info[1], InputError)


for _name in ("prefect.flow_runs", "prefect.task_runs"):
    logging.getLogger(_name).addFilter(_WithoutBadInput())


def _worth_retrying(_task: Any, run: Any, state: Any) -> bool:
    try:
        state.result()
    except Exception as error:
        return worth_retrying(error, run.run_count)
    return False


def _settle(future: "Future[T]", shown: PrefectFuture[T]) -> None:
    """Give a future the outcome of Prefect's."""
    shown.wait()  # a callback may come an instant before its state says so
    if not shown.state.is_final():
        future.set_exception(RuntimeError("a unit that it reads failed"))
        return
    outcome: Any = shown.result(raise_on_failure=False)
    if shown.state.is_completed():
        future.set_result(outcome)
    elif isinstance(outcome, BaseException):
        future.set_exception(outcome)
    else:
        future.set_exception(RuntimeError(shown.state.message or f"not run ({shown.state.name})"))


def log_to_run(level: int, text: str) -> None:
    """Show a line in the logs of the flow run, or task run, that this is, if any."""
    with suppress(MissingContextError):
        get_run_logger().log(level, text)
