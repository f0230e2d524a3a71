"""Options that several commands have."""

import warnings
from typing import Annotated, Literal

from cyclopts import Parameter

from schemas.renames import OLD_NAMES_UNTIL
from velfield.errors import InputError, OldNameWarning

Preset = Literal["best", "fast", "paper"]
Device = Literal["auto", "cpu", "cuda"]
Settings = Annotated[tuple[str, ...], Parameter(name="--set", consume_multiple=False, negative=(), show_default=False)]
"""``section.key=value``, any number of times."""


def renamed_option(value: str | None, old_value: str | None, *, name: str, old_name: str) -> str | None:
    """The value of an option that may be given by its old name, which is warned of.

    Raises
    ------
    InputError
        Both were given.
    """
    if old_value is None:
        return value
    if value is not None:
        raise InputError(f"found {old_name} and {name}, two names of one option; keep {name}")
    message = f"{old_name} is now {name}; the old name works until {OLD_NAMES_UNTIL}"
    warnings.warn(message, OldNameWarning, stacklevel=3)
    return old_value


def parse_frame_size(size: str, expected: str, min_px: int = 0) -> tuple[int, int]:
    """Parse width and height of ``--size WIDTHxHEIGHT``, px.

    Raises
    ------
    InputError
        It is no size, or a side is below ``min_px``; ``expected`` describes a valid one.
    """
    width, times, height = size.lower().partition("x")
    if not (times and width.isdigit() and height.isdigit() and min(int(width), int(height)) >= min_px):
        raise InputError(f"--size {size}: expected WIDTHxHEIGHT in pixels, {expected}")
    return int(width), int(height)
