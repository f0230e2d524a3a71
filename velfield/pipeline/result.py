"""The result of a unit of work, and its commit."""

import time
from dataclasses import dataclass, field
from pathlib import Path

from schemas.records import CommitRecord
from velfield.pipeline.plan import Plan
from velfield.run.commits import code_version, digest_outputs, valid_commit, write_commit


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
