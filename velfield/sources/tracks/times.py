"""Times of tables of tracks: numbers since an epoch, dates with zones, times of day."""

import re
from pathlib import Path

import numpy as np
import pandas as pd

from schemas.arrays import FloatArray
from velfield.errors import InputError
from velfield.sources.tracks.files import numbers
from velfield.sources.tracks.formats import TimeUnit

_PER_S: dict[str, float] = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
_EPOCH_S = (3e8, 4.1e9)
"""Seconds since 1970 from 1979 to 2099."""
_ISO = re.compile(r"\d{4}[-/.]\d{1,2}[-/.]\d{1,2}([T _]|$)|\d{8}T\d{4}")
_DAY_FIRST = re.compile(r"(\d{1,2})[./-](\d{1,2})[./-](\d{4}|\d{2})\b(.*)")
_TIME_OF_DAY = re.compile(r"\d{1,3}:\d{2}:\d{2}(\.\d+)?$")
_DAY_S, _HOUR_S = 86400.0, 3600.0


def to_seconds(series: pd.Series, unit: TimeUnit | None, path: Path) -> tuple[FloatArray, str]:
    """Times (n,), s from the first on, of numbers, dates with or without zones or times of day, and how they were read.

    The unit is that of numbers; None: seconds, or since 1970 in the unit that gives a year of today.

    Raises
    ------
    InputError
        Values that are no times, or times that can be read in two ways.
    """
    missing = series.isna()
    if missing.any():
        row = int(np.flatnonzero(missing)[0])
        raise InputError(f"{path}: found nothing in column {series.name}, row {row + 2}, expected a time")
    if pd.api.types.is_datetime64_any_dtype(series):
        return _since_first(series), "dates"
    if pd.api.types.is_timedelta64_dtype(series):
        return series.dt.total_seconds().to_numpy(np.float64), "durations"
    text = None if pd.api.types.is_numeric_dtype(series) else series.astype(str).str.strip().str.strip("\"'")
    if text is not None and text.str.contains(r"[:T/]|\d[.-]\d+[.-]", regex=True).any():
        return _from_text(text, series, path)
    if pd.api.types.is_integer_dtype(series):  # in whole numbers: nanoseconds do not fit into a float
        whole = series.to_numpy(np.int64)
        stamps = whole.astype(np.float64)
        since_first = (whole - whole.min()).astype(np.float64)
    else:
        stamps = numbers(series, path)
        since_first = stamps - stamps.min()
    return _from_numbers(stamps, since_first, unit, str(series.name), path)


def _from_numbers(
    stamps: FloatArray, since_first: FloatArray, unit: TimeUnit | None, name: str, path: Path
) -> tuple[FloatArray, str]:
    largest = float(np.abs(stamps).max(initial=0.0))
    if unit is not None:
        if largest / _PER_S[unit] > _EPOCH_S[1]:
            raise InputError(
                f"{path}: found {largest:.0f} in column {name}, expected times in {unit}; name the column by its unit, "
                "as time_s, time_ms, time_us or time_ns"
            )
        return since_first / _PER_S[unit], unit
    for candidate, per_s in _PER_S.items():
        if _EPOCH_S[0] <= largest / per_s <= _EPOCH_S[1] and float(stamps.min()) / per_s >= _EPOCH_S[0]:
            return since_first / per_s, f"{candidate} since 1970"
    digits = f"{largest:.0f}"
    if len(digits) in (14, 17) and digits[:2] in ("19", "20"):
        raise InputError(
            f"{path}: found {digits} in column {name}, a date without separators; write it as 2026-05-01T12:00:00.200Z"
        )
    if largest >= 1e7:
        raise InputError(
            f"{path}: found {digits} in column {name}, neither seconds nor a time since 1970; name the column by its "
            "unit, as time_s or time_ms, or write dates as 2026-05-01T12:00:00.200Z"
        )
    return since_first, "s"


