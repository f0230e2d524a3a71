"""Options that several commands have."""

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from velfield.errors import InputError

DONE, BAD_INPUT, USAGE, INCOMPLETE = 0, 1, 2, 3
"""Exit statuses. 3: done, but frames were lost."""
Device = Literal["auto", "cpu", "cuda"]
RunFolder = Annotated[Path, Parameter(help="The run folder.")]
ConfigFile = Annotated[Path | None, Parameter(help="flight.yaml with the flight's configuration.")]
Preset = Annotated[Literal["best", "fast", "paper"] | None, Parameter(help="Set of defaults to start from.")]
Settings = Annotated[
    tuple[str, ...],
    Parameter(
        name="--set",
        consume_multiple=False,
        negative=(),
        show_default=False,
        help="One parameter, as `section.key=value`; can be repeated.",
    ),
]
Workers = Annotated[int | None, Parameter(help="Processes of a local cluster. Default: threads of this process.")]
Scheduler = Annotated[str | None, Parameter(help="Address of a Dask scheduler.")]
Cluster = Annotated[
    Path | None,
    Parameter(
        help="File with the class of Dask clusters to use and its arguments; "
        "the documentation's page Examples has some."
    ),
]
FrameSize = Annotated[str, Parameter(help="Frame size, WxH in pixels.")]
Seed = Annotated[int, Parameter(help="Seed of the city and the flight.")]
Port = Annotated[int | None, Parameter(help="Port to listen on. Default: any free port.")]
OpenBrowser = Annotated[bool, Parameter(name="--open", help="Open the browser, if there is a screen.")]
Quiet = Annotated[bool, Parameter(name=["--quiet", "-q"], negative=(), help="Print results and warnings only.")]
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
