"""Time intervals of a flight: a track belongs to one of them, so that their fields add up to the whole field."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import floor
from typing import TYPE_CHECKING

import numpy as np

from schemas.arrays import IntArray
from velfield.errors import InputError

if TYPE_CHECKING:  # planning needs neither it nor pandas, half a second of imports
    from velfield.field.segments import Segments

DAY_S = 86_400.0
MAX_INTERVALS = 400
"""Upper bound of the number of intervals: each is a store of its own."""
_UNITS = {"s": 1.0, "min": 60.0, "h": 3600.0}
_FORMS = (
    "expected a length (15min, 90s, 1h), or intervals of seconds or of the time of day (0-300,300-900 or 07:00-09:00)"
)


@dataclass(frozen=True)
class TimeInterval:
    """A half-open interval [``start_s``, ``stop_s``) of the flight's clock.

    The interval ``rest`` holds the tracks in none of the requested ones; its ends are infinite.
    """

    name: str
    start_s: float
    stop_s: float


def parse_time_intervals(text: str, first_s: float, last_s: float) -> list[TimeInterval]:
    """The time intervals of a flight from ``first_s`` to ``last_s``.

    Parameters
    ----------
    text
        A length: intervals begin at multiples of it on the flight's clock, so that a clock that counts from midnight or
        from 1970 gives quarters of the hour. Or intervals, by commas: seconds, or times of day (UTC if the clock is).

    Raises
    ------
    InputError
        The text cannot be parsed, intervals overlap or are empty, or there are too many.

    Examples
    --------
    >>> [interval.name for interval in parse_time_intervals("15min", 1000.0, 2000.0)]
    ['900-1800', '1800-2700']
    >>> [interval.name for interval in parse_time_intervals("0-60,60-90", 0.0, 300.0)]
    ['0-60', '60-90', 'rest']
    """
    length = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*(s|min|h)\s*", text)
    if length:
        return _regular(float(length[1]) * _UNITS[length[2]], first_s, last_s, text)
    intervals = [_interval(part.strip(), floor(first_s / DAY_S) * DAY_S) for part in text.split(",")]
    ordered = sorted(intervals, key=lambda interval: interval.start_s)
    for before, after in pairwise(ordered):
        if after.start_s < before.stop_s:
            raise InputError(f"time intervals {before.name} and {after.name} overlap: a vehicle would count in both")
    return [*ordered, TimeInterval("rest", -np.inf, np.inf)]


def _regular(length_s: float, first_s: float, last_s: float, text: str) -> list[TimeInterval]:
    if length_s <= 0:
        raise InputError(f"time interval {text!r} has no length: {_FORMS}")
    low, high = floor(first_s / length_s), floor(last_s / length_s)
    if high - low >= MAX_INTERVALS:
        raise InputError(
            f"time interval {text!r} cuts the flight into {high - low + 1}, at most {MAX_INTERVALS}: take longer ones"
        )
    edges = [length_s * k for k in range(low, high + 2)]
    return [TimeInterval(f"{a:.12g}-{b:.12g}", a, b) for a, b in pairwise(edges)]


def _interval(part: str, midnight_s: float) -> TimeInterval:
    ends = part.split("-")
    if len(ends) != 2:
        raise InputError(f"time interval {part!r} is not understood: {_FORMS}")
    start_s, stop_s = (_moment(end, part, midnight_s) for end in ends)
    if not start_s < stop_s:
        raise InputError(f"time interval {part!r} ends before it begins: {_FORMS}")
    return TimeInterval(part.replace(":", ""), start_s, stop_s)


def _moment(text: str, part: str, midnight_s: float) -> float:
    clock = re.fullmatch(r"(\d{1,2}):(\d{2})", text)
    if clock:
        return midnight_s + 3600.0 * int(clock[1]) + 60.0 * int(clock[2])
    if not re.fullmatch(r"\d+(\.\d+)?", text):
        raise InputError(f"time interval {part!r} is not understood: {_FORMS}")
    return float(text)


def assign_intervals(segments: "Segments", intervals: Sequence[TimeInterval]) -> IntArray:
    """Index of the time interval of each segment, (n,): that of the midpoint of its track, so that no track is split.

    Parameters
    ----------
    segments
        Whole tracks, sorted by track.
    intervals
        From `parse_time_intervals`; tracks in none of them go to the last.
    """
    if not len(segments):
        return np.zeros(0, np.int64)
    _, first, count = np.unique(segments["track"], return_index=True, return_counts=True)
    begin = np.minimum.reduceat(segments["start_s"], first)
    end = np.maximum.reduceat(segments["start_s"] + segments["duration_s"], first)
    middle = 0.5 * (begin + end)
    number = np.full(len(middle), len(intervals) - 1, np.int64)
    for k, part in reversed(list(enumerate(intervals))):
        number[(middle >= part.start_s) & (middle < part.stop_s)] = k
    return np.repeat(number, count)
