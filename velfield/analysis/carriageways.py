"""Carriageways: where vehicles go the same way, with their direction and speeds."""

import math

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from velfield.analysis.regions import keep_large, label_smooth, region_table


def carriageways(
    direction_rad: NDArray[np.floating],
    count: NDArray[np.integer],
    *,
    speeds_px_per_s: dict[str, NDArray[np.floating]] | None = None,
    min_count: int = 3,
    max_step_rad: float = math.radians(15),
    min_area_px: int = 200,
) -> tuple[NDArray[np.int32], pd.DataFrame]:
    """Connected pixels whose direction changes smoothly: a carriageway may bend, its opposite is another.

    Parameters
    ----------
    direction_rad
        (h, w) modal direction; NaN where there is none.
    count
        (h, w) passages.
    speeds_px_per_s
        (h, w) speed layers by name (``p50``, ``p85``), of which the table gives medians.
    min_count
        Pixels of fewer passages are left out: a single tracklet is no lane.
    max_step_rad
        Largest change of direction from a pixel to the next.
    min_area_px
        Smaller regions are dropped.

    Returns
    -------
    labels
        (h, w) number of the carriageway, 0 where there is none.
    table
        A row each: ``region, x_px, y_px, area_px, passages, direction_rad`` (circular mean), ``straightness`` (1: all
        one direction, 0: round and round) and ``speed_<name>_px_per_s``.
    """
    direction = np.where(count >= min_count, direction_rad, np.nan).astype(np.float64)
    labels = keep_large(label_smooth(direction, max_step_rad), min_area_px=min_area_px)
    layers: dict[str, NDArray[np.floating]] = {"passages": np.asarray(count, np.float64)}
    for name, speed in (speeds_px_per_s or {}).items():
        layers[f"speed_{name}_px_per_s"] = speed
    table = region_table(labels, layers)
    size = len(table) + 1
    flat = labels.ravel()
    angle = np.nan_to_num(direction).ravel()
    cosine = np.bincount(flat, np.cos(angle), size)[1:]
    sine = np.bincount(flat, np.sin(angle), size)[1:]
    table["direction_rad"] = np.arctan2(sine, cosine)
    table["straightness"] = np.hypot(cosine, sine) / np.maximum(table["area_px"].to_numpy(), 1)
    return labels, table
