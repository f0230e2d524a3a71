"""Times that the camera wrote: when a flight began, and a frame rate that the user gives against those of images."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from PIL import ExifTags

from schemas.georeference import FlightStart
from velfield.errors import Failure, InputError
from velfield.sources.clips import creation_clock, first_clock
from velfield.sources.frames import SourceInfo
from velfield.sources.images import read_image_tags
from velfield.sources.telemetry.find import find_beside
from velfield.sources.telemetry.image_tags import exif_time, parse_clock
from velfield.sources.telemetry.read import read_telemetry, read_telemetry_file
from velfield.sources.telemetry.telemetry import Telemetry

_XMP_TIME = re.compile(
    rb"""(?:exif:DateTimeOriginal|xmp:CreateDate)\s*(?:=\s*["']|>)\s*(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d)(?:\.(\d+))?"""
)
"""Its zone is left out: the clock counts as EXIF's does, as the camera shows it."""
_MAX_DISAGREEMENT = 0.1
"""Relative to the duration, beside the clock's resolution at both ends."""


def describe_rate(folder: Path, names: Sequence[str], fps: float) -> tuple[str, ...]:
    """A warning where images in order of time took another time than their number over the rate; else none."""
    ends = [_capture_time(folder / name) for name in (names[0], names[-1])]
    if ends[0] is None or ends[1] is None:
        return ()
    taken_s, resolution_s = ends[1].clock_s - ends[0].clock_s, ends[0].resolution_s + ends[1].resolution_s
    expected_s = (len(names) - 1) / fps
    if taken_s <= 0 or abs(taken_s - expected_s) <= resolution_s + _MAX_DISAGREEMENT * taken_s:
        return ()
    rate = (len(names) - 1) / taken_s
    return (
        f"--fps {fps:g}: {len(names)} images would take {expected_s:.1f} s at that rate, and took {taken_s:.1f} s by "
        f"the times that the camera wrote in them: speeds would be {fps / rate:.2g} times the true ones; give --fps "
        f"{rate:.3g}, or --timestamps",
    )


def read_flight_start(source: Path, info: SourceInfo, telemetry: Path | None = None) -> FlightStart | None:
    """When the first frame of a video, list of clips or folder of images was taken; None where nothing says so.

    The times of a file of telemetry that is given count from the first frame.
    """
    if telemetry is not None and (start := _start(read_telemetry_file(telemetry, info), telemetry)) is not None:
        return start
    if info.kind == "folder":
        taken = _capture_time(source / info.names[0]) if info.names else None
        if taken is None:
            return None
        return FlightStart(clock_s=taken.clock_s, source=f"{taken.kind} of {info.names[0]}", is_utc=False)
    clip = Path(info.parts[0][0]) if info.parts else source
    part = info.parts[0][1] if info.parts else info
    if telemetry is None and (start := _start(read_telemetry(clip, part, find_beside(clip)), clip)) is not None:
        return start
    created_s = creation_clock(clip, part)
    return None if created_s is None else FlightStart(clock_s=created_s, source=f"header of {clip.name}", is_utc=True)


def _start(telemetry: Telemetry | Failure, path: Path) -> FlightStart | None:
    clock_s = None if isinstance(telemetry, Failure) else first_clock(telemetry)
    if isinstance(telemetry, Failure) or clock_s is None:
        return None
    kind = "MISB KLV" if telemetry.is_utc else "subtitles"
    return FlightStart(clock_s=clock_s, source=f"{kind} of {path.name}", is_utc=telemetry.is_utc)


class _CaptureTime(NamedTuple):
    """Time of exposure, its resolution, and which tags it is by."""

    clock_s: float
    resolution_s: float
    kind: str


def _capture_time(path: Path) -> _CaptureTime | None:
    """By EXIF, else XMP; None where neither has it."""
    try:
        exif, xmp = read_image_tags(path)
    except InputError:
        return None
    tags = exif.get_ifd(ExifTags.IFD.Exif)
    text, digits = exif_time(tags)
    written = _XMP_TIME.search(xmp)
    kind = "EXIF" if text or not written else "XMP"
    if not text and written:
        text, digits = (part.decode() for part in written.groups(default=b""))
    clock = parse_clock(text, digits)
    return None if clock is None else _CaptureTime(*clock, kind)
