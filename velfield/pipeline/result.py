"""The result of a unit of work, and its commit.

Progress within a unit: stages publish their steps, subscribers in the same process show them.

On a worker of a cluster there is no subscriber, and publishing costs nothing; there progress is shown unit by unit.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from schemas.records import CommitRecord
from velfield.pipeline.plan import Plan
from velfield.run.commits import code_version, digest_outputs, valid_commit, write_commit

Listener = Callable[[str, int], None]

_listeners: list[Listener] = []


def advance(stage: str, steps: int = 1) -> None:
    """Publish that ``steps`` more steps (frames, mostly) of ``stage`` are done."""
    for listener in tuple(_listeners):
        listener(stage, steps)


@contextmanager
def subscribe(listener: Listener) -> Iterator[None]:
    """Call ``listener`` with all progress of this process within the context.

    Examples
    --------
    >>> received = []
    >>> with subscribe(lambda stage, steps: received.append((stage, steps))):
    ...     advance("detections", 8)
    >>> received
    [('detections', 8)]
    """
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


@dataclass(frozen=True)
class StageResult:
    """The result of one unit of a stage."""

    outputs: list[Path] = field(default_factory=list)
    """Files written, inside the run folder; of a store, its chunks."""
    counts: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    """For information, one line each."""
    warnings: list[str] = field(default_factory=list)
    """One line each."""


def commit(plan: Plan, stage: str, unit: str, result: StageResult, *, started: float) -> CommitRecord:
    """Write the record of a finished unit: from now on it is not computed again."""
    record = CommitRecord(
        stage=stage,
        unit=unit,
        key=plan.keys[stage],
        outputs=digest_outputs(plan.layout, result.outputs),
        counts=result.counts,
        notes=tuple(result.notes),
        warnings=tuple(result.warnings),
        seconds=max(0.0, time.time() - started),
        code_version=code_version(),
    )
    write_commit(plan.layout, record)
    return record


def committed(plan: Plan, stage: str, unit: str) -> CommitRecord | None:
    """The record of a unit where it is finished as this plan wants it."""
    return valid_commit(plan.layout, stage, unit, plan.keys[stage])
