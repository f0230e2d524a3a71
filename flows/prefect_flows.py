"""Runs as Prefect flows, and their units as tasks: named for people, retried, linked to the units that they read."""

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from typing import Any, TypeVar

from prefect import flow as prefect_flow
from prefect import get_run_logger, task
from prefect.cache_policies import NO_CACHE
from prefect.exceptions import MissingContextError
from prefect.futures import PrefectFuture
from prefect.states import Completed
from prefect.task_runners import ThreadPoolTaskRunner

from flows.artifacts import LongStage, publish_summary
from flows.orchestration import RETRY_S, Orchestration, worth_retrying
from flows.stale import mark_crashed
from schemas.summary import RunSummary
from velfield.pipeline.plan import Plan

T = TypeVar("T")


class PrefectFlows(Orchestration):
    """Flows and tasks of the server that Prefect's settings name."""

    def __init__(self) -> None:
        self._shown: dict[Future[Any], PrefectFuture[Any]] = {}

    def run(self, flow: Callable[[], T], *, name: str, run_name: str, threads: int, parameters: Any) -> T:
        found: list[T] = []

        def shown(parameters: Any) -> object:
            found.append(flow())
            return end_state(found[0])

        runner: Any = ThreadPoolTaskRunner(max_workers=threads)
        as_flow = prefect_flow(
            name=name,
            flow_run_name=lambda: run_name,  # by a function: Prefect takes braces in a text for fields
            task_runner=runner,
            persist_result=False,
            validate_parameters=False,
        )
        as_flow(shown)(parameters)
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

    def mark_killed(self, run_name: str) -> None:
        mark_crashed(run_name)

    def show_progress(self, stage: str, steps: int) -> Callable[[int], None]:
        return LongStage(stage, steps).update

    def publish(self, plan: Plan, summary: RunSummary) -> None:
        publish_summary(plan, summary)


def end_state(outcome: object) -> object:
    """What a flow returns: its outcome, or where a run lost something the state ``Incomplete``, which says how much."""
    if not isinstance(outcome, RunSummary) or outcome.complete:
        return outcome
    return Completed(name="Incomplete", message=f"{outcome.loss}; its summary says why")


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
