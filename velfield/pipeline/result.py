"""What a unit of work hands back, and how it is committed."""

import time
from dataclasses import dataclass, field
from pathlib import Path

from schemas.records import CommitRecord
from velfield.pipeline.plan import Plan
from velfield.pipeline.version import code_version
from velfield.run.commits import digest_outputs, valid_commit, write_commit


@dataclass(frozen=True)
class Outcome:
    """What a unit of work did."""

    outputs: list[Path] = field(default_factory=list)
    """Files written, inside the run folder; of a store, its chunks."""
    counts: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    """What is worth telling, one line each."""
    warnings: list[str] = field(default_factory=list)
    """What is to be minded, one line each."""


def unit_name(frames: range) -> str:
    """Name of a unit of frames: its range, so that a record says which frames it is about.

    Examples
    --------
    >>> unit_name(range(64, 128))
    '000064-000127'
    """
    return f"{frames.start:06d}-{frames.stop - 1:06d}"


def commit(plan: Plan, stage: str, unit: str, outcome: Outcome, *, started: float) -> CommitRecord:
    """Write the record of a finished unit: from now on it is not done again."""
    record = CommitRecord(
        stage=stage,
        unit=unit,
        key=plan.keys[stage],
        outputs=digest_outputs(plan.layout, outcome.outputs),
        counts=outcome.counts,
        notes=tuple(outcome.notes),
        warnings=tuple(outcome.warnings),
        seconds=max(0.0, time.time() - started),
        code_version=code_version(),
    )
    write_commit(plan.layout, record)
    return record


def committed(plan: Plan, stage: str, unit: str) -> CommitRecord | None:
    """The record of a unit where it is finished as this plan wants it."""
    return valid_commit(plan.layout, stage, unit, plan.keys[stage])
