"""What a run is asked to do: its inputs, its configuration, its folder."""

from schemas.flight import FlightConfig
from schemas.model import Model


class Inputs(Model):
    """Paths that the user gave. Only ``source`` is needed."""

    source: str
    """Video file or folder of pictures."""
    base: str | None = None
    """Picture whose pixels are the base pixels."""
    labels: str | None = None
    """Marked cars, CSV or YOLO, in raw pixels."""
    detector: str | None = None
    """A detector file in place of training."""
    detections: str | None = None
    """Another detector's boxes in place of ours."""
    timestamps: str | None = None
    """CSV of frame times."""


class Job(Model):
    """One run."""

    root: str
    """The run folder."""
    inputs: Inputs
    config: FlightConfig = FlightConfig()
