"""Content of the report, apart from its figures."""

from typing import Literal

from pydantic import Field

from schemas.detector import PrecisionRecallCurve
from schemas.model import Model


class ReportStage(Model):
    """One stage, one line."""

    name: str
    text: str
    """Summary of the stage's results, with counts."""
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


class Report(Model):
    """The contents of a run's report."""

    title: str
    source: str
    """The video or folder."""
    created: str
    """Date and time."""
    version: str
    facts: tuple[tuple[str, str], ...] = ()
    """Headline numbers: label and value."""
    low_coverage_note: str = ""
    """A note for people where hardly any pixel was passed by several vehicles."""
    inputs: tuple[tuple[str, str], ...] = ()
    """Inputs of the run: base image, ground distance, labels, preset; label and value."""
    stages: tuple[ReportStage, ...] = ()
    residual: ResidualSeries | None = None
    detection: PrecisionRecallCurve | None = None
    """Of the detector, on labels held out when it was trained."""
    detection_source: str = ""
    """Whose precision and recall these are and who measured them on what, for people; empty in the reports of versions
    before 1.2."""
    gates: dict[str, int] = Field(default_factory=dict)
    """Counts of what tracking tried, rejected and kept, by the names of `velfield.tracking.gates.GateLog`."""
    notes: tuple[str, ...] = ()
    """Remarks of the stages."""
    warnings: tuple[str, ...] = ()
    """Warnings of the stages."""
    frames_lost: tuple[str, ...] = ()
    footage_lost: tuple[str, ...] = ()
    """Missing parts of the recording, one line each; also among the warnings."""
    files: tuple[tuple[str, str], ...] = ()
    """Files of the run folder worth opening: path relative to the report, and what it is."""


class ReportFigure(Model):
    """A figure of the report: its bytes go into the page, or the page refers to its file."""

    title: str
    caption: str
    alt_text: str
    """Description of the image for readers who cannot see it."""
    mime: Literal["image/png", "image/jpeg"]
    data: bytes = Field(b"", repr=False)
    file: str | None = None
    """Path of the image, relative to the report, in place of its bytes."""
    full_size: str | None = None
    """Path of the image at full size, relative to the report."""
