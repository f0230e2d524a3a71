"""Flow runs that were killed stay "Running" in Prefect for ever, unless they are marked as crashed."""

from prefect.client.orchestration import get_client
from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterName, FlowRunFilterState, FlowRunFilterStateType
from prefect.client.schemas.objects import StateType
from prefect.runtime import flow_run
from prefect.states import Crashed


def mark_crashed(name: str) -> int:
    """Mark earlier runs of this name that Prefect believes to be running as crashed; returns how many.

    Call while holding the run folder's lock: then no other run on it can be alive.
    """
    running = FlowRunFilter(
        name=FlowRunFilterName(any_=[name]),
        state=FlowRunFilterState(type=FlowRunFilterStateType(any_=[StateType.RUNNING])),
    )
    own = str(flow_run.id)
    found = 0
    with get_client(sync_client=True) as client:
        for run in client.read_flow_runs(flow_run_filter=running):
            if str(run.id) != own:
                state = Crashed(message="the process was killed; the next run of this folder resumed from its commits")
                client.set_flow_run_state(run.id, state, force=True)
                found += 1
    return found
