"""The seam between the pipeline and its detectors: the registry, detector files, what another detector needs."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal, get_args

import numpy as np
import pytest

from schemas.detector import (
    METHODS,
    BaseRecord,
    CnnRecord,
    DetectorConfig,
    DetectorRecord,
    PaperRecord,
    Rectangle,
    Round,
)
from velfield.detection.detect import detect_frame
from velfield.detection.interface import Detections, Detector
from velfield.detection.registry import (
    detector_class,
    from_record,
    load_detector,
    register,
    shipped_detector,
    train_detector,
)
from velfield.detection.samples import LabelledImage
from velfield.errors import InputError


class ToyConfig(DetectorConfig):
    method: Literal["toy"] = "toy"
    quantile: float = 0.5


class ToyRecord(BaseRecord):
    method: Literal["toy"] = "toy"


@dataclass(frozen=True)
class ToyDetector(Detector):
    """A pixel is a car where it is brighter than the threshold."""

    record: ToyRecord
    method: ClassVar[str] = "toy"

    def detect(
        self,
        image: np.ndarray,
        valid: np.ndarray | None = None,
        *,
        threshold: float | None = None,
    ) -> Detections:
        y, x = np.nonzero(image > (self.threshold if threshold is None else threshold))
        ones = np.ones(len(x))
        rows = np.column_stack([x, y, 0 * ones, image[y, x], 0.1 * ones])
        return Detections.from_rows(rows, ones)

    @classmethod
    def train(
        cls, samples: Sequence[LabelledImage], config: ToyConfig, *, base: Detector | None = None
    ) -> "ToyDetector":
        grey = np.concatenate(
            [sample.image[sample.cars[:, 1].astype(int), sample.cars[:, 0].astype(int)] for sample in samples]
        )
        threshold = float(np.quantile(grey, config.quantile)) - 1
        return cls(ToyRecord(working_car_length_px=config.working_car_length_px, threshold=threshold, cars=len(grey)))


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("velfield.detection.registry._CLASSES", {})
    register(ToyDetector)


def lit(count: int) -> LabelledImage:
    """A dark image with so many bright pixels, each labelled a car."""
    image = np.zeros((40, 60), np.uint8)
    y, x = np.unravel_index(np.linspace(45, image.size - 45, count).astype(int), image.shape)
    image[y, x] = 200
    cars = np.full((count, 5), np.nan)
    cars[:, :2] = np.column_stack([x, y])
    return LabelledImage(image=image, cars=cars)


@pytest.mark.usefixtures("toy")
def test_another_detector_is_trained_and_run_by_its_name() -> None:
    sample = lit(9)
    detector = train_detector([sample], ToyConfig())
    assert isinstance(detector, ToyDetector)
    assert detector.record.cars == 9
    found = detect_frame(sample.image, None, detector)
    assert found.xy.tolist() == sample.cars[:, :2].tolist()  # top to bottom
    assert found.chips.shape == (9, 32, 32)
    assert len(detector.detect(sample.image, threshold=250)) == 0


@pytest.mark.usefixtures("toy")
def test_too_few_labelled_cars_train_no_detector_of_any_method() -> None:
    with pytest.raises(InputError, match="7 labelled cars, 8 needed to train a detector"):
        train_detector([lit(3), lit(4)], ToyConfig())


@pytest.mark.usefixtures("toy")
def test_the_base_decides_which_method_is_trained() -> None:
    base = train_detector([lit(9)], ToyConfig())
    assert train_detector([lit(9)], ToyConfig(quantile=0.1), base=base).method == "toy"


def test_a_method_without_a_detector_is_an_input_error() -> None:
    with pytest.raises(InputError, match="found no detector 'yolo'"):
        detector_class("yolo")


@pytest.mark.parametrize("model", METHODS)
def test_every_method_of_the_configuration_has_a_detector_and_a_record(model: type[DetectorConfig]) -> None:
    method = model.model_fields["method"].default
    assert detector_class(method).method == method
    assert method in {record.model_fields["method"].default for record in get_args(get_args(DetectorRecord)[0])}


@pytest.mark.parametrize("model", METHODS)
def test_the_section_of_another_method_keeps_what_both_read(model: type[DetectorConfig]) -> None:
    section = model.model_validate({"threshold": 0.4, "working_car_length_px": 12.0, "seed": 5})
    for other in METHODS:
        method = str(other.model_fields["method"].default)
        converted = section.for_method(method)
        assert (type(converted), converted.threshold, converted.working_car_length_px, converted.seed) == (
            other,
            0.4,
            12.0,
            5,
        )


def one_round() -> Round:
    rectangle = Rectangle(sign=1, x0=-3, y0=-2, x1=3, y1=2)
    return Round(channel=0, rectangles=(rectangle,), threshold=0.5, leaf_low=-0.25, leaf_high=0.75)


def paper() -> PaperRecord:
    return PaperRecord(working_car_length_px=16, threshold=1.5, rounds=(one_round(),), grey_bits=5)


def cnn() -> CnnRecord:
    record = shipped_detector().record
    assert isinstance(record, CnnRecord)
    return record


@pytest.mark.parametrize("make", [paper, cnn])
def test_a_detector_comes_back_from_its_file(make, tmp_path: Path) -> None:
    detector, file = from_record(make()), tmp_path / "detector.json"
    detector.save(file)
    again = load_detector(file)
    assert again == detector
    assert type(again) is detector_class(again.record.method)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ("{", "this is not JSON"),
        ("[1]", "expected a detector file"),
        ('{"kind": "other"}', "the file: unable to extract tag"),
        ('{"kind": "velfield-detector", "version": 2, "method": "yolo"}', "'cnn', 'paper'"),
        ('{"kind": "velfield-detector", "version": 3, "method": "paper"}', "paper.version"),
        ('{"kind": "velfield-detector", "version": 1, "method": "paper"}', "paper.version"),
    ],
)
def test_another_file_is_one_clear_line(content: str, problem: str, tmp_path: Path) -> None:
    file = tmp_path / "detector.json"
    file.write_text(content)
    with pytest.raises(InputError, match="expected a detector file as velfield writes it") as caught:
        load_detector(file)
    assert problem in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_far_too_large_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("velfield.detection.registry.MAX_BYTES", 10)
    file = tmp_path / "detector.json"
    file.write_text("x" * 11)
    with pytest.raises(InputError, match="found 11 bytes, expected 10 at most"):
        load_detector(file)
    with pytest.raises(InputError, match="no such detector file"):
        load_detector(tmp_path / "none.json")
