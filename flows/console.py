"""What a person sees in the terminal: a bar for the stage that runs, one line for each that is done."""

import json
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal

from rich.console import Console as RichConsole
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from velfield.pipeline.progress import subscribe

Verbosity = Literal["quiet", "normal", "verbose", "json"]


@dataclass
class StageProgress:
    """How far one stage is. Blocks tell as they go where they run in this process; else units do."""

    total: int
    bar: Progress
    task: int
    name: str
    done: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)

    def hear(self, stage: str, steps: int) -> None:
        """Take a step that a block of this process told of."""
        if stage == self.name:
            self.at_least(self.done + steps)

    def at_least(self, done: int) -> None:
        """The stage is at least so far."""
        with self.lock:
            self.done = min(self.total, max(self.done, done))
            self.bar.update(self.task, completed=self.done)  # type: ignore[arg-type]


def say(text: str) -> None:
    """A line with the time of day, from a process that serves."""
    print(f"{time.strftime('%H:%M:%S')}    {text}", flush=True)


class Console:
    """Writes to the terminal; as lines of JSON where asked to."""

    def __init__(self, verbosity: Verbosity = "normal") -> None:
        self.verbosity: Verbosity = verbosity
        self._rich = RichConsole(stderr=True, quiet=verbosity in ("quiet", "json"), highlight=False)

    def event(self, kind: str, text: str, **values: object) -> None:
        """One line: text for people, or an object for a program."""
        if self.verbosity == "json":
            print(json.dumps({"time": time.time(), "event": kind, "text": text, **values}), file=sys.stderr, flush=True)
        elif self.verbosity != "quiet":
            self._rich.print(text, markup=False, soft_wrap=True)

    def warn(self, text: str) -> None:
        """A warning: shown even where all else is quiet."""
        if self.verbosity == "json":
            self.event("warning", text)
        else:
            RichConsole(stderr=True, highlight=False).print(f"warning: {text}", markup=False, soft_wrap=True)

    def result(self, text: str) -> None:
        """What the command was asked for, on standard output."""
        print(text, flush=True)

    @contextmanager
    def stage(self, name: str, label: str, total: int) -> Iterator[StageProgress]:
        """A progress bar for the time of one stage."""
        columns = (
            TextColumn("{task.description:<12}"),
            BarColumn(bar_width=30),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        hidden = not self._rich.is_terminal  # in a log a bar would leave empty lines
        with Progress(*columns, console=self._rich, transient=True, refresh_per_second=5, disable=hidden) as bar:
            progress = StageProgress(total, bar, bar.add_task(label, total=total), name)
            with subscribe(progress.hear):
                yield progress
