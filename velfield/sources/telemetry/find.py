"""Find the subtitle file that a drone wrote beside a video."""

import re
from pathlib import Path

from velfield.errors import Failure
from velfield.sources.telemetry.srt import parse_srt

_HEAD_CHARACTERS = 100_000


def find_beside(source: Path) -> Path | None:
    """The subtitle file beside a video, of its name up to the suffix; None where there is none that holds telemetry."""
    if not source.is_file():
        return None
    name = re.sub(r"([*?\[])", r"[\1]", source.stem)
    beside = sorted(path for path in source.parent.glob(f"{name}.*") if path.suffix.lower() == ".srt")
    return next((path for path in beside if _holds_telemetry(path)), None)


def _holds_telemetry(path: Path) -> bool:
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            return not isinstance(parse_srt(file.read(_HEAD_CHARACTERS), path.name), Failure)
    except OSError:
        return False
