"""Registration of the frames to the image given as ``--base``: scale, rotation and coverage, and their limits."""

from dataclasses import dataclass

import numpy as np

from schemas.arrays import Mask
from velfield.errors import InputError
from velfield.registration.transforms import FrameTransform
from velfield.sources.geo import BaseRaster

MIN_SCALE, MAX_SCALE = 0.5, 2.0
"""Base px per frame px: the scales that the coarse search covers and that are useful for a map."""
_TOLERANCE = 1.05
"""The scale varies over a tilted frame."""
_MIN_COVERAGE = 0.95
_GRID_SIDE = 25


@dataclass(frozen=True)
class BaseFit:
    """Registration of the flight to the given base image."""

    direct: bool
    """Whether frames are registered directly to it, not via the flight's own base image."""
    error_px: float
    """Cross-validated error of the control points, base px."""
    points: int
    """Number of control points."""
    scale: float
    rotation_rad: float
    """Base px per frame px at the centre of a frame in the middle of the flight, and the rotation there, from +x
    towards +y."""
    covered: float
    """Fraction of the area seen by the flight that the base image covers."""

    def note(self) -> str:
        """The registration in one line."""
        degrees = round(float(np.degrees(self.rotation_rad)))
        sense = "" if degrees == 0 else " cw" if degrees > 0 else " ccw"
        route = "directly to the base image" if self.direct else "to the base image via the flight's own"
        return f"frames registered {route}: scale {self.scale:.2f}, rotation {abs(degrees)}°{sense}"

    def warnings(self) -> list[str]:
        """Warnings, one line each."""
        if self.covered >= _MIN_COVERAGE:
            return []
        return [
            f"the base image covers {self.covered:.0%} of the area seen by the flight: vehicles outside it are not on "
            "the map; give a larger image, or none"
        ]


def check_scale(scale: float, given: BaseRaster, name: str) -> None:
    """Reject a base image of much lower or higher resolution than the frames.

    Raises
    ------
    InputError
        The scale is outside 0.5 to 2.
    """
    if MIN_SCALE / _TOLERANCE <= scale <= MAX_SCALE * _TOLERANCE:
        return
    height, width = given.grey.shape
    raise InputError(
        f"--base {name}: found {scale:.2g} base pixels per frame pixel, expected {MIN_SCALE:g} to {MAX_SCALE:g}; "
        f"give the image resampled to about {width / scale:.0f} x {height / scale:.0f} px"
    )


def covered_fraction(to_base: FrameTransform, visible: Mask | None, given: BaseRaster) -> float:
    """Fraction of a frame, or of its part ``visible`` (h, w), that the base image covers with valid pixels."""
    x, y = np.meshgrid(np.linspace(0, to_base.width - 1, _GRID_SIDE), np.linspace(0, to_base.height - 1, _GRID_SIDE))
    raw = np.column_stack([x.ravel(), y.ravel()])
    if visible is not None:
        raw = raw[visible[raw[:, 1].astype(np.int64), raw[:, 0].astype(np.int64)]]
    base, (height, width) = to_base.to_base(raw), given.grey.shape
    with np.errstate(invalid="ignore"):
        inside = np.asarray(((base >= 0) & (base <= [width - 1, height - 1])).all(axis=1))
    if given.valid is not None:
        column, row = base[inside].astype(np.int64).T
        inside[inside] = given.valid[row, column]
    return float(inside.mean()) if len(inside) else 0.0
