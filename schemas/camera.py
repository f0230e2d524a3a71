"""``camera.json``: the lens, how it was found and how sure that is."""

from typing import Annotated, Literal

from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt

from schemas.model import Model


class HarrisLensRecord(Model):
    """Harris' one-parameter radial model, r_d = r / sqrt(1 + a r^2), r in half-diagonals; ``a = 0`` is the pin-hole."""

    kind: Literal["harris"] = "harris"
    a: float
    """Distortion; positive is barrel."""
    centre_x_px: float
    centre_y_px: float
    half_diagonal_px: PositiveFloat


class DivisionLensRecord(Model):
    """One-parameter division model, r = r_d / (1 - k r_d^2), r_d in half-diagonals."""

    kind: Literal["division"] = "division"
    k: float
    """Distortion; positive is barrel."""
    centre_x_px: float
    centre_y_px: float
    half_diagonal_px: PositiveFloat


class PolynomialLensRecord(Model):
    """Polynomial radial model, r = r_d (1 + k_1 r_d^2 + k_2 r_d^4 + ...), r_d in half-diagonals."""

    kind: Literal["polynomial"] = "polynomial"
    coefficients: Annotated[tuple[float, ...], Field(min_length=1, max_length=4)]
    """k_1, k_2, ...; positive k_1 is barrel."""
    centre_x_px: float
    centre_y_px: float
    half_diagonal_px: PositiveFloat


LensRecord = Annotated[HarrisLensRecord | DivisionLensRecord | PolynomialLensRecord, Field(discriminator="kind")]


class ModelEvidence(Model):
    """How straight one candidate model makes the lines; lines left out of the fit are what decides."""

    model: str
    parameters: tuple[float, ...]
    residual_px: float = Field(ge=0)
    """RMS distance of the edge points from their lines, raw px."""
    heldout_px: float = Field(ge=0)
    """The same on lines left out of the fit."""


class OverlapEvidence(Model):
    """What control points say of the lens: pairs of frames that see the same ground at different places."""

    pairs: NonNegativeInt = 0
    frames: NonNegativeInt = 0
    """Frames among these pairs."""
    points: NonNegativeInt = 0
    """Matches among them."""
    lines_a: float | None = None
    """Distortion by the straight lines, as Harris' a ..."""
    lines_a_sd: float | None = None
    """... and its standard deviation, kerbs that bend alike allowed for."""
    a: float | None = None
    """Distortion by the control points, as Harris' a ..."""
    a_sd: float | None = None
    """... and its standard deviation; large where the camera hangs over one place."""
    fit_px: float | None = None
    """Usual miss of the matches with all fitted, raw px: large where the ground is not flat."""
    before_px: float | None = None
    """Usual miss of a frame's matches after a homography with the lens of the lines, raw px ..."""
    after_px: float | None = None
    """... and with the control points' lens, found without that frame."""
    used: bool = False
    """Whether the lens was changed by it."""
    reason: str
    """Why it was changed or not, in one line with the numbers."""


class CameraRecord(Model):
    """The lens of a flight and the evidence for it."""

    lens: LensRecord
    frame_width_px: PositiveInt
    frame_height_px: PositiveInt
    accepted: bool
    """Whether the evidence bore a distortion out; where not, the lens is the pin-hole."""
    reason: str
    """Why it was accepted or not, in one line with the numbers."""
    residual_px: float | None = None
    """RMS distance of the edge points from their straight lines with the lens that the lines gave, raw px."""
    residual_without_px: float | None = None
    """The same with no lens."""
    a_sd: float | None = None
    """Standard deviation of the distortion by all that was heard of it, kerbs that bend alike allowed for."""
    centre_sd_px: tuple[float, float] | None = None
    frames: NonNegativeInt = 0
    lines: NonNegativeInt = 0
    edge_points: NonNegativeInt = 0
    entropy_a: tuple[float, ...] = ()
    """Distortions of the grid of starts ..."""
    entropy_nats: tuple[float, ...] = ()
    """... and the entropy of the lines' angles and distances there; least where lines are straight."""
    candidates: tuple[ModelEvidence, ...] = ()
    overlap: OverlapEvidence | None = None
    """What the control points say of the lens, and whether it was refined by them; none: they were not asked."""
