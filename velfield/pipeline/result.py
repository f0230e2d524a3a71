"""The result of a unit of work, its commit, and the progress within it."""

import ctypes
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from schemas.records import CommitRecord
from velfield.parallel import count_steps
from velfield.pipeline.plan import Plan
from velfield.run.commits import code_version, digest_outputs, valid_commit, write_commit

_muted = threading.local()


def advance(stage: str, steps: int = 1) -> None:
    """Publish that ``steps`` more steps (frames, mostly) of ``stage`` are done."""
    if not getattr(_muted, "on", False):
        count_steps(steps, stage=stage)


@contextmanager
def without_progress() -> Iterator[None]:
    """Publish no progress from this thread within the context: it works on something else than the run's stages."""
    _muted.on = True
    try:
        yield
    finally:
        _muted.on = False


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
    _return_free_memory()
    return record


def _return_free_memory() -> None:
    """Return memory that the unit freed to the system, where the C library is glibc, which would keep most of it: the
    next unit is of another stage or size, and what each one leaves would add up to more than any of them takes."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def committed(plan: Plan, stage: str, unit: str) -> CommitRecord | None:
    """The record of a unit where it is finished as this plan wants it."""
    return valid_commit(plan.layout, stage, unit, plan.keys[stage])
