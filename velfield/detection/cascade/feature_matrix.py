"""The feature matrix of a training, binned: values of a pool of features at sampled poses, a byte each."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from schemas.arrays import ByteArray, Float32Array
from schemas.detector import Round
from velfield.detection.boosting import FeaturePool, assign_bins, boost, quantile_bin_edges, rounds_from_stumps
from velfield.detection.cascade.feature_image import (
    FeatureImage,
    RotatedPatch,
    feature_values_kernel,
    pack_poses,
    signed_grey_areas,
)
from velfield.detection.cascade.rounds import LANES
from velfield.detection.cascade.scenes import Poses

_BLOCK = 2048
"""Samples evaluated at a time: their values take four bytes each until they are binned."""
_EDGE_SAMPLES = 6000
_NO_OFFSET = np.zeros((1, 2), np.int64)


@dataclass(frozen=True)
class FeatureBinner:
    """A pool of features and the edges of their bins: gives columns of the binned feature matrix."""

    pool: FeaturePool
    contrast_floor: float
    edges: Float32Array

    def bins(self, image: FeatureImage, poses: Poses) -> ByteArray:
        """(features, poses) uint8."""
        parts = [
            assign_bins(
                feature_values(image, poses[start : start + _BLOCK], self.pool, self.contrast_floor), self.edges
            )
            for start in range(0, len(poses), _BLOCK)
        ]
        return np.concatenate(parts, axis=1) if parts else np.empty((len(self.pool), 0), np.uint8)

    def bins_of_images(self, parts: Iterable[tuple[FeatureImage, Poses]]) -> ByteArray:
        """The same of several images' poses, side by side (features, n)."""
        return np.concatenate([self.bins(image, poses) for image, poses in parts], axis=1)

    def train(
        self,
        positives: ByteArray,
        negatives: ByteArray,
        *,
        rounds: int,
        fraction: float,
        shrinkage: float,
        rng: np.random.Generator,
    ) -> tuple[Round, ...]:
        """Boost a classifier on binned samples (features, n); see `boosting.boost`."""
        stumps = boost(
            np.hstack([positives, negatives]),
            self.edges,
            np.arange(positives.shape[1] + negatives.shape[1]) < positives.shape[1],
            rounds=rounds,
            car_fraction=fraction,
            shrinkage=shrinkage,
            rng=rng,
        )
        return rounds_from_stumps(self.pool, stumps)


def fit_feature_binner(
    pool: FeaturePool,
    contrast_floor: float,
    parts: Sequence[tuple[FeatureImage, Poses]],
    rng: np.random.Generator,
) -> FeatureBinner:
    """Choose the edges so that equally many of a sample of the poses fall in each bin."""
    values = []
    fraction = min(1.0, _EDGE_SAMPLES / max(1, sum(len(poses) for _, poses in parts)))
    for image, poses in parts:
        some = poses.where(rng.random(len(poses)) < fraction)
        values.append(feature_values(image, some, pool, contrast_floor))
    return FeatureBinner(pool, contrast_floor, quantile_bin_edges(np.concatenate(values, axis=1)))


def feature_values(image: FeatureImage, poses: Poses, pool: FeaturePool, contrast_floor: float) -> Float32Array:
    """Values (features, poses) of all features of a pool."""
    patch = RotatedPatch.for_offsets(_NO_OFFSET, image.channels, image.scale)
    packed = pack_poses(poses.rows[:, :2], poses.rows[:, 2], image.scale, sizes=poses.sizes, mirrored=poses.mirrored)
    out = np.empty((len(pool), len(packed), LANES), np.float32)
    feature_values_kernel(
        image.words,
        image.difference,
        image.stride,
        packed,
        contrast_floor,
        patch.window,
        patch.scale.window_area,
        patch.corners(pool.table),
        pool.table[:, 0].copy(),
        pool.starts,
        patch.planes(pool.channels),
        signed_grey_areas(pool.table, pool.starts, pool.channels),
        patch.centres(_NO_OFFSET)[0],
        patch.allocate(),
        out,
    )
    return out.reshape(len(pool), -1)[:, : len(poses)]
