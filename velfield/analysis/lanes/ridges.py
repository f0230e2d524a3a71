"""Ridges: where paths of one direction of travel are densest across it.

The samples of all tracks are binned by position and direction, so that the cost from there on is that of the roads'
area, however many tracks there are. Each bin's centroid is moved across its direction to the weighted mean of its
neighbours (mean shift) until it lies on the ridge; then nodes are chosen along the ridges.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from schemas.arrays import FloatArray, IntArray, Mask
from velfield.analysis.trajectories import PathSamples
from velfield.compiled import kernel

BIN_M, SECTORS = 0.5, 24
"""Sides of a bin, and sectors of its direction."""
_LATERAL_M, _ALONG_M, _TURN_RAD = 0.55, 1.5, np.radians(14)
"""Standard deviations of the mean shift's kernel: across and along the direction, and of the direction."""
_ITERATIONS = 12
NODE_SPACING_M = 3.0
"""Distance between nodes along a ridge."""
_APART_M, _APART_RAD = 1.3, np.radians(32)
"""Ridges closer than this, of directions closer than this, are one."""


@dataclass(frozen=True)
class Bins:
    """Occupied bins of position and direction: sorted ``key`` (n,), centroid ``xy_m`` (n, 2), mean ``direction_rad``
    (n,), number of samples ``weight`` (n,)."""

    key: IntArray
    xy_m: FloatArray
    direction_rad: FloatArray
    weight: FloatArray


@dataclass(frozen=True)
class Nodes:
    """Points on the ridges: ``xy_m`` (n, 2), ``direction_rad`` (n,), samples near each ``weight`` (n,), and the node of
    each bin, ``of_bin`` (bins,), -1 where there is none."""

    xy_m: FloatArray
    direction_rad: FloatArray
    weight: FloatArray
    of_bin: IntArray

    def __len__(self) -> int:
        return len(self.xy_m)


def bin_keys(xy_m: FloatArray, direction_rad: FloatArray) -> IntArray:
    """One number (n,) for the bin of each sample; positions lie within 500 km of the origin."""
    x, y = (np.floor(xy_m[:, k] / BIN_M).astype(np.int64) + (1 << 20) for k in (0, 1))
    sector = np.rint(direction_rad / (2 * np.pi / SECTORS)).astype(np.int64) % SECTORS
    return np.asarray((y << 21 | x) * SECTORS + sector)


def bin_samples(samples: PathSamples, keys: IntArray) -> tuple[Bins, IntArray]:
    """The occupied bins of all samples, and the number (n,) of each sample's bin."""
    inverse, key = pd.factorize(keys, sort=True)  # by hashing: samples are many times as many as bins
    sums = [
        np.bincount(inverse, values, len(key))
        for values in (
            np.ones(len(keys)),
            samples.xy_m[:, 0],
            samples.xy_m[:, 1],
            np.cos(samples.direction_rad),
            np.sin(samples.direction_rad),
        )
    ]
    weight = sums[0]
    bins = Bins(
        np.asarray(key, np.int64),
        np.column_stack([sums[1], sums[2]]) / weight[:, None],
        np.arctan2(sums[4], sums[3]),
        np.asarray(weight, np.float64),
    )
    return bins, np.asarray(inverse, np.int64)


def find_nodes(bins: Bins, *, min_weight: float, position_sd_m: float = 0.0) -> Nodes:
    """Nodes along the ridges; those with fewer samples than ``min_weight`` within their reach are left out.

    Paths with errors are spread about their lane: the kernel, and the distance of two ridges, are wider by these.
    """
    lateral = float(np.hypot(_LATERAL_M, position_sd_m))
    xy, direction = _contract(bins, lateral)
    density = _density(xy, direction, bins)
    chosen, of_bin = _choose(xy, direction, density, _APART_M * lateral / _LATERAL_M)
    weight = np.asarray(np.bincount(of_bin, bins.weight, len(chosen)), np.float64)
    keep: Mask = weight >= min_weight
    number = np.where(keep, np.cumsum(keep) - 1, -1)
    return Nodes(xy[chosen][keep], direction[chosen][keep], weight[keep], number[of_bin])


def _contract(bins: Bins, lateral: float) -> tuple[FloatArray, FloatArray]:
    """Centroids moved onto the ridges, and the directions there."""
    tree = cKDTree(bins.xy_m)
    xy, direction = bins.xy_m.copy(), bins.direction_rad.copy()
    reach = 2.5 * max(lateral, _ALONG_M)
    pairs = tree.query_pairs(reach + 0.5, output_type="ndarray")
    turn = np.abs(np.angle(np.exp(1j * (direction[pairs[:, 0]] - direction[pairs[:, 1]]))))
    pairs = pairs[turn < 3 * _TURN_RAD]
    first, other = _adjacency(pairs, len(xy))
    for _ in range(_ITERATIONS):
        xy, direction = _shift(
            xy, direction, bins.xy_m, bins.direction_rad, bins.weight, first, other, lateral, _ALONG_M, _TURN_RAD
        )
    return xy, direction


