"""Flight logs as tables: CSV of Airdata, Litchi, DJI's flight records and others, with units in the names of columns.

A log is of a whole flight. The rows of the recording are those that a column marks as filmed, where one part of them
lasts as long as the video; a log without such a column must last no longer than the video, and begins with it.
"""

import csv
import re
from datetime import UTC, datetime
from itertools import groupby

from velfield.errors import Failure, InputError
from velfield.sources.telemetry.srt import FOOT_M
from velfield.sources.telemetry.telemetry import Telemetry

_LENGTHS = {"m": 1.0, "meter": 1.0, "meters": 1.0, "metres": 1.0, "ft": FOOT_M, "feet": FOOT_M}
_ANGLES = {"": 1.0, "deg": 1.0, "degree": 1.0, "degrees": 1.0, "rad": 57.29577951308232, "radians": 57.29577951308232}
_TIMES = {"ms": 1e-3, "millisecond": 1e-3, "milliseconds": 1e-3, "s": 1.0, "sec": 1.0, "seconds": 1.0}
_COLUMNS: tuple[tuple[str, str, dict[str, float]], ...] = (
    (r"(osd\.|gps)?lat(itude)?", "latitude_deg", _ANGLES),
    (r"(osd\.|gps)?(lon|lng|long|longitude|longtitude)", "longitude_deg", _ANGLES),
    (r"(osd\.)?(height|height_?above_?take_?off|relative_?altitude|rel_?alt|height_?agl)", "height_m", _LENGTHS),
    (r"(osd\.)?(altitude_?above_?sea_?level|abs_?alt|altitude_?msl)", "altitude_m", _LENGTHS),
    (r"gimbal[._]?(yaw|heading)", "yaw_deg", _ANGLES),
    (r"gimbal[._]?pitch", "pitch_deg", _ANGLES),
    (r"gimbal[._]?roll", "roll_deg", _ANGLES),
    (r"(osd\.)?(time|flytime|elapsed_?time|offset_?time|time_?since_?start)", "time_s", _TIMES),
)
"""Name of a column without its unit, quantity, and the factors of units; a length or a time without one is refused."""
_FILMED = re.compile(r"(camera\.)?is_?video|camera_?info\.record_?state")
_CLOCK = re.compile(r"datetime(\s*\(utc\))?|.*utc.*time.*")
_UNIT = re.compile(r"[\s_]*[\[(]([a-z]+)[\])]\s*$|_(m|ft|feet|ms|s|deg|rad)$")
_LONGER_S, _SAME_S = 5.0, 2.0


def is_flight_log(text: str) -> bool:
    """Whether a text is a table with columns of a latitude and of a time or a height."""
    names = {quantity for quantity, _ in _find_columns(text, "log").values()}
    return "latitude_deg" in names and len(names) > 2


def parse_flight_log(text: str, origin: str, duration_s: float) -> Telemetry | Failure:
    """Telemetry of a log, from the first row of the recording of a duration.

    Raises
    ------
    InputError
        A length or time without a unit, or a log of more than the recording.
    """
    columns, rows = _find_columns(text, origin), list(csv.DictReader(_lines(text), skipinitialspace=True))
    unknown = [name for name, (quantity, factor) in columns.items() if factor is None]
    if unknown:
        raise InputError(f"{origin}: found the column {unknown[0]!r} without a unit; name it, such as {unknown[0]}(m)")
    if "time_s" not in {quantity for quantity, _ in columns.values()}:
        return Failure(f"{origin}: found no column of the time since the start, expected one such as time(millisecond)")
    names = [name for name in (rows[0] if rows else ()) if name]
    filmed = next((name for name in names if _FILMED.fullmatch(name.strip().lower())), None)
    clock = next((name for name in names if _CLOCK.fullmatch(name.strip().lower())), None)
    records = [(_values(row, columns) | _clock_s(row.get(clock or "")), _is_set(row.get(filmed or ""))) for row in rows]
    timed = [(found.pop("time_s"), found, is_filmed) for found, is_filmed in records if "time_s" in found]
    parts = [list(part) for is_filmed, part in groupby(timed, key=lambda one: one[2]) if is_filmed or filmed is None]
    fitting = [part for part in parts if abs(part[-1][0] - part[0][0] - duration_s) <= max(_SAME_S, 0.05 * duration_s)]
    lasts_s = timed[-1][0] - timed[0][0] if timed else 0.0
    if filmed is None and timed and lasts_s <= duration_s + _LONGER_S:
        fitting = [timed]
    if len(fitting) != 1:
        found = f"{len(parts)} recordings" if filmed else f"a log of {lasts_s:.0f} s without a column isVideo"
        raise InputError(f"{origin}: found {found}, expected one of the video's {duration_s:.0f} s; cut the log to it")
    start_s = fitting[0][0][0]
    notes = [f"{origin}: its row at {start_s:.1f} s is taken for the first frame"]
    return Telemetry.from_records(
        origin, [(at - start_s, found) for at, found, _ in fitting[0]], notes, is_utc="utc" in (clock or "").lower()
    )


def _lines(text: str) -> list[str]:
    lines = text.splitlines()
    return lines[1:] if lines and lines[0].lower().startswith("sep=") else lines  # as DJI's converters begin


def _find_columns(text: str, origin: str) -> dict[str, tuple[str, float | None]]:
    """Quantity of each column that is read, and the factor of its unit; None where it has none."""
    found: dict[str, tuple[str, float | None]] = {}
    for name in next(csv.reader(_lines(text)[:1], skipinitialspace=True), []):
        plain = name.strip().lower()
        unit = _UNIT.search(plain)
        word = (unit[1] or unit[2]) if unit else ""
        title = (plain[: unit.start()] if unit else plain).replace(" ", "_")
        for pattern, quantity, units in _COLUMNS:
            if re.fullmatch(pattern, title) and quantity not in {one for one, _ in found.values()}:
                found[name] = quantity, units.get(word)
    return found


def _values(row: dict[str, str], columns: dict[str, tuple[str, float | None]]) -> dict[str, float]:
    found = {}
    for name, (quantity, factor) in columns.items():
        try:
            found[quantity] = float(row[name]) * (factor or 1.0)
        except (TypeError, ValueError):
            continue
    return found


def _clock_s(text: str | None) -> dict[str, float]:
    try:
        moment = datetime.fromisoformat((text or "").strip())
    except ValueError:
        return {}
    return {"clock_s": (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()}


def _is_set(text: str | None) -> bool:
    return (text or "").strip().lower() in ("1", "true", "yes", "recording", "starting")
