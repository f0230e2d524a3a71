"""Strips of vehicles along their axes, summed by track: dimensions, and the grey level in the middle."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from schemas.arrays import ByteArray, Float32Array, FloatArray, IntArray
from velfield.tracking.dimensions import STRIP_SHAPE, direction_of_axes, measure


@dataclass(frozen=True)
class StripSums:
    """Sums of the strips of each chain of tracklets, and their numbers: spread over it, at its start, at its end.

    ``total`` (3, chains, 32, 10), ``count`` (3, chains); ``ids`` (chains,); ``scale``, working px a base px.
    """

    ids: IntArray
    total: Float32Array
    count: IntArray
    scale: float

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


@dataclass(frozen=True)
class TrackImages:
    """Appearance of tracks, as far as known without reading frames.

    ``ids`` (tracks,); ``strips`` (tracks, 32, 10), the means of ``count`` (tracks,) strips; ``scale``, working px
    a base px.
    """

    ids: IntArray
    strips: FloatArray
    count: IntArray
    scale: float


def images_of_tracks(strips: StripSums, tracks: IntArray) -> TrackImages:
    """Mean strips by track, of all chains of each; ``tracks`` (chains,)."""
    ids, track = np.unique(tracks, return_inverse=True)
    total, count = np.zeros((len(ids), *STRIP_SHAPE)), np.zeros(len(ids), np.int64)
    for target, source in ((total, strips.total[0]), (count, strips.count[0])):
        np.add.at(target, track, source)
    seen = np.flatnonzero(count)
    return TrackImages(ids[seen], total[seen] / count[seen, None, None], count[seen], strips.scale)


def measure_tracks(images: TrackImages) -> pd.DataFrame:
    """Dimensions by track (`DIMENSION_COLUMNS`)."""
    found = measure(images.strips)
    columns = {
        name: getattr(found, name.removesuffix("_px")) / images.scale
        for name in ("length_px", "length_sd_px", "width_px", "width_sd_px")
    }
    return pd.DataFrame({"track_id": images.ids, **columns, "strips": images.count})


def mean_grey(strips: StripSums, tracks: IntArray) -> pd.Series:
    """Mean grey level of the vehicle by track, from the middle of the strips of all chains of each; ``tracks``
    (chains,)."""
    along, across = STRIP_SHAPE[0] // 2, STRIP_SHAPE[1] // 2
    middle = strips.total[0][:, along - 2 : along + 2, across - 1 : across + 1].mean(axis=(1, 2))
    sums = pd.DataFrame({"grey": middle, "count": strips.count[0]}).groupby(tracks).sum()
    return sums["grey"] / sums["count"].replace(0, np.nan)


def certain_length(strips: StripSums) -> FloatArray:
    """(chains,) px: the mean less a standard deviation; NaN where unknown."""
    found = measure_tracks(images_of_tracks(strips, strips.ids)).set_index("track_id")
    length = (found["length_px"] - found["length_sd_px"]).reindex(strips.ids)
    return np.asarray(length, dtype=np.float64)
