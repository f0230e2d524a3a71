"""How a flight lies on the picture given as ``--base``: whether its scale serves, what is told of it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from velfield.errors import InputError
from velfield.registration.transforms import FrameTransform
from velfield.sources.geo import BaseRaster

LEAST_SCALE, MOST_SCALE = 0.5, 2.0
"""Base px a frame px: the scales that the search for the place covers, and that the map is worth making at."""
_SLACK = 1.05
"""The scale of a tilted frame differs over it."""
_SAME_SCALE = 0.1
"""Scales farther from 1 than this let metres a pixel of the base picture be mistaken for the frames'."""
_COVERED = 0.95
_SIDE = 25


@dataclass(frozen=True)
class BaseFit:
    """How the flight lies on the given picture.

    Attributes
    ----------
    straight : whether frames are registered straight to it, not by way of the flight's own base image.
    error_px : distance of points left out of the fit, base px.
    points : how many of them.
    scale, rotation_rad : base px a frame px in the middle of a frame in the midst of the flight, and the turn there,
        from +x towards +y.
    covered : share of what the flight shows that the picture does.
    """

    straight: bool
    error_px: float
    points: int
    scale: float
    rotation_rad: float
    covered: float

    def note(self, given_gsd_m: float | None) -> str:
        """Where it lies, in one line; ``given_gsd_m``: ``--gsd-m`` where it alone tells the scale of the map."""
        turn = round(float(np.degrees(self.rotation_rad)))
        sense = "" if turn == 0 else ", clockwise" if turn > 0 else ", anticlockwise"
        route = "straight" if self.straight else "by way of the flight's own base image"
        told = (
            f"frames are registered to it {route}: a frame pixel is about {self.scale:.2f} base pixels, "
            f"turned by about {abs(turn)} degrees{sense}"
        )
        if given_gsd_m is not None and abs(np.log(self.scale)) > _SAME_SCALE:
            of_frame = f"a frame pixel is {given_gsd_m * self.scale:.3g} m"
            told += f"; --gsd-m {given_gsd_m:g} is of the base pixels, so that {of_frame}"
        return told

    def warnings(self) -> list[str]:
        """What is to be minded of it."""
        if self.covered >= _COVERED:
            return []
        return [
            f"the base picture shows {self.covered:.0%} of what the flight does: vehicles beyond it are not on the "
            "map; give a larger picture, or none"
        ]


def check_scale(scale: float, given: BaseRaster, name: str) -> None:
    """Refuse a picture of the place that is much coarser or finer than the frames.

    Raises
    ------
    InputError
        The scale is beyond 0.5 to 2.
    """
    if LEAST_SCALE / _SLACK <= scale <= MOST_SCALE * _SLACK:
        return
    height, width = given.grey.shape
    raise InputError(
        f"--base {name}: found {scale:.2g} base pixels a frame pixel, expected {LEAST_SCALE:g} to {MOST_SCALE:g}; "
        f"give the picture resampled to about {width / scale:.0f} x {height / scale:.0f} px"
    )


def covered_share(to_base: FrameTransform, shown: NDArray[np.bool_] | None, given: BaseRaster) -> float:
    """Share of a frame, or of its part ``shown`` (h, w), that lies on the given picture where that has data."""
    x, y = np.meshgrid(np.linspace(0, to_base.width - 1, _SIDE), np.linspace(0, to_base.height - 1, _SIDE))
    raw = np.column_stack([x.ravel(), y.ravel()])
    if shown is not None:
        raw = raw[shown[raw[:, 1].astype(np.int64), raw[:, 0].astype(np.int64)]]
    base, (height, width) = to_base.to_base(raw), given.grey.shape
    with np.errstate(invalid="ignore"):
        inside = np.asarray(((base >= 0) & (base <= [width - 1, height - 1])).all(axis=1))
    if given.valid is not None:
        column, row = base[inside].astype(np.int64).T
        inside[inside] = given.valid[row, column]
    return float(inside.mean()) if len(inside) else 0.0
