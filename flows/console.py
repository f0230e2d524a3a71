"""Terminal output: a progress bar for the running stage, one line for each that is done."""

import json
import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

from rich.console import Console as RichConsole
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from velfield.parallel import subscribe_steps

_LINE_EVERY_S = 10.0
_TRAINS = "detector"
"""The stage that counts steps of a training."""
Verbosity = Literal["quiet", "normal", "verbose", "json"]


@dataclass
class StageProgress:
    """Progress of one stage: by blocks where they run in this process, else by units."""

    bar: Progress
    task: TaskID
    log: Callable[[int, int], None]
    """Called with the steps that are done and their number: a line now and then where no bar is seen."""
    total: int = 0
    done: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)

    def expect(self, total: int) -> None:
        """Set the number of steps."""
        self.total = total
        self.bar.update(self.task, total=total)

    def remove(self) -> None:
        """Take the bar away, as the stage is done."""
        self.bar.update(self.task, visible=False)

    def set_progress(self, done: int, total: int) -> None:
        """Set the progress to at least so many steps of a number that was not known before."""
        if total != self.total:
            self.expect(total)
        self.at_least(done)

    def at_least(self, done: int) -> None:
        """Set the progress to at least so many steps."""
        with self.lock:
            self.done = min(self.total, max(self.done, done))
            self.bar.update(self.task, completed=self.done)
        self.log(self.done, self.total)


@dataclass
class StageBars:
    """Progress bars, one a stage."""

    bar: Progress
    log: Callable[[str], None] | None = None
    """Writes a line, where no bar is seen."""
    stages: dict[str, StageProgress] = field(default_factory=dict)
    logged_s: float = field(default_factory=time.monotonic)

    def add(self, name: str, label: str, steps: str = "steps") -> StageProgress:
        """A bar for a stage, by its name, what it is called, and what its steps are."""
        first = 0.0, 0, 0  # what an earlier run had done says nothing of the time left, nor what is not yet announced

        def log(done: int, total: int) -> None:
            nonlocal first
            now_s = time.monotonic()
            if first[2] != total or (done > 0 and not first[1]):  # the first waits for what is read and compiled once
                first = now_s, done, total
            begin_s, begun, _ = first
            if self.log is not None and 0 < done < total and now_s - self.logged_s >= _LINE_EVERY_S:
                self.logged_s = now_s
                left_s = (now_s - begin_s) * (total - done) / (done - begun) if done > begun else None
                left = "" if left_s is None else f", about {left_s:.0f} s left"
                self.log(f"{label}: {done} of {total} {steps}{left}")

        self.stages[name] = StageProgress(self.bar, self.bar.add_task(label, total=None), log)
        return self.stages[name]

    def add_steps(self, done: int, announced: int, stage: str) -> None:
        """Count steps that work in this process published; of a training their number is announced as it goes on."""
        progress = self.stages.get(stage or _TRAINS)
        if progress is not None:
            progress.set_progress(progress.done + done, progress.total + announced)


def print_with_time(text: str) -> None:
    """Print a line with the time of day, from a process that serves."""
    print(f"{time.strftime('%H:%M:%S')}    {text}", flush=True)


def _log_to_run(level: int, text: str) -> None:
    """Show a line in the logs of the flow run, or task run, that this is, if any."""
    if "prefect.context" in sys.modules:
        from flows.prefect_flows import log_to_run

        log_to_run(level, text)


class Console:
    """Writes to the terminal: text, or lines of JSON."""

    def __init__(self, verbosity: Verbosity = "normal") -> None:
        self.verbosity: Verbosity = verbosity
        self._warnings: list[str] = []
        self._rich = RichConsole(stderr=True, quiet=verbosity in ("quiet", "json"), highlight=False)

    def event(self, kind: str, text: str, **values: object) -> None:
        """One line: text for people, or an object for a program."""
        if self.verbosity == "json":
            print(json.dumps({"time": time.time(), "event": kind, "text": text, **values}), file=sys.stderr, flush=True)
        elif self.verbosity != "quiet":
            self._rich.print(text, markup=False, soft_wrap=True)
        _log_to_run(logging.INFO, text)

    def warn(self, text: str) -> None:
        """A warning: shown even with ``--quiet``."""
        if self.verbosity == "json":
            self.event("warning", text)
        else:
            RichConsole(stderr=True, highlight=False).print(f"warning: {text}", markup=False, soft_wrap=True)
            _log_to_run(logging.WARNING, text)

    def warn_at_end(self, text: str) -> None:
        """A warning for `print_warnings`, so that it does not stand between lines of progress; JSON at once."""
        if self.verbosity == "json":
            self.warn(text)
        else:
            self._warnings.append(text)

    def print_warnings(self) -> None:
        """Print the warnings that were kept for the end, together."""
        kept, self._warnings = self._warnings, []
        for text in kept:
            self.warn(text)

    def result(self, text: str) -> None:
        """A result of the command, on standard output."""
        print(text, flush=True)

    @contextmanager
    def stage(self, name: str, label: str, total: int) -> Iterator[StageProgress]:
        """A progress bar while one stage runs."""
        with self.stages() as bars:
            progress = bars.add(name, label)
            progress.expect(total)
            yield progress

    @contextmanager
    def stages(self) -> Iterator[StageBars]:
        """Progress bars of the stages that run."""
        columns = (
            TextColumn("{task.description:<12}"),
            BarColumn(bar_width=30),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        hidden = not self._rich.is_terminal  # in a log a bar would leave empty lines
        with Progress(*columns, console=self._rich, transient=True, refresh_per_second=5, disable=hidden) as bar:
            bars = StageBars(bar, partial(self.event, "progress") if hidden else None)
            with subscribe_steps(bars.add_steps):
                yield bars
