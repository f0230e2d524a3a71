"""What every car detector offers, and the registry of detectors by name of their method.

A detector is trained on labelled images (`Detector.train`), detects cars on images in base orientation, rescaled to a
car's usual length (`Detector.detect`), and is a record that goes into a JSON file (`Detector.save`) and comes back
(`load_detector`); one ships (`shipped_detector`).

Another one is a package ``velfield/detection/<method>`` whose module ``detector`` names its class ``DETECTOR``, and in
`schemas.detector` its configuration and its record, added to the unions ``DetectionConfig`` (with its ``Tag``) and
``DetectorRecord``.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from pydantic import TypeAdapter, ValidationError

from schemas.arrays import FloatArray, GreyImage, IntArray, Mask
from schemas.detector import (
    METHODS,
    RECORDS,
    BaseRecord,
    DetectorConfig,
    DetectorRecord,
    PrecisionRecallCurve,
)
from velfield.detection.frame import SearchableFrame
from velfield.errors import InputError, parse_json

if TYPE_CHECKING:
    import pandas as pd

    from velfield.detection.samples import LabelledImage

MIN_CARS = 8
"""Fewer labelled cars than this do not train a detector."""


@dataclass(frozen=True)
class Detections:
    """Cars of an image, in no order.

    Attributes
    ----------
    xy : (n, 2) float64, working px.
    orientation_rad : (n,) axial, [0, pi), from +x towards +y (down).
    orientation_sd_rad : (n,) its standard deviation.
    area_px : (n,) working px^2.
    score : (n,) above the score threshold.
    """

    xy: FloatArray
    orientation_rad: FloatArray
    orientation_sd_rad: FloatArray
    area_px: FloatArray
    score: FloatArray

    @classmethod
    def from_rows(cls, rows: FloatArray, area_px: FloatArray) -> "Detections":
        """Of rows (n, 5): x, y, axis, score, standard deviation of the axis; and areas (n,)."""
        return cls(rows[:, :2], rows[:, 2], rows[:, 4], area_px, rows[:, 3])

    def to_rows(self) -> FloatArray:
        """Rows (n, 6): those of `from_rows`, and the area."""
        rows = np.empty((len(self), 6))
        self._fill(rows)
        return rows

    def _fill(self, rows: FloatArray) -> None:
        rows[:, :2], rows[:, 2], rows[:, 3] = self.xy, self.orientation_rad, self.score
        rows[:, 4], rows[:, 5] = self.orientation_sd_rad, self.area_px

    def take(self, rows: IntArray) -> "Detections":
        """Some of them, in the order given."""
        of_axis = self.orientation_rad[rows], self.orientation_sd_rad[rows]
        return Detections(self.xy[rows], *of_axis, self.area_px[rows], self.score[rows])

    def shifted(self, x: float, y: float) -> "Detections":
        """Of a crop whose corner lies there, on the grid of the image."""
        return replace(self, xy=self.xy + np.array([x, y]))

    def __len__(self) -> int:
        return len(self.score)


def concatenate(parts: Sequence[Detections]) -> Detections:
    """All of several parts, in their order."""
    rows, start = np.empty((sum(map(len, parts)), 6)), 0
    for part in parts:
        part._fill(rows[start : start + len(part)])
        start += len(part)
    return Detections.from_rows(rows[:, :5], rows[:, 5])


@dataclass(frozen=True)
class Detector(ABC):
    """A trained detector; each method has a class of its own, which narrows `record`."""

    record: BaseRecord
    method: ClassVar[str]
    reads_raw_frames: ClassVar[bool] = False
    """Whether it is run on raw frames (`detect_raw`), at their own resolution, and not on the working grid."""
    context_px: ClassVar[int] = 32
    """What it reads around a car to find it, working px on every side: the margin of a crop."""
    box_cost_px: ClassVar[int] = 4000
    """Fixed cost of searching one more crop, as an area."""

    @abstractmethod
    def detect(
        self,
        image: GreyImage,
        valid: Mask | None = None,
        *,
        threshold: float | None = None,
    ) -> Detections:
        """Detect cars.

        Parameters
        ----------
        image
            (h, w) uint8 on the working grid.
        valid
            (h, w): where the frame covers it; none: everywhere.
        threshold
            Score threshold in place of the detector's own.
        """

    def find(
        self,
        image: GreyImage,
        valid: Mask | None = None,
        *,
        threshold: float | None = None,
    ) -> Detections:
        """Candidates of a crop that has `context_px` on every side: what `refine` makes the detections of."""
        return self.detect(image, valid, threshold=threshold)

    def find_in_crops(
        self,
        image: GreyImage,
        valid: Mask | None,
        crops: IntArray,
        *,
        threshold: float | None = None,
    ) -> Detections:
        """Candidates of an image of crops side by side, each of which has `context_px` on every side.

        Each crop is taken by itself; a detector may do better where that changes nothing.

        Parameters
        ----------
        crops
            (n, 4) first row, first column, height and width.
        """
        found = []
        for row, column, height, width in crops.tolist():
            part = np.s_[row : row + height, column : column + width]
            covered = None if valid is None else valid[part]
            found.append(self.find(image[part], covered, threshold=threshold).shifted(column, row))
        return concatenate(found)

    def detect_raw(self, grey: GreyImage, *, threshold: float | None = None) -> "pd.DataFrame":
        """Boxes of cars in a raw frame, of a detector that `reads_raw_frames`.

        Returns
        -------
        The columns of `velfield.sources.labels.labels.RAW_DETECTION_COLUMNS` from ``x_px`` on.
        """
        raise NotImplementedError

    def refine(self, frame: SearchableFrame, found: Detections, kept: Detections | None = None) -> Detections:
        """Detections of a whole frame from the candidates of its parts.

        Parameters
        ----------
        kept
            Detections that an earlier call gave, which stay unless a candidate is better.
        """
        return found if kept is None else concatenate([found, kept])

    @classmethod
    @abstractmethod
    def train(cls, samples: Sequence["LabelledImage"], config: Any, *, base: "Detector | None" = None) -> "Detector":
        """Train on labelled images.

        Parameters
        ----------
        config
            The section of this method.
        base
            An earlier detector of this method to continue, where the method can.

        Raises
        ------
        InputError
            ``base`` cannot be continued.
        """

    @property
    def threshold(self) -> float:
        """Score threshold."""
        return self.record.threshold

    @property
    def curve(self) -> PrecisionRecallCurve | None:
        """Precision and recall on cars held out of training."""
        return self.record.curve

    @property
    def weak_margin(self) -> float:
        """How far below the threshold a candidate's score may be that a track can confirm; 0: there are none."""
        return 0.0

    def with_threshold(self, threshold: float, curve: PrecisionRecallCurve | None) -> Self:
        """The detector with another score threshold, and the curve that it was chosen on."""
        return type(self)(self.record.model_copy(update={"threshold": threshold, "curve": curve}))

    def check_car_length(self, expected_px: float) -> None:
        """Raise InputError where it was trained on cars of another length than this, working px."""
        length_px = self.record.working_car_length_px
        if length_px != expected_px:
            raise InputError(
                f"found a detector of cars of {length_px:g} px to continue, expected {expected_px:g} px; "
                "set detection.working_car_length_px"
            )

    def for_flight(self, images: Sequence[GreyImage], config: Any) -> "Detector":
        """The detector, adjusted to images (h, w) of the flight on the working grid, where it can be; ``config`` is the
        section of its method, or of another."""
        return self

    @property
    def notes(self) -> list[str]:
        """What was assumed of the detector's file, one line each."""
        return []

    @property
    def limitations(self) -> list[str]:
        """What this machine cannot do of what the detector is set to do, one line each."""
        return []

    def to_json(self) -> str:
        """The content of its file."""
        return self.record.model_dump_json()

    def save(self, path: Path) -> None:
        """Write a detector file."""
        path.write_text(self.to_json(), encoding="utf-8")


