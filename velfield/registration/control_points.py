"""Correspondences between a raw frame and the base image: their folds, residuals and robust weights."""

from dataclasses import dataclass

import numpy as np

from schemas.arrays import FloatArray, IntArray, Mask

FOLDS = 5
FOLD_CELL_PX = 48
"""Control points of one cell of this side share a fold: errors of neighbours are correlated."""
_INLIER_WEIGHT = 0.25
"""Smallest weight of an inlier: a residual of about 1.6 times the robust scale."""
MIN_SIGMA_PX = 0.01


@dataclass(frozen=True, eq=False)
class ControlPoints:
    """Correspondences between a raw frame and the base image."""

    xy_raw: FloatArray
    xy_base: FloatArray
    """(n, 2) px."""
    sigma_px: FloatArray
    """(n,) expected standard deviation of each; only the ratios matter."""

    def __len__(self) -> int:
        return len(self.xy_raw)

    def concatenate(self, other: "ControlPoints") -> "ControlPoints":
        """These and the others, in this order."""
        return ControlPoints(
            np.concatenate([self.xy_raw, other.xy_raw]),
            np.concatenate([self.xy_base, other.xy_base]),
            np.concatenate([self.sigma_px, other.sigma_px]),
        )

    def select(self, mask: Mask) -> "ControlPoints":
        """The control points of a mask (n,)."""
        return ControlPoints(self.xy_raw[mask], self.xy_base[mask], self.sigma_px[mask])


def rms(vectors: FloatArray) -> float:
    """Root mean square length of vectors (n, 2); NaN without any."""
    return float(np.sqrt((vectors**2).sum(axis=1).mean())) if len(vectors) else float("nan")


def assign_folds(xy_raw: FloatArray, cell_px: float = FOLD_CELL_PX) -> IntArray:
    """Fold (n,) of each raw point, by its cell alone: independent of the other points."""
    cell = np.floor(np.asarray(xy_raw) / cell_px).astype(np.int64)
    return np.asarray((cell[:, 0] * 2 + cell[:, 1]) % FOLDS)


def geman_mcclure(size: FloatArray) -> FloatArray:
    """Weights (n,) of residuals of this size; 0 of those that are not finite."""
    return np.asarray(np.where(np.isfinite(size), 1.0 / (1.0 + size * size) ** 2, 0.0))


def finite_median(size: FloatArray) -> float:
    """Of those that are finite; infinite without any."""
    finite = size[np.isfinite(size)]
    return float(np.median(finite)) if len(finite) else float("inf")


def is_inlier(weights: FloatArray) -> Mask:
    """Inliers (n,) by robust weights (n,)."""
    return np.asarray(weights >= _INLIER_WEIGHT)


def robust_scale(residuals: FloatArray, sigma: FloatArray) -> float:
    """Robust standard deviation per coordinate of residuals (n, 2) over sigma (n,), by their median."""
    return max(finite_median(np.hypot(*residuals.T) / sigma) / 1.1774, MIN_SIGMA_PX)
