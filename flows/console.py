"""Terminal output: a progress bar for the running stage, one line for each that is done."""

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

from velfield.pipeline.result import subscribe

Verbosity = Literal["quiet", "normal", "verbose", "json"]


@dataclass
class StageProgress:
    """Progress of one stage: by blocks where they run in this process, else by units."""

    total: int
    bar: Progress
    task: int
    name: str
    done: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)

    def add_steps(self, stage: str, steps: int) -> None:
        """Count steps that a block of this process published."""
        if stage == self.name:
            self.at_least(self.done + steps)

    def at_least(self, done: int) -> None:
        """Set the progress to at least so many steps."""
        with self.lock:
            self.done = min(self.total, max(self.done, done))
            self.bar.update(self.task, completed=self.done)  # type: ignore[arg-type]


def print_with_time(text: str) -> None:
    """Print a line with the time of day, from a process that serves."""
    print(f"{time.strftime('%H:%M:%S')}    {text}", flush=True)


class Console:
    """Writes to the terminal: text, or lines of JSON."""

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
        """A warning: shown even with ``--quiet``."""
        if self.verbosity == "json":
            self.event("warning", text)
        else:
            RichConsole(stderr=True, highlight=False).print(f"warning: {text}", markup=False, soft_wrap=True)

    def result(self, text: str) -> None:
        """A result of the command, on standard output."""
        print(text, flush=True)

    @contextmanager
    def stage(self, name: str, label: str, total: int) -> Iterator[StageProgress]:
        """A progress bar while one stage runs."""
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
            with subscribe(progress.add_steps):
                yield progress
