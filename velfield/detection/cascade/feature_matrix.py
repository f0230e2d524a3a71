"""Values of a pool of features at samples, kept as bins: a byte each."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from schemas.arrays import ByteArray, Float32Array
from schemas.detector import Round
from velfield.detection.boosting import RectanglePool, bin_edges, binned, boost, rounds_of
from velfield.detection.cascade import kernels
from velfield.detection.cascade.feature_image import Patch, Picture, grey_areas, poses_of
from velfield.detection.cascade.scenes import Poses

_BLOCK = 2048
"""Samples measured at a time: their values, four bytes each, are soon bins."""
_EDGE_SAMPLES = 6000
_ON_SPOT = np.zeros((1, 2), np.int64)


@dataclass(frozen=True)
class Bank:
    """What is measured, and the bins that values fall in."""

    pool: RectanglePool
    contrast_floor: float
    edges: Float32Array

    def bins(self, picture: Picture, poses: Poses) -> ByteArray:
        """(features, poses) uint8."""
        parts = [
            binned(feature_values(picture, poses[start : start + _BLOCK], self.pool, self.contrast_floor), self.edges)
            for start in range(0, len(poses), _BLOCK)
        ]
        return np.concatenate(parts, axis=1) if parts else np.empty((len(self.pool), 0), np.uint8)

    def samples(self, parts: Iterable[tuple[Picture, Poses]]) -> ByteArray:
        """Several pictures' poses, side by side (features, n)."""
        return np.concatenate([self.bins(picture, poses) for picture, poses in parts], axis=1)

    def learnt(
        self,
        wanted: ByteArray,
        others: ByteArray,
        *,
        rounds: int,
        fraction: float,
        shrinkage: float,
        rng: np.random.Generator,
    ) -> tuple[Round, ...]:
        """Rounds of boosting that tell what is wanted from all else; see `boosting.boost`."""
        stumps = boost(
            np.hstack([wanted, others]),
            self.edges,
            np.arange(wanted.shape[1] + others.shape[1]) < wanted.shape[1],
            rounds=rounds,
            car_fraction=fraction,
            shrinkage=shrinkage,
            rng=rng,
        )
        return rounds_of(self.pool, stumps)


def bank_of(
    pool: RectanglePool,
    contrast_floor: float,
    parts: Sequence[tuple[Picture, Poses]],
    rng: np.random.Generator,
) -> Bank:
    """A bank whose bins hold as many of some samples each."""
    values = []
    share = min(1.0, _EDGE_SAMPLES / max(1, sum(len(poses) for _, poses in parts)))
    for picture, poses in parts:
        some = poses.where(rng.random(len(poses)) < share)
        values.append(feature_values(picture, some, pool, contrast_floor))
    return Bank(pool, contrast_floor, bin_edges(np.concatenate(values, axis=1)))


def feature_values(picture: Picture, poses: Poses, pool: RectanglePool, contrast_floor: float) -> Float32Array:
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
