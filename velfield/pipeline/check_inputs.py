"""Optional inputs are read before any work: a bad file is reported at once, not an hour later."""

from collections.abc import Callable
from pathlib import Path

from velfield.detection.detector import load_detector
from velfield.errors import InputError
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import committed
from velfield.pipeline.stage import STAGES, Cut
from velfield.pipeline.units import WHOLE
from velfield.sources.geo import read_base_raster
from velfield.sources.labels.detections import read_detections
from velfield.sources.labels.labels import read_labels

_READ: dict[str, Callable[[Path, Plan], object]] = {
    "base": lambda path, plan: read_base_raster(path, plan.config.frames),
    "labels": lambda path, plan: read_labels(path, plan.info),
    "detector": lambda path, plan: load_detector(path),
    "detections": lambda path, plan: read_detections(path, plan.info),
}


def validate_inputs(plan: Plan) -> None:
    """Read each file that a stage has yet to read; see that the device is there.

    Raises
    ------
    InputError
        One cannot be read or is not what its option expects, or there is no such device; the message names the option.
    """
    for option, read in _READ.items():
        path = getattr(plan.job.inputs, option)
        if path and _is_pending(plan, option):
            try:
                read(Path(path), plan)
            except InputError as error:
                raise InputError(f"--{option}: {error}") from None
    if plan.config.work.device == "cuda":
        from velfield.detection.cnn.model import check_device

        check_device("cuda")


def _is_pending(plan: Plan, option: str) -> bool:
    """Whether a stage that reads this input has yet to be computed."""
    stages = [stage.name for stage in STAGES if option in stage.inputs and stage.cut is Cut.WHOLE]
    return any(committed(plan, stage, WHOLE) is None for stage in stages)
