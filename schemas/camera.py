"""``camera.json``: the lens, how it was estimated, and its uncertainty."""

from typing import Annotated, Literal

from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt

from schemas.model import Model


class HarrisLensRecord(Model):
    """Harris' one-parameter radial model, r_d = r / sqrt(1 + a r^2), r in half-diagonals; ``a = 0``: pinhole model."""

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
    """Straightness of the lines under one candidate model; the cross-validated residual selects the model."""

    model: str
    parameters: tuple[float, ...]
    residual_px: float = Field(ge=0)
    """RMS distance of the edge points from their lines, raw px."""
    heldout_px: float = Field(ge=0)
    """The same, cross-validated: on lines held out of the fit."""


class OverlapEvidence(Model):
    """The multi-view estimate of the lens, from pairs of frames that see the same ground."""

    pairs: NonNegativeInt = 0
    frames: NonNegativeInt = 0
    """Frames in these pairs."""
    points: NonNegativeInt = 0
    """Matched points in them."""
    lines_a: float | None = None
    """Distortion by the plumb line, as Harris' a ..."""
    lines_a_sd: float | None = None
    """... and its standard deviation, inflated for curved kerbs."""
    a: float | None = None
    """Distortion by the multi-view estimate, as Harris' a ..."""
    a_sd: float | None = None
    """... and its standard deviation; large if the camera hovers."""
    fit_px: float | None = None
    """Residual of the multi-view fit (mean of the pairs' medians), raw px: large if the scene is not flat."""
    before_px: float | None = None
    """Residual after homographies alone with the plumb-line lens, raw px ..."""
    after_px: float | None = None
    """... and cross-validated with the multi-view lens: estimated without the frame."""
    used: bool = False
    """Whether the lens was changed by it."""
    reason: str
    """Why it was changed or not, in one line with the figures."""


class TiltEvidence(Model):
    """Perspective of the ground plane by the directions of lines: whether the camera looks down."""

    convergence_x: float
    """The horizon is where 1 + convergence . x = 0, x in half-diagonals from the image's middle ..."""
    convergence_y: float
    gain_nats: float
    """Decrease of the entropy of the lines' angles by the rectification."""
    tilt_deg: float
    """Angle to the vertical, for a focal length of 1.25 widths of the frame."""
    oblique: bool
    """Whether that is too large for a map."""


class CameraRecord(Model):
    """The lens of a flight and the evidence for it."""

    lens: LensRecord
    frame_width_px: PositiveInt
    frame_height_px: PositiveInt
    accepted: bool
    """Whether a distortion is significant; if not, the lens is the pinhole model."""
    reason: str
    """Why it was accepted or not, in one line with the figures."""
    residual_px: float | None = None
    """RMS distance of the edge points from their straight lines with the plumb-line lens, raw px."""
    residual_without_px: float | None = None
    """The same without a lens."""
    a_sd: float | None = None
    """Standard deviation of the distortion by both estimates, inflated for curved kerbs."""
    centre_sd_px: tuple[float, float] | None = None
    frames: NonNegativeInt = 0
    lines: NonNegativeInt = 0
    edge_points: NonNegativeInt = 0
    entropy_a: tuple[float, ...] = ()
    """Grid of distortions ..."""
    entropy_nats: tuple[float, ...] = ()
    """... and the entropy of the lines' angles and distances there; minimal where lines are straight."""
    candidates: tuple[ModelEvidence, ...] = ()
    tilt: TiltEvidence | None = None
    """None: too few lines."""
    overlap: OverlapEvidence | None = None
    """The multi-view estimate, and whether it refined the lens; None: ``lens.refine`` is ``never``."""
