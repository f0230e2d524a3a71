"""``velfield train``: train a detector from labelled cars."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from flows.options import ConfigFile, Preset, Settings
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
    config: ConfigFile = None,
    preset: Preset = None,
    settings: Settings = (),
) -> int:
    """Train a detector from labelled cars; `velfield run --detector` takes the file.

    Parameters
    ----------
    source
        Video file, or folder of images, that the labels belong to.
    labels
        Labels: CSV, GeoJSON, YOLO, COCO, LabelMe, VIA. Every car of each labelled frame must be labelled.
    out
        Detector file to write, with its precision-recall curve on cars held out of training.
    gsd_m
        Ground sample distance of the frames, metres per pixel. Default: from the length of the labelled cars.
    continued
        Detector file to fine-tune. Default: `shipped`, the detector that comes with velfield.
    review
        PNG to write, with the detections on the labelled frames.
    """
    from velfield.pipeline.configuration import resolve_config
    from velfield.pipeline.train import train_from_labels, write_training

    resolved = resolve_config(preset=preset, file=config, settings=settings, overrides={"gsd_m": gsd_m})
    for file in (out, review):
        if file is not None and not file.parent.is_dir():
            raise InputError(f"{file}: the folder {file.parent} does not exist; create it first")
    from flows.console import Console

    stop_on_signals(resumes=False, grace_s=0.0)
    console = Console()
    console.event("train", "training on the labelled cars: up to some minutes")
    with console.stage("detector", "training", 0):
        training = train_from_labels(source, labels, resolved, continued=continued)
    print("\n".join(write_training(training, out, review)))
    return 0
