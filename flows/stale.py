"""Flow runs that were killed stay "Running" in Prefect for ever, unless they are marked as crashed."""

from collections.abc import Callable

from prefect.client.orchestration import get_client
from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterState, FlowRunFilterStateType
from prefect.client.schemas.objects import FlowRun, StateType
from prefect.runtime import flow_run
from prefect.states import Crashed

from schemas.job import absolute
from velfield.run.layout import RunLayout, to_path
from velfield.run.lock import holder_is_gone

_PAGE = 200
_S3 = "s3://"
_RESUMED = "the process was killed; the next run of this folder resumed from its commits"
_ENDED = "the process was killed; the same command resumes from its commits"


def mark_crashed(folder: str) -> int:
    """Mark runs that Prefect believes to be running as crashed: earlier ones of this folder, any whose process ended.

    Call while holding the run folder's lock: then no other run on it can be alive. Returns how many.
    """
    own, remote = str(flow_run.id), folder.startswith(_S3)
    return _mark(lambda run: str(run.id) != own and _folder_of(run) == folder, _RESUMED) + _mark(
        lambda run: str(run.id) != own and _folder_of(run) != folder and _is_abandoned(run, remote=remote), _ENDED
    )


def mark_abandoned() -> int:
    """Mark as crashed the runs that a server lists as running when it starts; returns how many.

    Runs of its own deployments ended with the server before; others did where their process has ended.
    """
    return _mark(lambda run: run.deployment_id is not None or _is_abandoned(run, remote=False), _ENDED)


def _is_abandoned(run: FlowRun, *, remote: bool) -> bool:
    """Whether the holder of the lock of a run's folder has ended.

    S3 is asked only by who works on it (``remote``): another process has no credentials for it, or waits in vain.
    """
    folder = _folder_of(run)
    if folder is None or (folder.startswith(_S3) and not remote):
        return False
    return holder_is_gone(RunLayout(to_path(folder)))


def _folder_of(run: FlowRun) -> str | None:
    """Path of the run folder from the root on, as `Orchestration.run` was given it; None for flows of other programs.

    The run's name is that of the folder alone, which folders of other places have too.
    """
    folder = run.parameters.get("run_folder")
    return folder if isinstance(folder, str) and absolute(folder) == folder else None


def _mark(is_dead: Callable[[FlowRun], bool], message: str) -> int:
    running = FlowRunFilter(state=FlowRunFilterState(type=FlowRunFilterStateType(any_=[StateType.RUNNING])))
    with get_client(sync_client=True) as client:
        runs: list[FlowRun] = []
        while page := client.read_flow_runs(flow_run_filter=running, limit=_PAGE, offset=len(runs)):
            runs += page
        dead = [run for run in runs if is_dead(run)]
        for run in dead:
            client.set_flow_run_state(run.id, Crashed(message=message), force=True)
    return len(dead)
