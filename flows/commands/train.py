"""``velfield train``: train a detector from labelled cars."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from flows.options import Preset, Settings
from flows.stopping import stop_on_signals
from velfield.errors import InputError


def train(
    source: Path,
    /,
    *,
    labels: Path,
    out: Path = Path("detector.json"),
    gsd_m: float | None = None,
    continued: Annotated[str | None, Parameter(name="--continue")] = None,
    review: Path | None = None,
    config: Path | None = None,
    preset: Preset | None = None,
    settings: Settings = (),
) -> int:
    """Train a detector from labelled cars; `velfield run --detector` takes the file.

    Parameters
    ----------
    source
        Video file, or folder of images, that the labels belong to.
    labels
        Marked cars: CSV, GeoJSON, YOLO, COCO, LabelMe, VIA. All cars of every frame that is named must be marked.
    out
        The detector file, with its precision-recall curve on cars left out of training.
    gsd_m
        Ground sample distance of the frames, metres a pixel. Default: from the length of the marked cars.
    continued
        A detector file to fine-tune on the labels. Default, and `shipped`: the one that ships.
    review
        PNG to write: what was taken for cars and what was not.
    config
        flight.yaml with the flight's configuration.
    preset
        Set of defaults to start from.
    settings
        `section.key=value`, any number of times.
    """
    from velfield.pipeline.configuration import resolve_config
    from velfield.pipeline.train import train_from_labels, write_training

    resolved = resolve_config(preset=preset, file=config, settings=settings, overrides={"gsd_m": gsd_m})
    for file in (out, review):
        if file is not None and not file.parent.is_dir():
            raise InputError(f"{file}: found no folder {file.parent}, expected one to write to; make it")
    from flows.console import training_progress

    stop_on_signals(resumes=False, grace_s=0.0)
    with training_progress():
        training = train_from_labels(source, labels, resolved, continued=continued)
    print("\n".join(write_training(training, out, review)))
    return 0
