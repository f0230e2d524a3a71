"""Car detectors: for each method its section of the configuration, and its detector file.

Both are tagged unions, discriminated by ``method``: a key that the chosen method never reads is refused. Another
detector needs its two models here, added to the unions ``DetectionConfig`` (with its ``Tag``) and ``DetectorRecord``,
and its class in `velfield.detection.registry`. A detector file is JSON with a schema, never pickle; it holds numbers
only, no image that the detector was trained on.
"""

from base64 import b64decode
from typing import Annotated, Literal, Self, get_args

from pydantic import (
    Discriminator,
    Field,
    FiniteFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    Tag,
    field_validator,
    model_validator,
)

from schemas.model import Model
from schemas.scale import CAR_LENGTH_M

Coordinate = Annotated[int, Field(ge=-64, le=64)]


# The configuration: the section ``detection`` of flight.yaml.


class DetectorConfig(Model):
    """How cars are detected (paper: car detection): the keys that every method reads."""

    method: str
    """The detector: ``cnn``, a convolutional network, pre-trained and fine-tuned on the flight; ``paper``, the
    paper's dense response, which needs labels."""
    threshold: float | None = None
    """Score threshold; none: chosen in training and stored with the detector."""
    working_car_length_px: PositiveFloat = 16.0
    """Frames are rescaled so that a car is about this long: 8 x 16 px at the paper's 0.23 m a pixel."""
    car_length_m: PositiveFloat = CAR_LENGTH_M
    """Length of a usual car, which with the ground sample distance sets the working scale."""
    seed: int = Field(0, ge=0)
    """Seed of all random numbers of the training."""
    full_frame_every: PositiveInt = 8
    """Every n-th frame is searched whole; those after it where they differ from it, and its detections are kept
    elsewhere. 1: every frame is searched whole."""

    def for_method(self, method: str) -> "DetectorConfig":
        """The section of another method: the keys that both read, and those that this section nests under its name."""
        if method == self.method:
            return self
        (target,) = (model for model in METHODS if model.model_fields["method"].default == method)
        shared = next(base for base in type(self).__mro__ if base in target.__mro__ and issubclass(base, Model))
        values = {name: getattr(self, name) for name in shared.model_fields if name != "method"}
        nested = getattr(self, method, None)
        return target.model_validate(values | (nested.model_dump() if isinstance(nested, Model) else {}))


class CnnConfig(DetectorConfig):
    """How cars are detected (paper: car detection), here by the convolutional network."""

    method: Literal["cnn"] = "cnn"
    fine_tune_steps: PositiveInt = 250
    """Optimiser steps of the fine-tuning on labelled cars."""
    precision: Literal["int8", "float32"] = "int8"
    """Numbers that the network is run with on a processor; a GPU always takes ``float32``."""


class PaperConfig(DetectorConfig):
    """How cars are detected (paper: car detection), here as the paper does."""

    method: Literal["paper"] = "paper"
    full_frame_every: PositiveInt = 1
    """As published: every frame is searched whole."""
    rounds: PositiveInt = 200
    """Rounds of AdaBoost. Paper: 200."""
    feature_pool: PositiveInt = 1000
    """Random features that a round chooses from."""
    max_rectangles: PositiveInt = 5
    """1 to this many positive, and as many negative, rectangles a feature. Paper: 5."""
    corner_sigma_px: PositiveFloat = 10.0
    """Standard deviation of the rectangles' corners, working px. Paper: 10."""
    car_radius_px: PositiveFloat = 6.0
    """Pixels nearer than this to a car's centre are positive samples. Paper: 6."""
    background_radius_px: PositiveFloat = 20.0
    """Pixels farther than this from every car are negative samples. Paper: 20."""
    car_fraction: PositiveFloat = Field(0.15, lt=1)
    """Fraction of positive samples. Paper: 15 %."""
    response_sigma_px: PositiveFloat = 3.0
    """Gaussian blur of the response before its maxima are taken. Paper: 3."""
    min_region_px: PositiveInt = 10
    """Regions smaller than this are dropped. Paper: 10."""


def _read_method(section: object) -> object:
    if isinstance(section, dict):
        return section.get("method", CnnConfig.model_fields["method"].default)
    return getattr(section, "method", None)


DetectionConfig = Annotated[
    Annotated[CnnConfig, Tag("cnn")] | Annotated[PaperConfig, Tag("paper")],
    Discriminator(_read_method),
]
"""The section of the chosen method; without ``method``, that of the network."""

METHODS: tuple[type[DetectorConfig], ...] = tuple(get_args(one)[0] for one in get_args(get_args(DetectionConfig)[0]))


# The detector file.