def _from_text(text: pd.Series, series: pd.Series, path: Path) -> tuple[FloatArray, str]:
    text = text.str.replace(r"(:\d{2}),(\d)", r"\1.\2", regex=True).str.replace(r"\s*(UTC|GMT)$", "Z", regex=True)
    first = str(text.iloc[0])
    if _TIME_OF_DAY.match(first):
        return _times_of_day(text, series, path), "times of day"
    if _ISO.match(first):
        text = text.str.replace(r"^(\d{4})[/.](\d{1,2})[/.](\d{1,2})", r"\1-\2-\3", regex=True)
        text = text.str.replace(r"^(\d{4}-\d+-\d+)_", r"\1 ", regex=True)
        options: dict[str, object] = {"format": "ISO8601"}
    elif _DAY_FIRST.match(first):
        options = {"format": "mixed", "dayfirst": _is_day_first(text, series, path)}
    else:
        raise _no_time(series, 0, path)
    zoned = text.str.contains(r"(?:[zZ]|:\d{2}(?:\.\d+)?\s*[+-]\d{2}:?(?:\d{2})?)$", regex=True)
    if zoned.any() and not zoned.all():
        row = int(np.flatnonzero((zoned != zoned.iloc[0]).to_numpy())[0])
        raise InputError(
            f"{path}: found times with and without a time zone in column {series.name} (row {row + 2}); add the zone "
            "to each, such as +02:00"
        )
    try:
        stamps = pd.to_datetime(text, errors="coerce", utc=True, **options)  # type: ignore[call-overload]
    except (ValueError, OverflowError):
        raise _no_time(series, 0, path) from None
    bad = stamps.isna().to_numpy()
    if bad.any():
        raise _no_time(series, int(np.flatnonzero(bad)[0]), path)
    return _since_first(stamps), "dates with zones" if zoned.all() else "dates without a zone"


def _since_first(stamps: pd.Series) -> FloatArray:
    return np.asarray((stamps - stamps.min()).dt.total_seconds(), np.float64)


def _no_time(series: pd.Series, row: int, path: Path) -> InputError:
    found = series.iloc[[row]].tolist()[0]
    return InputError(
        f"{path}: found {found!r} in column {series.name}, row {row + 2}: neither seconds nor times of day nor a date; "
        "write times as seconds, or as 2026-05-01T12:00:00.200Z"
    )


def _is_day_first(text: pd.Series, series: pd.Series, path: Path) -> bool:
    """Whether the day stands before the month; either will do where all are of one day."""
    fields = text.str.extract(r"^(\d{1,2})[./-](\d{1,2})[./-](\d+)")
    if fields.isna().any(axis=None):
        raise _no_time(series, int(np.flatnonzero(fields.isna().any(axis=1))[0]), path)
    first, second = fields[0].astype(int), fields[1].astype(int)
    if (first > 12).any() or "." in str(text.iloc[0])[:6]:
        return True
    if (second > 12).any() or len(fields.drop_duplicates()) == 1:
        return False
    raise InputError(
        f"{path}: found {series.iloc[0]!r} in column {series.name}: day or month first? Write dates as "
        "2026-05-01T12:00:00"
    )


def _times_of_day(text: pd.Series, series: pd.Series, path: Path) -> FloatArray:
    """Seconds of times of day; those after midnight follow those before it."""
    stamps = pd.to_timedelta(text, errors="coerce")
    bad = stamps.isna().to_numpy()
    if bad.any():
        raise _no_time(series, int(np.flatnonzero(bad)[0]), path)
    seconds = stamps.dt.total_seconds().to_numpy(np.float64)
    order = np.unique(seconds)
    if len(order) > 1 and seconds.max() < _DAY_S:
        gaps = np.diff(order)
        widest = int(gaps.argmax())
        if gaps[widest] > _DAY_S / 2:
            seconds = np.where(seconds > order[widest], seconds - _DAY_S, seconds)
    return np.asarray(seconds - seconds.min())


def check_clock(track: FloatArray, time_s: FloatArray, path: Path) -> str | None:
    """A note where times without a zone leave out an hour, as clocks do in spring.

    Raises
    ------
    InputError
        They go back by an hour from one row of a track to its next, as clocks do in autumn.
    """
    order = np.argsort(track, kind="stable")
    step = np.diff(time_s[order])
    same = np.diff(track[order]) == 0
    back = np.flatnonzero(same & (step < -_HOUR_S + 60) & (step > -_HOUR_S - 60))
    if len(back):
        raise InputError(
            f"{path}: found times that go back by an hour in row {int(order[back[0] + 1]) + 2}, and no time zone: a "
            "change of summer time? Write times with their zone, as 02:59:30+02:00"
        )
    gaps = np.diff(np.unique(time_s))
    if len(gaps) and abs(float(gaps.max()) - _HOUR_S) < 60:
        return "an hour without rows: where it is a change of summer time, write times with their zone"
    return None
