"""Detector files: read, of this and the last format version, and the one that ships."""

import json
import warnings
from importlib.resources import files
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from schemas.detector import DETECTOR_VERSION, DetectorRecord
from schemas.renames import OLD_NAMES_UNTIL, upgrade_detector
from velfield.detection.detector import Detector, from_record
from velfield.errors import InputError, OldNameWarning

MAX_BYTES = 20_000_000
_SHIPPED = "shipped_detector.json"
_RECORD: TypeAdapter[DetectorRecord] = TypeAdapter(DetectorRecord)


def load_detector(path: Path) -> Detector:
    """Read a detector file; a warning where it is of an old format.

    Raises
    ------
    InputError
        No such file, too large, not a detector file, or a number out of range.
    """
    if not path.is_file():
        raise InputError(
            f"{path}: no such detector file; give one that `velfield train` wrote, or leave the option out"
        )
    if path.stat().st_size > MAX_BYTES:
        raise InputError(
            f"{path}: found {path.stat().st_size} bytes, expected {MAX_BYTES} at most; give a detector file as "
            "`velfield train` writes it"
        )
    return _parse(path.read_bytes(), str(path))


def shipped_detector() -> Detector:
    """The pre-trained detector that comes with velfield."""
    return _parse(files("velfield.detection").joinpath(_SHIPPED).read_bytes(), _SHIPPED)


def _parse(data: bytes, name: str) -> Detector:
    try:
        content = json.loads(data)
        if isinstance(content, dict) and content.get("version") == 1:
            content = upgrade_detector(content)
            warnings.warn(
                f"{name}: a detector file of format version 1, written now is version {DETECTOR_VERSION}; the old one "
                f"is read until {OLD_NAMES_UNTIL}",
                OldNameWarning,
                stacklevel=3,
            )
        return from_record(_RECORD.validate_python(content))
    except (ValueError, ValidationError) as error:
        raise InputError(
            f"{name}: {_problem(error)}; expected a detector file as velfield writes it (detector.json): "
            "make one with `velfield train`"
        ) from None


def _problem(error: ValueError) -> str:
    if not isinstance(error, ValidationError):
        return "this is not JSON"
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"]) or "the file"
    return f"{where}: {first['msg'].lower()}"
