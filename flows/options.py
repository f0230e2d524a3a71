"""Options that several commands have."""

from typing import Annotated, Literal

from cyclopts import Parameter

from velfield.errors import InputError

Preset = Literal["best", "fast", "paper"]
Settings = Annotated[tuple[str, ...], Parameter(name="--set", consume_multiple=False, negative=(), show_default=False)]
"""``section.key=value``, any number of times."""


def frame_size(size: str, wanted: str, least_px: int = 0) -> tuple[int, int]:
    """Width and height of ``--size WIDTHxHEIGHT``, px.

    Raises
    ------
    InputError
        It is none, or a side is below ``least_px``; ``wanted`` says what would do.
    """
    width, times, height = size.lower().partition("x")
    if not (times and width.isdigit() and height.isdigit() and min(int(width), int(height)) >= least_px):
        raise InputError(f"--size {size}: expected WIDTHxHEIGHT in pixels, {wanted}")
    return int(width), int(height)
