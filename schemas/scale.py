"""The ground sample distance by each of its sources, with an interval, and which one a run uses."""

from typing import Literal, Self

from pydantic import PositiveFloat, model_validator

from schemas.model import Model

CAR_LENGTH_M = 4.45
"""Median length of cars on the road: new cars of Europe average 4.4 m, of Korea 4.6 m."""
ScaleSource = Literal["control_points", "base", "given", "metadata", "vehicles"]
"""``control_points``: of `velfield georeference`; ``base``: the reference system of the image given as ``--base``;
``given``: ``--gsd-m``; ``metadata``: the camera's height and focal length; ``vehicles``: the lengths of cars."""


class ScaleEstimate(Model):
    """The ground sample distance by one source.

    Examples
    --------
    >>> estimate = ScaleEstimate(gsd_m=0.05, low_m=0.048, high_m=0.052, source="metadata")
    >>> estimate.text()
    '0.05 m a pixel (90 % interval 0.048 to 0.052) by the metadata'
    """

    gsd_m: PositiveFloat
    """Ground sample distance, m a base pixel."""
    low_m: PositiveFloat
    """Lower end of the 90 % interval, m a base pixel."""
    high_m: PositiveFloat
    """Upper end of the 90 % interval, m a base pixel."""
    source: ScaleSource
    note: str = ""
    """Basis of the estimate, one line."""

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if not self.low_m <= self.gsd_m <= self.high_m:
            raise ValueError(f"gsd_m {self.gsd_m:g} is not between low_m {self.low_m:g} and high_m {self.high_m:g}")
        return self

    def text(self) -> str:
        """The estimate in one line, with its interval where it has one."""
        by = f"by {_NAMES[self.source]}"
        if self.low_m == self.high_m:
            return f"{self.gsd_m:.4g} m a pixel {by}"
        return f"{self.gsd_m:.3g} m a pixel (90 % interval {self.low_m:.3g} to {self.high_m:.3g}) {by}"


_NAMES: dict[ScaleSource, str] = {
    "control_points": "the control points",
    "base": "the base image",
    "given": "--gsd-m",
    "metadata": "the metadata",
    "vehicles": "the lengths of vehicles",
}


class ScaleChoice(Model):
    """The estimate of scale that a run uses, and the others."""

    used: ScaleEstimate | None = None
    """None: no source knows the scale, and speeds stay in px/s."""
    others: tuple[ScaleEstimate, ...] = ()
    disagreements: tuple[str, ...] = ()
    """One line for each of the others whose interval does not meet that of the one that is used."""
