"""Stops: pixels where a part of the traffic is stationary."""

import numpy as np
from numpy.typing import NDArray

from velfield.analysis.regions import Regions, label_mask, region_table


def find_stops(
    stationary_fraction: NDArray[np.floating],
    count: NDArray[np.integer],
    *,
    min_fraction: float = 0.2,
    max_fraction: float = 0.9,
    min_count: int = 3,
    min_area_px: int = 30,
) -> Regions:
    """Regions where some vehicles are stationary and others are not: stop lines, queues, bus stops.

    Parameters
    ----------
    stationary_fraction
        (h, w) fraction of tracks that are stationary; NaN where empty.
    count
        (h, w) tracks.
    min_fraction, max_fraction
        Limits of the stationary fraction; above the upper one vehicles are parked.
    min_count
        Fewest tracks of a pixel.
    min_area_px
        Smaller regions are dropped, px.

    Returns
    -------
    Regions
        Medians in the table: ``tracks, stationary_fraction``; the largest number of tracks first.
    """
    fraction = np.nan_to_num(np.asarray(stationary_fraction, np.float64))
    mask = (count >= min_count) & (fraction >= min_fraction) & (fraction <= max_fraction)
    labels = label_mask(mask, min_area_px=min_area_px)
    table = region_table(labels, {"tracks": np.asarray(count, np.float64), "stationary_fraction": fraction})
    return Regions(labels, table.sort_values(["tracks", "region"], ascending=[False, True], ignore_index=True))
