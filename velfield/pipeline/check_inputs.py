"""Optional inputs are read before any work: a bad file is reported at once, not an hour later."""

from pathlib import Path

from velfield.errors import InputError
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import committed
from velfield.pipeline.stage import STAGES, Cut
from velfield.run.commits import WHOLE


def validate_inputs(plan: Plan) -> None:
    """Read each file that a stage has yet to read; see that the device is there.

    Raises
    ------
    InputError
        One cannot be read or is not what its option expects, or there is no such device; the message names the option.
    """
    if plan.config.work.device == "cuda":
        from velfield.detection.runtime import check_device

        check_device("cuda")
    options = ("base", "labels", "detector", "detections", "telemetry")
    pending = [name for name in options if getattr(plan.job.inputs, name) and _is_pending(plan, name)]
    if not pending:
        return
    from velfield.pipeline import given_files  # a second of imports, for which the first frame need not wait

    for option in pending:
        try:
            given_files.READ_GIVEN[option](Path(getattr(plan.job.inputs, option)), plan)
        except InputError as error:
            raise InputError(f"--{option}: {error}") from None
    if "base" in pending and plan.is_long:  # of a short flight the stage that registers it comes soon enough
        given_files.check_base_area(plan)


def _is_pending(plan: Plan, option: str) -> bool:
    """Whether a stage that reads this input has yet to be computed."""
    stages = [stage.name for stage in STAGES if option in stage.inputs and stage.cut is Cut.WHOLE]
    return any(committed(plan, stage, WHOLE) is None for stage in stages)
