"""Find the file of telemetry that a drone wrote beside a video."""

import re
from pathlib import Path

from velfield.errors import Failure
from velfield.sources.telemetry.klv import KLV_KEY, KLV_SUFFIX
from velfield.sources.telemetry.srt import parse_srt

TELEMETRY_SUFFIXES = (".srt", KLV_SUFFIX)
"""Suffixes, in lower case, of files that a drone writes beside a video."""
_HEAD_BYTES = 100_000


def find_beside(source: Path) -> Path | None:
    """The subtitles or KLV beside a video, of its name up to the suffix; None where there are none with telemetry."""
    return next((path for path in _beside(source) if _holds_telemetry(path)), None)


def note_unusable(source: Path) -> str:
    """Note on a file of subtitles or KLV beside a video that holds no telemetry; empty where another one does, or
    where there is none."""
    beside = _beside(source)
    if not beside or any(map(_holds_telemetry, beside)):
        return ""
    return f"{beside[0].name}, next to the video, holds no position, height or attitude: it is not used"


def _beside(source: Path) -> list[Path]:
    if not source.is_file():
        return []
    name = re.sub(r"([*?\[])", r"[\1]", source.stem)
    return sorted(path for path in source.parent.glob(f"{name}.*") if path.suffix.lower() in TELEMETRY_SUFFIXES)


def _holds_telemetry(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError:
        return False
    if path.suffix.lower() == KLV_SUFFIX:
        return KLV_KEY in head
    return not isinstance(parse_srt(head.decode("utf-8", "replace"), path.name), Failure)
