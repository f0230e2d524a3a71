"""What the annotation page sends: cars marked in raw frames."""

from pydantic import Field, PositiveFloat

from schemas.model import Model


class MarkedCar(Model):
    """A car, as it was drawn: from one end to the other."""

    frame: str
    x_px: float = Field(allow_inf_nan=False)
    y_px: float = Field(allow_inf_nan=False)
    orientation_rad: float | None = Field(None, allow_inf_nan=False)
    """Axial, from +x towards +y (down); none where an older label does not tell."""
    length_px: PositiveFloat | None = Field(None, allow_inf_nan=False)
    width_px: PositiveFloat | None = Field(None, allow_inf_nan=False)


class Marks(Model):
    """All that is marked in some frames: what the labels said of these frames before is replaced."""

    frames: tuple[str, ...]
    """Frames that are labelled, also those without a car."""
    cleared: tuple[str, ...] = ()
    """Frames that are labelled no more."""
    cars: tuple[MarkedCar, ...]
