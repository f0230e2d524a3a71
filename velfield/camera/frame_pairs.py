"""What the multi-view estimate of the lens works on: matched points of frame pairs, and the lenses that it tries."""

from dataclasses import dataclass, replace

import numpy as np

from schemas.arrays import FloatArray, IntArray, Mask
from velfield.camera.lens import HarrisLens, PolynomialLens
from velfield.camera.straighten import RadialLens


@dataclass(frozen=True)
class FramePairs:
    """Matched points of frame pairs, every pair padded to the same length."""

    frame_shape: tuple[int, int]
    """(height, width), px."""
    frames: IntArray
    """(pairs, 2), numbers of the frames i and j."""
    xy_i: FloatArray
    xy_j: FloatArray
    """(pairs, n, 2), raw px."""
    valid: Mask
    """(pairs, n) bool, false where padded."""

    def select(self, pairs: Mask) -> "FramePairs":
        """The pairs of a mask (pairs,)."""
        return FramePairs(self.frame_shape, self.frames[pairs], self.xy_i[pairs], self.xy_j[pairs], self.valid[pairs])


@dataclass(frozen=True)
class ScaledLens:
    """Lenses of one profile that differ in amount of distortion and in centre."""

    unit: RadialLens
    """The lens of amount 1; the amount is in units of Harris' a."""
    centre_sd: float
    """Prior standard deviation of the centre about that of ``unit``, half-diagonals."""

    def lens(self, shared: FloatArray) -> RadialLens:
        """The lens of (amount, centre x, centre y, ...), the centre in half-diagonals from that of ``unit``."""
        return scale_distortion(self.unit, float(shared[0]), (float(shared[1]), float(shared[2])))

    def normalise(self, xy: FloatArray) -> FloatArray:
        """Pixels (..., 2) to half-diagonals about the centre."""
        return np.asarray((xy - (self.unit.centre_x_px, self.unit.centre_y_px)) / self.unit.half_diagonal_px)

    def denormalise(self, xy: FloatArray) -> FloatArray:
        """The inverse of `normalise`."""
        return np.asarray(xy * self.unit.half_diagonal_px + (self.unit.centre_x_px, self.unit.centre_y_px))


def scale_distortion(lens: RadialLens, factor: float, shift: tuple[float, float] = (0.0, 0.0)) -> RadialLens:
    """The lens with its distortion times ``factor`` and its centre shifted by ``shift`` half-diagonals."""
    x = lens.centre_x_px + shift[0] * lens.half_diagonal_px
    y = lens.centre_y_px + shift[1] * lens.half_diagonal_px
    if isinstance(lens, HarrisLens):
        return replace(lens, a=lens.a * factor, centre_x_px=x, centre_y_px=y)
    if isinstance(lens, PolynomialLens):
        coefficients = tuple(factor * k for k in lens.coefficients)
        return replace(lens, coefficients=coefficients, centre_x_px=x, centre_y_px=y)
    return replace(lens, k=lens.k * factor, centre_x_px=x, centre_y_px=y)
