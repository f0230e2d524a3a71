"""Summaries: of a stage, its units added up and one line for people; of a run, what it lost besides."""

from collections.abc import Mapping, Sequence

from schemas.records import CommitRecord
from schemas.summary import RunSummary, StageSummary
from velfield.errors import count_text
from velfield.pipeline.plan import Plan
from velfield.pipeline.stage import STAGE
from velfield.run.stores import FrameStore, RegistrationStore
from velfield.sources.frames import FootageLoss

_MEANS = frozenset({"heldout_px", "residual_px", "searched"})
"""Counts that are averaged over units, weighted by frames; all others are summed."""


class _Count(float):
    """A count in a line of a stage: ``{frames:.0f}`` is a number, ``{frames:frame}`` a number with this noun."""

    def __format__(self, spec: str) -> str:
        return count_text(self, spec) if spec[:1].isalpha() else super().__format__(spec)


def summarise_stage(
    name: str,
    records: Sequence[CommitRecord],
    *,
    units: int,
    before: Sequence[CommitRecord],
    lost: Mapping[str, str] | None = None,
    seconds: float,
) -> StageSummary:
    """Add up a stage's units; ``before``: those that an earlier run finished; ``lost``: why others failed, by name."""
    lost = lost or {}
    counts = _total([record.counts for record in records])
    line = next(line.text for line in STAGE[name].lines if line.when(counts))
    text = line.format_map({key: _Count(counts.get(key, "nan")) for key in _keys(line)})
    if before:
        part = f"{len(before)} of {count_text(units, 'unit')} " if len(before) < units else ""
        text += f" ({part}done before)"
    if lost:
        text += f"; {len(lost)} of {count_text(units, 'unit')} lost"
    return StageSummary(
        name=name,
        units=units,
        done_before=len(before),
        lost=tuple(lost),
        failures=tuple(lost.values()),
        counts=counts,
        notes=tuple(note for record in records for note in record.notes),
        warnings=tuple(warning for record in records for warning in record.warnings),
        seconds=seconds,
        seconds_before=sum(record.seconds for record in before),
        text=text,
    )


def summarise_run(plan: Plan, stages: Sequence[StageSummary]) -> RunSummary:
    """The summary of a run of frames: its stages, and the frames that are not there or in no tracklet."""
    absent = tuple(f"{plan.job.inputs.source}: {line}" for line in plan.info.warnings if isinstance(line, FootageLoss))
    return RunSummary(root=plan.job.root, stages=tuple(stages), frames_lost=lost_frames(plan), footage_lost=absent)


def lost_frames(plan: Plan) -> tuple[str, ...]:
    """Frames that are not registered, with the reason, one line each."""
    times_s = FrameStore(plan.layout.frames).column("time_s")
    statuses = RegistrationStore(plan.layout.registration).statuses()
    return tuple(
        f"frame {frame} ({times_s[frame]:.3f} s): {status or 'not processed'}"
        for frame, status in enumerate(statuses)
        if status != "ok"
    )


def _keys(line: str) -> list[str]:
    return [part.split(":")[0] for part in line.split("{")[1:]]


def _total(units: Sequence[Mapping[str, float]]) -> dict[str, float]:
    total: dict[str, float] = {}
    weights = [unit.get("frames", 1.0) for unit in units]
    for key in sorted({key for unit in units for key in unit}):
        values = [(unit[key], weight) for unit, weight in zip(units, weights, strict=True) if key in unit]
        if key in _MEANS:
            total[key] = sum(v * w for v, w in values) / max(sum(w for _, w in values), 1e-12)
        else:
            total[key] = sum(v for v, _ in values)
    return total