class Rectangle(Model):
    """A signed rectangle of a feature: whole working px from the centre, half-open."""

    sign: Literal[-1, 1]
    x0: Coordinate
    y0: Coordinate
    x1: Coordinate
    y1: Coordinate

    @model_validator(mode="after")
    def _has_an_area(self) -> Self:
        if self.x1 <= self.x0 or self.y1 <= self.y0:
            raise ValueError(f"rectangle from ({self.x0}, {self.y0}) to ({self.x1}, {self.y1}) has no area")
        return self


class Round(Model):
    """One round of boosting, a decision stump: a feature, which is a sum of rectangles, its threshold, two leaves."""

    channel: Literal[0, 1, 2]
    """0 grey, 1 gradient along the axis, 2 gradient across it."""
    rectangles: tuple[Rectangle, ...] = Field(min_length=1, max_length=16)
    threshold: float
    leaf_low: float
    """Added to the score where the feature is at most the threshold ..."""
    leaf_high: float
    """... and where it is above."""


class PrecisionRecallCurve(Model):
    """Precision and recall against the score threshold, on cars held out of training."""

    recall: tuple[float, ...] = Field(max_length=1000)
    precision: tuple[float, ...] = Field(max_length=1000)
    threshold: tuple[float, ...] = Field((), max_length=1000)
    """None in the reports of versions before 1.2."""
    operating_point: NonNegativeInt | None = None
    """Index of the chosen threshold."""
    description: str
    """Which cars it was measured on."""


class BaseRecord(Model):
    """Content that every detector file has in common."""

    kind: Literal["velfield-detector"] = "velfield-detector"
    version: Literal[2] = 2
    method: str
    working_car_length_px: PositiveFloat = Field(le=200)
    """Length of a car on the grid that it was trained on."""
    threshold: float
    """Score threshold."""
    curve: PrecisionRecallCurve | None = None
    cars: NonNegativeInt = 0
    """How many labelled cars it was trained on."""
    attribution: tuple[str, ...] = Field(default=(), max_length=50)
    """Whose images it was trained on, and under what licence."""


class CnnRecord(BaseRecord):
    """A trained convolutional network."""

    method: Literal["cnn"] = "cnn"
    onnx: str = Field(max_length=8_000_000)
    """The network as an ONNX model, base64."""
    activation_ranges: dict[str, tuple[FiniteFloat, FiniteFloat]] | None = Field(default=None, max_length=100)
    """Least and largest value of the network's activations, on images of the flight; none: it is run in float32."""
    gamma: float | None = Field(default=None, gt=0.0, le=1.0)
    """Exponent by which images of the flight are brightened; none: each image by its own."""

    @field_validator("onnx")
    @classmethod
    def _is_base64(cls, onnx: str) -> str:
        try:
            b64decode(onnx, validate=True)
        except ValueError:
            raise ValueError("the network is not base64") from None
        return onnx


class PaperRecord(BaseRecord):
    """The paper's trained classifier."""

    method: Literal["paper"] = "paper"
    rounds: tuple[Round, ...] = Field(min_length=1, max_length=50_000)
    grey_bits: int = Field(default=8, ge=1, le=8)
    """Number of most significant bits of the grey levels that are used."""
    response_sigma_px: PositiveFloat = 3.0
    """Gaussian blur of the response before its maxima are taken."""
    min_region_px: PositiveInt = 10
    """Regions smaller than this are dropped."""


OnnxLayout = Literal["boxes", "oriented_boxes", "boxes_with_objectness", "end_to_end", "end_to_end_oriented"]
"""Output of a YOLO-type network for an image: ``boxes``, (4 + classes, n) as of YOLOv8 and later; ``oriented_boxes``,
the same and an angle; ``boxes_with_objectness``, (n, 5 + classes) as of YOLOv5; ``end_to_end``, (n, 6) corners, score
and class, duplicates suppressed; ``end_to_end_oriented``, (n, 7) centre, size, score, class and angle."""


class OnnxDescription(Model):
    """The YAML beside an ONNX model; what it leaves out is read from the model's metadata (Ultralytics)."""

    layout: OnnxLayout | None = None
    classes: tuple[str, ...] = ()
    """Names of the classes, in their order."""
    vehicles: tuple[int, ...] | None = None
    """Numbers of the classes that are vehicles."""
    image_size_px: PositiveInt | None = Field(None, ge=32, le=8192)
    """Side of the network's input, where the model leaves it open."""
    threshold: float | None = Field(None, ge=0, lt=1)
    """Score threshold."""


class OnnxRecord(BaseRecord):
    """Another maker's network, in an ONNX file that stays where it is."""

    method: Literal["onnx"] = "onnx"
    path: str
    """The ONNX file; workers must reach it as they reach the video."""
    digest: str
    layout: OnnxLayout
    classes: tuple[str, ...] = ()
    vehicles: tuple[int, ...] = Field(min_length=1)
    tile_px: tuple[PositiveInt, PositiveInt]
    """Width and height of the network's input."""


DetectorRecord = Annotated[CnnRecord | PaperRecord | OnnxRecord, Field(discriminator="method")]
