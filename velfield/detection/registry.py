"""Detectors by the name of their method: training one, reading its file, and the one that ships.

Another one is a module that names its class ``DETECTOR``, listed here, and in `schemas.detector` its configuration and
its record, added to the unions ``DetectionConfig`` (with its ``Tag``) and ``DetectorRecord``.
"""

from collections.abc import Sequence
from importlib import import_module
from importlib.resources import files
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from schemas.detector import BaseRecord, DetectorConfig, DetectorRecord
from velfield.detection.interface import Detector
from velfield.detection.samples import LabelledImage
from velfield.errors import InputError, parse_json

MIN_CARS = 8
"""Fewer labelled cars than this do not train a detector."""

_MODULES = {
    "cnn": "velfield.detection.cnn.detector",
    "onnx": "velfield.detection.onnx.detector",
    "paper": "velfield.paper.detector",
}
"""Where the class of each method is, as ``DETECTOR``."""
_CLASSES: dict[str, type[Detector]] = {}


def register(detector: type[Detector]) -> None:
    """Let a class be known by its method, besides those of velfield itself.

    This alone does not make a method configurable: ``detection.method`` takes those of the union ``DetectionConfig``.
    """
    _CLASSES[detector.method] = detector


def detector_class(method: str) -> type[Detector]:
    """The class of a method, imported when it is first asked for: some take a second."""
    if method not in _CLASSES:
        if method not in _MODULES:
            raise InputError(f"found no detector {method!r}; expected one that is registered")
        register(import_module(_MODULES[method]).DETECTOR)
    return _CLASSES[method]


def from_record(record: BaseRecord) -> Detector:
    """The detector of a record."""
    return detector_class(record.method)(record)


def train_detector(
    samples: Sequence[LabelledImage], config: DetectorConfig, *, base: Detector | None = None
) -> Detector:
    """Train a detector on labelled images (paper: car detection).

    Parameters
    ----------
    config
        Its ``method`` chooses the detector.
    base
        An earlier detector to continue: its method is trained, whatever the configuration's. By default the one that
        ships, where it is of the configuration's method.

    Raises
    ------
    InputError
        Too few cars; a base that cannot be continued.
    """
    count = sum(len(sample.cars) for sample in samples)
    if count < MIN_CARS:
        raise InputError(f"{count} labelled cars, {MIN_CARS} needed to train a detector; label the cars of one frame")
    method = config.method if base is None else base.method
    if base is None and method == (shipped := shipped_detector()).method:
        base = shipped
    return detector_class(method).train(samples, config.for_method(method), base=base)


MAX_BYTES = 20_000_000
_SHIPPED = "shipped_detector.json"
_RECORD: TypeAdapter[DetectorRecord] = TypeAdapter(DetectorRecord)


ONNX_SUFFIX = ".onnx"
"""Suffix of another program's network: see `velfield.detection.onnx`."""
_OTHER_FORMATS = (
    ".pt",
    ".pth",
    ".torchscript",
    ".engine",
    ".tflite",
    ".pb",
    ".h5",
    ".keras",
    ".mlmodel",
    ".safetensors",
)
"""Suffixes of files that the trainers of such networks write, and that cannot be read."""


def load_detector(path: Path) -> Detector:
    """Read a detector file, or another maker's ONNX model.

    Raises
    ------
    InputError
        No such file, too large, not a detector file, or a number out of range.
    """
    if not path.is_file():
        raise InputError(
            f"{path}: found {'a folder' if path.is_dir() else 'no such detector file'}, expected a file: one that "
            "`velfield train` wrote, or an ONNX model; give its path, or omit the option"
        )
    if path.suffix.lower() == ONNX_SUFFIX:
        from velfield.detection.onnx.detector import OnnxDetector

        return OnnxDetector.from_file(path)
    if path.suffix.lower() in _OTHER_FORMATS:
        raise InputError(
            f"{path}: found a model as {path.suffix}, expected .onnx (or a detector.json); export it as ONNX "
            "(documentation: Another detector)"
        )
    if path.stat().st_size > MAX_BYTES:
        raise InputError(
            f"{path}: found {path.stat().st_size} bytes, expected {MAX_BYTES} at most; give a detector file as "
            "`velfield train` writes it"
        )
    return _parse(path.read_bytes(), str(path))


def shipped_detector() -> Detector:
    """The pre-trained detector that comes with velfield."""
    return _parse(files("velfield.detection").joinpath(_SHIPPED).read_bytes(), _SHIPPED)


def _parse(data: bytes, name: str) -> Detector:
    try:
        return from_record(_RECORD.validate_python(parse_json(data)))
    except (ValueError, ValidationError) as error:
        raise InputError(
            f"{name}: {_problem(error)}; expected a detector file as velfield writes it (detector.json): "
            "make one with `velfield train`"
        ) from None


def _problem(error: ValueError) -> str:
    if not isinstance(error, ValidationError):
        return "this is not JSON"
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"]) or "the file"
    return f"{where}: {first['msg'].lower()}"
