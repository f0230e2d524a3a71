"""Slices of time: whole passages shared out among intervals, so that the slices' fields add up to the field of all."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import floor

import numpy as np
from numpy.typing import NDArray

from velfield.errors import InputError
from velfield.field.segments import Segments

DAY_S = 86_400.0
MOST_SLICES = 400
"""Each is a store of its own."""
_UNITS = {"s": 1.0, "min": 60.0, "h": 3600.0}
_FORMS = (
    "expected a length (15min, 90s, 1h), or intervals of seconds or of the time of day (0-300,300-900 or 07:00-09:00)"
)


@dataclass(frozen=True)
class TimeSlice:
    """An interval of the flight's clock: ``start_s`` belongs to it, ``stop_s`` to the next.

    The slice ``rest`` holds what lies in none of the intervals that were asked for; its ends are infinite.
    """

    name: str
    start_s: float
    stop_s: float


def parse_slices(text: str, first_s: float, last_s: float) -> list[TimeSlice]:
    """The slices of a flight from ``first_s`` to ``last_s``.

    Parameters
    ----------
    text
        A length: slices begin at multiples of it on the flight's clock, so that clocks that count from midnight or from
        1970 give quarters of the hour. Or intervals, by commas: seconds, or times of day (UTC where the clock is).

    Raises
    ------
    InputError
        The text is not understood, intervals overlap or are empty, or there are too many.

    Examples
    --------
    >>> [s.name for s in parse_slices("15min", 1000.0, 2000.0)]
    ['900-1800', '1800-2700']
    >>> [s.name for s in parse_slices("0-60,60-90", 0.0, 300.0)]
    ['0-60', '60-90', 'rest']
    """
    length = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*(s|min|h)\s*", text)
    if length:
        return _regular(float(length[1]) * _UNITS[length[2]], first_s, last_s, text)
    slices = [_interval(part.strip(), floor(first_s / DAY_S) * DAY_S) for part in text.split(",")]
    ordered = sorted(slices, key=lambda s: s.start_s)
    for before, after in pairwise(ordered):
        if after.start_s < before.stop_s:
            raise InputError(f"slices {before.name} and {after.name} overlap: a passage would count in both")
    return [*ordered, TimeSlice("rest", -np.inf, np.inf)]


def _regular(length_s: float, first_s: float, last_s: float, text: str) -> list[TimeSlice]:
    if length_s <= 0:
        raise InputError(f"slice {text!r} has no length: {_FORMS}")
    low, high = floor(first_s / length_s), floor(last_s / length_s)
    if high - low >= MOST_SLICES:
        raise InputError(
            f"slice {text!r} cuts the flight into {high - low + 1}, at most {MOST_SLICES}: take longer ones"
        )
    edges = [length_s * k for k in range(low, high + 2)]
    return [TimeSlice(f"{a:.12g}-{b:.12g}", a, b) for a, b in pairwise(edges)]


def _interval(part: str, midnight_s: float) -> TimeSlice:
    ends = part.split("-")
    if len(ends) != 2:
        raise InputError(f"slice {part!r} is not understood: {_FORMS}")
    start_s, stop_s = (_moment(end, part, midnight_s) for end in ends)
    if not start_s < stop_s:
        raise InputError(f"slice {part!r} ends before it begins: {_FORMS}")
    return TimeSlice(part.replace(":", ""), start_s, stop_s)


def _moment(text: str, part: str, midnight_s: float) -> float:
    clock = re.fullmatch(r"(\d{1,2}):(\d{2})", text)
    if clock:
        return midnight_s + 3600.0 * int(clock[1]) + 60.0 * int(clock[2])
    if not re.fullmatch(r"\d+(\.\d+)?", text):
        raise InputError(f"slice {part!r} is not understood: {_FORMS}")
    return float(text)


def slice_of_passages(segments: Segments, slices: Sequence[TimeSlice]) -> NDArray[np.int64]:
    """Number of the slice of each segment, (n,): that of the middle of its passage, so that none is split.

    Parameters
    ----------
    segments
        Whole passages, sorted by passage.
    slices
        As `parse_slices` gives them: what lies in none goes to the last.
    """
    if not len(segments):
        return np.zeros(0, np.int64)
    _, first, count = np.unique(segments["passage"], return_index=True, return_counts=True)
    begin = np.minimum.reduceat(segments["start_s"], first)
    end = np.maximum.reduceat(segments["start_s"] + segments["duration_s"], first)
    middle = 0.5 * (begin + end)
    number = np.full(len(middle), len(slices) - 1, np.int64)
    for k, part in reversed(list(enumerate(slices))):
        number[(middle >= part.start_s) & (middle < part.stop_s)] = k
    return np.repeat(number, count)
