"""The detector file: JSON with a schema, never pickle. Numbers only: no picture that it was learnt from."""

from base64 import b64decode
from typing import Annotated, Literal, Self

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, model_validator

from schemas.model import Model

DETECTOR_VERSION = 1

Coordinate = Annotated[int, Field(ge=-64, le=64)]


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
    """One round of boosting: a sum of rectangles, a threshold, and what is said below and above it."""

    channel: Literal[0, 1, 2, 3]
    """0 grey, 1 gradient along, 2 gradient across, 3 difference to the background."""
    rectangles: tuple[Rectangle, ...] = Field(min_length=1, max_length=16)
    threshold: float
    below: float
    above: float


class PrecisionRecallCurve(Model):
    """How precision falls as recall rises, on cars that were left out of training."""

    recall: tuple[float, ...] = Field(max_length=1000)
    precision: tuple[float, ...] = Field(max_length=1000)
    threshold: tuple[float, ...] = Field(max_length=1000)
    chosen: NonNegativeInt | None = None
    evidence: str


class Proposer(Model):
    """Step one of the aligned method: a coarse classifier at half the resolution, dense over place and turn."""

    rounds: tuple[Round, ...] = Field(min_length=1, max_length=500)
    least_score: float
    """Places that it likes less are not looked at again."""
    least_first_score: float
    """Places that the first rounds of step two like less are let go."""


class LayerRecord(Model):
    """A layer of the network: its weights by neighbour, channel in and channel out, then its biases."""

    shape: tuple[PositiveInt, PositiveInt, PositiveInt]
    """Neighbours looked at (1 or 9), channels in, channels out."""
    numbers: str = Field(max_length=2_000_000)
    """Base64 of little-endian half-precision floats."""

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        neighbours, into, out = self.shape
        try:
            found = len(b64decode(self.numbers, validate=True))
        except ValueError:
            raise ValueError("the numbers of a layer are not base64") from None
        if found != 2 * (neighbours * into * out + out):
            raise ValueError(f"a layer of {neighbours} x {into} x {out} with {found} bytes of numbers")
        return self


class MotionRecord(Model):
    """How much less what differs from the background needs to be liked, where a network looks at it."""

    still_grey: NonNegativeFloat
    """What stands differs by no more, mean grey levels about a find."""
    moving_grey: PositiveFloat
    """What differs by so much moves."""
    lift: NonNegativeFloat
    """What moves is liked so much more; from the one to the other it grows evenly."""

    @model_validator(mode="after")
    def _is_a_ramp(self) -> Self:
        if self.moving_grey <= self.still_grey:
            raise ValueError(f"what moves differs by {self.moving_grey:g}, what stands by {self.still_grey:g}")
        return self


class DetectorRecord(Model):
    """A trained detector."""

    kind: Literal["velfield-detector"] = "velfield-detector"
    version: Literal[1] = 1
    method: Literal["aligned", "dense", "network"]
    working_car_length_px: PositiveFloat = Field(le=200)
    """A car's length on the grid that it was learnt on."""
    rounds: tuple[Round, ...] = Field(default=(), max_length=50_000)
    network: dict[str, LayerRecord] | None = Field(default=None, max_length=100)
    """The layers of the network, by name."""
    motion: MotionRecord | None = None
    """Network: what is made of the difference to the background; none: nothing."""
    threshold: float
    grey_bits: int = Field(default=8, ge=1, le=8)
    """Dense: so many bits of the grey are looked at."""
    contrast_floor: PositiveFloat | None = None
    """Aligned: sums are divided by the mean gradient about the place plus this; none: they are taken as they are."""
    proposer: Proposer | None = None
    """Aligned: what finds the places to look at."""
    curve: PrecisionRecallCurve | None = None
    cars: NonNegativeInt = 0
    """How many marked cars it was learnt from."""
    attribution: tuple[str, ...] = Field(default=(), max_length=50)
    """Whose pictures it was learnt from, and under what licence."""

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        if self.method == "aligned" and (self.contrast_floor is None or self.proposer is None):
            raise ValueError("a detector of the aligned method needs contrast_floor and proposer")
        if self.method == "network" and self.network is None:
            raise ValueError("a detector of the network method needs network")
        if self.method != "network" and not self.rounds:
            raise ValueError(f"a detector of the {self.method} method needs rounds")
        return self


class LongVehicleRecord(Model):
    """A classifier that tells the middle of a lorry or bus from all other places along its axis, and from cars."""

    kind: Literal["velfield-long-vehicles"] = "velfield-long-vehicles"
    version: Literal[1] = 1
    working_car_length_px: PositiveFloat = Field(le=200)
    rounds: tuple[Round, ...] = Field(min_length=1, max_length=5000)
    threshold: float
    """Above it a place is the middle of something long."""
    contrast_floor: PositiveFloat
    attribution: tuple[str, ...] = Field(default=(), max_length=50)
