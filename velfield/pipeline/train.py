"""Training of a detector on labelled cars, without a run: `velfield train`."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from schemas.flight import FlightConfig
from velfield.detection.interface import Detector
from velfield.detection.registry import load_detector, shipped_detector, train_detector
from velfield.detection.review import collect_tp_fn_fp_crops, contact_sheet
from velfield.detection.samples import LabelledImage
from velfield.detection.scale_search import working_scale
from velfield.errors import InputError
from velfield.pipeline.stages.labels import check_label_axes, labelled_images, median_car_length_raw_px
from velfield.report.figures import png_bytes
from velfield.sources.labels.labels import Labels, read_labels
from velfield.sources.source import probe

SHIPPED = "shipped"


@dataclass(frozen=True)
class Training:
    """A detector and its training images, on the working grid."""

    detector: Detector
    samples: tuple[LabelledImage, ...]
    labels: Labels


def train_from_labels(source: Path, labels: Path, config: FlightConfig, *, continued: str | None = None) -> Training:
    """Train on the labelled frames of a video or folder of images.

    Parameters
    ----------
    source, labels
        As for ``velfield run``.
    config
        ``gsd_m`` sets the working scale where it is given, else the labels' length does.
    continued
        A detector file to continue, or ``shipped``, to fine-tune.

    Raises
    ------
    InputError
        Labels that cannot be read, of unknown size, or too few.
    """
    fps = (config.frames.fps or 1.0) if source.is_dir() else None  # training needs no timestamps
    info = probe(source, frames=config.frames.model_copy(update={"fps": fps}))
    table = read_labels(labels, info)
    samples = tuple(labelled_images(source, info, table, work_per_raw=_scale(config, table)))
    detector = train_detector(samples, config.detection, base=_base_detector(continued))
    return Training(detector, samples, table)


def _scale(config: FlightConfig, labels: Labels) -> float:
    """Working px a raw px."""
    if config.gsd_m is not None:
        return working_scale(config.detection, config.gsd_m)
    length = median_car_length_raw_px(labels.cars)
    if not np.isfinite(length):
        raise InputError("the labels have no length_px and --gsd-m is not given, expected either; give --gsd-m")
    return config.detection.working_car_length_px / length


def _base_detector(name: str | None) -> Detector | None:
    if name is None:
        return None
    return shipped_detector() if name == SHIPPED else load_detector(Path(name))


def write_training(training: Training, out: Path, review: Path | None = None) -> list[str]:
    """Write the detector file and, with ``review``, the contact sheet; returns lines for people."""
    training.detector.save(out)
    record, lines = training.detector.record, [*training.labels.notes, *check_label_axes(training.samples)]
    lines.append(
        f"{out}: {record.cars} cars, labelled frames: {len(training.samples)}, score threshold {record.threshold:.3f}"
    )
    if record.curve is not None and record.curve.operating_point is not None:
        k = record.curve.operating_point
        precision, recall = record.curve.precision[k], record.curve.recall[k]
        lines.append(f"precision {precision:.2f} at recall {recall:.2f}: {record.curve.description}")
    else:
        lines.append("too few labelled cars to hold some out, so precision and recall are unknown; label 16 or more")
    if review is not None:
        kinds = collect_tp_fn_fp_crops(training.detector, training.samples)
        review.write_bytes(png_bytes(contact_sheet(kinds)))
        counts = ", ".join(f"{len(chips)} {name}" for name, chips in kinds.items())
        lines.append(f"{review}: {counts}")
    return lines
