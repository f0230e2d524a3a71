"""Where traffic stops, and where it slows down."""

import math

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from velfield.analysis.regions import label_mask, region_table


def stopping_places(
    stationary_fraction: NDArray[np.floating],
    count: NDArray[np.integer],
    *,
    min_share: float = 0.2,
    max_share: float = 0.9,
    min_count: int = 3,
    min_area_px: int = 30,
) -> tuple[NDArray[np.int32], pd.DataFrame]:
    """Where some vehicles stand and others pass: stop lines, queues, bus stops. Where all stand, they are parked.

    Parameters
    ----------
    stationary_fraction
        (h, w) share of passages that stand.
    count
        (h, w) passages.

    Returns
    -------
    labels
        (h, w) number of the place, 0 where there is none.
    table
        A row each: ``region, x_px, y_px, area_px, passages, stationary_fraction``, the busiest first.
    """
    share = np.nan_to_num(np.asarray(stationary_fraction, np.float64))
    mask = (count >= min_count) & (share >= min_share) & (share <= max_share)
    labels = label_mask(mask, min_area_px=min_area_px)
    table = region_table(labels, {"passages": np.asarray(count, np.float64), "standing_share": share})
    return labels, table.sort_values(["passages", "region"], ascending=[False, True], ignore_index=True)


def bottlenecks(
    speed_px_per_s: NDArray[np.floating],
    direction_rad: NDArray[np.floating],
    count: NDArray[np.integer],
    *,
    distance_px: float,
    max_ratio: float = 0.6,
    min_count: int = 5,
    min_area_px: int = 30,
) -> tuple[NDArray[np.int32], pd.DataFrame]:
    """Where vehicles go much slower than ``distance_px`` before, on the same carriageway.

    Parameters
    ----------
    speed_px_per_s
        (h, w) speed: modal or median.
    direction_rad
        (h, w) modal direction.
    count
        (h, w) passages.
    distance_px
        How far back along the direction the speed is compared.
    max_ratio
        Speed here over speed before; below it, it is a bottleneck.

    Returns
    -------
    labels
        (h, w) number of the bottleneck, 0 where there is none.
    table
        A row each: ``region, x_px, y_px, area_px, passages, speed_px_per_s, speed_before_px_per_s, ratio``, the
        sharpest first.
    """
    before = _value_before(speed_px_per_s, direction_rad, distance_px)
    known = np.isfinite(before) & np.isfinite(speed_px_per_s) & (before > 0) & (count >= min_count)
    ratio = np.divide(speed_px_per_s, before, out=np.full(before.shape, np.nan), where=known)
    labels = label_mask(known & (np.nan_to_num(ratio, nan=9.0) <= max_ratio), min_area_px=min_area_px)
    layers: dict[str, NDArray[np.floating]] = {
        "passages": np.asarray(count, np.float64),
        "speed_px_per_s": speed_px_per_s,
        "speed_before_px_per_s": before,
        "ratio": ratio,
    }
    table = region_table(labels, layers)
    return labels, table.sort_values(["ratio", "region"], ignore_index=True)


def _value_before(
    values: NDArray[np.floating], direction_rad: NDArray[np.floating], distance_px: float
) -> NDArray[np.float64]:
    """The value a distance back along the direction; NaN where nothing is known there, or it goes another way."""
    height, width = values.shape
    y, x = np.nonzero(np.isfinite(direction_rad))
    direction = direction_rad[y, x]
    back_x = np.floor(x - distance_px * np.cos(direction) + 0.5).astype(np.int64)
    back_y = np.floor(y - distance_px * np.sin(direction) + 0.5).astype(np.int64)
    inside = (back_x >= 0) & (back_x < width) & (back_y >= 0) & (back_y < height)
    y, x, back_y, back_x, direction = y[inside], x[inside], back_y[inside], back_x[inside], direction[inside]
    same_way = np.cos(direction_rad[back_y, back_x] - direction) > math.cos(math.radians(45))  # NaN is never
    out = np.full(values.shape, np.nan)
    out[y[same_way], x[same_way]] = values[back_y[same_way], back_x[same_way]]
    return out
