"""When to make previews (`velfield.pipeline.preview`): early on a long flight, and rarely enough to cost little."""

import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

from flows.console import Console
from flows.runners import Runner
from flows.work import UnderWay
from velfield.errors import InputError
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import committed
from velfield.pipeline.stage import FIELD_STAGES
from velfield.run.commits import WHOLE
from velfield.run.layout import is_remote

WORTH_S = 30.0
"""A preview of the finished units is made where so much time is left at least ..."""
TIMES_ITS_COST = 3.0
"""... and so many times what it takes."""
COST_S_A_MPX = 2.5
"""Assumed time that a preview takes, until one has been timed."""
SHARE = 0.1
"""Fraction of the time that goes into previews."""


class _OverError(RuntimeError):
    """The run's own field is being made."""


@dataclass
class Previews:
    """Previews of one run, as work beside its stages."""

    plan: Plan
    runner: Runner
    console: Console

    urgent = False
    """Whether the task under way is a first preview that is quick to make: a person waits for it."""

    def __post_init__(self) -> None:
        # On S3 folders are not renamed in one step.
        self._off = not self.plan.config.work.previews or is_remote(self.plan.layout.root)
        self._publishing = threading.Lock()
        self._first_tried = False
        self._units_shown = 0
        self._cost_s = COST_S_A_MPX * self.plan.info.width * self.plan.info.height / 1e6
        self._next_s = -math.inf

    def next_task(self, stages: Sequence[UnderWay]) -> Callable[[], None] | None:
        """A preview, where it is time for one."""
        if self._off:
            return None
        if not self._first_tried:
            self._first_tried = True
            if self.plan.is_long and not self.plan.layout.report.exists():
                self.urgent = self.plan.is_of_frames_alone
                return lambda: self._make(self._show_first_frames)
        found = next((stage for stage in stages if stage.stage.name == "detections"), None)
        if found is None or not self._is_worth_it(found):
            return None
        self._units_shown = len(found.ended)
        return lambda: self._make(partial(self._show_finished_units, found.plan))

    def _is_worth_it(self, found: UnderWay) -> bool:
        """Whether units came since the last preview, most of the work is still to come, and little time went into
        previews."""
        now_s, done, units = time.monotonic(), len(found.ended), len(found.units)
        if done <= self._units_shown or found.lost or now_s < self._next_s:
            return False
        left_s = (now_s - found.started_s) / done * (units - done)
        return left_s >= max(WORTH_S, TIMES_ITS_COST * self._cost_s) and not committed(found.plan, "tracks", WHOLE)

    def _show_first_frames(self) -> int:
        from velfield.pipeline.preview import make_first_preview, publish_first_preview  # all that the stages import

        frames = self.runner.call(make_first_preview, self.plan)
        publish_first_preview(self.plan, self._while_wanted())
        return frames

    def _show_finished_units(self, plan: Plan) -> int:
        from velfield.pipeline.preview import preview_finished_units

        return preview_finished_units(plan, self._compute, self._while_wanted())

    def _make(self, preview: Callable[[], int]) -> None:
        start_s = time.monotonic()
        try:
            frames = preview()
        except _OverError:
            return
        end_s = time.monotonic()
        self._cost_s = end_s - start_s
        self._next_s = end_s + self._cost_s * (1 - SHARE) / SHARE
        self.console.event(
            "preview",
            f"preview       field of {frames} of {self.plan.frame_count} frames on the page and in maps/   "
            f"{self._cost_s:.1f} s",
            frames=frames,
            report=str(self.plan.layout.report),
        )

    def _compute(self, graph: Any) -> Any:
        if self._off:
            raise _OverError
        return self.runner.compute_here(graph)

    @contextmanager
    def _while_wanted(self) -> Iterator[None]:
        with self._publishing:
            if self._off:
                raise _OverError
            yield

    def before(self, stage: str) -> None:
        """From the run's own tracklets on, no preview is made or published."""
        if stage in FIELD_STAGES:
            with self._publishing:
                self._off = True

    def finish(self, error: BaseException | None) -> None:
        """A preview that fails, fails alone."""
        self.urgent = False
        if isinstance(error, InputError):
            self.console.event("note", f"  no map of the first frames: {error}")
        elif error is not None:
            self._off = True
            self.console.warn(f"no preview of the field: {error}")