def _adjacency(pairs: IntArray, n: int) -> tuple[IntArray, IntArray]:
    """Neighbours of each of n points, itself included: those of i are ``other[first[i]:first[i + 1]]``."""
    own = np.arange(n)
    a = np.concatenate([pairs[:, 0], pairs[:, 1], own])
    b = np.concatenate([pairs[:, 1], pairs[:, 0], own])
    order = np.argsort(a, kind="stable")
    return np.searchsorted(a[order], np.arange(n + 1)).astype(np.int64), b[order].astype(np.int64)


@kernel
def _shift(
    xy: FloatArray,
    direction: FloatArray,
    data: FloatArray,
    data_direction: FloatArray,
    weight: FloatArray,
    first: IntArray,
    other: IntArray,
    lateral: float,
    along: float,
    turn: float,
) -> tuple[FloatArray, FloatArray]:
    """One step of mean shift across the direction of each point; its direction becomes the neighbours' mean."""
    out, out_direction = xy.copy(), direction.copy()
    for i in range(len(xy)):
        c, s = np.cos(direction[i]), np.sin(direction[i])
        total = offset = cos = sin = 0.0
        for k in range(first[i], first[i + 1]):
            j = other[k]
            dx, dy = data[j, 0] - xy[i, 0], data[j, 1] - xy[i, 1]
            u, v = dx * c + dy * s, dy * c - dx * s
            da = (data_direction[j] - direction[i] + np.pi) % (2 * np.pi) - np.pi
            # along a bend the ridge leaves the tangent: compare with the arc of the neighbour's own direction
            v -= 0.5 * u * np.sin(da)
            w = weight[j] * np.exp(-0.5 * ((u / along) ** 2 + (v / lateral) ** 2 + (da / turn) ** 2))
            total += w
            offset += w * v
            cos += w * np.cos(data_direction[j])
            sin += w * np.sin(data_direction[j])
        if total > 0:
            out[i, 0] = xy[i, 0] - s * offset / total
            out[i, 1] = xy[i, 1] + c * offset / total
            out_direction[i] = np.arctan2(sin, cos)
    return out, out_direction


def _density(xy: FloatArray, direction: FloatArray, bins: Bins) -> FloatArray:
    """Samples on the ridge near each contracted point."""
    tree = cKDTree(np.column_stack([xy, 2 * np.cos(direction), 2 * np.sin(direction)]))
    pairs = tree.query_pairs(1.0, output_type="ndarray")
    out = bins.weight.copy()
    np.add.at(out, pairs[:, 0], bins.weight[pairs[:, 1]])
    np.add.at(out, pairs[:, 1], bins.weight[pairs[:, 0]])
    return out


def _choose(xy: FloatArray, direction: FloatArray, density: FloatArray, apart: float) -> tuple[IntArray, IntArray]:
    """Points that are nodes, and the number of each point's node: densest first, those near it are its."""
    tree = cKDTree(xy)
    pairs = tree.query_pairs(NODE_SPACING_M, output_type="ndarray")
    first, other = _adjacency(pairs, len(xy))
    order = np.argsort(-density, kind="stable").astype(np.int64)
    chosen, owner = _suppress(xy, direction, order, first, other, NODE_SPACING_M / 2, apart, _APART_RAD)
    return chosen, owner


@kernel
def _suppress(
    xy: FloatArray,
    direction: FloatArray,
    order: IntArray,
    first: IntArray,
    other: IntArray,
    along: float,
    apart: float,
    turn: float,
) -> tuple[IntArray, IntArray]:
    """Greedy choice of nodes; each point belongs to the node that is nearest to it along and across its direction."""
    owner = np.full(len(xy), -1, np.int64)
    best = np.full(len(xy), 1e9)
    chosen = np.empty(len(xy), np.int64)
    n = 0
    for i in order:
        if owner[i] >= 0:
            continue
        chosen[n] = i
        for k in range(first[i], first[i + 1]):
            j = other[k]
            da = abs((direction[j] - direction[i] + np.pi) % (2 * np.pi) - np.pi)
            c, s = np.cos(direction[i]), np.sin(direction[i])
            dx, dy = xy[j, 0] - xy[i, 0], xy[j, 1] - xy[i, 1]
            u, v = abs(dx * c + dy * s), abs(dy * c - dx * s)
            if da < turn and u <= along and v <= apart:
                distance = np.hypot(u / along, v / apart)
                if distance < best[j]:
                    best[j] = distance
                    owner[j] = n
        owner[i], best[i] = n, 0.0
        n += 1
    return chosen[:n].copy(), owner
