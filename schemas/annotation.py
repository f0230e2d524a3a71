"""Data that the annotation page sends: cars labelled in raw frames."""

from pydantic import Field, PositiveFloat

from schemas.model import Model


class MarkedCar(Model):
    """A labelled car."""

    frame: str
    x_px: float = Field(allow_inf_nan=False)
    y_px: float = Field(allow_inf_nan=False)
    orientation_rad: float | None = Field(None, allow_inf_nan=False)
    """Axial, from +x towards +y (down); None where an older label does not give it."""
    length_px: PositiveFloat | None = Field(None, allow_inf_nan=False)
    width_px: PositiveFloat | None = Field(None, allow_inf_nan=False)


class Marks(Model):
    """The labels of some frames, which replace the earlier ones of these frames."""

    frames: tuple[str, ...]
    """Frames that are labelled, also those without a car."""
    cleared: tuple[str, ...] = ()
    """Frames that are no longer labelled."""
    cars: tuple[MarkedCar, ...]
