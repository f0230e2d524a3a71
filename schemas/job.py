"""Specification of a run: its inputs, its configuration, its folder."""

import os
from pathlib import Path
from typing import Self

from schemas.flight import FlightConfig
from schemas.model import Model


def absolute(path: str) -> str:
    """The path from the root on, so that it means the same in a process that works elsewhere; an address as it is.

    Examples
    --------
    >>> absolute("s3://bucket/run")
    's3://bucket/run'
    >>> absolute("s3:/bucket/run")  # as `pathlib.Path` writes it
    's3://bucket/run'
    """
    if path.startswith("s3:/"):
        return "s3://" + path.removeprefix("s3:").lstrip("/")
    return path if ":/" in path else os.path.abspath(path)


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
    telemetry: str | None = None
    """Subtitle file (.SRT) that the drone wrote; None: the one beside the video, or what the source itself holds."""

    @classmethod
    def from_simulated_flight(cls, folder: Path) -> Self:
        """All that `velfield simulate` wrote into a folder, apart from the truth."""
        names = {"source": "frames", "timestamps": "timestamps.csv", "base": "base.png", "labels": "labels.csv"}
        return cls.model_validate({key: str(folder / name) for key, name in names.items()})


class Job(Model):
    """One run."""

    root: str
    """The run folder."""
    inputs: Inputs
    config: FlightConfig = FlightConfig()

    def anywhere(self) -> "Job":
        """The same job with absolute paths: workers have working folders of their own."""
        given = {name: path and absolute(path) for name, path in self.inputs.model_dump().items()}
        return self.model_copy(update={"root": absolute(self.root), "inputs": Inputs(**given)})
