"""What was given besides the source is read before any work: a bad file is told at once, not an hour later."""

from collections.abc import Callable
from pathlib import Path

from velfield.detection.files import load_detector
from velfield.errors import InputError
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import committed
from velfield.sources.geo import read_base_raster
from velfield.sources.labels.detections import read_detections
from velfield.sources.labels.labels import read_labels

_WHOLE = "all"


def check_given(plan: Plan) -> None:
    """Read each file that a stage is still to read.

    Raises
    ------
    InputError
        One cannot be read or is not what it was given as; it names the option.
    """
    given = plan.job.inputs
    if given.base and committed(plan, "base", _WHOLE) is None:
        _reading("base", lambda: read_base_raster(Path(str(given.base)), plan.config.frames))
    if committed(plan, "detector", _WHOLE) is not None:
        return
    if given.labels:
        _reading("labels", lambda: read_labels(Path(str(given.labels)), plan.info))
    if given.detector:
        _reading("detector", lambda: load_detector(Path(str(given.detector))))
    if given.detections:
        _reading("detections", lambda: read_detections(Path(str(given.detections)), plan.info))


def _reading(option: str, read: Callable[[], object]) -> None:
    try:
        read()
    except InputError as error:
        raise InputError(f"--{option}: {error}") from None
