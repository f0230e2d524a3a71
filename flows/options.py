"""Options that several commands have."""

from typing import Annotated, Literal

from cyclopts import Parameter

Preset = Literal["best", "fast", "paper"]
Settings = Annotated[tuple[str, ...], Parameter(name="--set", consume_multiple=False, negative=(), show_default=False)]
"""``section.key=value``, any number of times."""