_CLASSES: dict[str, type[Detector]] = {}


def register(detector: type[Detector]) -> None:
    """Let a class be known by its method, besides those that lie in ``velfield/detection/<method>``.

    This alone does not make a method configurable: ``detection.method`` takes those of the union ``DetectionConfig``.
    """
    _CLASSES[detector.method] = detector


def detector_class(method: str) -> type[Detector]:
    """The class of a method, imported when it is first asked for: some take a second."""
    if method not in _CLASSES:
        if method not in {model.model_fields["method"].default for model in (*METHODS, *RECORDS)}:
            raise InputError(f"found no detector {method!r}; expected one that is registered")
        register(import_module(f"velfield.detection.{method}.detector").DETECTOR)
    return _CLASSES[method]


def from_record(record: BaseRecord) -> Detector:
    """The detector of a record."""
    return detector_class(record.method)(record)


def train_detector(
    samples: Sequence["LabelledImage"], config: DetectorConfig, *, base: Detector | None = None
) -> Detector:
    """Train a detector on labelled images (paper: car detection).

    Parameters
    ----------
    config
        Its ``method`` chooses the detector.
    base
        An earlier detector to continue: its method is trained, whatever the configuration's.

    Raises
    ------
    InputError
        Too few cars; a base that cannot be continued.
    """
    count = sum(len(sample.cars) for sample in samples)
    if count < MIN_CARS:
        raise InputError(f"{count} labelled cars, {MIN_CARS} needed to train a detector; label the cars of one frame")
    method = config.method if base is None else base.method
    return detector_class(method).train(samples, config.for_method(method), base=base)


MAX_BYTES = 20_000_000
_SHIPPED = "shipped_detector.json"
_RECORD: TypeAdapter[DetectorRecord] = TypeAdapter(DetectorRecord)


ONNX_SUFFIX = ".onnx"
"""Of another maker's network: see `velfield.detection.onnx`."""
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
"""Those that the trainers of such networks write, and that are not read."""


def load_detector(path: Path) -> Detector:
    """Read a detector file, or another maker's ONNX model; a warning where it is of an old format.

    Raises
    ------
    InputError
        No such file, too large, not a detector file, or a number out of range.
    """
    if not path.is_file():
        raise InputError(
            f"{path}: found {'a folder' if path.is_dir() else 'no such detector file'}, expected a file: one that "
            "`velfield train` wrote, or an ONNX model; give its path, or leave the option out"
        )
    if path.suffix.lower() == ONNX_SUFFIX:
        from velfield.detection.onnx.detector import OnnxDetector

        return OnnxDetector.from_file(path)
    if path.suffix.lower() in _OTHER_FORMATS:
        raise InputError(
            f"{path}: found a model as {path.suffix}, expected .onnx (or a detector.json); export it as ONNX "
            "(docs/detection.md#another-detector)"
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
        content = parse_json(data)
        return from_record(_RECORD.validate_python(content))
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
