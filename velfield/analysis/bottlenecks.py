"""Bottlenecks: pixels where traffic is much slower than upstream."""

import math

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from velfield.analysis.regions import Regions, label_mask, region_table

_SAME_DIRECTION_RAD = math.radians(45)
"""Upstream traffic of a direction that differs by more is on another carriageway."""


def find_bottlenecks(
    speed_px_per_s: NDArray[np.floating],
    direction_rad: NDArray[np.floating],
    count: NDArray[np.integer],
    *,
    distance_px: float,
    max_ratio: float = 0.6,
    min_count: int = 5,
    min_area_px: int = 30,
) -> Regions:
    """Regions where the speed is at most ``max_ratio`` of that ``distance_px`` upstream on the same carriageway.

    Parameters
    ----------
    speed_px_per_s
        (h, w) modal or median speed, px/s.
    direction_rad
        (h, w) modal direction; NaN where there is none.
    count
        (h, w) tracks.
    distance_px
        Distance upstream, against the direction, at which the speed is compared, px.
    max_ratio
        Largest ratio of the speed to that upstream.
    min_count
        Fewest tracks of a pixel.
    min_area_px
        Smaller regions are dropped, px.

    Returns
    -------
    Regions
        Medians in the table: ``tracks, speed_px_per_s, upstream_speed_px_per_s, ratio``; the smallest ratio first.
    """
    upstream = _upstream(speed_px_per_s, direction_rad, distance_px)
    known = np.isfinite(upstream) & np.isfinite(speed_px_per_s) & (upstream > 0) & (count >= min_count)
    ratio = np.divide(speed_px_per_s, upstream, out=np.full(upstream.shape, np.nan), where=known)
    labels = label_mask(known & (np.nan_to_num(ratio, nan=np.inf) <= max_ratio), min_area_px=min_area_px)
    layers: dict[str, NDArray[np.floating]] = {
        "tracks": np.asarray(count, np.float64),
        "speed_px_per_s": speed_px_per_s,
        "upstream_speed_px_per_s": upstream,
        "ratio": ratio,
    }
    return Regions(labels, region_table(labels, layers).sort_values(["ratio", "region"], ignore_index=True))


def _upstream(values: NDArray[np.floating], direction_rad: NDArray[np.floating], distance_px: float) -> FloatArray:
    """Values at a distance against the direction; NaN where none is known there, or of another direction."""
    height, width = values.shape
    y, x = np.nonzero(np.isfinite(direction_rad))
    direction = direction_rad[y, x]
    from_x = np.floor(x - distance_px * np.cos(direction) + 0.5).astype(np.int64)
    from_y = np.floor(y - distance_px * np.sin(direction) + 0.5).astype(np.int64)
    inside = (from_x >= 0) & (from_x < width) & (from_y >= 0) & (from_y < height)
    y, x, from_y, from_x, direction = y[inside], x[inside], from_y[inside], from_x[inside], direction[inside]
    same = np.cos(direction_rad[from_y, from_x] - direction) > math.cos(_SAME_DIRECTION_RAD)  # False for NaN
    out = np.full(values.shape, np.nan)
    out[y[same], x[same]] = values[from_y[same], from_x[same]]
    return out
