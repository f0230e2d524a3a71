"""Values of a pool of features at samples, kept as bins: a byte each."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from velfield.detection import aligned_kernels as kernels
from velfield.detection.boosting import Bytes, RectanglePool, bin_edges, binned
from velfield.detection.detector import BoostedSums
from velfield.detection.samples import Poses
from velfield.detection.turned import Patch, Picture, grey_areas, poses_of

Singles = NDArray[np.float32]
Floats = NDArray[np.float64]

_BLOCK = 2048
"""Samples measured at a time: their values, four bytes each, are soon bins."""
_EDGE_SAMPLES = 6000
_ON_SPOT = np.zeros((1, 2), np.int64)


@dataclass(frozen=True)
class Samples:
    """What is known of poses: bins (features, n) uint8, and margins (n,), what an earlier detector says of each."""

    bins: Bytes
    margins: Floats

    def __add__(self, other: "Samples") -> "Samples":
        return Samples(np.concatenate([self.bins, other.bins], axis=1), np.concatenate([self.margins, other.margins]))


@dataclass(frozen=True)
class Bank:
    """What is measured, and the bins that values fall in; ``prior``: the earlier detector that is continued."""

    pool: RectanglePool
    contrast_floor: float
    edges: Singles
    prior: BoostedSums | None = None

    def bins(self, picture: Picture, poses: Poses) -> Bytes:
        """(features, poses) uint8."""
        parts = [
            binned(feature_values(picture, poses[start : start + _BLOCK], self.pool, self.contrast_floor), self.edges)
            for start in range(0, len(poses), _BLOCK)
        ]
        return np.concatenate(parts, axis=1) if parts else np.empty((len(self.pool), 0), np.uint8)

    def margins(self, picture: Picture, poses: Poses) -> Floats:
        """What the earlier detector says of poses, (n,); 0 where there is none."""
        if self.prior is None:
            return np.zeros(len(poses))
        pool = RectanglePool(self.prior.rectangles, self.prior.starts, self.prior.channels)
        parts = [np.empty(0)]
        for start in range(0, len(poses), _BLOCK):
            values = feature_values(picture, poses[start : start + _BLOCK], pool, self.contrast_floor)
            above = values > self.prior.thresholds[:, None]
            said = np.where(above, self.prior.leaves[:, 1, None], self.prior.leaves[:, 0, None])
            parts.append(said.sum(axis=0, dtype=np.float64))
        return np.concatenate(parts)

    def samples(self, parts: Iterable[tuple[Picture, Poses]]) -> Samples:
        """Several pictures' poses, side by side."""
        known = [Samples(self.bins(picture, poses), self.margins(picture, poses)) for picture, poses in parts]
        return Samples(
            np.concatenate([one.bins for one in known], axis=1), np.concatenate([one.margins for one in known])
        )


def bank_of(
    pool: RectanglePool,
    contrast_floor: float,
    parts: Sequence[tuple[Picture, Poses]],
    rng: np.random.Generator,
    prior: BoostedSums | None = None,
) -> Bank:
    """A bank whose bins hold as many of some samples each."""
    values = []
    share = min(1.0, _EDGE_SAMPLES / max(1, sum(len(poses) for _, poses in parts)))
    for picture, poses in parts:
        some = poses.where(rng.random(len(poses)) < share)
        values.append(feature_values(picture, some, pool, contrast_floor))
    return Bank(pool, contrast_floor, bin_edges(np.concatenate(values, axis=1)), prior)


def feature_values(picture: Picture, poses: Poses, pool: RectanglePool, contrast_floor: float) -> Singles:
    """Values (features, poses) of all features of a pool."""
    patch = Patch.for_offsets(_ON_SPOT, picture.channels, picture.grain)
    packed = poses_of(poses.rows[:, :2], poses.rows[:, 2], picture.grain, sizes=poses.sizes, mirrored=poses.mirrored)
    out = np.empty((len(pool), len(packed), kernels.LANES), np.float32)
    kernels.feature_values(
        picture.words,
        picture.difference,
        picture.stride,
        packed,
        contrast_floor,
        patch.window,
        patch.grain.window_area,
        patch.corners(pool.table),
        pool.table[:, 0].copy(),
        pool.starts,
        patch.planes(pool.channels),
        grey_areas(pool.table, pool.starts, pool.channels),
        patch.bases(_ON_SPOT)[0],
        patch.room(),
        out,
    )
    return out.reshape(len(pool), -1)[:, : len(poses)]
