"""What the report shows, apart from its pictures."""

from typing import Literal

from pydantic import Field

from schemas.model import Model


class ReportStage(Model):
    """One stage, one line."""

    name: str
    text: str
    """What it did, with counts, for people."""
    seconds: float = Field(ge=0)
    lost: int = Field(0, ge=0)
    """Units that failed in every try."""


class ResidualSeries(Model):
    """Registration residual against time."""

    times_s: tuple[float, ...]
    residual_px: tuple[float | None, ...]
    """Held-out residual of each frame, base px; None where the frame is not registered."""
    limit_px: float | None = None
    """Above this a frame is not used."""


class PrecisionRecall(Model):
    """The detector's curve on its training evidence or on frames held out."""

    recall: tuple[float, ...]
    precision: tuple[float, ...]
    chosen: int | None = None
    """Index of the point that the threshold stands at."""
    evidence: str = ""
    """What the curve was measured on."""


class Report(Model):
    """A run, as its report tells it."""

    title: str
    source: str
    """The video or folder."""
    created: str
    """Date and time."""
    version: str
    facts: tuple[tuple[str, str], ...] = ()
    """Headline numbers: label and value."""
    few: str = ""
    """What is to be said where hardly any pixel was passed by several vehicles."""
    inputs: tuple[tuple[str, str], ...] = ()
    """What went in: base image, ground distance, labels, preset; label and value."""
    stages: tuple[ReportStage, ...] = ()
    residual: ResidualSeries | None = None
    detection: PrecisionRecall | None = None
    gates: dict[str, int] = Field(default_factory=dict)
    """What tracking tried, turned down and kept, by the names of `velfield.tracking.limits.GateLog`."""
    notes: tuple[str, ...] = ()
    """What is worth telling of the stages."""
    warnings: tuple[str, ...] = ()
    """What is to be minded."""
    frames_lost: tuple[str, ...] = ()
    files: tuple[tuple[str, str], ...] = ()
    """Files of the run folder worth opening: path relative to the report, and what it is."""


class ReportFigure(Model):
    """A picture of the report: its bytes go into the page, or the page names its file."""

    title: str
    caption: str
    alternative: str
    """What the picture shows, for those who do not see it."""
    mime: Literal["image/png", "image/jpeg"]
    data: bytes = Field(b"", repr=False)
    file: str | None = None
    """Path of the picture, relative to the report, in place of its bytes."""
    full_size: str | None = None
    """Path of the full picture, relative to the report."""
