"""Summary of a run: a line a stage, warnings, what was lost."""

from pydantic import Field

from schemas.model import Model


class StageSummary(Model):
    """One stage, all its units together."""

    name: str
    units: int
    done_before: int
    """Units that an earlier run had finished."""
    lost: tuple[str, ...] = ()
    """Units that failed in every try: done again by the next run."""
    failures: tuple[str, ...] = ()
    """Why they failed, one line each."""
    counts: dict[str, float] = Field(default_factory=dict)
    notes: tuple[str, ...] = ()
    """Remarks, one line each."""
    warnings: tuple[str, ...] = ()
    """Warnings, one line each."""
    seconds: float
    """Time that this run spent on the stage."""
    seconds_before: float = 0.0
    """Total time that earlier runs spent on the units that they had finished."""
    text: str
    """The stage in one line, for people."""


class RunSummary(Model):
    """One run."""

    root: str
    stages: tuple[StageSummary, ...]
    frames_lost: tuple[str, ...] = ()
    """Frames that are in no tracklet though the source has them, and why: ``frame 12 (2.412 s): failed:...``."""
    footage_lost: tuple[str, ...] = ()
    """Parts of the recording that the source does not have: ``clip.mp4: 31 frames read of 60 declared: ...``."""

    @property
    def complete(self) -> bool:
        """Whether nothing was lost."""
        return not self.frames_lost and not self.footage_lost and not any(stage.lost for stage in self.stages)

    @property
    def loss(self) -> str:
        """What was lost, in one line."""
        units = sum(len(stage.lost) for stage in self.stages)
        absent = ", part of the recording is missing" if self.footage_lost else ""
        return f"incomplete: frames lost: {len(self.frames_lost)}, units lost: {units}{absent}"
