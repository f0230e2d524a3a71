"""Options that several commands have."""

from typing import Annotated, Literal

from cyclopts import Parameter

from velfield.errors import InputError

DONE, BAD_INPUT, USAGE, INCOMPLETE = 0, 1, 2, 3
"""Exit statuses. 3: done, but frames were lost."""
Preset = Literal["best", "fast", "paper"]
Device = Literal["auto", "cpu", "cuda"]
Settings = Annotated[tuple[str, ...], Parameter(name="--set", consume_multiple=False, negative=(), show_default=False)]
"""``section.key=value``, any number of times."""

Quiet = Annotated[bool, Parameter(name=["--quiet", "-q"], negative=())]
Verbose = Annotated[bool, Parameter(name=["--verbose", "-v"], negative=())]
LogJson = Annotated[bool, Parameter(name="--log-json", negative=())]


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
