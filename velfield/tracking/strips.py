"""Strips of vehicles along their axes, summed by track, and the sizes of their detections: dimensions, and the grey
level in the middle."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from schemas.arrays import ByteArray, Float32Array, FloatArray, IntArray
from velfield.tracking.dimensions import STRIP_SHAPE, direction_of_axes, mean_dimensions


@dataclass(frozen=True)
class StripSums:
    """Sums of the strips of each chain of tracklets, and their numbers: spread over it, at its start, at its end.

    ``total`` (3, chains, 32, 10), ``count`` (3, chains); ``ids`` (chains,). ``sizes`` (n, 4) of the detections that are
    spread over the chains, base px, as of `mean_dimensions`, and the ``chain`` (n,) of each, its index.
    """

    ids: IntArray
    total: Float32Array
    count: IntArray
    sizes: FloatArray
    chain: IntArray

    def mean(self, which: int) -> FloatArray:
        """(chains, 32, 10); NaN where there are none."""
        count = np.where(self.count[which], self.count[which], np.nan)[:, None, None]
        return np.asarray(self.total[which] / count)


def along_headings(strips: ByteArray, axis_rad: FloatArray, heading_rad: FloatArray) -> Float32Array:
    """Strips (n, length, width), turned along their vehicles' headings (n,)."""
    backward = direction_of_axes(axis_rad, heading_rad)
    found = np.asarray(strips, np.float32)
    found[backward] = found[backward, ::-1, ::-1]
    return found


def measure_tracks(strips: StripSums, tracks: IntArray) -> pd.DataFrame:
    """Dimensions by track (`DIMENSION_COLUMNS`), by the detections of all chains of each; ``tracks`` (chains,)."""
    ids, track = np.unique(tracks, return_inverse=True)
    found = mean_dimensions(strips.sizes, track[strips.chain], len(ids))
    size, sd = found[:, :2], found[:, :2] * found[:, 2:4]
    columns = {"length_px": size[:, 0], "length_sd_px": sd[:, 0], "width_px": size[:, 1], "width_sd_px": sd[:, 1]}
    table = pd.DataFrame({"track_id": ids, **columns, "strips": found[:, 4].astype(np.int64)})
    return table[table["strips"] > 0].reset_index(drop=True)


def mean_grey(strips: StripSums, tracks: IntArray) -> pd.Series:
    """Mean grey level of the vehicle by track, from the middle of the strips of all chains of each; ``tracks``
    (chains,)."""
    along, across = STRIP_SHAPE[0] // 2, STRIP_SHAPE[1] // 2
    middle = strips.total[0][:, along - 2 : along + 2, across - 1 : across + 1].mean(axis=(1, 2))
    sums = pd.DataFrame({"grey": middle, "count": strips.count[0]}).groupby(tracks).sum()
    return sums["grey"] / sums["count"].replace(0, np.nan)


def certain_length(strips: StripSums) -> FloatArray:
    """(chains,) base px: the mean less a standard deviation; NaN where unknown."""
    found = mean_dimensions(strips.sizes, strips.chain, len(strips.ids))
    return np.asarray(found[:, 0] * (1 - found[:, 2]))
